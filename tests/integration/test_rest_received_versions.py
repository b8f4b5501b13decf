"""Versions received from other servers over HTTP: revisions and commits keep their digests, or are refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from threading import current_thread
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import select

from marey_schemas.datasets.naming import MAIN
from marey_schemas.encoding import blocks
from marey_schemas.encoding.canonical import document_digest
from marey_server.access.principal import SYSTEM
from marey_server.process.computing import THREAD_NAME
from marey_server.process.memory import Holding
from marey_server.store import datasets
from marey_server.store.database.connections import Database
from marey_server.store.datasets import receiving
from marey_server.store.datasets.chunks import store_chunks
from marey_server.store.fsck import check_store
from marey_server.store.tables import dataset_ref, document
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord, key_of, revision_content
from marey_versions.tree.building import build
from marey_versions.tree.chunks import ChunksInMemory

LAB = "/projects/lab"
GAITS = f"{LAB}/datasets/gaits"
POSES = np.array([[0, 1, 0, 1, 0, 0, 0]], dtype=np.float32)
AT = "2020-01-02T03:04:05.000006Z"


def ok(response: httpx.Response, status: int = 200) -> Any:
    assert response.status_code == status, response.text
    return response.json()


def refused(response: httpx.Response, status: int, code: str) -> Any:
    assert (response.status_code, response.json().get("code")) == (status, code), response.text
    return response.json()


def hierarchy(joint: str) -> dict[str, Any]:
    return {"schema": "marey/skeleton@1", "joints": [{"name": joint, "parent": -1, "offset": [0, 1, 0]}]}


def skeleton(joint: str, path: str | None = "rig") -> dict[str, Any]:
    """Return a skeleton with one joint, as it is received from another server."""
    content = revision_content("skeleton", {"hierarchy": document_digest(hierarchy(joint))})
    return {"content": content, "kind": "skeleton", "path": path, "parts": {"hierarchy": hierarchy(joint)}}


def clip(joint: str, used: str) -> dict[str, Any]:
    """Return a clip with one frame, as another server sends it; `used` is the content digest of its skeleton."""
    motion: dict[str, Any] = {
        "schema": "marey/motion@1", "frame_rate_hz": 30, "joints": [joint], "skeleton": {"content": used},
        "poses": {"dtype": "<f4", "shape": [1, 7], "data": POSES.tolist()},
    }  # fmt: skip
    content = revision_content("clip", {"motion": document_digest({**motion, "poses": POSES})})
    return {"content": content, "kind": "clip", "path": "walk", "parts": {"motion": motion}}


def parts_of(one: dict[str, Any]) -> dict[str, str]:
    return {part: document_digest(tree) for part, tree in one["parts"].items()}


def commit(entries: dict[str, dict[str, Any]], *parents: str, before: dict[str, dict[str, Any]] | None = None) -> Any:
    """Return a received commit whose version has these entries, by path.

    `before` are the entries of the commit's first parent.
    """
    before = before or {}
    values = {key_of(path, one["kind"]): {"parts": parts_of(one), "tags": []} for path, one in entries.items()}
    tree = build(ChunksInMemory(), sorted(values.items()))
    record = CommitRecord(tree, parents, "somebody elsewhere", "Their work", AT)
    changes: list[dict[str, Any]] = [
        {"path": path, "kind": one["kind"], "parts": parts_of(one)}
        for path, one in entries.items()
        if before.get(path) != one
    ]
    changes += [{"path": path, "kind": before[path]["kind"], "parts": None} for path in before.keys() - entries.keys()]
    body = {"tree": tree, "parents": parents, "author": record.author, "message": record.message, "at": AT}
    return {**body, "changes": changes}, record.digest


@pytest.fixture
def client(owner: httpx.Client) -> httpx.Client:
    """The client of the owner of `lab`, which has the dataset `gaits` without commits."""
    ok(owner.post(f"{LAB}/datasets", json={"name": "gaits", "collection": "gaits"}), 201)
    return owner


def send(client: httpx.Client, *revisions: dict[str, Any]) -> Any:
    return ok(client.post(f"{GAITS}/contents", json={"revisions": revisions}))


def receive(client: httpx.Client, body: Any, **more: Any) -> Any:
    return ok(client.post(f"{GAITS}/received-commits", json={**body, **more}), 201)


def items_of(client: httpx.Client, kind: str = "skeletons") -> list[str]:
    return [f"{one['collection']}/{one['name']}" for one in ok(client.get(f"{LAB}/{kind}"))["items"]]


def test_commits_from_elsewhere_keep_digest_author_and_time(client: httpx.Client) -> None:
    one, two = skeleton("Hips"), skeleton("Root")
    assert send(client, one, two) == {"added": 2}
    assert send(client, one, two) == {"added": 0}
    assert items_of(client) == []
    first, digest = commit({"a/rig": one})
    assert receive(client, first)["digest"] == digest
    second, newest = commit({"a/rig": two, "b": one}, digest, before={"a/rig": one})
    made = receive(client, second, begins="main")
    assert (made["digest"], made["author"], made["at"]) == (newest, "somebody elsewhere", "2020-01-02T03:04:05.000006Z")
    assert receive(client, second, begins="main") == made
    assert [one["digest"] for one in ok(client.get(f"{GAITS}/commits"))["items"]] == [newest, digest]
    assert [one["path"] for one in ok(client.get(f"{GAITS}/entries"))["items"]] == ["a/rig", "b"]
    ok(client.post(f"{GAITS}/checkout", json={"version": "main"}))
    assert sorted(items_of(client)) == ["gaits/a/rig", "gaits/b"]


def test_a_commit_is_not_recorded_in_another_dataset_of_the_same_name(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the preparation of the commit, and before its recording, another dataset takes the place and the name."""
    one = skeleton("Hips")
    send(client, one)
    body, digest = commit({"rig": one})
    receive(client, body)
    prepare = datasets.prepare_receipt

    def prepare_and_replace(*arguments: Any) -> Any:
        prepared = prepare(*arguments)
        assert client.delete(GAITS, headers={"If-Match": "*"}).status_code == 204
        ok(client.post(f"{LAB}/datasets", json={"name": "gaits"}), 201)
        return prepared

    with monkeypatch.context() as patch:
        patch.setattr(datasets, "prepare_receipt", prepare_and_replace)
        refused(client.post(f"{GAITS}/received-commits", json=body), 409, "branch-moved")
    refused(client.get(f"{GAITS}/commits/{digest}"), 404, "no-version")
    assert (receive(client, body)["digest"], receive(client, body)["entries"]) == (digest, 1)


@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
def test_a_received_commit_locks_its_branch_before_it_stores_chunks(
    client: httpx.Client, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other commits lock in the same order, so that two commits never wait for each other."""
    one, other = skeleton("Hips"), open_database()
    send(client, one)
    free: list[list[str]] = []

    def store(tx: Transaction, chunks: Mapping[str, bytes]) -> None:
        branch = select(dataset_ref.c.name).where(dataset_ref.c.name == MAIN).with_for_update(skip_locked=True)
        free.append(other.write(SYSTEM, lambda tx: list(tx.execute(branch).scalars())))
        store_chunks(tx, chunks)

    monkeypatch.setattr(receiving, "store_chunks", store)
    receive(client, commit({"rig": one})[0], begins=MAIN)
    assert free == [[]]


def test_a_revision_that_is_no_entry_gets_an_item_that_stays(client: httpx.Client) -> None:
    used = skeleton("Hips", path=None)
    send(client, used)
    (name,) = items_of(client)
    assert name.startswith("imported/skeletons/skeleton ")


def test_a_part_that_the_project_has_is_taken_from_there(client: httpx.Client) -> None:
    one = skeleton("Hips")
    send(client, one)
    mapping = {"schema": "marey/skeleton-mapping@1", "joints": {"Hips": "hips"}}
    digests = {"hierarchy": document_digest(hierarchy("Hips")), "mapping": document_digest(mapping)}
    parts = {"hierarchy": {"content": one["content"]}, "mapping": mapping}
    two = {"content": revision_content("skeleton", digests), "kind": "skeleton", "path": "rig", "parts": parts}
    assert send(client, two) == {"added": 1}
    absent = {**two, "content": "sha256:" + "1" * 64, "parts": {"mapping": {"content": one["content"]}}}
    refused(client.post(f"{GAITS}/contents", json={"revisions": [absent]}), 422, "no-part")


def test_what_is_not_what_it_says_is_refused_and_changes_nothing(client: httpx.Client, database: Database) -> None:
    one, two = skeleton("Hips"), skeleton("Root")
    send(client, one)
    forged = {**two, "content": "sha256:" + "1" * 64}
    refused(client.post(f"{GAITS}/contents", json={"revisions": [two, forged]}), 422, "other-content")
    unknown = clip("Hips", "sha256:" + "2" * 64)
    told = refused(client.post(f"{GAITS}/contents", json={"revisions": [unknown]}), 409, "missing-contents")
    assert told["context"]["contents"] == ["sha256:" + "2" * 64]
    body, digest = commit({"a": one})
    other, _ = commit({"a": two})
    url = f"{GAITS}/received-commits"
    told = refused(client.post(url, json=other), 409, "missing-contents")
    assert told["context"]["contents"] == [two["content"]]
    refused(client.post(url, json={**body, "tree": other["tree"]}), 422, "other-tree")
    refused(client.post(url, json={**body, "parents": ["sha256:" + "3" * 64]}), 409, "missing-parents")
    for at in ("yesterday", "2020-99-01T00:00:00.000000Z", "2020-1-01T00:00:00.000000Z", "2020-01-01T00:00:00.0Z"):
        refused(client.post(url, json={**body, "at": at}), 422, "invalid-body")
    for text in ({"author": "a\0"}, {"message": "m\0"}, {"changes": [{**body["changes"][0], "tags": ["\0"]}]}):
        assert client.post(url, json={**body, **text}).status_code == 422
    refused(client.post(url, json={**body, "begins": "nowhere"}), 404, "no-version")
    refused(client.get(f"{GAITS}/commits/{digest}"), 404, "no-version")
    assert items_of(client) == []
    assert not list(check_store(database))


def test_a_branch_with_commits_does_not_begin_elsewhere(client: httpx.Client) -> None:
    one = skeleton("Hips")
    send(client, one)
    first, digest = commit({"a": one})
    receive(client, first, begins="main")
    second, _ = commit({"a": one, "b": one})
    refused(client.post(f"{GAITS}/received-commits", json={**second, "begins": "main"}), 409, "branch-moved")
    assert ok(client.get(f"{GAITS}/commits/main"))["digest"] == digest


def test_a_clip_refers_to_the_skeleton_of_this_project(client: httpx.Client) -> None:
    used = skeleton("Hips")
    walk = clip("Hips", used["content"])
    send(client, used)
    assert send(client, walk) == {"added": 1}
    body, _ = commit({"rig": used})
    motion = {"motion": document_digest({**walk["parts"]["motion"], "poses": POSES})}
    values = {
        key_of("rig", "skeleton"): {"parts": parts_of(used), "tags": []},
        key_of("walk", "clip"): {"parts": motion, "tags": []},
    }
    tree = build(ChunksInMemory(), sorted(values.items()))
    changes = [*body["changes"], {"path": "walk", "kind": "clip", "parts": motion}]
    receive(client, {**body, "tree": tree, "changes": changes}, begins="main")
    ok(client.post(f"{GAITS}/checkout", json={"version": "main"}))
    ((found,), (rig,)) = (ok(client.get(f"{LAB}/{kind}"))["items"] for kind in ("clips", "skeletons"))
    read = ok(client.get(f"{LAB}/clips/{found['id']}/parts/motion"))
    assert read["skeleton"] == {"item": rig["id"], "revision": 1}


def numbers(dtype: str, *values: int) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [len(values)], "data": list(values)}


def test_a_partial_array_takes_its_tiles_from_an_array_that_the_project_has(
    client: httpx.Client, database: Database
) -> None:
    rig = skeleton("Hips")
    first = clip("Hips", rig["content"])
    send(client, rig)
    send(client, first)
    place = {"content": first["content"], "part": "motion"}
    absent = {"content": "sha256:" + "2" * 64, "part": "motion"}
    found = ok(client.post(f"{LAB}/contents", json={"tiles": [place, absent, {**place, "part": "info"}]}))
    assert (list(found["tiles"][0]), found["tiles"][1:]) == (["/poses"], [None, None])
    partial: dict[str, Any] = {
        "base": first["content"], "pointer": "/poses", "dtype": "<f4", "shape": [1, 7],
        "tiles": numbers("<i4", 0), "sizes": numbers("<i4"), "bytes": numbers("|u1"),
    }  # fmt: skip

    def with_poses(**changed: Any) -> dict[str, Any]:
        motion = {**first["parts"]["motion"], "frame_rate_hz": 60}
        content = revision_content("clip", {"motion": document_digest({**motion, "poses": POSES})})
        return {**first, "content": content, "parts": {"motion": {**motion, "poses": {**partial, **changed}}}}

    for changed, status, code in (
        ({"base": absent["content"]}, 409, "missing-contents"),
        ({"base": [1]}, 422, "bad-array"),
        ({"base": rig["content"]}, 422, "bad-array"),
        ({"pointer": "/other"}, 422, "bad-array"),
        ({"pointer": "/joints"}, 422, "bad-array"),
        ({"tiles": numbers("<i4", 1)}, 422, "bad-array"),
        ({"shape": [2, 7]}, 422, "bad-array"),
        ({"shape": [1 << 30, 7]}, 422, "bad-array"),
    ):
        refused(client.post(f"{GAITS}/contents", json={"revisions": [with_poses(**changed)]}), status, code)
    assert send(client, with_poses()) == {"added": 1}
    assert list(check_store(database)) == []


def test_a_partial_array_takes_nothing_from_another_project(client: httpx.Client) -> None:
    rig = skeleton("Hips")
    first = clip("Hips", rig["content"])
    ok(client.post("/projects", json={"name": "other"}), 201)
    ok(client.post("/projects/other/datasets", json={"name": "gaits"}), 201)
    for one in (rig, first):
        ok(client.post("/projects/other/datasets/gaits/contents", json={"revisions": [one]}))
    send(client, rig)
    answer = client.post(f"{GAITS}/contents", json={"revisions": [partial_clip(first)]})
    refused(answer, 409, "missing-contents")


def partial_clip(first: dict[str, Any]) -> dict[str, Any]:
    """Return a clip with a partial array of poses, which takes its tiles from the poses of the clip `first`."""
    motion = {**first["parts"]["motion"], "poses": {
        "base": first["content"], "pointer": "/poses", "dtype": "<f4", "shape": [1, 7],
        "tiles": numbers("<i4", 0), "sizes": numbers("<i4"), "bytes": numbers("|u1"),
    }}  # fmt: skip
    return {**first, "content": "sha256:" + "3" * 64, "parts": {"motion": motion}}


def test_partial_arrays_and_their_bases_take_from_the_memory_of_requests(
    client: httpx.Client, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = skeleton("Hips")
    first = clip("Hips", rig["content"])
    send(client, rig)
    send(client, first)
    statement = select(document.c.size_bytes).where(document.c.schema == "marey/motion@1")
    base_bytes = database.read(SYSTEM, lambda tx: tx.execute(statement).scalar_one())
    taken: list[int] = []
    monkeypatch.setattr(Holding, "grow", lambda _, more: taken.append(more))
    client.post(f"{GAITS}/contents", json={"revisions": [partial_clip(first)]})
    assert {POSES.nbytes, base_bytes} <= set(taken)


def test_tiles_are_hashed_when_no_transaction_is_open(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = skeleton("Hips")
    first = clip("Hips", rig["content"])
    send(client, rig)
    send(client, first)
    threads: list[str] = []
    split = blocks.split

    def noted(data: bytes) -> list[bytes]:
        threads.append(current_thread().name)
        return split(data)

    monkeypatch.setattr(blocks, "split", noted)
    ok(client.post(f"{LAB}/contents", json={"tiles": [{"content": first["content"], "part": "motion"}]}))
    assert [name.startswith(THREAD_NAME) for name in threads] == [True]


def test_a_base_is_divided_into_tiles_once_for_many_partial_arrays(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without this, a request with many small partial arrays of one large base would take an hour of processor time."""
    rig = skeleton("Hips")
    first = clip("Hips", rig["content"])
    send(client, rig)
    send(client, first)
    sent = partial_clip(first)
    motion = sent["parts"]["motion"]
    motion["more"] = dict.fromkeys("abcdefgh", motion["poses"])
    divided: list[bytes] = []
    split = blocks.split

    def counted(data: bytes) -> list[bytes]:
        divided.append(data)
        return split(data)

    monkeypatch.setattr(blocks, "split", counted)
    client.post(f"{GAITS}/contents", json={"revisions": [sent]})
    assert len(divided) == 1
