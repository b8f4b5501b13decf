"""Writes that wait at the same time, and then share one commit."""

import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Any

import pytest
import sqlalchemy

from marey_server.access.principal import SYSTEM
from marey_server.errors import ConflictProblem, UnavailableProblem
from marey_server.store.database.connections import Database
from marey_server.store.tables import user
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)


def add_user(tx: Transaction, name: str) -> str:
    row = {"id": f"user_{name}", "name": name, "administrator": False, "disabled": False, "created_us": 0, "rev": 1}
    tx.execute(sqlalchemy.insert(user).values(**row))
    return name


def user_names(database: Database) -> list[str]:
    return database.read(SYSTEM, lambda tx: sorted(tx.execute(sqlalchemy.select(user.c.name)).scalars()))


@pytest.fixture
def submit_all(database: Database) -> Callable[..., Any]:
    """Function that submits writes while another write runs, so that all of them wait; returns the futures."""

    def submit(*functions: Any) -> list[Future[Any]]:
        let_go = threading.Event()
        holding = database.submit_write(SYSTEM, lambda tx: let_go.wait(30))
        futures = [database.submit_write(SYSTEM, function) for function in functions]
        let_go.set()
        holding.result(30)
        return futures

    return submit


def adding(name: str) -> Callable[..., Any]:
    return lambda tx: add_user(tx, name)


def test_writes_that_waited_all_happen_and_each_hears_its_own_answer(
    database: Database, submit_all: Callable[..., Any]
) -> None:
    names = [f"u{number:02d}" for number in range(40)]
    assert [future.result(30) for future in submit_all(*map(adding, names))] == names
    assert user_names(database) == names


def test_a_refused_write_leaves_nothing_and_disturbs_no_other(
    database: Database, submit_all: Callable[..., Any]
) -> None:
    def refused(tx: Transaction) -> None:
        add_user(tx, "refused")
        raise ConflictProblem("not you")

    first, second, third = submit_all(adding("a"), refused, adding("b"))
    assert (first.result(30), third.result(30)) == ("a", "b")
    with pytest.raises(ConflictProblem, match="not you"):
        second.result(30)
    assert user_names(database) == ["a", "b"]


def test_a_write_that_breaks_leaves_nothing_and_the_others_happen_once(
    database: Database, submit_all: Callable[..., Any]
) -> None:
    def broken(tx: Transaction) -> None:
        add_user(tx, "broken")
        raise KeyError("a fault of ours")

    first, second, third = submit_all(adding("a"), broken, adding("b"))
    assert (first.result(30), third.result(30)) == ("a", "b")
    with pytest.raises(KeyError):
        second.result(30)
    assert user_names(database) == ["a", "b"]


def test_what_follows_a_commit_sees_it_and_follows_no_refusal(
    database: Database, submit_all: Callable[..., Any]
) -> None:
    heard = []

    def heard_of(name: str, *, refuse: bool = False) -> Callable[..., Any]:
        def write(tx: Transaction) -> None:
            tx.after_commit(lambda: heard.append((name, user_names(database))))
            add_user(tx, name)
            if refuse:
                raise ConflictProblem("not you")

        return write

    futures = submit_all(heard_of("a"), heard_of("b", refuse=True), heard_of("c"))
    for future in futures:
        future.exception(30)
    assert heard == [("a", ["a", "c"]), ("c", ["a", "c"])]


def test_a_failure_after_the_commit_writes_nothing_twice(database: Database, submit_all: Callable[..., Any]) -> None:
    tries: list[int] = []

    def fail() -> None:
        raise KeyError("nothing")

    def write(tx: Transaction) -> None:
        tries.append(1)
        add_user(tx, "a")
        tx.after_commit(fail)

    failed, fine = submit_all(write, adding("b"))
    with pytest.raises(KeyError):
        failed.result(30)
    assert fine.result(30) == "b"
    assert (user_names(database), len(tries)) == (["a", "b"], 1)


def test_a_write_that_was_cancelled_while_it_waited_does_not_happen(database: Database) -> None:
    let_go = threading.Event()
    holding = database.submit_write(SYSTEM, lambda tx: let_go.wait(30))
    cancelled, kept = (database.submit_write(SYSTEM, adding(name)) for name in ("cancelled", "kept"))
    assert cancelled.cancel()
    let_go.set()
    holding.result(30)
    assert kept.result(30) == "kept"
    with pytest.raises(CancelledError):
        cancelled.result(0)
    assert user_names(database) == ["kept"]


def test_a_closed_lane_says_that_the_server_is_stopping_and_writes_nothing(
    database: Database, database_url: str
) -> None:
    database.close()
    with pytest.raises(UnavailableProblem) as refused:
        database.submit_write(SYSTEM, adding("late"))
    assert refused.value.error_code == "draining"
    other = Database(database_url)
    assert "late" not in user_names(other)
    other.close()
