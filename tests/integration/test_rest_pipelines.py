"""Pipelines over HTTP."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from tests.support.rest_server import Server

pytestmark = pytest.mark.usefixtures("test_kinds")


CHAIN: dict[str, Any] = {
    "steps": {
        "square": {"kind": "square", "inputs": {"things": {"step": "sum"}}, "into": "squared"},
        "sum": {"kind": "sum"},
    },
    "into": "made",
}


def ok(response: httpx.Response, status: int = 200) -> Any:
    assert response.status_code == status, response.text
    return response.json()


def submit(owner: httpx.Client, wanted: object = CHAIN, **headers: str) -> Any:
    return ok(owner.post("/projects/lab/pipelines", json=wanted, headers=headers), 202)["jobs"]


def do_next(server: Server, worker: httpx.Client, *names: str) -> Any:
    """Claim one job and complete it with small documents of these names; return its lease."""
    (lease,) = ok(worker.post("/leases", json={"worker": "w", "kinds": ["sum", "square"]}))["leases"]
    attempt = server.client(lease["attempt_token"])
    place = f"/jobs/{lease['job']}/attempts/{lease['fence']}"
    outputs = [
        {
            "name": name,
            "kind": "character",
            "item_name": name,
            "parts": {"character": {"schema": "marey/document@1", "name": name}},
        }
        for name in names
    ]
    if outputs:
        ok(attempt.post(f"{place}/outputs", json={"outputs": outputs}))
    ok(attempt.post(f"{place}/complete", json={"write_id": "write-one"}))
    return lease


def test_a_pipeline_is_answered_with_its_jobs_and_worked_off(
    server: Server, owner: httpx.Client, worker: httpx.Client
) -> None:
    made = submit(owner)
    assert {name: (job["kind"], job["state"], job["into"]) for name, job in made.items()} == {
        "sum": ("sum", "queued", "made"),
        "square": ("square", "waiting", "squared"),
    }
    waiting = ok(owner.get(f"/jobs/{made['square']['id']}"))
    assert waiting["inputs"] == {"things": [{"job": made["sum"]["id"]}]}
    assert waiting["after"] == [made["sum"]["id"]]

    assert do_next(server, worker, "a")["job"] == made["sum"]["id"]
    lease = do_next(server, worker, "a2")
    assert lease["job"] == made["square"]["id"]
    (pin,) = lease["inputs"]["things"]
    assert (pin["name"], pin["revision"], pin["collection"]) == ("a", 1, "made")
    told = [one["kind"] for one in ok(owner.get(f"/jobs/{made['square']['id']}/events"))["items"]]
    assert told == ["job.submitted", "job.bound", "job.started", "job.succeeded"]
    assert {job["state"] for job in submit(owner).values()} == {"succeeded"}


def test_a_pipeline_sent_twice_is_one(owner: httpx.Client) -> None:
    first, second = (submit(owner, **{"Idempotency-Key": "once"}) for _ in range(2))
    assert first == second
    assert len(ok(owner.get("/projects/lab/jobs"))["items"]) == 2
    other = {**CHAIN, "into": "elsewhere"}
    refused = owner.post("/projects/lab/pipelines", json=other, headers={"Idempotency-Key": "once"})
    assert refused.status_code == 422


def test_a_pipeline_that_makes_no_sense_is_refused_whole_and_with_its_place(owner: httpx.Client) -> None:
    for steps, pointer in (
        ({**CHAIN["steps"], "sum": {"kind": "sum", "after": ["square"]}}, "/steps/sum/after/0"),
        ({**CHAIN["steps"], "sum": {"kind": "sum", "params": {"no": 1}}}, "/steps/sum/params/no"),
        ({"square": CHAIN["steps"]["square"]}, "/steps/square/inputs/things/step"),
        ({f"s{n}": {"kind": "sum"} for n in range(33)}, "/steps"),
    ):
        refused = owner.post("/projects/lab/pipelines", json={"steps": steps})
        assert (refused.status_code, refused.json()["errors"][0]["pointer"]) == (422, pointer)
    assert ok(owner.get("/projects/lab/jobs"))["items"] == []


def test_jobs_of_other_projects_are_as_unknown_as_none(server: Server, owner: httpx.Client) -> None:
    hidden = server.client(server.make_project("other", owner="hanna"))
    theirs = ok(hidden.post("/projects/other/jobs", json={"kind": "sum"}), 202)["id"]
    told = []
    for job in (theirs, "job_nowhere"):
        steps = {"square": {"kind": "square", "inputs": {"things": {"job": job}}}}
        refused = owner.post("/projects/lab/pipelines", json={"steps": steps})
        assert refused.status_code == 422
        told.append(refused.text.replace(job, "X").replace(refused.json()["instance"], ""))
        alone = owner.post("/projects/lab/jobs", json={"kind": "square", "inputs": {"things": {"job": job}}})
        assert (alone.status_code, alone.json()["errors"][0]["code"]) == (422, "unknown-job")
    assert told[0] == told[1]
    assert hidden.post("/projects/lab/pipelines", json=CHAIN).status_code == 404


def test_only_who_may_submit_jobs_submits_pipelines(server: Server, owner: httpx.Client) -> None:
    reader = server.make_user("rita")
    ok(owner.put("/projects/lab/members/rita", json={"role": "reader"}))
    assert server.client(reader).post("/projects/lab/pipelines", json=CHAIN).status_code == 403
    narrow = ok(owner.post("/tokens", json={"name": "narrow", "scopes": ["read", "write"]}), 201)["secret"]
    assert server.client(narrow).post("/projects/lab/pipelines", json=CHAIN).status_code == 403
