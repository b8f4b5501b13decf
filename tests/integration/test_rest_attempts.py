"""Tokens of attempts, and tokens limited to a project, over HTTP: what they allow, and when they end."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import httpx
import pytest
from tests.support.rest_server import ALL_SCOPES, Server

from marey_server.access.principal import SYSTEM
from marey_server.store.credentials import tokens

CHAIN = {"schema": "marey/skeleton@1", "joints": [{"name": "hips", "parent": -1, "offset": [0, 1, 0]}]}
ORIGINAL, SECRET = b"the file of the clip", b"of another project"
LAST = {"write_id": "the-last-request"}


def digest(data: bytes) -> str:
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def put(client: httpx.Client, data: bytes) -> httpx.Response:
    return client.put(f"/blobs/{digest(data)}", content=data)


def add(client: httpx.Client, project: str, kind: str, name: str, **parts: Any) -> str:
    """Create an item; return its id."""
    made = client.post(f"/projects/{project}/{kind}", json={"name": name, "parts": parts})
    assert made.status_code == 201, made.text
    item: str = made.json()["id"]
    return item


def study(blob: bytes) -> dict[str, Any]:
    return {"schema": "marey/document@1", "blob": digest(blob)}


@dataclass
class Desk:
    """An author with two projects, and a running attempt of a job in one of them."""

    server: Server
    author: httpx.Client
    worker: httpx.Client
    attempt: httpx.Client
    place: str
    job: str
    clip: str
    skeleton: str
    other_clip: str
    admin: str

    def part(self, kind: str, item: str, part: str) -> Any:
        place = {"kind": kind, "item": item, "revision": 1, "part": part}
        answer = self.attempt.post("/projects/lab/parts", json={"parts": [place]})
        assert answer.status_code == 200, answer.text
        return answer.json()["documents"][0]

    def stage(self, blob: bytes) -> httpx.Response:
        output = {"name": "made", "kind": "character", "item_name": "made", "parts": {"character": study(blob)}}
        return self.attempt.post(f"{self.place}/outputs", json={"outputs": [output]})

    def submit(self) -> tuple[httpx.Client, str, str]:
        """Submit and claim a job; return the client of its attempt, the path of the attempt, and the id of the job."""
        body = {"kind": "export", "inputs": {"clips": [{"item": self.clip}]}, "cache": "off"}
        assert self.author.post("/projects/lab/jobs", json=body).status_code == 202
        (lease,) = self.worker.post("/leases", json={"worker": "w", "kinds": ["export"]}).json()["leases"]
        client = self.server.client(lease["attempt_token"])
        return client, f"/jobs/{lease['job']}/attempts/{lease['fence']}", lease["job"]

    def ended_job(self) -> Any:
        """Wait for the end of the job, and return it."""
        client = self.server.client(self.admin)
        for _ in range(8):
            job = client.get(f"/jobs/{self.job}", headers={"Prefer": "wait=30"}).json()
            if job["finished_at"] is not None:
                break
        return job


@pytest.fixture
def desk(server: Server) -> Desk:
    admin = server.make_user("root", administrator=True, scopes=ALL_SCOPES)
    author = server.client(server.make_project("lab", owner="olga"))
    assert author.post("/projects", json={"name": "other"}).status_code == 201
    for data in (ORIGINAL, SECRET):
        assert put(author, data).is_success
    add(author, "other", "characters", "secret", character=study(SECRET))
    skeleton = add(author, "lab", "skeletons", "rig", hierarchy=CHAIN)
    motion = {
        "schema": "marey/motion@1", "skeleton": {"item": skeleton, "revision": 1}, "frame_rate_hz": 30,
        "joints": ["hips"], "poses": {"dtype": "<f4", "shape": [1, 7], "data": [[0, 1, 0, 1, 0, 0, 0]]},
    }  # fmt: skip
    info = {"schema": "marey/clip-info@1", "source": {"file": digest(ORIGINAL), "file_name": "walk.bvh"}}
    clip = add(author, "lab", "clips", "walk", motion=motion, info=info)
    other_clip = add(author, "lab", "clips", "run", motion=motion)
    worker = server.client(server.make_user("worker", administrator=True, scopes=("work",)))
    made = Desk(server, author, worker, author, "", "", clip, skeleton, other_clip, admin)
    made.attempt, made.place, made.job = made.submit()
    return made


# -- what an attempt reads and publishes ------------------------------------------------------------------------------


def test_an_attempt_reads_its_inputs_and_what_they_name_and_nothing_else(desk: Desk) -> None:
    assert desk.part("clip", desk.clip, "motion")["joints"] == ["hips"]
    assert desk.part("skeleton", desk.skeleton, "hierarchy")["joints"]
    assert desk.attempt.get(f"/blobs/{digest(ORIGINAL)}").content == ORIGINAL
    assert desk.part("clip", desk.other_clip, "motion") is None
    reads = {
        f"/projects/lab/clips/{desk.clip}": 200,
        f"/projects/lab/skeletons/{desk.skeleton}": 200,
        f"/projects/lab/clips/{desk.other_clip}": 404,
        "/projects/lab/clips": 403,
        "/projects/lab/clips?name=*": 403,
        "/projects/lab/clips?name=run": 200,
        "/projects/lab": 403,
        "/projects/lab/events": 403,
        "/projects/lab/members": 403,
        f"/jobs/{desk.job}": 403,
        f"/jobs/{desk.job}/results": 200,
        "/projects": 200,
    }
    assert {address: desk.attempt.get(address).status_code for address in reads} == reads
    assert desk.attempt.get("/projects").json()["items"] == []


def test_an_attempt_reads_an_input_that_was_deleted_and_no_other_deleted_clip(desk: Desk) -> None:
    for kind, item in (("clips", desk.clip), ("skeletons", desk.skeleton), ("clips", desk.other_clip)):
        assert desk.author.delete(f"/projects/lab/{kind}/{item}", headers={"If-Match": "*"}).is_success
    assert desk.part("clip", desk.clip, "motion")["joints"] == ["hips"]
    assert desk.attempt.get(f"/blobs/{digest(ORIGINAL)}").content == ORIGINAL
    assert desk.part("skeleton", desk.skeleton, "hierarchy") is not None, "clips that use it must stay readable"
    assert desk.part("clip", desk.other_clip, "motion") is None
    place = {"kind": "clip", "item": desk.clip, "revision": 1, "part": "motion"}
    assert desk.author.post("/projects/lab/parts", json={"parts": [place]}).json() == {"documents": [None]}


def test_an_attempt_neither_reads_nor_publishes_blobs_of_its_author_in_another_project(desk: Desk) -> None:
    assert desk.attempt.get(f"/blobs/{digest(SECRET)}").status_code == 404
    assert desk.stage(SECRET).json()["code"] == "missing-blobs"
    named = {**LAST, "result": {"archive": {"blob": digest(SECRET)}}}
    assert desk.attempt.post(f"{desk.place}/complete", json=named).json()["code"] == "missing-blobs"
    assert put(desk.attempt, b"made by the attempt").is_success
    assert desk.stage(b"made by the attempt").is_success
    assert desk.author.get(f"/blobs/{digest(b'made by the attempt')}").status_code == 404
    assert desk.attempt.post(f"{desk.place}/complete", json=LAST).status_code == 200
    assert desk.author.get(f"/blobs/{digest(b'made by the attempt')}").is_success


def test_a_batch_of_completions_publishes_nothing_that_only_the_worker_possesses(desk: Desk) -> None:
    user = desk.server.database.read(SYSTEM, tokens.resolve_token, desk.worker.headers["Authorization"][7:])
    own = desk.server.make_token(str(user.user_id), "worker", administrator=True, scopes=ALL_SCOPES)
    assert put(desk.server.client(own), b"of the worker").is_success
    done = {"job": desk.job, "fence": 1, **LAST, "result": {"archive": {"blob": digest(b"of the worker")}}}
    (result,) = desk.worker.post("/leases/completions", json={"completions": [done]}).json()["results"]
    assert result["code"] == "missing-blobs"


def test_uploads_of_an_attempt_and_of_its_author_are_separate(desk: Desk) -> None:
    of_attempt, of_author = (
        client.post("/uploads", json={"length": len(SECRET)}).json()["id"] for client in (desk.attempt, desk.author)
    )
    assert desk.author.get(f"/uploads/{of_attempt}").status_code == 404
    assert desk.attempt.get(f"/uploads/{of_author}").status_code == 404
    piece = {"Upload-Offset": "0"}
    sent = desk.attempt.patch(f"/uploads/{of_attempt}", content=SECRET, headers=piece)
    assert sent.json()["digest"] == digest(SECRET)
    assert desk.attempt.get(f"/blobs/{digest(SECRET)}").content == SECRET


# -- its end ----------------------------------------------------------------------------------------------------------


def test_an_attempt_that_has_ended_repeats_its_last_request_and_does_nothing_else(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = desk.attempt.post(f"{desk.place}/complete", json=LAST)
    requests: tuple[tuple[str, str, Any], ...] = (
        ("GET", f"/blobs/{digest(ORIGINAL)}", None),
        ("POST", "/projects/lab/parts", {"parts": []}),
        ("GET", f"/projects/lab/clips/{desk.clip}", None),
        ("POST", "/uploads", {"length": 2**34}),
        ("POST", f"{desk.place}/heartbeat", {}),
        ("POST", f"{desk.place}/complete", {"write_id": "another-request"}),
        ("GET", "/me", None),
    )
    for method, address, body in requests:
        answer = desk.attempt.request(method, address, json=body)
        assert (answer.status_code, answer.json()["code"]) == (409, "lease-lost"), address
    assert put(desk.attempt, b"late").status_code == 409
    again = desk.attempt.post(f"{desk.place}/complete", json=LAST)
    assert (again.status_code, again.json()) == (200, first.json())
    monkeypatch.setattr(tokens, "REPLAY_GRACE_US", 0)
    assert desk.attempt.post(f"{desk.place}/complete", json=LAST).status_code == 401


def test_the_report_of_a_failure_is_repeated_while_another_attempt_runs(desk: Desk) -> None:
    body = {**LAST, "code": "stopped", "interrupted": True}
    first = desk.attempt.post(f"{desk.place}/fail", json=body)
    assert desk.worker.post("/leases", json={"worker": "w", "kinds": ["export"]}).json()["leases"]
    again = desk.attempt.post(f"{desk.place}/fail", json=body)
    assert (again.status_code, again.json()) == (200, first.json())
    assert desk.attempt.get(f"/blobs/{digest(ORIGINAL)}").status_code == 409


@pytest.mark.parametrize("way", ["disabled", "removed", "reader"])
def test_an_attempt_dies_when_its_author_may_no_longer_run_the_job(desk: Desk, way: str) -> None:
    admin = desk.server.client(desk.admin)
    assert admin.put("/projects/lab/members/root", json={"role": "owner"}).is_success
    any_state = {"If-Match": "*"}
    assert desk.attempt.post(f"{desk.place}/heartbeat", json={}).status_code == 200
    assert desk.stage(ORIGINAL).is_success
    if way == "disabled":
        done = admin.patch("/users/olga", json={"disabled": True}, headers=any_state)
    elif way == "removed":
        done = admin.delete("/projects/lab/members/olga", headers=any_state)
    else:
        done = admin.put("/projects/lab/members/olga", json={"role": "reader"}, headers=any_state)
    assert done.is_success, done.text
    refused = desk.attempt.post(f"{desk.place}/heartbeat", json={})
    assert (refused.status_code, refused.json()["code"]) == (409, "lease-lost")
    assert refused.json()["context"] == {"reason": "author-lost-access"}
    assert desk.attempt.post(f"{desk.place}/complete", json=LAST).status_code == 409
    job = desk.ended_job()
    assert (job["state"], job["failure"]["code"]) == ("failed", "author-lost-access")
    assert admin.get("/projects/lab/characters").json()["items"] == []


def test_a_batch_of_completions_publishes_nothing_of_an_author_who_was_disabled(desk: Desk) -> None:
    admin = desk.server.client(desk.admin)
    assert admin.patch("/users/olga", json={"disabled": True}, headers={"If-Match": "*"}).is_success
    done = {"job": desk.job, "fence": 1, **LAST}
    (result,) = desk.worker.post("/leases/completions", json={"completions": [done]}).json()["results"]
    assert result["code"] == "lease-lost"


# -- what is decoded for it -------------------------------------------------------------------------------------------


def in_chunks(body: bytes) -> Iterator[bytes]:
    """Yield the bytes of a body, so that the client sends a chunked request without Content-Length."""
    yield body


@pytest.mark.parametrize("chunked", [False, True])
def test_nothing_is_decoded_for_an_attempt_that_has_ended_or_belongs_to_another_job(
    desk: Desk, decoded: list[int], *, chunked: bool
) -> None:
    _, of_other, _ = desk.submit()
    assert desk.attempt.post(f"{desk.place}/heartbeat", json={}).is_success
    body = b"[" + b"[]," * 100_000 + b"[]]"
    decoded.clear()

    def send(place: str, what: str) -> int:
        content = in_chunks(body) if chunked else body
        headers = {"Content-Type": "application/json"}
        return desk.attempt.post(f"{place}/{what}", content=content, headers=headers).status_code

    assert (send(of_other, "outputs"), send(of_other, "complete"), decoded) == (404, 404, [])
    assert desk.attempt.post(f"{desk.place}/complete", json=LAST).is_success
    decoded.clear()
    assert (send(desk.place, "outputs"), decoded) == (409, [])


# -- tokens bound to a project ----------------------------------------------------------------------------------------


@pytest.fixture
def bound(desk: Desk) -> httpx.Client:
    """A client with a token of the author that is valid only for the project `lab`."""
    user = desk.server.database.read(SYSTEM, tokens.resolve_token, desk.author.headers["Authorization"][7:])
    scopes = ("read!project=lab", "write!project=lab", "jobs!project=lab")
    return desk.server.client(desk.server.make_token(str(user.user_id), "olga", scopes=scopes))


def test_a_bound_token_learns_reads_and_publishes_nothing_of_another_project(desk: Desk, bound: httpx.Client) -> None:
    assert put(desk.author, b"just sent").is_success
    hidden = [digest(SECRET), digest(b"just sent")]
    assert bound.post("/blobs/missing", json={"digests": hidden}).json()["missing"] == hidden
    for data in (SECRET, b"just sent"):
        unknown = f"/blobs/{digest(b'that nobody has')}"
        theirs, nobodys = bound.get(f"/blobs/{digest(data)}").json(), bound.get(unknown).json()
        assert theirs["detail"].replace(digest(data), "") == nobodys["detail"].replace(unknown[7:], "")
        body = {"name": "copy", "parts": {"character": study(data)}}
        assert bound.post("/projects/lab/characters", json=body).json()["code"] == "missing-blobs"
        files = {"files": [{"name": "walk.bvh", "blob": digest(data)}]}
        assert bound.post("/projects/lab/imports", json=files).status_code == 404
        job = {"kind": "import", "params": files}
        assert bound.post("/projects/lab/jobs", json=job).json()["code"] == "missing-blobs"
    upload = desk.author.post("/uploads", json={"length": 5}).json()["id"]
    assert bound.get(f"/uploads/{upload}").status_code == 404


def test_a_bound_token_uses_what_it_sent_and_what_its_project_refers_to(desk: Desk, bound: httpx.Client) -> None:
    assert put(bound, b"mine").is_success
    assert bound.post("/blobs/missing", json={"digests": [digest(b"mine")]}).json()["missing"] == []
    for data in (b"mine", ORIGINAL):
        assert bound.get(f"/blobs/{digest(data)}").content == data
        add(bound, "lab", "characters", f"of {len(data)}", character=study(data))
    upload = bound.post("/uploads", json={"length": 5}).json()["id"]
    assert bound.get(f"/uploads/{upload}").is_success
    sent = bound.patch(f"/uploads/{upload}", content=b"12345", headers={"Upload-Offset": "0"})
    assert bound.get(f"/blobs/{sent.json()['digest']}").content == b"12345"
    assert desk.author.get(f"/blobs/{digest(b'mine')}").is_success


def test_an_author_who_may_read_both_projects_copies_between_them(desk: Desk) -> None:
    add(desk.author, "lab", "characters", "copy", character=study(SECRET))
    assert desk.author.get(f"/blobs/{digest(SECRET)}").content == SECRET


def test_a_bound_token_sends_nothing_where_its_user_may_not_write(desk: Desk) -> None:
    user = desk.server.database.read(SYSTEM, tokens.resolve_token, desk.author.headers["Authorization"][7:])
    assert desk.server.client(desk.admin).post("/projects", json={"name": "hidden"}).status_code == 201
    for project in ("hidden", "nowhere"):
        token = desk.server.make_token(str(user.user_id), "olga", scopes=(f"write!project={project}",))
        assert put(desk.server.client(token), b"x").json()["code"] == "insufficient-scope"
