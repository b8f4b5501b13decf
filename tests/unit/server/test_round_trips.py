"""Round trips between the server and Postgres: a round trip costs more time than the statement that it sends."""

import tempfile
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from sqlalchemy import Integer, bindparam, exc, func, select, text
from tests.support.store_fixtures import READ, Lab, requiring

from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.store import items
from marey_server.store.database.connections import Database
from marey_server.store.database.prepared import Prepared
from marey_server.store.tables import server_state
from marey_server.store.transaction import Transaction

on_postgres = pytest.mark.parametrize("database_url", ["postgres"], indirect=True)

STATE = Prepared(select(server_state.c.value).where(server_state.c.key == bindparam("key")))
QUOTIENT = Prepared(select(func.div(1, bindparam("divisor"), type_=Integer)))
PREPARED = text("SELECT count(*) FROM pg_prepared_statements WHERE statement LIKE 'SELECT server_state.value%'")
OFTEN = 8
"""Number of runs after which the driver has prepared a statement; it does so at the sixth run."""


def round_trips(database: Database, run: Callable[[], object]) -> int:
    """Return the number of round trips that `run` makes on the only connection of a database."""
    with tempfile.TemporaryFile() as trace, database.engine.connect() as connection:
        driver: Any = connection.connection.driver_connection
        connection.close()
        driver.pgconn.trace(trace.fileno())
        try:
            run()
        finally:
            driver.pgconn.untrace()  # this also writes what the trace has buffered
        trace.seek(0)
        return trace.read().count(b"ReadyForQuery")


def find_state(tx: Transaction, key: str) -> list[Any]:
    return tx.run(STATE, {"key": key})


def refuse(tx: Transaction) -> None:
    find_state(tx, "nothing")
    raise NotFoundProblem("There is nothing.")


@on_postgres
def test_a_read_begins_and_asks_for_the_time_in_one_round_trip(database: Database) -> None:
    def look(tx: Transaction) -> int:
        find_state(tx, "nothing")
        return tx.now_us

    before_us = database.write(SYSTEM, look)
    assert before_us < database.read(SYSTEM, look) < database.write(SYSTEM, look)
    assert round_trips(database, lambda: database.read(SYSTEM, look)) == 3  # begin and time, statement, commit


@on_postgres
@pytest.mark.parametrize("kind", ["read", "write"])
def test_a_refusal_keeps_the_statements_that_are_prepared(database: Database, kind: str) -> None:
    def run() -> None:
        with pytest.raises(NotFoundProblem):
            (database.read if kind == "read" else database.write)(SYSTEM, refuse)

    for _ in range(OFTEN):
        run()
    assert database.read(SYSTEM, lambda tx: tx.execute(PREPARED).scalar_one()) == 1
    assert round_trips(database, run) == 3


def test_a_refused_write_leaves_nothing_and_the_next_one_is_not_part_of_it(database: Database) -> None:
    def add(tx: Transaction, key: str) -> None:
        tx.execute(tx.insert_or_ignore(server_state, {"key": key, "value": "1"}))

    def add_and_refuse(tx: Transaction) -> None:
        add(tx, "refused")
        raise NotFoundProblem("There is nothing.")

    for key in ("first", "second"):
        with pytest.raises(NotFoundProblem):
            database.write(SYSTEM, add_and_refuse)
        database.write(SYSTEM, add, key)
    kept = [database.read(SYSTEM, find_state, key) for key in ("first", "refused", "second")]
    assert [len(rows) for rows in kept] == [1, 0, 1]


def test_a_read_after_a_refused_one_sees_what_was_written_in_between(database: Database) -> None:
    with pytest.raises(NotFoundProblem):
        database.read(SYSTEM, refuse)
    database.write(
        SYSTEM, lambda tx: tx.execute(tx.insert_or_ignore(server_state, {"key": "k", "value": "1"})).rowcount
    )
    assert len(database.read(SYSTEM, find_state, "k")) == 1


def test_statements_run_together_return_what_each_returns_alone(database: Database) -> None:
    def both(tx: Transaction) -> tuple[list[list[Any]], list[list[Any]]]:
        for key, value in (("a", "1"), ("b", "2")):
            tx.execute(tx.insert_or_ignore(server_state, {"key": key, "value": value}))
        runs: list[tuple[Prepared, Mapping[str, Any]]] = [(STATE, {"key": key}) for key in ("b", "nothing", "a")]
        return tx.run_together(*runs), [tx.run(statement, values) for statement, values in runs]

    together, alone = database.write(SYSTEM, both)
    assert together == alone
    assert [[row.value for row in rows] for rows in together] == [["2"], [], ["1"]]
    assert database.read(SYSTEM, Transaction.run_together) == []


@on_postgres
def test_an_error_of_statements_run_together_is_translated_and_the_connection_goes_on(database: Database) -> None:
    def divide(tx: Transaction) -> None:
        tx.run_together((STATE, {"key": "a"}), (QUOTIENT, {"divisor": 0}), (STATE, {"key": "b"}))

    for run in (database.read, database.write):
        with pytest.raises(InvalidProblem, match="cannot store") as failed:
            run(SYSTEM, divide)
        assert isinstance(failed.value.__cause__, exc.DataError)
        assert database.read(SYSTEM, find_state, "nothing") == []


@on_postgres
def test_a_refused_write_on_a_broken_connection_runs_again_on_another_one(database: Database) -> None:
    runs = 0

    def lose_once_and_refuse(tx: Transaction) -> None:
        nonlocal runs
        runs += 1
        driver: Any = tx.connection.connection.driver_connection
        if runs == 1:
            driver.close()
        raise NotFoundProblem("There is nothing.")

    with pytest.raises(NotFoundProblem):
        database.write(SYSTEM, lose_once_and_refuse)
    assert runs == 2


@on_postgres
def test_an_item_is_read_in_five_round_trips(lab: Lab) -> None:
    rig = lab.add_skeleton()

    def read() -> Any:
        return lab.database.read(lab.reader, requiring(READ, items.read_item), "lab", Kind.SKELETON, rig.id)

    assert read() == rig
    assert round_trips(lab.database, read) == 5  # begin, project, item, its tags and parts and facets, commit
