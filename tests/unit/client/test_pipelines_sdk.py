"""Pipelines in the SDK: submission, waiting, cancellation, and explanations of failed steps."""

import json
from datetime import UTC, datetime
from typing import Any

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer, problem

from marey_client import errors
from marey_client.cli.queue.pipelines import follow_run
from marey_client.explanations import explain
from marey_client.handles.pipelines import PipelineRun
from marey_schemas.queue.jobs import Job
from marey_schemas.queue.pipelines import PipelineCreate

NOW = datetime(2026, 1, 1, tzinfo=UTC)
TWO = PipelineCreate.model_validate(
    {"steps": {"a": {"kind": "import"}, "b": {"kind": "align", "inputs": {"clips": {"step": "a"}}}}}
)


def job(name: str, **members: Any) -> dict[str, Any]:
    given = {
        "id": f"job_{name}", "project": "lab", "kind": "retarget", "state": "queued", "params": {}, "inputs": {},
        "into": "", "priority": 0, "seed": 0, "attempt": 0, "fence": 0, "max_attempts": 3, "author": "ada",
        "created_at": NOW, "run_at": NOW, "rev": 1,
    }  # fmt: skip
    return Job.model_validate({**given, **members}).model_dump(mode="json")


def answer(tree: dict[str, Any]) -> httpx.Response:
    return httpx.Response(200, content=json.dumps(tree))


def submitted(script: ScriptedServer, **states: Any) -> PipelineRun:
    made = {"jobs": {name: job(name, state=state) for name, state in states.items()}}
    script.answers = [httpx.Response(202, content=json.dumps(made))]
    return script.marey().project("lab").pipeline(TWO)


def failed(reason: str = "error", detail: str = "crooked") -> dict[str, Any]:
    return {"state": "failed", "failure": {"reason": reason, "code": "bad", "detail": detail}}


def test_a_pipeline_is_handed_in_once_and_known_by_its_steps(script: ScriptedServer) -> None:
    run = submitted(script, a="queued", b="waiting")
    (request,) = script.requests
    assert (request.method, request.url.path) == ("POST", "/api/v1/projects/lab/pipelines")
    assert json.loads(request.content) == {
        "steps": {"a": {"kind": "import"}, "b": {"kind": "align", "inputs": {"clips": {"step": "a"}}}}
    }
    assert request.headers["Idempotency-Key"]
    assert {name: one.id for name, one in run.steps.items()} == {"a": "job_a", "b": "job_b"}
    assert not run.ended


def test_waiting_ends_with_the_last_job_and_asks_no_more_for_those_that_have_ended(script: ScriptedServer) -> None:
    run = submitted(script, a="running", b="waiting")
    script.answers = [
        answer(job("a", state="succeeded")),
        answer(job("b", state="running")),
        answer(job("b", state="succeeded")),
    ]
    seen = []
    ended = run.wait(on_progress=lambda steps: seen.append([one.state.value for one in steps.values()]))
    assert seen == [["running", "waiting"], ["succeeded", "running"], ["succeeded", "succeeded"]]
    assert {one.state for one in ended.values()} == {"succeeded"}


def test_a_pipeline_that_was_computed_before_needs_no_waiting(script: ScriptedServer) -> None:
    run = submitted(script, a="succeeded", b="succeeded")
    assert run.wait().keys() == {"a", "b"}
    assert len(script.requests) == 1


def test_the_step_that_failed_by_itself_is_named_not_those_that_followed(script: ScriptedServer) -> None:
    run = submitted(script, a="running", b="waiting")
    script.answers = [answer(job("a", **failed())), answer(job("b", **failed("dependency_failed", "needs job_a")))]
    with pytest.raises(errors.JobUnsuccessful, match=r"step a \(job_a\) failed \(bad\): crooked") as caught:
        run.wait()
    assert caught.value.job.id == "job_a"


def test_waiting_gives_up_when_told_to_and_says_what_goes_on(script: ScriptedServer) -> None:
    run = submitted(script, a="running", b="waiting")
    script.answers = [answer(job("a", state="running")), answer(job("b", state="waiting"))] * 100
    with pytest.raises(errors.WaitedTooLong, match="have not ended: a, b"):
        run.wait(timeout_s=0.01)


def test_cancelling_asks_every_job_that_has_not_ended(script: ScriptedServer) -> None:
    run = submitted(script, a="succeeded", b="running")
    stopping = answer(job("b", state="cancelled"))
    script.answers = [answer(job("b", state="running")), stopping, stopping]
    assert {name: one.state.value for name, one in run.cancel().items()} == {"a": "succeeded", "b": "cancelled"}
    assert [request.url.path for request in script.requests if request.url.path.endswith("/cancel")] == [
        "/api/v1/jobs/job_b/cancel"
    ]


def test_the_last_jobs_are_cancelled_first_and_one_that_ended_meanwhile_is_no_error(script: ScriptedServer) -> None:
    run = submitted(script, a="running", b="waiting")
    gone = problem(409, "job-ended")
    script.answers = [answer(job("a", state="running")), answer(job("b", state="waiting")), gone]
    script.answers += [answer(job("a", state="cancelled"))] * 2 + [answer(job("b", state="cancelled"))]
    run.cancel()
    stopped = [request.url.path for request in script.requests if request.url.path.endswith("/cancel")]
    assert stopped == ["/api/v1/jobs/job_b/cancel", "/api/v1/jobs/job_a/cancel"]


def test_why_a_job_waits_is_told_with_those_it_waits_for(script: ScriptedServer) -> None:
    waiting = Job.model_validate(
        job("b", state="waiting", after=["job_a", "job_c"], inputs={"clips": [{"job": "job_a"}]})
    )
    (told, *_) = explain(waiting, [], [], NOW)
    assert "job_a, which makes its inputs and job_c" in told


def test_a_failed_step_is_told_in_one_line(script: ScriptedServer, capsys: pytest.CaptureFixture[str]) -> None:
    run = submitted(script, a="queued", b="waiting")
    several = failed(detail="ValueError: crooked\n  in two places; the job's log tells where")
    script.answers = [answer(job("a", **several)), answer(job("b", **failed("dependency_failed", "a is failed")))]
    with pytest.raises(errors.JobUnsuccessful):
        follow_run(run, "lab", wait=True, as_json=False)
    assert "ValueError: crooked in two places; the job's log tells where" in capsys.readouterr().out
