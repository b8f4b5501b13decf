"""A worker process against a server that remembers what it heard."""

import os
import signal
import time
import uuid
from collections.abc import Callable
from typing import Any

import psutil
import pytest
from psutil import Process


def alive(pid: int) -> bool:
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def test_a_kind_of_another_distribution_runs_and_its_result_log_and_progress_arrive(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    start_worker()
    job = server.submit("add", {"a": 2, "b": 3})
    end = server.ended(job)
    assert end["result"]["sum"] == 5
    assert end["code_version"] == "add@1"
    assert "numpy" in end["environment"]
    assert b"adding 2 and 3" in server.logs[job]


def test_a_child_stays_warm_between_jobs(server: Any, start_worker: Callable[..., Any]) -> None:
    start_worker()
    ends = [server.ended(server.submit("add", {"a": 1, "b": n})) for n in range(3)]
    assert len({end["result"]["pid"] for end in ends}) == 1


def test_the_next_job_begins_while_the_end_of_the_last_one_is_reported(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    server.may_complete.clear()
    start_worker("--slots", "1")
    first, second = (server.submit("add", {"a": 1, "b": n}) for n in range(2))
    server.until(lambda: server.started == [first, second])
    assert not server.completed
    server.may_complete.set()
    assert [server.ended(job)["result"]["sum"] for job in (first, second)] == [1, 2]


def test_a_worker_that_stops_reports_what_is_done(server: Any, start_worker: Callable[..., Any]) -> None:
    server.may_complete.clear()
    worker = start_worker("--slots", "1")
    job = server.submit("add", {"a": 1, "b": 1})
    server.until(lambda: job in server.completing)
    worker.process.send_signal(signal.SIGTERM)
    server.may_complete.set()
    assert worker.process.wait(30) == 0
    assert server.completed[job]["result"]["sum"] == 2


def test_a_task_knows_its_place_and_the_job_that_gathers_gets_what_the_tasks_returned(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    start_worker("--slots", "1")
    task = server.submit("tally", {"tasks": 3}, position=2, size=3)
    result = server.ended(task)["result"]
    assert (result["task"], result["threads"]) == ([2, 3], os.cpu_count())
    server.results["whole"] = [{"task": [n, 3]} for n in range(3)]
    server.submit("tally", {"tasks": 3}, job="whole", size=3)
    assert server.ended("whole")["result"] == {"seen": [[0, 3], [1, 3], [2, 3]]}


def test_a_job_that_was_not_spread_over_tasks_is_done_and_gathered_at_once(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    start_worker()
    assert server.ended(server.submit("tally", {"tasks": 1}))["result"] == {"seen": [[0, 1]]}


def test_the_attempts_own_token_is_used_for_the_attempt(server: Any, start_worker: Callable[..., Any]) -> None:
    start_worker()
    job = server.submit("add", {"a": 1, "b": 1})
    server.ended(job)
    assert server.tokens_seen == {"Bearer marey_worker_token", f"Bearer mareyjob_secret_of_{job}"}


def test_no_secret_stands_in_arguments_or_environment(server: Any, start_worker: Callable[..., Any]) -> None:
    worker = start_worker()
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    process = psutil.Process(worker.process.pid)
    for member in [process, *process.children(recursive=True)]:
        seen = " ".join(member.cmdline()) + " ".join(member.environ().values())
        assert "marey_worker_token" not in seen
        assert "mareyjob_" not in seen


@pytest.mark.parametrize(
    ("how", "code", "retryable", "detail"),
    [
        ("raise", "exception", True, "the numbers do not add up"),
        ("refuse", "not-today", False, "this cannot be done"),
        ("segfault", "worker-process-died", True, "SIGSEGV"),
        ("exit", "worker-process-died", True, "status 7"),
        ("eat", "memory-limit", True, "512 MB"),
    ],
)
def test_each_way_to_fail_is_told_apart_and_the_worker_goes_on(
    server: Any, start_worker: Callable[..., Any], how: str, code: str, retryable: bool, detail: str
) -> None:
    start_worker()
    failed = server.ended(server.submit("misbehave", {"how": how}, memory_limit_mb=512))
    assert (failed["code"], failed["retryable"], failed["interrupted"]) == (code, retryable, False)
    assert detail in failed["detail"]
    assert server.ended(server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2


def test_the_same_crash_has_the_same_signature_and_another_has_another(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    start_worker()
    signatures = [
        server.ended(server.submit("misbehave", {"how": how}))["signature"]
        for how in ("raise", "raise", "segfault", "segfault", "exit")
    ]
    assert signatures[0] == signatures[1]
    assert signatures[2] == signatures[3]
    assert len(set(signatures)) == 3


def test_a_crash_leaves_its_traceback_in_the_log(server: Any, start_worker: Callable[..., Any]) -> None:
    start_worker()
    job = server.submit("misbehave", {"how": "segfault"})
    server.ended(job)
    assert b"Segmentation fault" in server.logs[job]
    assert b"_segfault" in server.logs[job]


def test_an_exception_is_named_in_the_answer_and_traced_in_the_log(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    start_worker()
    job = server.submit("misbehave", {"how": "raise"})
    assert "Traceback" not in server.ended(job)["detail"]
    assert b"Traceback" in server.logs[job]


def test_memory_hoarded_by_a_grandchild_is_noticed_and_all_are_killed(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    mark = {"MAREY_TEST_HOARDER": str(uuid.uuid4())}
    start_worker(env=mark)
    job = server.submit("misbehave", {"how": "hoard"}, memory_limit_mb=1024)
    server.until(lambda: _hoarders(mark, 500 << 20))
    failed = server.ended(job)
    assert failed["code"] == "memory-limit"
    assert failed["signature"] == "memory-limit"
    server.until(lambda: not _hoarders(mark, 500 << 20))


def test_a_copy_that_a_job_made_of_its_process_does_not_answer_for_it(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    start_worker()
    assert server.ended(server.submit("misbehave", {"how": "fork-and-raise"}))["result"] == {"survived": True}


def _hoarders(mark: dict[str, str], size: int) -> list[Process]:
    """Processes of this test alone that hold more memory: others on the machine may have children of workers, too."""
    return [process for process in psutil.process_iter() if _holds_more_than(process, size, mark)]


def _holds_more_than(process: Process, size: int, mark: dict[str, str]) -> bool:
    try:
        return process.memory_info().rss > size and mark.items() <= process.environ().items()
    except psutil.Error:
        return False


def test_answers_that_come_too_late_do_not_reach_the_next_job(server: Any, start_worker: Callable[..., Any]) -> None:
    server.documents["clip_1", 1, "motion"] = {"some": "document"}
    start_worker()
    for _ in range(3):
        assert server.ended(server.submit("misbehave", {"how": "give-up-early"}))["code"] == "exception"
        assert server.ended(server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2


def test_a_job_that_needs_what_was_deleted_fails_for_good_and_says_what_is_missing(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    start_worker()
    failed = server.ended(server.submit("misbehave", {"how": "miss"}))
    assert (failed["code"], failed["retryable"]) == ("no-skeleton", False)
    assert "Traceback" not in failed["detail"]


def test_a_job_is_stopped_at_its_time_limit(server: Any, start_worker: Callable[..., Any]) -> None:
    start_worker()
    failed = server.ended(server.submit("misbehave", {"how": "sleep", "seconds": 60}, time_limit_s=1))
    assert failed["code"] == "time-limit"


def test_a_cancelled_job_is_stopped(server: Any, start_worker: Callable[..., Any]) -> None:
    server.heartbeat_s = 0.3
    start_worker()
    job = server.submit("misbehave", {"how": "sleep", "seconds": 60})
    server.until(lambda: server.heartbeats[job])
    server.cancelled.add(job)
    assert server.ended(job)["code"] == "cancelled"
    assert server.ended(server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2


def test_a_job_whose_lease_was_lost_is_given_up_without_another_word(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    server.heartbeat_s = 0.3
    start_worker()
    job = server.submit("misbehave", {"how": "sleep", "seconds": 60})
    server.until(lambda: server.heartbeats[job])
    server.lost.add(job)
    assert server.ended(server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2
    assert job not in server.completed
    assert job not in server.failed


def test_a_job_goes_on_while_the_server_is_away_and_is_published_when_it_is_back(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    server.heartbeat_s, server.ttl_s = 0.2, 0.6
    start_worker()
    job = server.submit("misbehave", {"how": "sleep", "seconds": 2})
    server.until(lambda: server.heartbeats[job])
    server.silent.add(job)
    time.sleep(2.5)
    assert job not in server.completed
    heard = len(server.heartbeats[job])
    server.silent.clear()
    assert server.ended(job)["result"] == {"slept": True}
    assert len(server.heartbeats[job]) > heard


def test_on_sigterm_a_running_job_is_given_back_and_the_exit_status_says_so(
    server: Any, start_worker: Callable[..., Any]
) -> None:
    worker = start_worker()
    job = server.submit("misbehave", {"how": "sleep", "seconds": 60})
    server.until(lambda: not server.jobs)
    time.sleep(0.5)
    assert worker.stop() != 0
    assert server.failed[job]["interrupted"] is True


def test_on_sigterm_an_idle_worker_exits_with_success(server: Any, start_worker: Callable[..., Any]) -> None:
    worker = start_worker()
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    assert worker.stop() == 0


def test_a_worker_stops_when_whoever_started_it_has_gone(server: Any, start_worker: Callable[..., Any]) -> None:
    worker = start_worker()
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    worker.process.stdin.close()
    assert worker.process.wait(30) == 0


def test_children_do_not_outlive_a_worker_that_was_killed(server: Any, start_worker: Callable[..., Any]) -> None:
    worker = start_worker()
    server.submit("misbehave", {"how": "sleep", "seconds": 60})
    server.until(lambda: not server.jobs)
    time.sleep(0.5)
    children = [child.pid for child in psutil.Process(worker.process.pid).children(recursive=True)]
    assert children
    os.kill(worker.process.pid, signal.SIGKILL)
    worker.process.wait()
    server.until(lambda: not any(alive(pid) for pid in children), 10)


def test_slots_run_jobs_at_the_same_time(server: Any, start_worker: Callable[..., Any]) -> None:
    start_worker("--slots", "2")
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    jobs = [server.submit("misbehave", {"how": "sleep", "seconds": 1.5}, job=f"both{n}") for n in range(2)]
    server.until(lambda: not server.jobs, 5)
    assert not server.completed.keys() & set(jobs)
    assert all(server.ended(job)["result"] == {"slept": True} for job in jobs)


def test_a_file_that_a_job_made_is_sent_and_named_by_its_digest(server: Any, start_worker: Callable[..., Any]) -> None:
    start_worker()
    end = server.ended(server.submit("misbehave", {"how": "put"}))
    assert server.blobs[end["result"]["digest"]] == b"bytes that a job made"


@pytest.mark.parametrize("point", ["worker.after_claim", "worker.before_complete", "worker.after_complete"])
def test_fault_points_kill_the_worker_where_they_say(server: Any, start_worker: Callable[..., Any], point: str) -> None:
    worker = start_worker(env={"MAREY_FAULT": f"{point}:kill"})
    job = server.submit("add", {"a": 1, "b": 1})
    assert worker.process.wait(60) == -signal.SIGKILL
    assert (job in server.completed) == (point == "worker.after_complete")
