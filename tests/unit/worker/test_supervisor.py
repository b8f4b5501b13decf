"""A worker process, tested with a server that records the requests it receives."""

import os
import signal
import time
from pathlib import Path

import psutil
import pytest
from tests.support.attached_worker import StartWorker
from tests.support.fake_server import FakeServer
from tests.support.present import present

from marey_client.credentials import write_private
from marey_client.errors import error_of
from marey_schemas.encoding.digests import digest_of
from marey_schemas.problems import Problem
from marey_schemas.queue.jobs import Progress
from marey_schemas.queue.worker_protocol import FailRequest
from marey_worker import supervisor
from marey_worker.commands import main


def alive(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_kind_of_another_distribution_runs_and_its_result_log_and_progress_arrive(shared_server: FakeServer) -> None:
    job = shared_server.submit("add", {"a": 2, "b": 3})
    end = shared_server.ended(job)
    assert end["result"]["sum"] == 5
    assert end["code_version"] == "add@1"
    assert "numpy" in end["environment"]
    assert b"adding 2 and 3" in shared_server.logs[job]


def test_a_child_stays_warm_between_jobs(shared_server: FakeServer) -> None:
    ends = [shared_server.ended(shared_server.submit("add", {"a": 1, "b": n})) for n in range(3)]
    assert len({end["result"]["pid"] for end in ends}) == 1


def test_the_next_job_begins_while_the_end_of_the_last_one_is_reported(
    server: FakeServer, start_worker: StartWorker
) -> None:
    server.may_complete.clear()
    start_worker("--slots", "1")
    first, second = (server.submit("add", {"a": 1, "b": n}) for n in range(2))
    server.until(lambda: list(server.leased) == [first, second])
    assert not server.completed
    server.may_complete.set()
    assert [server.ended(job)["result"]["sum"] for job in (first, second)] == [1, 2]


def test_a_job_is_run_once_although_the_answer_to_its_claim_was_lost(
    server: FakeServer, start_worker: StartWorker
) -> None:
    server.answers_to_lose = 1
    job = server.submit("add", {"a": 1, "b": 1})
    start_worker("--slots", "1")
    assert server.ended(job)["result"]["sum"] == 2
    assert server.answers_to_lose == 0
    assert [name for name, _ in server.order].count("claimed") == 1


@pytest.mark.parametrize("lost", [0, 1])
def test_a_worker_goes_on_with_the_token_that_replaced_its_own(
    server: FakeServer, start_worker: StartWorker, tmp_path: Path, lost: int
) -> None:
    file = tmp_path / "worker.token"
    write_private(file, "marey_a_old\n")
    server.valid_tokens = {"marey_a_old"}
    server.answers_to_lose = lost
    start_worker("--slots", "1", token_file=file)
    first = server.submit("add", {"a": 1, "b": 1})
    server.until(lambda: server.leased)
    server.valid_tokens.add("marey_b_new")  # as during the grace of a rotation
    write_private(file, "marey_b_new\n")
    assert server.ended(first)["result"]["sum"] == 2
    server.until(lambda: {"marey_b_new"} in server.claimants.values())
    server.valid_tokens.remove("marey_a_old")
    assert server.ended(server.submit("add", {"a": 2, "b": 2}))["result"]["sum"] == 4
    assert all(len(tokens) == 1 for tokens in server.claimants.values())  # no claim is repeated with another token
    assert [name for name, _ in server.order].count("claimed") == 2


def test_a_claim_whose_token_ended_before_it_was_answered_is_given_up_for_one_with_the_new_token(
    server: FakeServer, start_worker: StartWorker, tmp_path: Path
) -> None:
    file = tmp_path / "worker.token"
    write_private(file, "marey_a_old\n")
    server.answers_to_lose = 1
    server.submit("add", {"a": 0, "b": 0})
    worker = start_worker("--slots", "1", token_file=file)
    server.until(lambda: server.answers_to_lose == 0)
    write_private(file, "marey_b_new\n")
    server.valid_tokens = {"marey_b_new"}
    assert server.ended(server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2
    server.valid_tokens = set()
    assert worker.process.wait(60) == 1  # a token that nobody replaced is refused as before


def test_a_worker_that_stops_reports_what_is_done(server: FakeServer, start_worker: StartWorker) -> None:
    server.may_complete.clear()
    worker = start_worker("--slots", "1")
    job = server.submit("add", {"a": 1, "b": 1})
    server.until(lambda: job in server.completing)
    worker.process.send_signal(signal.SIGTERM)
    server.may_complete.set()
    assert worker.process.wait(30) == 0
    assert server.completed[job]["result"]["sum"] == 2


def test_a_task_knows_its_place_and_the_job_that_gathers_gets_what_the_tasks_returned(
    shared_server: FakeServer,
) -> None:
    task = shared_server.submit("tally", {"tasks": 3}, position=2, size=3)
    result = shared_server.ended(task)["result"]
    assert (result["task"], result["threads"]) == ([2, 3], os.cpu_count())
    shared_server.results["whole"] = [{"task": [n, 3]} for n in range(3)]
    shared_server.submit("tally", {"tasks": 3}, job="whole", size=3)
    assert shared_server.ended("whole")["result"] == {"seen": [[0, 3], [1, 3], [2, 3]]}


def test_a_job_that_was_not_spread_over_tasks_is_done_and_gathered_at_once(shared_server: FakeServer) -> None:
    assert shared_server.ended(shared_server.submit("tally", {"tasks": 1}))["result"] == {"seen": [[0, 1]]}


def test_the_attempts_own_token_is_used_for_the_attempt(server: FakeServer, start_worker: StartWorker) -> None:
    start_worker()
    job = server.submit("add", {"a": 1, "b": 1})
    server.ended(job)
    assert server.tokens_seen == {"Bearer marey_worker_token", f"Bearer mareyjob_secret_of_{job}"}


def test_no_secret_stands_in_arguments_or_environment(server: FakeServer, start_worker: StartWorker) -> None:
    secrets = {"MAREY_DATABASE_URL": "postgresql://marey:hunter2@db/marey", "PGPASSWORD": "hunter2"}
    worker = start_worker(env=secrets, forked=False)
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    process = psutil.Process(worker.process.pid)
    children = process.children(recursive=True)
    for member in [process, *children]:
        seen = " ".join(member.cmdline()) + " ".join(member.environ().values())
        assert "marey_worker_token" not in seen
        assert "mareyjob_" not in seen
    assert children
    assert not [child for child in children if "hunter2" in " ".join(child.environ().values())]


@pytest.mark.parametrize(
    ("how", "code", "retryable", "detail"),
    [
        ("raise", "exception", True, "the numbers do not add up"),
        ("refuse", "not-today", False, "this cannot be done"),
        ("segfault", "worker-process-died", True, "SIGSEGV"),
        ("exit", "worker-process-died", True, "status 7"),
        ("eat", "memory-limit", True, "512 MiB"),
    ],
)
def test_each_way_to_fail_is_told_apart_and_the_worker_goes_on(
    shared_server: FakeServer, how: str, code: str, retryable: bool, detail: str
) -> None:
    failed = shared_server.ended(shared_server.submit("misbehave", {"how": how}, memory_limit_mb=512))
    assert (failed["code"], failed["retryable"], failed["interrupted"]) == (code, retryable, False)
    assert detail in failed["detail"]
    assert shared_server.ended(shared_server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2


@pytest.mark.parametrize(("how", "code"), [("raise-oddly", "exception"), ("refuse-oddly", f"{('odd' * 100)[:127]}…")])
def test_a_failure_is_reported_however_long_or_odd_its_texts_are(
    shared_server: FakeServer, how: str, code: str
) -> None:
    job = shared_server.submit("misbehave", {"how": how})
    after = shared_server.submit("add", {"a": 1, "b": 1})
    failed = FailRequest.model_validate(shared_server.ended(job))
    assert failed.code == code
    assert "a\\x00b\\udc80c" in failed.detail
    assert shared_server.ended(after)["result"]["sum"] == 2


def test_progress_is_reported_however_long_or_odd_its_note_is(shared_server: FakeServer) -> None:
    job = shared_server.submit("misbehave", {"how": "report-oddly"}, heartbeat_s=0.3)
    assert shared_server.ended(job)["result"] == {"reported": True}
    (progress, *_) = filter(None, shared_server.heartbeats[job])
    assert Progress.model_validate(progress).note.startswith("a\\x00b\\udc80ca")


@pytest.mark.parametrize("number", ["nan", "inf", str(1 << 63), str(1 << 64), "half a character"])
def test_a_result_that_no_request_can_contain_fails_its_job_and_not_the_worker(
    shared_server: FakeServer, number: str
) -> None:
    job = shared_server.submit("misbehave", {"how": "answer-oddly", "blob": number})
    after = shared_server.submit("add", {"a": 1, "b": 1})
    failed = shared_server.ended(job)
    assert (failed["code"], failed["retryable"]) == ("bad-result", False)
    assert shared_server.ended(after)["result"]["sum"] == 2


def test_the_same_crash_has_the_same_signature_and_another_has_another(shared_server: FakeServer) -> None:
    signatures = [
        shared_server.ended(shared_server.submit("misbehave", {"how": how}))["signature"]
        for how in ("raise", "raise", "segfault", "segfault", "exit")
    ]
    assert signatures[0] == signatures[1]
    assert signatures[2] == signatures[3]
    assert len(set(signatures)) == 3


def test_a_crash_leaves_its_traceback_in_the_log(shared_server: FakeServer) -> None:
    job = shared_server.submit("misbehave", {"how": "segfault"})
    shared_server.ended(job)
    assert b"Segmentation fault" in shared_server.logs[job]
    assert b"_segfault" in shared_server.logs[job]


def test_an_exception_is_named_in_the_answer_and_traced_in_the_log(shared_server: FakeServer) -> None:
    job = shared_server.submit("misbehave", {"how": "raise"})
    assert "Traceback" not in shared_server.ended(job)["detail"]
    assert b"Traceback" in shared_server.logs[job]


def test_memory_hoarded_by_a_grandchild_is_noticed_and_all_are_killed(
    shared_server: FakeServer, tmp_path: Path
) -> None:
    job = shared_server.submit("misbehave", {"how": "hoard", "folder": str(tmp_path)}, memory_limit_mb=1024)
    failed = shared_server.ended(job)
    assert failed["code"] == "memory-limit"
    assert failed["signature"] == "memory-limit"
    hoarder = int((tmp_path / "hoarder").read_text())
    shared_server.until(lambda: not alive(hoarder))


def test_a_copy_that_a_job_made_of_its_process_does_not_answer_for_it(shared_server: FakeServer) -> None:
    assert shared_server.ended(shared_server.submit("misbehave", {"how": "fork-and-raise"}))["result"] == {
        "survived": True
    }


def test_answers_that_come_too_late_do_not_reach_the_next_job(shared_server: FakeServer) -> None:
    shared_server.documents["clip_1", 1, "motion"] = {"some": "document"}
    for _ in range(3):
        assert shared_server.ended(shared_server.submit("misbehave", {"how": "give-up-early"}))["code"] == "exception"
        assert shared_server.ended(shared_server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2


def test_a_job_that_needs_what_was_deleted_fails_for_good_and_says_what_is_missing(shared_server: FakeServer) -> None:
    failed = shared_server.ended(shared_server.submit("misbehave", {"how": "miss"}))
    assert (failed["code"], failed["retryable"]) == ("no-skeleton", False)
    assert "Traceback" not in failed["detail"]


def test_a_job_is_stopped_at_its_time_limit(shared_server: FakeServer) -> None:
    failed = shared_server.ended(shared_server.submit("misbehave", {"how": "sleep", "seconds": 60}, time_limit_s=1))
    assert failed["code"] == "time-limit"


def test_a_cancelled_job_is_stopped(shared_server: FakeServer) -> None:
    job = shared_server.submit("misbehave", {"how": "sleep", "seconds": 60}, heartbeat_s=0.3)
    shared_server.until(lambda: shared_server.heartbeats[job])
    shared_server.cancelled.add(job)
    assert shared_server.ended(job)["code"] == "cancelled"
    assert shared_server.ended(shared_server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2


def test_a_job_whose_lease_was_lost_is_given_up_without_another_word(shared_server: FakeServer) -> None:
    job = shared_server.submit("misbehave", {"how": "sleep", "seconds": 60}, heartbeat_s=0.3)
    shared_server.until(lambda: shared_server.heartbeats[job])
    shared_server.lost.add(job)
    assert shared_server.ended(shared_server.submit("add", {"a": 1, "b": 1}))["result"]["sum"] == 2
    assert job not in shared_server.completed
    assert job not in shared_server.failed


def test_a_job_goes_on_while_the_server_is_away_and_is_published_when_it_is_back(
    shared_server: FakeServer, tmp_path: Path
) -> None:
    wait = {"how": "wait", "folder": str(tmp_path)}
    job = shared_server.submit("misbehave", wait, heartbeat_s=0.2, ttl_s=0.6)
    shared_server.until(lambda: shared_server.heartbeats[job] and (tmp_path / "started").exists())
    shared_server.silent.add(job)
    time.sleep(0.6)  # at least as long as the lease, which has to be confirmed afterwards
    (tmp_path / "go").touch()
    refused = shared_server.refused[job]
    shared_server.until(lambda: shared_server.refused[job] > refused)
    assert job not in shared_server.completed
    heard = len(shared_server.heartbeats[job])
    shared_server.silent.clear()
    assert shared_server.ended(job)["result"] == {"waited": True}
    assert len(shared_server.heartbeats[job]) > heard


def test_on_sigterm_a_running_job_is_given_back_and_the_exit_status_says_so(
    server: FakeServer, start_worker: StartWorker, tmp_path: Path
) -> None:
    worker = start_worker()
    job = server.submit("misbehave", {"how": "wait", "folder": str(tmp_path)})
    server.until((tmp_path / "started").exists)
    assert worker.stop() != 0
    assert server.failed[job]["interrupted"] is True


def test_a_job_is_given_back_if_its_process_gets_sigterm_before_the_worker(
    server: FakeServer, start_worker: StartWorker, tmp_path: Path
) -> None:
    worker = start_worker()
    job = server.submit("misbehave", {"how": "wait", "folder": str(tmp_path)})
    server.until((tmp_path / "started").exists)
    for child in psutil.Process(worker.process.pid).children(recursive=True):
        child.terminate()
    time.sleep(0.3)
    assert worker.stop() != 0
    assert server.failed[job]["interrupted"] is True


def test_a_worker_announces_its_labels_and_claims_its_kinds_only(server: FakeServer, start_worker: StartWorker) -> None:
    start_worker("--label", "gpu=a100", "--label", "site=", "--kind", "add")
    server.submit("misbehave", {"how": "sleep"})
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    assert server.announced == {"kinds": ["add"], "labels": {"gpu": "a100", "site": ""}}


def test_a_label_without_a_value_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["marey_worker", "--label", "gpu"])
    with pytest.raises(SystemExit):
        main()
    assert "argument --label: 'gpu' is not a label; write it like site=lyon" in capsys.readouterr().err


def test_on_sigterm_an_idle_worker_exits_with_success(server: FakeServer, start_worker: StartWorker) -> None:
    worker = start_worker()
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    assert worker.stop() == 0


def test_a_worker_stops_when_whoever_started_it_has_gone(server: FakeServer, start_worker: StartWorker) -> None:
    worker = start_worker()
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    present(worker.process.stdin).close()
    assert worker.process.wait(30) == 0


def test_children_do_not_outlive_a_worker_that_was_killed(
    server: FakeServer, start_worker: StartWorker, tmp_path: Path
) -> None:
    worker = start_worker()
    server.submit("misbehave", {"how": "wait", "folder": str(tmp_path)})
    server.until((tmp_path / "started").exists)
    children = [child.pid for child in psutil.Process(worker.process.pid).children(recursive=True)]
    assert children
    worker.process.kill()
    worker.process.wait()
    server.until(lambda: not any(alive(pid) for pid in children))


def test_slots_run_jobs_at_the_same_time(server: FakeServer, start_worker: StartWorker, tmp_path: Path) -> None:
    start_worker("--slots", "2")
    jobs = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        jobs.append(server.submit("misbehave", {"how": "wait", "folder": str(tmp_path / name)}))
    server.until(lambda: all((tmp_path / name / "started").exists() for name in ("one", "other")))
    for name in ("one", "other"):
        (tmp_path / name / "go").touch()
    assert all(server.ended(job)["result"] == {"waited": True} for job in jobs)


def test_a_file_that_a_job_made_is_sent_and_named_by_its_digest(shared_server: FakeServer) -> None:
    end = shared_server.ended(shared_server.submit("misbehave", {"how": "put"}))
    assert shared_server.blobs[end["result"]["digest"]] == b"bytes that a job made"


def test_a_file_that_is_too_large_for_the_memory_limit_is_not_downloaded(shared_server: FakeServer) -> None:
    small, large = b"small", bytes((128 << 20) + 1)
    shared_server.blobs |= {digest_of(data): data for data in (small, large)}
    failed, read = (
        shared_server.ended(
            shared_server.submit("misbehave", {"how": "read-blob", "blob": digest}, memory_limit_mb=512)
        )
        for digest in (digest_of(large), digest_of(small))
    )
    assert (failed["code"], failed["retryable"]) == ("file-too-large", False)
    assert all(told in failed["detail"] for told in (digest_of(large), str(len(large)), "memory_limit_mb"))
    assert read["result"] == {"bytes": len(small)}


def test_a_file_that_is_too_large_is_refused_even_if_the_worker_has_it_in_its_cache(
    shared_server: FakeServer,
) -> None:
    digest = digest_of(data := bytes(128 << 20) + b"again")
    shared_server.blobs[digest] = data
    read, failed = (
        shared_server.ended(
            shared_server.submit("misbehave", {"how": "read-blob", "blob": digest}, memory_limit_mb=limit_mb)
        )
        for limit_mb in (4096, 512)
    )
    assert read["result"] == {"bytes": len(data)}
    assert failed["code"] == "file-too-large"


def test_a_result_is_not_shared_if_something_could_not_be_read(shared_server: FakeServer) -> None:
    small, large, gone = b"small", bytes((128 << 20) + 1), b"gone"
    shared_server.blobs |= {digest_of(data): data for data in (small, large)}

    def end(how: str = "do-without", **params: str) -> tuple[str, bool]:
        job = shared_server.submit("misbehave", {"how": how, **params}, memory_limit_mb=512)
        report = shared_server.ended(job)
        return report["result"].get("lacks", ""), report.get("shareable", True)

    assert end() == ("no-skeleton", False)
    assert end(blob=digest_of(gone)) == ("no-blob", False)
    assert end(blob=digest_of(large)) == ("file-too-large", False)
    assert end(blob=digest_of(small)) == ("", True)
    assert end("have-no-mapping") == ("", True)


@pytest.mark.parametrize("point", ["worker.after_claim", "worker.before_complete", "worker.after_complete"])
def test_fault_points_kill_the_worker_where_they_say(server: FakeServer, start_worker: StartWorker, point: str) -> None:
    worker = start_worker(env={"MAREY_FAULT": f"{point}:kill"})
    job = server.submit("add", {"a": 1, "b": 1})
    assert worker.process.wait(60) == -signal.SIGKILL
    assert (job in server.completed) == (point == "worker.after_complete")


@pytest.mark.parametrize(
    ("status", "told"),
    [
        (401, "Refused. Give it a token of `marey token create NAME --scope work` with --token-file."),
        (404, "http://server.test/api has no queue of jobs; set MAREY_SERVER to the address of the server alone"),
        (503, "Refused."),
    ],
)
def test_a_worker_says_what_to_do_about_a_wrong_token_or_address(status: int, told: str) -> None:
    error = error_of(Problem(type="t", title="Refused", status=status, detail="Refused.", instance="r", code="refused"))
    assert supervisor._explained(error, "http://server.test/api").startswith(told)
