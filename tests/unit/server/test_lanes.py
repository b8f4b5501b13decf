"""Lanes of threads: clients take turns, queues are limited, and calls of disconnected clients are skipped."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Iterator

import pytest
from tests.support.patience import PATIENCE_S

from marey_server.errors import ClientGoneProblem, StoppingProblem, UnavailableProblem
from marey_server.store.database.lanes import SERVER, Client, FairLine, Lane

ANNA, BEN = Client("anna"), Client("ben")
STRANGER, OTHER = Client("192.0.2.1", known=False), Client("192.0.2.2", known=False)


@pytest.fixture
def release() -> Iterator[threading.Event]:
    """An event for which calls of a test wait; if the test does not set it, it is set after the test."""
    event = threading.Event()
    yield event
    event.set()


def test_clients_take_turns_and_so_do_known_ones_and_strangers() -> None:
    line: FairLine[str] = FairLine()
    for client, name in [(ANNA, "a1"), (ANNA, "a2"), (ANNA, "a3"), (BEN, "b1"), (STRANGER, "s1"), (OTHER, "o1")]:
        line.put(client, name)
    assert [line.take() for _ in range(7)] == ["a1", "s1", "b1", "o1", "a2", "a3", None]


def test_who_may_not_run_is_passed_over() -> None:
    line: FairLine[str] = FairLine()
    line.put(ANNA, "a1")
    line.put(BEN, "b1")
    assert line.take(lambda client: client is not ANNA) == "b1"
    assert line.take(lambda client: client is not ANNA) is None
    assert line.take() == "a1"


def test_a_full_line_refuses_and_says_when_to_come_back() -> None:
    line: FairLine[int] = FairLine(most_waiting=3, most_each=2)
    for number in range(2):
        line.put(ANNA, number)
    with pytest.raises(UnavailableProblem) as own_share:
        line.put(ANNA, 2)
    line.put(BEN, 2)
    with pytest.raises(UnavailableProblem):
        line.put(Client("carl"), 3)
    line.put(STRANGER, 3)  # their line is another
    assert (own_share.value.error_code, int(own_share.value.headers["Retry-After"]) > 0) == ("busy", True)
    assert len(line) == 4


def test_one_client_and_all_strangers_leave_a_thread_to_others(release: threading.Event) -> None:
    lane = Lane("test", 3, most_each=2)
    held = [lane.submit(client, release.wait, PATIENCE_S) for client in (STRANGER, OTHER, STRANGER, OTHER)]
    assert lane.submit(ANNA, lambda: "quick").result(PATIENCE_S) == "quick"
    release.set()
    assert all(future.result(PATIENCE_S) for future in held)
    lane.close()


def test_calls_of_the_server_itself_may_use_all_threads() -> None:
    lane, both = Lane("test", 2, most_each=1), threading.Barrier(2)
    calls = [lane.submit(SERVER, both.wait, PATIENCE_S) for _ in range(2)]
    assert {call.result(PATIENCE_S) for call in calls} == {0, 1}
    lane.close()


def test_nothing_is_begun_for_a_client_that_has_gone(release: threading.Event) -> None:
    lane, gone, begun = Lane("test", 1), threading.Event(), threading.Event()
    held = lane.submit(ANNA, release.wait, PATIENCE_S)
    waiting = lane.submit(Client("ben", is_gone=gone.is_set), begun.set)
    gone.set()
    release.set()
    with pytest.raises(ClientGoneProblem):
        waiting.result(PATIENCE_S)
    assert held.result(PATIENCE_S)
    assert not begun.is_set()
    lane.close()


def test_a_cancelled_call_is_not_begun(release: threading.Event) -> None:
    lane, begun = Lane("test", 1), threading.Event()
    lane.submit(ANNA, release.wait, PATIENCE_S)
    assert lane.submit(ANNA, begun.set).cancel()
    release.set()
    assert lane.submit(ANNA, lambda: "next").result(PATIENCE_S) == "next"
    assert not begun.is_set()
    lane.close()


def test_the_end_of_an_iteration_is_an_error_that_event_loops_accept() -> None:
    lane = Lane("test", 1)
    error = lane.submit(ANNA, next, iter(())).exception(PATIENCE_S)
    assert isinstance(error, RuntimeError)
    assert isinstance(error.__cause__, StopIteration)
    lane.close()


def test_closing_without_waiting_refuses_what_is_queued(release: threading.Event) -> None:
    lane = Lane("test", 1)
    running = lane.submit(ANNA, release.wait, PATIENCE_S)
    queued = lane.submit(BEN, release.wait, PATIENCE_S)
    lane.close(wait=False)
    refusal = queued.exception(0)
    assert isinstance(refusal, StoppingProblem)
    assert "Retry-After" in refusal.headers
    release.set()
    assert running.result(PATIENCE_S)


def test_a_closed_lane_says_that_the_server_is_stopping() -> None:
    lane = Lane("test", 1)
    lane.close()
    with pytest.raises(UnavailableProblem) as refused:
        lane.submit(ANNA, print)
    assert refused.value.error_code == "draining"


class Tree:
    """Decoded body of a request."""


def test_a_refused_call_keeps_nothing_that_its_functions_used() -> None:
    """Bodies that a refused call keeps can be freed only by the garbage collector, which stops all threads."""
    trees: list[weakref.ref[Tree]] = []

    def check(tree: Tree) -> None:
        trees.append(weakref.ref(tree))
        raise ValueError("not allowed")

    def refuse() -> None:
        tree = Tree()
        try:
            check(tree)
        except ValueError:
            raise UnavailableProblem("Not now.") from None

    lane = Lane("test", 1)
    gc.disable()
    try:
        future = lane.submit(ANNA, refuse)
        error = future.exception(PATIENCE_S)
        lane.close()
        assert isinstance(error, UnavailableProblem)
        assert trees[0]() is None
        kept = weakref.ref(future)
        del future, error
        assert kept() is None
    finally:
        gc.enable()
        lane.close()
