"""Documents that are read again: answers are the same, show changes, and go only to callers who may still read."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from tests.support.rest_server import Server

from marey_schemas.access import Role
from marey_schemas.encoding.codecs import decode_tree
from marey_server.store.items import reading

STUDY = {"schema": "marey/document@1", "answer": 42}
FORMS = ("application/json", "application/msgpack", "application/bson", "application/msgpack; arrays=blocks")


@pytest.fixture
def reader(server: Server) -> httpx.Client:
    """The client of the user `rita`, who may only read."""
    return server.client(server.make_user("rita"))


@pytest.fixture
def owner(server: Server, reader: httpx.Client) -> httpx.Client:
    """The client of the owner of the project `lab`; `rita` may read this project."""
    return server.client(server.make_project(rita=Role.READER))


@pytest.fixture
def study(owner: httpx.Client) -> str:
    """The path of an item with one document."""
    made = owner.post("/projects/lab/characters", json={"name": "s", "parts": {"character": STUDY}})
    assert made.status_code == 201, made.text
    return f"/projects/lab/characters/{made.json()['id']}"


def ok(response: httpx.Response) -> Any:
    assert response.is_success, response.text
    return response.json()


def test_each_form_is_sent_again_as_it_was(owner: httpx.Client, study: str) -> None:
    first = {form: owner.get(f"{study}/parts/character", headers={"Accept": form}) for form in FORMS}
    assert len({response.content for response in first.values()}) >= 3
    for form, response in first.items():
        again = owner.get(f"{study}/parts/character", headers={"Accept": form})
        assert (again.status_code, again.content) == (200, response.content)
        assert again.headers["ETag"] == response.headers["ETag"]
        assert again.headers["Content-Type"] == response.headers["Content-Type"] == form


def test_a_document_read_before_is_read_as_it_is_now(owner: httpx.Client, study: str) -> None:
    part = f"{study}/parts/character"
    assert ok(owner.get(part))["answer"] == 42
    assert owner.put(part, json={**STUDY, "answer": 43}, headers={"If-Match": "*"}).is_success
    assert ok(owner.get(part))["answer"] == 43
    assert ok(owner.get(part, params={"revision": 1}))["answer"] == 42


def test_who_may_read_no_more_does_not_get_what_he_read_before(
    owner: httpx.Client, reader: httpx.Client, study: str
) -> None:
    part = f"{study}/parts/character"
    assert ok(reader.get(part)) == ok(reader.get(part)) == STUDY
    etag = reader.get(part).headers["ETag"]
    assert owner.delete("/projects/lab/members/rita", headers={"If-Match": "*"}).is_success
    assert reader.get(part).status_code == 404
    assert reader.get(part, headers={"If-None-Match": etag}).status_code == 404
    assert ok(owner.get(part)) == STUDY


def test_a_revoked_token_does_not_get_what_it_read_before(server: Server, reader: httpx.Client, study: str) -> None:
    part = f"{study}/parts/character"
    made = ok(reader.post("/tokens", json={"name": "short", "scopes": ["read"]}))
    holder = server.client(made["secret"])
    assert ok(holder.get(part)) == STUDY
    assert reader.delete(f"/tokens/{made['id']}").is_success
    assert holder.get(part).status_code == 401


def test_a_deleted_item_is_gone_for_who_read_it_before(owner: httpx.Client, reader: httpx.Client, study: str) -> None:
    part = f"{study}/parts/character"
    assert ok(reader.get(part)) == STUDY
    assert owner.delete(study, headers={"If-Match": "*"}).is_success
    assert reader.get(part).status_code == 404


@pytest.mark.parametrize("form", FORMS)
def test_documents_of_several_items_are_read_in_one_request(owner: httpx.Client, study: str, form: str) -> None:
    item = study.rpartition("/")[2]
    assert owner.put(f"{study}/parts/character", json={**STUDY, "answer": 43}, headers={"If-Match": "*"}).is_success
    places = [
        {"kind": "character", "item": item, "revision": 2, "part": "character"},
        {"kind": "character", "item": "nobody", "revision": 1, "part": "character"},
        {"kind": "clip", "item": item, "revision": 1, "part": "character"},
        {"kind": "character", "item": item, "revision": 1, "part": "character"},
    ]
    answer = owner.post("/projects/lab/parts", json={"parts": places}, headers={"Accept": form})
    assert answer.headers["Content-Type"] == form
    newest, nobody, of_another_kind, first = decode_tree(answer.content, form.partition(";")[0])["documents"]
    assert (newest["answer"], first["answer"]) == (43, 42)
    assert nobody is of_another_kind is None


def test_several_documents_are_read_by_those_who_may_read_the_project(
    owner: httpx.Client, reader: httpx.Client, study: str
) -> None:
    place = {"kind": "character", "item": study.rpartition("/")[2], "revision": 1, "part": "character"}
    assert ok(reader.post("/projects/lab/parts", json={"parts": [place]}))["documents"] == [STUDY]
    assert owner.delete("/projects/lab/members/rita", headers={"If-Match": "*"}).is_success
    assert reader.post("/projects/lab/parts", json={"parts": [place]}).status_code == 404


def test_documents_that_are_large_together_are_left_out_at_the_end(
    owner: httpx.Client, study: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "MOST_BYTES_AT_ONCE", 10)
    place = {"kind": "character", "item": study.rpartition("/")[2], "revision": 1, "part": "character"}
    assert ok(owner.post("/projects/lab/parts", json={"parts": [place, place]}))["documents"] == [STUDY]


def test_quaternions_that_are_no_rotations_are_refused_by_frame_and_joint(owner: httpx.Client) -> None:
    rows: list[list[float]] = [[0, 1, 0, 1, 0, 0, 0, 1, 0, 0, 0], [0, 1, 0, 0.6, 0.8, 0, 0, 1, 0, 0.5, 0]]
    motion: dict[str, Any] = {
        "schema": "marey/motion@1", "skeleton": {"item": "skeleton_none", "revision": 1}, "frame_rate_hz": 30,
        "joints": ["Hips", "LeftArm"], "poses": {"dtype": "<f4", "shape": [2, 11], "data": rows},
    }  # fmt: skip
    refused = owner.post("/projects/lab/clips", json={"name": "walk", "parts": {"motion": motion}})
    assert (refused.status_code, refused.json()["code"]) == (422, "invalid")
    (fault,) = refused.json()["errors"]
    assert fault["pointer"] == "/motion/poses/data/1/7"
    assert fault["detail"].startswith(
        "Frame 1, joint LeftArm: the rotation must be a unit quaternion (w, x, y, z), but"
    )
    replaced = owner.put("/projects/lab/clips/clip_none/parts/motion", json=motion, headers={"If-Match": "*"})
    assert (replaced.status_code, replaced.json()["errors"]) == (422, [fault])
    rows[1][9] = 0
    replaced = owner.put("/projects/lab/clips/clip_none/parts/motion", json=motion, headers={"If-Match": "*"})
    assert replaced.status_code == 404
    assert owner.get("/projects/lab/clips").json()["items"] == []
