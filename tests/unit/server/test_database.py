"""Transactions: retries, translation of errors, and the clock."""

import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import psycopg
import pytest
import sqlalchemy
import sqlalchemy.exc
from sqlalchemy import Column
from sqlalchemy.engine.default import DefaultDialect

from marey_server.access.principal import SYSTEM
from marey_server.errors import ClientGoneProblem, InvalidProblem, StorageFullProblem, UnavailableProblem
from marey_server.store.database import opening
from marey_server.store.database.clock import DatabaseClock
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import Client
from marey_server.store.tables import server_state, user
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

on_sqlite = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
on_postgres = pytest.mark.parametrize("database_url", ["postgres"], indirect=True)


def add_user(tx: Transaction, name: str = "u") -> None:
    row = {"id": f"user_{name}", "name": name, "administrator": False, "disabled": False, "created_us": 0, "rev": 1}
    tx.execute(sqlalchemy.insert(user).values(**row))


def add_large_row(tx: Transaction, key: str) -> None:
    tx.execute(tx.insert_or_ignore(server_state, {"key": key, "value": "x" * 300_000}))


def user_names(tx: Transaction) -> list[str]:
    return sorted(tx.execute(sqlalchemy.select(user.c.name)).scalars())


def test_a_write_that_fails_leaves_nothing(database: Database) -> None:
    def fail(tx: Transaction) -> None:
        add_user(tx)
        raise KeyError("on the way")

    with pytest.raises(KeyError):
        database.write(SYSTEM, fail)
    assert database.read(SYSTEM, user_names) == []


def test_a_failure_says_nothing_of_what_was_to_be_written(database: Database) -> None:
    def add_twice(tx: Transaction) -> None:
        add_user(tx)
        row = {"id": "user_u", "name": "ann", "password_hash": "scrypt$canary", "created_us": 0}
        tx.execute(sqlalchemy.insert(user), row)

    with pytest.raises(sqlalchemy.exc.IntegrityError) as failed:
        database.write(SYSTEM, add_twice)
    assert "INSERT INTO" in str(failed.value)
    assert "canary" not in str(failed.value)


def test_a_read_cannot_write(database: Database) -> None:
    with pytest.raises((sqlalchemy.exc.DBAPIError, UnavailableProblem)):
        database.read(SYSTEM, add_user)
    assert database.read(SYSTEM, user_names) == []


def test_a_read_sees_one_state_throughout(database: Database) -> None:
    def look(tx: Transaction) -> tuple[list[Any], list[Any]]:
        before = user_names(tx)
        thread = threading.Thread(target=database.write, args=(SYSTEM, add_user))
        thread.start()
        thread.join(30)
        return before, user_names(tx)

    assert database.read(SYSTEM, look) == ([], [])
    assert database.read(SYSTEM, user_names) == ["u"]


def test_a_read_for_a_client_that_has_gone_stops_before_its_next_statement(database: Database) -> None:
    gone, one = threading.Event(), sqlalchemy.select(sqlalchemy.literal(1))

    def read(tx: Transaction) -> None:
        assert tx.execute(one).scalar_one() == 1
        gone.set()
        with pytest.raises(ClientGoneProblem):
            tx.execute(one)
        tx.beside(SYSTEM).execute(one)

    reading = database.queue_read(Client("ada", is_gone=gone.is_set), SYSTEM, read)
    with pytest.raises(ClientGoneProblem):
        reading.result(60)


def test_what_waits_for_the_commit_runs_once_after_it_and_not_after_a_failure(database: Database) -> None:
    heard = []

    def work(tx: Transaction, fail: bool) -> None:
        add_user(tx, "fails" if fail else "works")
        tx.after_commit(lambda: heard.append(database.read(SYSTEM, user_names)))
        if fail:
            raise KeyError("on the way")

    with pytest.raises(KeyError):
        database.write(SYSTEM, work, True)
    database.write(SYSTEM, work, False)
    assert heard == [["works"]]


def test_writes_from_many_threads_all_happen(database: Database) -> None:
    futures = [database.submit_write(SYSTEM, add_user, f"u{number:02d}") for number in range(40)]
    threads = [threading.Thread(target=database.write, args=(SYSTEM, add_user, f"t{number}")) for number in range(8)]
    for thread in threads:
        thread.start()
    for future in futures:
        future.result(60)
    for thread in threads:
        thread.join(60)
    assert len(database.read(SYSTEM, user_names)) == 48


@on_postgres
def test_a_deadlock_is_resolved_by_trying_again(database: Database) -> None:
    def add_both(tx: Transaction) -> None:
        for name in "ab":
            add_user(tx, name)

    database.write(SYSTEM, add_both)
    both = threading.Barrier(2)
    met = threading.Event()

    def cross(tx: Transaction, first: str, second: str) -> None:
        tx.execute(sqlalchemy.update(user).where(user.c.name == first).values(rev=user.c.rev + 1))
        if not met.is_set():
            both.wait(60)
            met.set()
        tx.execute(sqlalchemy.update(user).where(user.c.name == second).values(rev=user.c.rev + 1))

    futures = [database.submit_write(SYSTEM, cross, *pair) for pair in (("a", "b"), ("b", "a"))]
    for future in futures:
        future.result(60)
    revs = database.read(SYSTEM, lambda tx: tx.execute(sqlalchemy.select(user.c.rev)).scalars().all())
    assert revs == [3, 3]


def break_connection(tx: Transaction) -> None:
    tx.connection.exec_driver_sql("SELECT pg_terminate_backend(pg_backend_pid())")


@on_postgres
def test_a_broken_connection_is_replaced_and_the_work_done_again(database: Database) -> None:
    tries = []

    def work(tx: Transaction) -> None:
        tries.append(1)
        if len(tries) == 1:
            break_connection(tx)
        add_user(tx)

    database.write(SYSTEM, work)
    assert (len(tries), database.read(SYSTEM, user_names)) == (2, ["u"])

    def look(tx: Transaction) -> list[str]:
        tries.append(1)
        if len(tries) == 3:
            break_connection(tx)
        return user_names(tx)

    assert database.read(SYSTEM, look) == ["u"]


@on_postgres
def test_a_commit_whose_answer_is_lost_is_not_done_twice(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    """The answer is lost after the commit: the row exists, and was not written a second time."""
    tries = []

    def work(tx: Transaction) -> None:
        tries.append(1)
        add_user(tx, f"u{len(tries)}")

    real_commit = DefaultDialect.do_commit

    def commit_then_lose(self: DefaultDialect, connection: Any) -> None:
        real_commit(self, connection)
        connection.driver_connection.close()
        raise psycopg.OperationalError("server closed the connection unexpectedly")

    with monkeypatch.context() as lossy:
        lossy.setattr(type(database.engine.dialect), "do_commit", commit_then_lose)
        with pytest.raises(UnavailableProblem):
            database.write(SYSTEM, work)
    assert database.read(SYSTEM, user_names) == ["u1"]


def test_a_database_that_is_not_there_is_unavailable() -> None:
    database = Database("postgresql://nobody@127.0.0.1:1/none")
    for run in (database.read, database.write):
        with pytest.raises(UnavailableProblem) as refused:
            run(SYSTEM, user_names)
        assert refused.value.headers["Retry-After"]
        assert "127.0.0.1" not in refused.value.detail
    database.close()


@on_sqlite
def test_a_full_database_says_so_and_keeps_what_was_there(database: Database) -> None:
    database.write(SYSTEM, add_user, "before")

    def too_much(tx: Transaction) -> None:
        tx.connection.exec_driver_sql("PRAGMA max_page_count = 1")
        for number in range(5000):
            add_user(tx, f"{number:050d}")

    with pytest.raises(StorageFullProblem):
        database.write(SYSTEM, too_much)
    database.engine.dispose()
    assert database.read(SYSTEM, user_names) == ["before"]
    database.write(SYSTEM, add_user, "after")


@pytest.mark.parametrize(("column", "value"), [(user.c.name, "\ud800"), (user.c.rev, 2**80), (user.c.rev, -(2**80))])
def test_values_beyond_what_can_be_stored_are_the_callers_mistake(
    database: Database, column: Column[Any], value: int | str
) -> None:
    def write(tx: Transaction) -> None:
        tx.execute(sqlalchemy.update(user).values({column: value}))

    with pytest.raises(InvalidProblem):
        database.write(SYSTEM, write)


@on_postgres
def test_postgres_knows_who_connects_and_does_not_wait_for_ever(database: Database) -> None:
    settings = database.read(
        SYSTEM,
        lambda tx: [
            tx.connection.exec_driver_sql(f"SHOW {name}").scalar()
            for name in ("application_name", "lock_timeout", "idle_in_transaction_session_timeout")
        ],
    )
    assert settings == ["marey", "30s", "5min"]


# -- the clock --------------------------------------------------------------------------------------------------------

HOUR_NS = 3600 * 10**9


def now(database: Database) -> int:
    return database.write(SYSTEM, lambda tx: tx.now_us)


@pytest.fixture
def with_own_clock(database_url: str) -> Iterator[Callable[..., Any]]:
    opened = []

    def open_one() -> Database:
        opened.append(Database(database_url, clock=DatabaseClock()))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


@pytest.mark.parametrize("jump_ns", [HOUR_NS, -HOUR_NS])
def test_a_jump_of_the_wall_clock_is_not_felt(
    with_own_clock: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, jump_ns: int
) -> None:
    database = with_own_clock()
    before = now(database)
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + jump_ns)
    assert 0 <= now(database) - before < 60_000_000


def test_a_restart_with_a_clock_set_back_does_not_go_back(
    with_own_clock: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = with_own_clock()
    latest = max(now(first) for _ in range(5))
    first.close()
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() - HOUR_NS)
    again = now(with_own_clock())
    assert latest <= again < latest + 60_000_000


@on_sqlite
def test_a_restart_with_a_clock_set_forward_follows_it(
    with_own_clock: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = with_own_clock()
    before = now(first)
    first.close()
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + HOUR_NS)
    # A new database may be ahead of the machine by the time that its clock has reserved.
    assert now(with_own_clock()) - before >= HOUR_NS // 1000 - 60_000_000


def test_time_does_not_pass_within_a_transaction(database: Database) -> None:
    def look(tx: Transaction) -> int:
        first = tx.now_us
        time.sleep(0.01)
        return tx.now_us - first

    assert database.write(SYSTEM, look) == 0


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_a_write_follows_one_whose_commit_found_the_disk_full(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Postgres itself ends a transaction whose commit fails."""

    def commit(_dialect: DefaultDialect, _connection: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(DefaultDialect, "do_commit", commit)
        with pytest.raises(StorageFullProblem):
            database.write(SYSTEM, add_user)
    database.write(SYSTEM, add_user)
    assert database.read(SYSTEM, user_names) == ["u"]


def test_reasons_of_drivers_contain_no_numbers_of_errors() -> None:
    error = OSError("failed to resolve host 'db.invalid': [Errno -2] Name or service not known")
    assert opening._reason(error) == "failed to resolve host 'db.invalid': Name or service not known"
