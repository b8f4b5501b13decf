"""Worker of a pod that was started for one job: its claims, and its exit status."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer, problem

from marey_schemas.backoff import Backoff
from marey_schemas.processes.child_process import ChildBroken
from marey_worker import one_job
from marey_worker.one_job import NamedJob, OneJobWorker
from marey_worker.supervisor import WorkerOptions


class IdleChild:
    """Child process that is ready at once and never gets a job."""

    def __init__(self, *_: Any, **_options: Any) -> None:
        self.killed = False

    def wait_until_ready(self) -> None:
        """Return at once: the process is always ready."""

    def kill(self, *, grace_s: float) -> None:
        self.killed = True


class BrokenChild(IdleChild):
    def wait_until_ready(self) -> None:
        raise ChildBroken(1)


def worker(script: ScriptedServer, folder: Path, monkeypatch: pytest.MonkeyPatch) -> OneJobWorker:
    monkeypatch.setattr(one_job, "ChildProcess", IdleChild)
    monkeypatch.setattr(one_job, "PAUSES", Backoff(0.0, 0.0))
    options = WorkerOptions(name="pod", kinds=("add",), labels={"marey/own-pod": "yes"}, cache=folder, threads=1)
    return OneJobWorker(script.marey().transport, options, NamedJob("job_1", 2))


def answer(state: str | None) -> httpx.Response:
    return httpx.Response(200, json={"leases": [], "state": state})


def test_a_pod_waits_until_its_job_has_ended_and_ends_with_status_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = ScriptedServer()
    one = worker(script, tmp_path, monkeypatch)
    script.answers = [answer("running"), httpx.ConnectError("gone"), problem(409, "lease-lost"), answer("queued")]
    script.answers.append(answer("succeeded"))
    assert one.run() == 0
    claims = [json.loads(request.content) for request in script.requests]
    assert {(claim["job"], claim["task"], claim["max"]) for claim in claims} == {("job_1", 2, 1)}
    ids = [claim["claim_id"] for claim in claims]
    assert ids[1] == ids[2], "a claim whose answer was lost is repeated"
    assert len({ids[0], ids[1], ids[3], ids[4]}) == 4


@pytest.mark.parametrize("status", [401, 403, 404, 422])
def test_a_pod_that_the_server_refuses_ends_with_status_42(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    script = ScriptedServer()
    one = worker(script, tmp_path, monkeypatch)
    script.answers = [problem(status, "refused")]
    assert one.run() == 42


def test_a_pod_that_is_stopped_while_it_waits_does_not_count_as_a_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = ScriptedServer()
    one = worker(script, tmp_path, monkeypatch)

    def stop(_: httpx.Request) -> httpx.Response:
        one.stop()
        return answer("running")

    script.answers = [stop]
    assert one.run() == 143
    monkeypatch.setattr(one_job, "ChildProcess", BrokenChild)
    assert worker_with_broken_child(script, tmp_path).run() == 1


def worker_with_broken_child(script: ScriptedServer, folder: Path) -> OneJobWorker:
    options = WorkerOptions(name="pod", kinds=("add",), cache=folder, threads=1)
    return OneJobWorker(script.marey().transport, options, NamedJob("job_1"))
