"""Array differences over HTTP: a project returns arrays as differences, and restores arrays from differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import func, select
from tests.support.rest_server import noted_memory

from marey_schemas.encoding.array_differences import ArrayDifference
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import array_digest, document_digest
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_server.access.principal import SYSTEM
from marey_server.store.database.connections import Database
from marey_server.store.fsck import check_store
from marey_server.store.tables import revision
from marey_versions.records import revision_content

LAB, OTHER = "/projects/lab", "/projects/other"
BLOCKS = "application/msgpack; arrays=blocks"
FRAMES = 600
HIERARCHY: dict[str, Any] = {
    "schema": "marey/skeleton@1", "joints": [{"name": "Hips", "parent": -1, "offset": [0, 1, 0]}],
}  # fmt: skip
RIG = revision_content("skeleton", {"hierarchy": document_digest(HIERARCHY)})
ABSENT = "sha256:" + "2" * 64


def poses(edited: int = 0, height_m: float = 0) -> NDArray[np.float32]:
    """Return the poses of one joint; `edited` frames from frame 300 on are moved by 0.5 m, all by `height_m`."""
    made = np.zeros((FRAMES, 7), np.float32)
    made[:, :3] = np.random.default_rng(1).normal(size=(FRAMES, 3))
    made[:, 1] += height_m
    made[:, 3] = 1
    made[300 : 300 + edited, 0] += 0.5
    return made


def clip(array: NDArray[np.float32], sent: Any = None) -> dict[str, Any]:
    """Return a received clip whose digest is that of the poses `array`; its document contains `sent`, if given."""
    motion: dict[str, Any] = {
        "schema": "marey/motion@1", "frame_rate_hz": 30, "joints": ["Hips"], "skeleton": {"content": RIG},
        "poses": array,
    }  # fmt: skip
    content = revision_content("clip", {"motion": document_digest(motion)})
    parts = {"motion": {**motion, "poses": array if sent is None else sent}}
    return {"content": content, "kind": "clip", "path": "walk", "parts": parts}


def difference(array: NDArray[Any], base: NDArray[Any]) -> dict[str, Any]:
    content = clip(base)["content"]
    found = ArrayDifference.between(
        EncodedArray.of(array), EncodedArray.of(base), content, "/poses", array_digest(array)
    )
    assert found is not None
    return found.document


def send(client: httpx.Client, *revisions: Mapping[str, Any], project: str = LAB) -> httpx.Response:
    body = encode_tree({"revisions": revisions}, MSGPACK, arrays="blocks")
    return client.post(f"{project}/datasets/gaits/contents", content=body, headers={"Content-Type": BLOCKS})


def refused(response: httpx.Response, status: int, code: str) -> None:
    assert (response.status_code, response.json()["code"]) == (status, code), response.text


def documents(client: httpx.Client, *wanted: Mapping[str, Any], project: str = LAB) -> list[Any]:
    """Request documents; the arrays in the result are numpy arrays."""
    answer = client.post(f"{project}/contents", json={"documents": wanted}, headers={"Accept": BLOCKS})
    assert answer.status_code == 200, answer.text
    found: list[Any] = decode_tree(answer.content, MSGPACK)["documents"]
    return found


@pytest.fixture
def client(owner: httpx.Client) -> httpx.Client:
    """The client of the owner of `lab` and `other`; `lab` has a clip, and `other` only the skeleton."""
    assert owner.post("/projects", json={"name": "other"}).status_code == 201
    for project in (LAB, OTHER):
        assert owner.post(f"{project}/datasets", json={"name": "gaits"}).status_code == 201
        rig = {"content": RIG, "kind": "skeleton", "path": None, "parts": {"hierarchy": HIERARCHY}}
        assert send(owner, rig, project=project).json() == {"added": 1}
    assert send(owner, clip(poses())).json() == {"added": 1}
    return owner


def test_an_array_is_restored_from_its_difference_and_the_base(client: httpx.Client, database: Database) -> None:
    assert send(client, clip(poses(9), difference(poses(9), poses()))).json() == {"added": 1}
    (found,) = documents(client, {"content": clip(poses(9))["content"], "part": "motion"})
    assert (found["poses"] == poses(9)).all()
    assert list(check_store(database)) == []


def test_a_difference_with_another_base_or_a_false_digest_is_refused_and_changes_nothing(
    client: httpx.Client, database: Database
) -> None:
    sent = difference(poses(9), poses())
    more = {**sent, "difference": EncodedArray.of(np.zeros((FRAMES + 1, 7), "<u4"))}
    stored = select(func.count()).select_from(revision)
    before = database.read(SYSTEM, lambda tx: tx.execute(stored).scalar_one())
    for changed, status, code in (
        ({**sent, "base": ABSENT}, 409, "missing-contents"),
        ({**sent, "base": [1]}, 422, "bad-array"),
        ({**sent, "base": RIG}, 422, "bad-array"),
        ({**sent, "pointer": "/joints"}, 422, "bad-array"),
        ({**sent, "digest": ABSENT}, 422, "bad-array"),
        ({**sent, "frames": sent["frames"] + np.uint32(1)}, 422, "bad-array"),
        ({**sent, "shape": [FRAMES + 1, 7]}, 422, "bad-array"),
        ({**sent, "shape": [1 << 30, 7]}, 422, "bad-array"),
        (more, 422, "bad-array"),
        ({**sent, "more": 1}, 422, "invalid"),
    ):
        refused(send(client, clip(poses(9), changed)), status, code)
    assert database.read(SYSTEM, lambda tx: tx.execute(stored).scalar_one()) == before
    forged = clip(poses(9), difference(poses(8), poses()))  # a valid difference, but of another array
    refused(send(client, forged), 422, "other-content")


def test_a_difference_that_expands_to_gigabytes_is_refused(client: httpx.Client) -> None:
    sent = difference(poses(9), poses())
    sent["difference"] = EncodedArray("<u4", (1 << 30, 7), EncodedArray.of(np.zeros((1 << 20, 7), "<u4")).data)
    answer = send(client, clip(poses(9), sent))
    assert answer.status_code in (413, 422), answer.text


def test_differences_and_bases_take_from_the_memory_of_requests(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = noted_memory(monkeypatch)
    sent = difference(poses(9), poses())
    assert send(client, clip(poses(9), sent)).status_code == 200
    assert {poses().nbytes, 9 * 7 * 4} <= set(taken)


def test_a_base_of_another_project_is_unknown(client: httpx.Client) -> None:
    """The answers do not show whether another project has a revision, although the caller may read both projects."""
    sent = difference(poses(9), poses())
    answers = [
        send(client, clip(poses(9), {**sent, "base": base}), project=OTHER).json()
        for base in (clip(poses())["content"], ABSENT)
    ]
    for answer, base in zip(answers, (clip(poses())["content"], ABSENT), strict=True):
        assert (answer["status"], answer["code"]) == (409, "missing-contents")
        assert answer["detail"].replace(base, "") == answers[0]["detail"].replace(clip(poses())["content"], "")
    assert send(client, clip(poses(9)), project=OTHER).json() == {"added": 1}
    place = {"content": clip(poses(9))["content"], "part": "motion"}
    known, unknown = (
        documents(client, {**place, "base": base}, project=OTHER)[0] for base in (clip(poses())["content"], ABSENT)
    )
    assert document_digest(known) == document_digest(unknown) == document_digest(clip(poses(9))["parts"]["motion"])


def test_documents_have_differences_from_the_base_that_the_reader_names(client: httpx.Client) -> None:
    assert send(client, clip(poses(9)), clip(poses(height_m=1))).json() == {"added": 2}
    before, edited, other = (clip(one)["content"] for one in (poses(), poses(9), poses(height_m=1)))
    wanted = {"content": edited, "part": "motion"}
    found = documents(
        client, wanted, {**wanted, "base": before}, {**wanted, "base": other}, {**wanted, "base": RIG},
        {**wanted, "base": None}, {**wanted, "base": edited}, {"content": ABSENT, "part": "motion", "base": before},
    )  # fmt: skip
    assert found.pop() is None
    described = [ArrayDifference.of(one["poses"]) for one in found]
    assert [one is not None for one in described] == [False, True, False, False, False, True]
    assert described[1] is not None
    assert described[1].document.keys() == difference(poses(9), poses()).keys()
    whole = described[1].applied_to(EncodedArray.of(poses()))
    assert array_digest(whole) == array_digest(poses(9)) == described[1].digest
    assert described[5] is not None
    assert len(np.asarray(described[5].frames)) == 0


def test_arrays_are_compared_only_up_to_a_total_size(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """One request may name a large document many times."""
    assert send(client, clip(poses(9))).json() == {"added": 1}
    wanted = {"content": clip(poses(9))["content"], "part": "motion", "base": clip(poses())["content"]}
    monkeypatch.setattr("marey_server.store.datasets.portable.MOST_BYTES_COMPARED", 2 * poses().nbytes)
    found = documents(client, wanted, wanted, wanted)
    assert [ArrayDifference.of(one["poses"]) is not None for one in found] == [True, True, False]


def test_the_bases_of_documents_count_towards_the_size_of_an_answer(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert send(client, clip(poses(9))).json() == {"added": 1}
    wanted = {"content": clip(poses(9))["content"], "part": "motion"}
    monkeypatch.setattr("marey_server.store.datasets.portable.MOST_BYTES_AT_ONCE", 3 * poses().nbytes)
    assert (
        len(documents(client, *[wanted] * 9))
        > 2 * len(documents(client, *[{**wanted, "base": clip(poses())["content"]}] * 9)) - 1
    )
