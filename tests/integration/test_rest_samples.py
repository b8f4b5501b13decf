"""Samples of models over HTTP, and the entity tags by which a client recognises outdated samples."""

from typing import Any

import httpx
import pytest
from tests.support.rest_server import Server, stored_file
from tests.support.search_primitives import walking

from marey_motion.documents import skeleton_to_document
from marey_motion.modelling.primitive_documents import primitive_to_tree
from marey_schemas.encoding import codecs
from marey_server.store.database.lanes import Client


def created(owner: httpx.Client, kind: str, name: str, **parts: object) -> dict[str, Any]:
    body = codecs.encode_tree({"name": name, "parts": parts}, codecs.MSGPACK)
    headers = {"Content-Type": codecs.MSGPACK, "Accept": "application/json"}
    made = owner.post(f"/projects/lab/{kind}", content=body, headers=headers)
    assert made.status_code == 201, made.text
    return made.json()


@pytest.fixture
def place(owner: httpx.Client) -> str:
    """The path of a model."""
    primitive, _ = walking()
    rig = created(
        owner, "skeletons", "rig", hierarchy=skeleton_to_document(primitive.skeleton).model_dump(by_alias=True)
    )
    model = created(owner, "models", "walk", model=primitive_to_tree(primitive, {"item": rig["id"], "revision": 1}))
    return f"/projects/lab/models/{model['id']}"


def test_the_documents_of_a_model_count_as_memory_before_they_are_packed(
    server: Server, owner: httpx.Client, place: str
) -> None:
    services = server.app.services
    services.memory.take(Client("somebody else"), 0, services.memory.total_bytes, reserved=False)
    refused = owner.get(f"{place}/samples")
    assert (refused.status_code, refused.json()["code"], len(services.models)) == (503, "memory", 0)


def test_samples_change_their_tag_with_the_revision_they_name(owner: httpx.Client, place: str) -> None:
    first = owner.get(f"{place}/samples")
    held = {"If-None-Match": first.headers["ETag"]}
    assert owner.get(f"{place}/samples", headers=held).status_code == 304

    page = b"<!doctype html><title>Walk</title>"
    report = {"schema": "marey/model-report@1", "title": "walk", "html": stored_file(owner, page)}
    revised = owner.put(f"{place}/parts/report", json=report, headers={"If-Match": "*"})
    assert revised.is_success, revised.text
    second = owner.get(f"{place}/samples", headers=held)
    assert (second.status_code, second.json()["model"]["revision"]) == (200, 2)
    assert second.json()["motions"] == first.json()["motions"]
