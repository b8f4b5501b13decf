"""Prepared statements return the same rows as SQLAlchemy itself, and raise the same errors."""

import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psycopg
import pytest
from sqlalchemy import bindparam, delete, exc, false, insert, select, tuple_, update
from tests.support.present import present

from marey_server import store
from marey_server.access.principal import SYSTEM
from marey_server.store.database import prepared
from marey_server.store.database.connections import Database
from marey_server.store.database.prepared import Prepared, run_text
from marey_server.store.tables import event, user
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

on_postgres = pytest.mark.parametrize("database_url", ["postgres"], indirect=True)

ADD = Prepared(insert(event))
ALL = select(event).order_by(event.c.seq)
SOME = Prepared(ALL.where(event.c.kind.in_(bindparam("kinds", expanding=True))))


def row(kind: str = "made", **others: Any) -> dict[str, Any]:
    return {"at_us": 7, "kind": kind, "subject": "clip_1", "actor": None, "body": {"é": [1, None]}} | others


def test_what_is_inserted_is_what_sqlalchemy_inserts(database: Database) -> None:
    def both(tx: Transaction) -> list[tuple[Any, ...]]:
        tx.run(ADD, row())
        tx.execute(insert(event), row())
        return [one[1:] for one in tx.execute(ALL).all()]

    ours, theirs = database.write(SYSTEM, both)
    assert ours == theirs


def test_an_insert_takes_the_columns_that_are_named_this_time(database: Database) -> None:
    somebody = {"id": "user_ann", "name": "ann", "created_us": 7}
    add = Prepared(insert(user))

    def both(tx: Transaction) -> list[Any]:
        tx.run(add, {**somebody, "administrator": True})
        tx.run(add, {**somebody, "id": "user_ben", "name": "ben", "disabled": True})
        return list(tx.execute(select(user.c.administrator, user.c.disabled).order_by(user.c.name)).all())

    assert database.write(SYSTEM, both) == [(True, False), (False, True)]


def test_rows_hold_what_sqlalchemy_reads(database: Database) -> None:
    people = [
        {"id": f"user_{name}", "name": name, "administrator": name == "ann", "created_us": 2**50}
        for name in ("ann", "ben")
    ]
    everybody = select(user).order_by(user.c.name)

    def both(tx: Transaction) -> tuple[list[Any], list[Any]]:
        tx.run_each(Prepared(insert(user)), people)
        return list(tx.run(Prepared(everybody), {})), list(tx.execute(everybody).all())

    ours, theirs = database.write(SYSTEM, both)
    assert [one._asdict() for one in ours] == [dict(one._mapping) for one in theirs]
    assert [one.administrator for one in ours] == [True, False]


@pytest.mark.parametrize("kinds", [[], ["made"], ["made", "gone"], ["gone", "other"]])
def test_lists_of_any_length_are_taken(database: Database, kinds: list[str]) -> None:
    def one(tx: Transaction) -> list[str]:
        tx.run_each(ADD, [row("made"), row("gone"), row("kept")])
        return [found.kind for found in tx.run(SOME, {"kinds": kinds})]

    assert database.write(SYSTEM, one) == [kind for kind in ("made", "gone") if kind in kinds]


def test_lists_of_pairs_and_lists_in_the_statement_itself(database: Database) -> None:
    pairs = tuple_(event.c.kind, event.c.subject).in_(bindparam("pairs", expanding=True))
    statement = Prepared(ALL.where(pairs, event.c.subject.in_(["a", "b"]), event.c.at_us >= bindparam("since")))

    def one(tx: Transaction) -> list[list[str]]:
        tx.run_each(ADD, [row("made", subject=subject) for subject in "abc"])
        wanted = [[("made", "a")], [("made", "a"), ("made", "b"), ("made", "c")]]
        return [[found.subject for found in tx.run(statement, {"pairs": some, "since": 7})] for some in wanted]

    assert database.write(SYSTEM, one) == [["a"], ["a", "b"]]


def test_only_so_many_texts_are_kept(database: Database) -> None:
    statement = Prepared(ALL.where(event.c.kind.in_(bindparam("kinds", expanding=True))))

    def many(tx: Transaction) -> None:
        tx.run(ADD, row())
        for length in range(1, 2 * prepared.MOST_FORMS):
            assert len(tx.run(statement, {"kinds": ["made"] * length})) == 1

    database.write(SYSTEM, many)
    assert len(statement._forms) <= prepared.MOST_FORMS


def test_an_update_gives_the_rows_that_it_changed(database: Database) -> None:
    retired = Prepared(
        update(user)
        .where(user.c.name == bindparam("who"), user.c.disabled == false())
        .values(disabled=True, rev=user.c.rev + 1)
        .returning(user.c.name, user.c.disabled, user.c.rev)
    )

    def twice(tx: Transaction) -> tuple[list[Any], list[Any], None]:
        tx.run(Prepared(insert(user)), {"id": "user_1", "name": "ann", "created_us": 0})
        return tx.run(retired, {"who": "ann"}), tx.run(retired, {"who": "ann"}), tx.first(retired, {"who": "ann"})

    ((ann,), again, nobody) = database.write(SYSTEM, twice)
    assert (ann.name, ann.disabled, ann.rev) == ("ann", True, 2)
    assert again == []
    assert nobody is None


def test_a_parameter_that_the_statement_does_not_have_is_a_fault(database: Database) -> None:
    statement = Prepared(delete(event).where(event.c.seq == bindparam("which")))
    database.write(SYSTEM, lambda tx: tx.run(statement, {"which": 1}))
    with pytest.raises(TypeError, match="whom"):
        database.write(SYSTEM, lambda tx: tx.run(statement, {"which": 1, "whom": 2}))


def test_a_refusal_of_the_database_is_the_error_that_sqlalchemy_raises_without_values(database: Database) -> None:
    someone = {"id": "user_1", "name": "a secret", "created_us": 0}
    with pytest.raises(exc.IntegrityError) as failed:
        database.write(SYSTEM, lambda tx: tx.run_each(Prepared(insert(user)), [someone, someone]))
    assert "a secret" not in str(failed.value).partition("DETAIL")[0]
    assert not failed.value.connection_invalidated
    assert database.read(SYSTEM, lambda tx: tx.execute(select(user)).all()) == []


@on_postgres
def test_after_a_restart_of_the_database_every_resting_connection_is_made_anew(database: Database) -> None:
    resting = [database.engine.connect() for _ in range(8)]  # all of the pool
    for connection in resting:
        connection.exec_driver_sql("SELECT 1")
    for connection in resting:
        connection.close()
    others = "datname = current_database() AND application_name = 'marey' AND pid <> pg_backend_pid()"
    with database.engine.connect() as connection:
        run_text(connection, f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {others}")
    assert database.read(SYSTEM, lambda tx: tx.run(SOME, {"kinds": ["made"]})) == []


@on_postgres
def test_a_broken_connection_is_told_as_such(database: Database) -> None:
    with database.engine.connect() as connection:
        present(connection.connection.driver_connection).close()
        with pytest.raises(exc.DBAPIError) as failed:
            SOME.run(connection, {"kinds": ["made"]})
    assert failed.value.connection_invalidated
    assert isinstance(failed.value.orig, psycopg.OperationalError)


def prepared_statements() -> Iterator[str]:
    """Yield the names of all prepared statements of the store, by module."""
    for module in pkgutil.walk_packages(store.__path__, "marey_server.store."):
        for name, value in vars(importlib.import_module(module.name)).items():
            kept = value.values() if isinstance(value, dict) else (value,)
            if any(isinstance(one, Prepared) for one in kept):
                yield f"{module.name.removeprefix('marey_server.store.')}.{name}"


def test_only_statements_with_a_measured_gain_are_prepared() -> None:
    """The decision record lists all prepared statements; measure the gain of a new one, and add it to the record."""
    record = Path("docs/decisions/0012-prepared-statements.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `([\w.]+)` \|", record, re.MULTILINE)
    assert sorted(set(prepared_statements())) == sorted(listed)
