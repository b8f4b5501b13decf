"""The server stores the last results of a job while the worker's child process already runs the next job."""

from pathlib import Path

import numpy as np
import pytest
from tests.support.attached_worker import StartWorker
from tests.support.fake_server import FakeServer


def being_stored(server: FakeServer, **terms: object) -> str:
    """Submit a job with two results, and return its id.

    The server stores the results only after the test removes the job from `server.slow`.
    """
    server.slow.add(job := f"maker{len(server.leased) + len(server.jobs)}")
    server.submit("make", {"results": 2}, job=job, **terms)
    return job


def running(server: FakeServer, folder: Path, how: str = "wait") -> str:
    """Submit a job that runs until `let_go` is called; wait until the job runs, and return its id."""
    job = server.submit("misbehave", {"how": how, "folder": str(folder)})
    server.until((folder / "started").exists)
    return job


def let_go(folder: Path) -> None:
    (folder / "go").touch()


def test_the_next_job_runs_while_the_last_results_are_stored(shared_server: FakeServer, tmp_path: Path) -> None:
    first = being_stored(shared_server)
    second = running(shared_server, tmp_path)
    assert first not in shared_server.completed
    assert not shared_server.staged[first]
    shared_server.slow.clear()
    assert shared_server.ended(first)["result"] == {"made": 2}
    assert second not in shared_server.completed
    let_go(tmp_path)
    assert shared_server.ended(second)["result"] == {"waited": True}
    assert {output["name"] for output in shared_server.staged[first]} == {"made-0", "made-1"}
    assert not shared_server.staged[second]


def test_a_third_job_waits_until_the_results_of_the_first_are_published(shared_server: FakeServer) -> None:
    first = being_stored(shared_server)
    shared_server.until(lambda: first in shared_server.leased)
    second, third = (shared_server.submit("add", {"a": 1, "b": n}) for n in range(2))
    shared_server.until(lambda: second in shared_server.leased)
    shared_server.slow.clear()
    shared_server.ended(third)
    order = [event for event in shared_server.order if event[1] in (first, second, third)]
    assert order.index(("claimed", second)) < order.index(("ended", first)) < order.index(("claimed", third))


def test_results_that_are_refused_while_the_next_job_runs_fail_their_own_job(
    shared_server: FakeServer, tmp_path: Path
) -> None:
    first = being_stored(shared_server)
    second = running(shared_server, tmp_path)
    shared_server.unwelcome.add(first)
    shared_server.slow.clear()
    failed = shared_server.ended(first)
    assert (failed["code"], failed["retryable"], failed["signature"]) == ("exception", True, "staging")
    assert failed["detail"] == "the results could not be stored: invalid"
    let_go(tmp_path)
    assert shared_server.ended(second)["result"] == {"waited": True}
    assert first not in shared_server.completed


@pytest.mark.parametrize(
    ("job", "status", "code", "retryable"),
    [
        ("toomuch", 409, "quota-exceeded", False),
        ("deletedskeleton", 422, "no-skeleton", False),
        ("toolarge", 413, "too-large", False),
        ("brokenserver", 500, "internal", True),
    ],
)
def test_results_that_cannot_be_published_fail_their_job_with_the_reason(
    shared_server: FakeServer, job: str, status: int, code: str, retryable: bool
) -> None:
    shared_server.refusals[job] = (status, code)
    shared_server.submit("make", {"results": 2}, job=job)
    failed = shared_server.ended(job)
    assert (failed["code"], failed["retryable"]) == (code, retryable)
    assert failed["detail"].startswith("the results ")
    next_job = shared_server.submit("add", {"a": 1, "b": 2})
    assert shared_server.ended(next_job)["result"]


def test_results_that_are_refused_before_others_are_made_end_the_job_at_once(shared_server: FakeServer) -> None:
    shared_server.unwelcome.add("manymade")
    shared_server.submit("make", {"results": 10_000}, job="manymade")
    assert shared_server.ended("manymade")["code"] == "exception"
    assert shared_server.logs["manymade"].count(b"making") < 10_000


def test_a_job_is_cancelled_while_its_results_are_stored_and_the_next_one_goes_on(
    shared_server: FakeServer, tmp_path: Path
) -> None:
    first = being_stored(shared_server, heartbeat_s=0.3)
    second = running(shared_server, tmp_path)
    shared_server.cancelled.add(first)
    assert shared_server.ended(first)["code"] == "cancelled"
    shared_server.slow.clear()
    let_go(tmp_path)
    assert shared_server.ended(second)["result"] == {"waited": True}
    assert first not in shared_server.completed


def test_a_lease_that_is_lost_while_results_are_stored_is_given_up_without_another_word(
    shared_server: FakeServer, tmp_path: Path
) -> None:
    first = being_stored(shared_server)
    second = running(shared_server, tmp_path)
    shared_server.lost.add(first)
    shared_server.slow.clear()
    let_go(tmp_path)
    assert shared_server.ended(second)["result"] == {"waited": True}
    assert ("ended", first) not in shared_server.order


def test_the_time_limit_of_a_job_includes_the_storing_of_its_results(shared_server: FakeServer, tmp_path: Path) -> None:
    first = being_stored(shared_server, time_limit_s=1)
    second = running(shared_server, tmp_path)
    assert shared_server.ended(first)["code"] == "time-limit"
    shared_server.slow.clear()
    let_go(tmp_path)
    assert shared_server.ended(second)["result"] == {"waited": True}


def test_heartbeats_and_log_of_a_job_go_on_while_its_results_are_stored(
    shared_server: FakeServer, tmp_path: Path
) -> None:
    first = being_stored(shared_server, heartbeat_s=0.3)
    second = running(shared_server, tmp_path)
    heard = len(shared_server.heartbeats[first])
    shared_server.until(lambda: len(shared_server.heartbeats[first]) > heard + 1)
    shared_server.until(lambda: b"making 1" in shared_server.logs[first])
    assert first not in shared_server.completed
    shared_server.slow.clear()
    let_go(tmp_path)
    shared_server.ended(first)
    shared_server.ended(second)


@pytest.mark.parametrize("how", ["cancelled", "segfault"])
def test_the_death_of_the_child_in_the_next_job_does_not_affect_results_that_are_stored(
    shared_server: FakeServer, tmp_path: Path, how: str
) -> None:
    first = being_stored(shared_server)
    if how == "segfault":
        second = shared_server.submit("misbehave", {"how": how})
        code = "worker-process-died"
    else:
        second = shared_server.submit("misbehave", {"how": "sleep", "seconds": 60}, heartbeat_s=0.3)
        shared_server.cancelled.add(second)
        code = "cancelled"
    shared_server.until(lambda: second in shared_server.leased)
    shared_server.until(lambda: how == "segfault" or shared_server.heartbeats[second])
    shared_server.slow.clear()
    assert shared_server.ended(first)["result"] == {"made": 2}
    assert shared_server.ended(second)["code"] == code
    assert shared_server.ended(shared_server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2


def test_results_are_published_although_the_next_job_does_not_read_its_answers(
    shared_server: FakeServer, tmp_path: Path
) -> None:
    shared_server.documents["clip_1", 1, "motion"] = {"poses": np.zeros(1_000_000, np.float32)}
    first = being_stored(shared_server)
    second = running(shared_server, tmp_path, how="read-late")
    shared_server.slow.clear()
    assert shared_server.ended(first)["result"] == {"made": 2}
    assert second not in shared_server.completed
    let_go(tmp_path)
    assert shared_server.ended(second)["result"] == {"waited": True}


def test_on_sigterm_a_job_whose_results_are_stored_is_given_back_with_the_next_one(
    server: FakeServer, start_worker: StartWorker, tmp_path: Path
) -> None:
    worker = start_worker("--slots", "1")
    first = being_stored(server)
    second = running(server, tmp_path)
    assert worker.stop() != 0
    assert [server.failed[job]["interrupted"] for job in (first, second)] == [True, True]
    server.slow.clear()
    assert not server.completed
