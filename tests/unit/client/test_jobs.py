"""Waiting for jobs, and explanations of their states."""

import asyncio
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from tests.support.command_line import run_here
from tests.support.scripted_server import ScriptedServer

from marey_client import errors
from marey_client.asynchronous.marey import AsyncMarey
from marey_client.cli.queue import jobs as job_commands
from marey_client.explanations import explain, explain_job
from marey_schemas.access import RunningJobs
from marey_schemas.queue.jobs import Attempt, Job
from marey_schemas.queue.workers import Worker

NOW = datetime(2026, 1, 1, tzinfo=UTC)


def job(**members: Any) -> Job:
    given = {
        "id": "job_1", "project": "lab", "kind": "retarget", "state": "queued", "params": {}, "inputs": {}, "into": "",
        "priority": 0, "seed": 0, "attempt": 0, "fence": 0, "max_attempts": 3, "author": "ada", "created_at": NOW,
        "run_at": NOW, "rev": 1,
    }  # fmt: skip
    return Job.model_validate({**given, **members})


def answer(**members: Any) -> httpx.Response:
    return httpx.Response(200, content=job(**members).model_dump_json())


def test_waiting_ends_with_the_job_and_tells_its_progress(script: ScriptedServer) -> None:
    script.answers = [answer(), answer(state="running", progress={"done": 1, "total": 2}), answer(state="succeeded")]
    seen = []
    ended = script.marey().jobs.wait("job_1", on_progress=lambda now: seen.append(now.state))
    assert ended.state == "succeeded"
    assert seen == ["queued", "running", "succeeded"]


def test_a_job_that_failed_raises_with_its_reason(script: ScriptedServer) -> None:
    failure = {"reason": "error", "code": "no-mapping", "detail": "nothing maps"}
    script.answers = [answer(state="failed", failure=failure)] * 2
    jobs = script.marey().jobs
    with pytest.raises(errors.JobUnsuccessful, match="nothing maps") as caught:
        jobs.wait("job_1")
    assert caught.value.job.failure.code == "no-mapping"
    assert jobs.wait("job_1", require_success=False).state == "failed"


def test_waiting_gives_up_when_told_to(script: ScriptedServer) -> None:
    script.answers = [answer(state="running")] * 100
    with pytest.raises(errors.WaitedTooLong, match="still running"):
        script.marey().jobs.wait("job_1", timeout_s=0.01)


def test_a_retry_asks_older_servers_only_for_what_they_know(script: ScriptedServer) -> None:
    script.answers = [httpx.Response(202, content=job().model_dump_json())] * 2
    jobs = script.marey().jobs
    jobs.retry("job_1")
    jobs.retry("job_1", dependants=False)
    assert [dict(request.url.params) for request in script.requests] == [{}, {"dependants": "false"}]


def test_a_job_is_retried_alone_on_the_command_line_and_in_asynchronous_code(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_commands, "connect", lambda _: script.marey())
    script.answers = [httpx.Response(202, content=job().model_dump_json())] * 2
    done = run_here(["job", "retry", "job_1", "--no-dependants"])
    assert (done.returncode, done.stdout) == (0, "job_1\n")

    async def retry() -> Job:
        async with AsyncMarey("http://marey.test", http=script.transport()) as marey:
            return await marey.jobs.retry("job_1", dependants=False)

    assert asyncio.run(retry()).id == "job_1"
    assert [dict(request.url.params) for request in script.requests] == [{"dependants": "false"}] * 2


@pytest.mark.parametrize(
    ("members", "running", "expected"),
    [
        ({"state": "waiting"}, [], "depends on"),
        ({"state": "waiting", "size": 4, "children": {"queued": 3, "succeeded": 1}}, [], "3 queued, 1 succeeded"),
        ({"run_at": NOW + timedelta(seconds=30), "attempt": 1}, [], "in 30 s at the earliest, after attempt 1 of 3"),
        ({}, [job(state="running")], "busy with 1"),
        ({}, [], "has asked for one"),
        ({"state": "running", "attempt": 2, "cancel_requested": True}, [], "was cancelled and will stop"),
        ({"state": "failed", "failure": {"reason": "poison", "code": "x", "detail": "twice"}}, [], "poison, x"),
        ({"state": "succeeded", "cached_from": "job_0"}, [], "job_0"),
    ],
)
def test_every_state_has_its_reason(members: dict[str, Any], running: list[Job], expected: str) -> None:
    assert expected in explain(job(**members), [], running, NOW)[0]


def worker(kinds: tuple[str, ...] | None, labels: dict[str, str] | None) -> Worker:
    return Worker(name="w", alive=True, seen_at=NOW, running=0, kinds=kinds, labels=labels)


def test_a_job_that_no_worker_fits_says_what_a_worker_would_need() -> None:
    waiting = job(labels={"gpu": "a100"})
    others = [worker(("align",), {"gpu": "a100"}), worker(("retarget",), {"gpu": "h100"})]
    needed = "it needs a worker that runs jobs of the kind retarget and has the labels gpu=a100; of the workers"
    assert needed in explain(waiting, [], [job(state="running")], NOW, others)[0]
    for fitting in (worker(("retarget",), {"gpu": "a100", "site": "lyon"}), worker(None, None)):
        assert "busy with 1" in explain(waiting, [], [job(state="running")], NOW, [*others, fitting])[0]
    assert "and has the labels gpu=a100 has asked for a job" in explain(waiting, [], [], NOW, [])[0]


def test_a_job_with_a_pod_of_its_own_says_why() -> None:
    pod = {"marey/own-pod": "yes"}
    assert "its memory limit or its expected" in explain(job(labels=pod), [], [], NOW, [worker(("retarget",), {})])[0]
    assert "it needs 2 graphics processors" in explain(job(labels={"marey/gpus": "2"} | pod), [], [], NOW)[0]
    held = job(labels=pod, progress={"done": 0, "note": "no node ran the pod"})
    assert "Earlier, no node ran the pod." in explain(held, [], [], NOW)[0]
    held = job(labels=pod, progress={"done": 0, "note": "no node ran the pod"}, run_at=NOW + timedelta(seconds=30))
    told = "queued: no node ran the pod. The server starts its next pod in 30 s at the earliest."
    assert explain(held, [], [], NOW) == [told]
    own = job(kind="script", params={"declaration": {"image": "torch@sha256:ab"}}, labels=pod)
    assert "names the image torch@sha256:ab. The server starts this pod in its cluster" in explain(own, [], [], NOW)[0]


def test_a_job_that_the_limit_of_its_project_holds_back_says_so() -> None:
    fitting = [worker(("retarget",), {})]
    full, room = RunningJobs(used=2, allowed=2), RunningJobs(used=1, allowed=2)
    told = explain(job(), [], [job(state="running")], NOW, fitting, full)[0]
    assert told.startswith("queued: the project runs 2 jobs, and its limit is 2;")
    for limit in (room, RunningJobs(used=9), None):
        assert "busy with 1" in explain(job(), [], [job(state="running")], NOW, fitting, limit)[0]


def test_who_may_not_list_workers_gets_an_explanation_all_the_same(script: ScriptedServer) -> None:
    empty = httpx.Response(200, content=b'{"items": []}')
    refused = httpx.Response(403, json={"code": "forbidden", "status": 403, "title": "Forbidden", "detail": "no"})
    script.answers = [answer(), empty, empty, refused, refused]
    assert "has asked for one" in explain_job(script.marey(), "job_1")[0]


def test_earlier_attempts_are_told(script: ScriptedServer) -> None:
    lost = Attempt(job="job_1", fence=1, worker="w1", started_at=NOW, ended_at=NOW, outcome="lost", detail=None)
    assert "attempt 1 on w1 was lost" in explain(job(), [lost], [], NOW)
