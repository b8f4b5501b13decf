"""Jobs and the worker protocol over HTTP."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server, running

from marey_schemas.encoding import codecs, tiles
from marey_schemas.encoding.arrays import EncodedArray
from marey_server.access.principal import SYSTEM
from marey_server.errors import InvalidProblem
from marey_server.store.database.connections import Database
from marey_server.store.jobs import reaper
from marey_server.store.transaction import Transaction

BLOCKS = "application/msgpack; arrays=blocks"


pytestmark = pytest.mark.usefixtures("test_kinds")


def ok(response: httpx.Response, status: int = 200) -> Any:
    assert response.status_code == status, response.text
    return response.json()


def submit(owner: httpx.Client, kind: str = "errand", **fields: Any) -> Any:
    return ok(owner.post("/projects/lab/jobs", json={"kind": kind, **fields}), 202)


def claim(worker: httpx.Client, **fields: Any) -> list[Any]:
    wanted = {"worker": "w", "kinds": ["errand", "sum", "square"], "max": 10, **fields}
    return list(ok(worker.post("/leases", json=wanted))["leases"])


def attempt(server: Server, lease: dict[str, Any]) -> httpx.Client:
    client = server.client(lease["attempt_token"])
    client.base_url = httpx.URL(f"{server.api}/jobs/{lease['job']}/attempts/{lease['fence']}/")
    return client


def thing(name: str, value: object = 1) -> dict[str, Any]:
    parts = {"character": {"schema": "marey/document@1", "value": value}}
    return {"name": name, "kind": "character", "item_name": name, "parts": parts}


def test_staged_arrays_are_stored_as_they_came_if_their_blocks_are_predicted(
    server: Server, owner: httpx.Client, worker: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    array = np.cumsum(np.arange(4000.0).reshape(1000, 4), axis=0)
    compress = tiles._compress
    with monkeypatch.context() as slower:
        slower.setattr(tiles, "_compress", lambda sections, _level=1: compress(sections, 12))
        small = EncodedArray.of(array)
    unpredicted = EncodedArray.of(array + 1, predict=False)
    assert small != EncodedArray.of(array)
    submit(owner)
    (lease,) = claim(worker)
    mine = attempt(server, lease)
    outputs = [thing("small", small), thing("unpredicted", unpredicted)]
    body = codecs.encode_tree({"outputs": outputs}, "application/msgpack", arrays="blocks")
    ok(mine.post("outputs", content=body, headers={"Content-Type": BLOCKS}))
    kept, encoded_again = ok(mine.post("complete", json={"write_id": "the-only-one"}))["outputs"]

    def stored(output: Any) -> bytes:
        place = f"/projects/lab/characters/{output['item']}/parts/character"
        leaf = msgpack.unpackb(owner.get(place, headers={"Accept": BLOCKS}).content)["value"]
        return bytes(leaf["data"])

    assert stored(kept) == small.data
    assert stored(encoded_again) == EncodedArray.of(array + 1).data


def test_a_job_goes_from_its_submission_to_its_outputs(
    server: Server, owner: httpx.Client, worker: httpx.Client
) -> None:
    response = owner.post("/projects/lab/jobs", json={"kind": "errand", "into": "made"})
    job = ok(response, 202)
    assert response.headers["Location"] == f"/api/v1/jobs/{job['id']}"
    assert response.headers["Retry-After"] == "1"
    (lease,) = claim(worker)
    mine = attempt(server, lease)
    assert ok(mine.post("heartbeat", json={"progress": {"done": 1, "total": 2}}))["cancel_requested"] is False
    assert ok(owner.get(f"/jobs/{job['id']}"))["progress"]["done"] == 1
    assert ok(mine.post("outputs", json={"outputs": [thing("a")]}))["staged"] == 1
    body = codecs.encode_tree({"outputs": [thing("b", np.arange(12.0))]}, "application/msgpack", arrays="blocks")
    assert ok(mine.post("outputs", content=body, headers={"Content-Type": BLOCKS}))["staged"] == 2

    done = ok(mine.post("complete", json={"write_id": "write-one", "result": {"seconds": 1.5}}))
    assert [one["name"] for one in done["outputs"]] == ["a", "b"]
    assert ok(mine.post("complete", json={"write_id": "write-one"})) == done
    assert mine.post("complete", json={"write_id": "write-two"}).status_code == 409
    assert ok(owner.get(f"/jobs/{job['id']}/outputs"))["items"] == done["outputs"]
    assert ok(owner.get(f"/jobs/{job['id']}"))["result"] == {"seconds": 1.5, "outputs": 2}
    (tried,) = ok(owner.get(f"/jobs/{job['id']}/attempts"))["items"]
    assert (tried["worker"], tried["outcome"]) == ("w", "succeeded")
    told = [one["kind"] for one in ok(owner.get(f"/jobs/{job['id']}/events"))["items"]]
    assert told == ["job.submitted", "job.started", "job.succeeded"]
    made = ok(owner.get("/projects/lab/characters", params={"collection": "made"}))["items"]
    assert sorted(one["name"] for one in made) == ["a", "b"]


def test_jobs_are_listed_by_the_states_there_are(owner: httpx.Client) -> None:
    job = submit(owner)
    assert [one["id"] for one in ok(owner.get("/projects/lab/jobs?state=queued,failed"))["items"]] == [job["id"]]
    assert ok(owner.get("/projects/lab/jobs?state=failed"))["items"] == []
    refused = owner.get("/projects/lab/jobs?state=queued,done")
    assert refused.status_code == 400
    (fault,) = refused.json()["errors"]
    assert fault["pointer"] == "state.1"
    for state in ("waiting", "queued", "running", "succeeded", "failed", "cancelled"):
        assert f"'{state}'" in fault["detail"]


def test_a_waiting_worker_hears_of_a_job_when_it_is_submitted(owner: httpx.Client, worker: httpx.Client) -> None:
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(claim, worker, wait_s=30)
        time.sleep(0.3)
        assert not waiting.done()
        job = submit(owner)
        (lease,) = waiting.result(30)
    assert lease["job"] == job["id"]
    assert claim(worker, wait_s=0.1) == []


def test_who_prefers_to_wait_is_answered_when_the_job_has_ended(
    server: Server, owner: httpx.Client, worker: httpx.Client
) -> None:
    job = submit(owner)
    (lease,) = claim(worker)
    prefer = {"Prefer": "wait=30"}
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(owner.get, f"/jobs/{job['id']}", headers=prefer)
        time.sleep(0.3)
        assert not waiting.done()
        ok(attempt(server, lease).post("complete", json={"write_id": "write-one"}))
        assert ok(waiting.result(30))["state"] == "succeeded"
    started = time.monotonic()
    late = ok(owner.post("/projects/lab/jobs", json={"kind": "errand"}, headers={"Prefer": "wait=1"}), 202)
    assert late["state"] == "queued"
    assert time.monotonic() - started >= 0.9


def test_the_same_submission_sent_twice_is_one_job(owner: httpx.Client) -> None:
    key = {"Idempotency-Key": "once"}
    first = owner.post("/projects/lab/jobs", json={"kind": "errand"}, headers=key)
    second = owner.post("/projects/lab/jobs", json={"kind": "errand"}, headers=key)
    assert ok(first, 202) == ok(second, 202)
    assert len(ok(owner.get("/projects/lab/jobs"))["items"]) == 1


def test_many_are_submitted_claimed_and_completed_at_once(owner: httpx.Client, worker: httpx.Client) -> None:
    wanted = [{"kind": "errand", "params": {"number": n}} for n in range(20)]
    made = ok(owner.post("/projects/lab/jobs/batch", json={"jobs": wanted}), 202)["jobs"]
    leases = claim(worker, max=256)
    assert {one["job"] for one in leases} == {one["id"] for one in made}
    done = [{"job": one["job"], "fence": one["fence"], "write_id": "write-one"} for one in leases]
    done.append({"job": "job_none", "fence": 1, "write_id": "write-one"})
    results = ok(worker.post("/leases/completions", json={"completions": done}))["results"]
    assert [one["answer"] is not None for one in results] == [True] * 20 + [False]
    refused = owner.post("/projects/lab/jobs/batch", json={"jobs": [*wanted, {"kind": "errand", "params": {"no": 1}}]})
    assert refused.status_code == 422
    assert refused.json()["errors"][0]["pointer"] == "/jobs/20/params/no"


def test_a_worker_that_was_too_slow_gets_409_everywhere(
    server: Server, owner: httpx.Client, worker: httpx.Client, clock: AdjustableClock
) -> None:
    job = submit(owner)
    (slept,) = claim(worker)
    clock.advance(61)
    assert server.database.write(SYSTEM, reaper.reap_page).taken == 1
    (awake,) = claim(worker)
    stale = attempt(server, slept)
    requests: list[tuple[str, dict[str, Any]]] = [
        ("heartbeat", {"json": {}}),
        ("log", {"content": b"late", "headers": {"Upload-Offset": "0"}}),
        ("outputs", {"json": {"outputs": [thing("late")]}}),
        ("complete", {"json": {"write_id": "write-one"}}),
        ("fail", {"json": {"write_id": "write-one", "code": "late"}}),
    ]
    for name, content in requests:
        response = stale.post(name, **content)
        assert (response.status_code, response.json()["code"]) == (409, "lease-lost"), name
    fresh = attempt(server, awake)
    ok(fresh.post("complete", json={"write_id": "write-two"}))
    for name, content in requests:
        assert stale.post(name, **content).status_code == 409, name
    outcomes = [one["outcome"] for one in ok(owner.get(f"/jobs/{job['id']}/attempts"))["items"]]
    assert outcomes == ["lost", "succeeded"]


def test_a_log_is_appended_by_offset_and_read_from_any_byte(
    server: Server, owner: httpx.Client, worker: httpx.Client
) -> None:
    job = submit(owner)
    (lease,) = claim(worker)
    mine = attempt(server, lease)
    for offset, piece in ((0, b"one\n"), (4, b"two\n"), (0, b"one\n")):
        ok(mine.post("log", content=piece, headers={"Upload-Offset": str(offset)}))
    refused = mine.post("log", content=b"three", headers={"Upload-Offset": "5"})
    assert (refused.status_code, refused.json()["context"]) == (409, {"offset": 8})
    assert mine.post("log", content=b"three").status_code == 400
    read = owner.get(f"/jobs/{job['id']}/log", params={"offset": 4}, headers={"Accept": "text/plain"})
    assert (read.content, read.headers["Log-Offset"], read.headers["Log-Sealed"]) == (b"two\n", "8", "false")
    ok(mine.post("complete", json={"write_id": "write-one"}))
    assert owner.get(f"/jobs/{job['id']}/log").headers["Log-Sealed"] == "true"


def test_a_job_is_cancelled_and_tried_again(server: Server, owner: httpx.Client, worker: httpx.Client) -> None:
    job = submit(owner)
    (lease,) = claim(worker)
    assert ok(owner.post(f"/jobs/{job['id']}/cancel"))["cancel_requested"]
    mine = attempt(server, lease)
    assert ok(mine.post("heartbeat", json={}))["cancel_requested"]
    assert ok(mine.post("fail", json={"write_id": "write-one", "code": "cancelled"}))["state"] == "cancelled"
    again = owner.post(f"/jobs/{job['id']}/retry")
    assert ok(again, 202)["retry_of"] == job["id"]
    assert again.headers["Location"].endswith(again.json()["id"])
    assert owner.post(f"/jobs/{again.json()['id']}/retry").status_code == 409


def test_a_claim_whose_answer_was_lost_is_answered_again(owner: httpx.Client, worker: httpx.Client) -> None:
    for _ in range(3):
        submit(owner)
    wanted = {"worker": "w", "kinds": ["errand"], "max": 2, "claim_id": "a" * 32}
    answers = [ok(worker.post("/leases", json=wanted)) for _ in range(2)]
    assert answers[0] == answers[1]
    assert len({lease["job"] for lease in answers[0]["leases"]}) == 2
    assert len(claim(worker, max=256)) == 1


def test_names_of_workers_are_for_contributors(server: Server, owner: httpx.Client, worker: httpx.Client) -> None:
    job = submit(owner)
    claim(worker)
    ok(owner.patch("/projects/lab", json={"visibility": "public"}, headers={"If-Match": "*"}))
    for client, name in (
        (owner, "w"),
        (server.client(), "a worker"),
        (server.client(server.make_user("sam")), "a worker"),
    ):
        (tried,) = ok(client.get(f"/jobs/{job['id']}/attempts"))["items"]
        assert tried["worker"] == name


def test_strangers_neither_see_nor_touch_jobs(server: Server, owner: httpx.Client) -> None:
    job = submit(owner)
    stranger = server.client(server.make_user("sam"))
    for method, path in (("GET", ""), ("GET", "/log"), ("GET", "/events"), ("POST", "/cancel"), ("POST", "/retry")):
        assert stranger.request(method, f"/jobs/{job['id']}{path}").status_code == 404, path
    assert stranger.post("/leases", json={"worker": "w", "kinds": ["errand"]}).status_code == 403


def test_contributors_cancel_and_retry_their_own_jobs_only(
    server: Server, owner: httpx.Client, worker: httpx.Client
) -> None:
    sam = server.client(server.make_user("sam"))
    ok(owner.put("/projects/lab/members/sam", json={"role": "contributor"}))
    theirs, own = submit(owner), submit(sam)
    for what in ("cancel", "retry"):
        refused = sam.post(f"/jobs/{theirs['id']}/{what}")
        assert (refused.status_code, refused.json()["code"]) == (403, "insufficient-role")
        if what == "cancel":
            ok(owner.post(f"/jobs/{theirs['id']}/cancel"))
    ok(sam.post(f"/jobs/{own['id']}/cancel"))
    assert ok(sam.post(f"/jobs/{own['id']}/retry"), 202)["retry_of"] == own["id"]
    assert ok(owner.post(f"/jobs/{theirs['id']}/retry"), 202)["retry_of"] == theirs["id"]


def test_who_has_left_a_project_does_not_hear_of_a_retry_again(server: Server, owner: httpx.Client) -> None:
    sam = server.client(server.make_user("sam"))
    ok(owner.put("/projects/lab/members/sam", json={"role": "contributor"}))
    job = submit(sam)["id"]
    ok(sam.post(f"/jobs/{job}/cancel"))

    def retry() -> httpx.Response:
        return sam.post(f"/jobs/{job}/retry", headers={"Idempotency-Key": "again"})

    first = ok(retry(), 202)
    assert ok(retry(), 202) == first
    owner.delete("/projects/lab/members/sam", headers={"If-Match": "*"}).raise_for_status()
    assert (retry().status_code, retry().json()["code"]) == (404, "no-job")


def test_a_job_whose_failed_dependency_belongs_to_another_is_retried_by_those_who_may_retry_both(
    server: Server, owner: httpx.Client
) -> None:
    sam = server.client(server.make_user("sam"))
    ok(owner.put("/projects/lab/members/sam", json={"role": "contributor"}))
    theirs = submit(owner)
    own = submit(sam, after=[theirs["id"]])
    ok(owner.post(f"/jobs/{theirs['id']}/cancel"))
    assert ok(sam.get(f"/jobs/{own['id']}"))["state"] == "failed"
    refused = sam.post(f"/jobs/{own['id']}/retry")
    assert (refused.status_code, refused.json()["code"]) == (403, "insufficient-role")
    again = ok(owner.post(f"/jobs/{own['id']}/retry"), 202)
    assert (again["retry_of"], again["state"]) == (own["id"], "waiting")


def test_a_retry_takes_along_the_dependants_that_the_caller_may_retry(server: Server, owner: httpx.Client) -> None:
    sam = server.client(server.make_user("sam"))
    ok(owner.put("/projects/lab/members/sam", json={"role": "contributor"}))
    failed = submit(sam)
    own, theirs = submit(sam, after=[failed["id"]]), submit(owner, after=[failed["id"]])
    ok(sam.post(f"/jobs/{failed['id']}/cancel"))
    ok(sam.post(f"/jobs/{failed['id']}/retry"), 202)

    def retried() -> set[str]:
        return {one["retry_of"] for one in ok(owner.get("/projects/lab/jobs"))["items"] if one["retry_of"]}

    assert retried() == {failed["id"], own["id"]}
    ok(owner.post(f"/jobs/{theirs['id']}/retry"), 202)
    assert retried() == {failed["id"], own["id"], theirs["id"]}


def test_a_retry_without_dependants_leaves_them_as_they_are(owner: httpx.Client) -> None:
    failed = submit(owner)
    dependant = submit(owner, after=[failed["id"]])
    ok(owner.post(f"/jobs/{failed['id']}/cancel"))
    assert owner.post(f"/jobs/{failed['id']}/retry?dependants=perhaps").status_code == 400
    again = ok(owner.post(f"/jobs/{failed['id']}/retry?dependants=false"), 202)
    jobs = ok(owner.get("/projects/lab/jobs"))["items"]
    assert {one["id"] for one in jobs} == {failed["id"], dependant["id"], again["id"]}


def test_anybody_may_list_the_kinds_of_jobs(server: Server) -> None:
    worker = server.make_user("worker", scopes=("work",))
    for anybody in (server.client(), server.client(worker)):
        kinds = ok(anybody.get("/job-kinds"))["items"]
        assert {"import", "retarget", "export"} <= {kind["name"] for kind in kinds}
        assert ok(anybody.get("/job-kinds/retarget"))["inputs"]["clips"]["kind"] == "clip"
        unknown = anybody.get("/job-kinds/Levitate")
        assert unknown.status_code == 404
        assert unknown.json()["detail"].startswith("There is no job kind 'Levitate'")


def test_jobs_of_lost_workers_are_taken_back_whatever_becomes_of_the_other_chores(
    database: Database, tmp_path: Path, test_kinds: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = threading.Event()

    def share_nothing(tx: Transaction) -> int:
        tried.set()
        raise InvalidProblem("This result is not to be had.")

    monkeypatch.setattr(reaper, "share_waiting", share_nothing)
    with running(database, tmp_path, lease_ttl_s=1, heartbeat_s=0.3) as server:
        owner = server.client(server.make_project())
        worker = server.client(server.make_user("wanda", administrator=True, scopes=("work",)))
        job = submit(owner)
        claim(worker)
        assert tried.wait(PATIENCE_S)
        (again,) = claim(worker, wait_s=30)
        assert again["job"] == job["id"]


def test_the_server_takes_back_jobs_of_lost_workers_by_itself(
    database: Database, tmp_path: Path, test_kinds: None
) -> None:
    with running(database, tmp_path, lease_ttl_s=1, heartbeat_s=0.3) as server:
        owner = server.client(server.make_project())
        worker = server.client(server.make_user("wanda", administrator=True, scopes=("work",)))
        job = submit(owner)
        (first,) = claim(worker)
        (second,) = claim(worker, wait_s=30)
        assert (second["job"], second["fence"] > first["fence"]) == (job["id"], True)


def test_an_administrator_lists_waiting_and_working_workers(
    server: Server, owner: httpx.Client, worker: httpx.Client
) -> None:
    chief = server.client(server.make_user("chief", administrator=True, scopes=("read", "admin")))
    waiting = {"worker": "idle", "kinds": ["errand"], "labels": {"site": "lyon"}, "version": "9.9"}
    assert ok(worker.post("/leases", json=waiting))["leases"] == []
    submit(owner)
    assert len(claim(worker)) == 1
    idle, busy = ok(chief.get("/workers"))["items"]
    assert (busy["name"], busy["running"], busy["alive"]) == ("w", 1, True)
    assert (idle["name"], idle["running"], idle["alive"], idle["version"]) == ("idle", 0, True, "9.9")
    assert (idle["labels"], idle["kinds"]) == ({"site": "lyon"}, ["errand"])
    assert owner.get("/workers").status_code == 403


def test_metrics_show_the_queue_and_do_not_read_it_again_at_once(server: Server, owner: httpx.Client) -> None:
    submit(owner, labels={"gpu": "secret-name"})
    text = httpx.get(f"{server.address}/metrics").text
    assert 'marey_jobs_queued{kind="errand",labels="some"} 1.0' in text
    assert 'marey_workers{version="other"} 0.0' in text
    assert "secret-name" not in text
    submit(owner, labels={"gpu": "secret-name"})
    assert 'marey_jobs_queued{kind="errand",labels="some"} 1.0' in httpx.get(f"{server.address}/metrics").text
