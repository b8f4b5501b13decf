"""Rows of the benchmark of versions, and its proxy that counts bytes."""

from __future__ import annotations

import socket
import threading

import pytest
from benchmarks.versions import operations, peers
from benchmarks.versions.counting import CountingProxy
from benchmarks.versions.operations import Job, Measured, Written
from benchmarks.versions.peers import PeerTimes

BRANCHES = Job("branch", 30, of_p90=True)
NOTHING = Written(0.0, None)


def test_a_proxy_counts_the_bytes_of_both_directions() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        answering = threading.Thread(target=answer_once, args=(listener, b"four"))
        answering.start()
        with CountingProxy(listener.getsockname()[1]) as proxy:
            port = int(proxy.url.rpartition(":")[2])
            with socket.create_connection(("127.0.0.1", port)) as caller:
                caller.sendall(b"question")
                answer = caller.recv(100)
            answering.join()
            counted, later = proxy.take_count(), proxy.take_count()

    assert (answer, counted, later) == (b"four", 12, 0)


def answer_once(listener: socket.socket, answer: bytes) -> None:
    """Read eight bytes from one connection, and answer."""
    with listener.accept()[0] as connection:
        assert connection.recv(8, socket.MSG_WAITALL) == b"question"
        connection.sendall(answer)


def test_a_row_shows_the_growth_from_the_smallest_size_and_judges_the_goal_of_the_job() -> None:
    few, many = Measured({"branch": [10.0] * 10}, NOTHING), Measured({"branch": [20.0] * 8 + [90.0] * 2}, NOTHING)
    measured = {**dict.fromkeys(operations.SIZES, few), 1_000_000: many}

    first = operations._row(BRANCHES, 1_000, measured, ())
    last = operations._row(BRANCHES, 1_000_000, measured, ())

    assert (first.ours, first.met) == ("10.0 ms, p90 10.0", True)
    assert last.ours.endswith("; 2.0x that of 1,000")
    assert (last.goal, last.met) == ("p90 < 30 ms", False), (
        "the median meets the goal, but the 90th percentile does not"
    )


def test_a_row_compares_with_the_fastest_peer_and_names_those_that_are_not_installed() -> None:
    found = [
        PeerTimes({"branch": 40.0}, {"branch": "A: 40 ms"}),
        PeerTimes({"branch": 5.0}, {"branch": "B: 5 ms"}),
        PeerTimes({}, {"branch": "C is not installed"}),
    ]

    row = operations._row(BRANCHES, 1_000, {1_000: Measured({"branch": [10.0, 10.0]}, NOTHING)} | OTHERS, found)

    assert (row.peer, row.ratio) == ("A: 40 ms; B: 5 ms; C is not installed", 0.5)


OTHERS = dict.fromkeys(operations.SIZES[1:], Measured({"branch": []}, NOTHING))


def test_bytes_written_are_judged_only_where_the_operating_system_counts_them() -> None:
    unknown = operations._row_of_written(1_000, Written(9_000.0, None))
    too_many = operations._row_of_written(1_000, Written(9_000.0, 90_000.0))

    assert (unknown.ours, unknown.met) == ("9.0 kB of chunks", None)
    assert too_many.met is False


def test_a_peer_that_is_not_installed_is_named_in_every_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(peers.DVC, raising=False)
    monkeypatch.delenv(peers.OXEN, raising=False)
    monkeypatch.setattr("shutil.which", lambda _: None)

    found = peers.measure_peers((peers.FILES,))[peers.FILES]

    assert [one.shown["branch"] for one in found] == [f"{name} is not installed" for name in ("Git", "DVC", "Oxen")]
    assert not any(one.times_ms for one in found)
