"""Commands on annotations over HTTP: concurrent changes, repeated requests, and too many commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server

from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_motion.editing.annotations import commands, layers
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_server.motions import annotating

ANNOTATIONS = "/projects/lab/annotations"
FRAMES = 100


def made(client: httpx.Client, url: str, body: dict[str, Any]) -> str:
    answer = client.post(url, content=encode_tree(body, MSGPACK), headers={"Content-Type": MSGPACK})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


@pytest.fixture
def annotation(owner: httpx.Client) -> str:
    """An annotation whose only segment labels the frames 0:50 as `a`."""
    skeleton = Skeleton(("root",), np.array([-1]), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    poses = np.tile(np.array([0, 1, 0, 1, 0, 0, 0], dtype=np.float32), (FRAMES, 1))
    hierarchy = skeleton_to_document(skeleton).model_dump(mode="json", by_alias=True)
    rig = made(owner, "/projects/lab/skeletons", {"name": "rig", "parts": {"hierarchy": hierarchy}})
    motion = clip_to_document(Clip(skeleton, 30.0, poses), RevisionRef(item=rig, revision=1)).model_dump(by_alias=True)
    clip = made(owner, "/projects/lab/clips", {"name": "clip", "parts": {"motion": motion}})
    document = {
        "schema": "marey/annotation@1",
        "clip": {"item": clip, "revision": 1},
        "segments": [{"label": "a", "start": 0, "end": 50}],
    }
    return made(owner, ANNOTATIONS, {"name": "parts", "parts": {"annotation": document}})


def command(client: httpx.Client, annotation: str, *commands: dict[str, Any], **headers: str) -> httpx.Response:
    return client.post(
        f"{ANNOTATIONS}/{annotation}/commands",
        json={"commands": list(commands)},
        headers={"If-Match": "*", **headers},
    )


def segments(client: httpx.Client, annotation: str) -> list[str]:
    found = client.get(f"{ANNOTATIONS}/{annotation}/parts/annotation").json()["segments"]
    return [f"{one['label']} {one['start']}:{one['end']}" for one in found]


def meanwhile(monkeypatch: pytest.MonkeyPatch, name: str, action: Callable[[], None]) -> None:
    """Run `action` once, while the server's function with this name applies commands."""
    carry_out, left = commands.COMMANDS[name], [action]

    def interrupted(layer: layers.Layer, **arguments: Any) -> layers.Layer:
        if left:
            left.pop()()
        return carry_out(layer, **arguments)

    monkeypatch.setitem(commands.COMMANDS, name, interrupted)


RELABEL = {"command": "relabel_segment", "at": 5, "label": "b"}
ADD = {"command": "create_segment", "label": "c", "start": 60, "end": 70}


def test_others_write_while_commands_are_carried_out(
    owner: httpx.Client, annotation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def write() -> None:
        answer = httpx.post(
            f"{owner.base_url}projects/lab/collections",
            json={"path": "other"},
            headers=owner.headers,
            timeout=PATIENCE_S,
        )
        seen.append(answer.status_code)

    meanwhile(monkeypatch, "relabel_segment", write)
    assert command(owner, annotation, RELABEL).status_code == 200
    assert seen == [201]


def test_commands_for_any_state_are_applied_anew_to_what_others_made_of_it(
    owner: httpx.Client, annotation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    meanwhile(monkeypatch, "relabel_segment", lambda: _require_done(command(owner, annotation, ADD)))
    answer = command(owner, annotation, RELABEL)
    assert (answer.status_code, answer.json()["revision"]) == (200, 3)
    assert segments(owner, annotation) == ["b 0:50", "c 60:70"]


def test_commands_for_one_state_are_refused_where_others_were_faster(
    owner: httpx.Client, annotation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = owner.get(f"{ANNOTATIONS}/{annotation}").headers["ETag"]
    meanwhile(monkeypatch, "relabel_segment", lambda: _require_done(command(owner, annotation, ADD)))
    assert command(owner, annotation, RELABEL, **{"If-Match": state}).status_code == 412
    assert segments(owner, annotation) == ["a 0:50", "c 60:70"]


def test_commands_that_are_sent_again_get_their_first_answer(owner: httpx.Client, annotation: str) -> None:
    first, again = (command(owner, annotation, ADD, **{"Idempotency-Key": "once"}) for _ in range(2))
    assert (first.status_code, again.status_code) == (200, 200)
    assert again.content == first.content
    assert again.headers["Idempotent-Replayed"] == "true"
    assert command(owner, annotation, ADD).status_code == 422


def test_more_commands_than_take_some_seconds_are_refused(
    owner: httpx.Client, annotation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(annotating, "MOST_WORK", 10)
    assert command(owner, annotation, *[RELABEL] * 10).status_code == 200
    answer = command(owner, annotation, *[{**RELABEL, "label": "z"}] * 11)
    assert (answer.status_code, answer.json()["code"]) == (413, "too-many-commands")
    assert segments(owner, annotation) == ["b 0:50"]


def test_readers_may_not_command(owner: httpx.Client, annotation: str, server: Server) -> None:
    stranger = server.client(server.make_user("stranger"))
    assert command(stranger, annotation, RELABEL).status_code == 404


def _require_done(answer: httpx.Response) -> None:
    assert answer.status_code == 200, answer.text


def test_only_clips_get_annotations(owner: httpx.Client, annotation: str) -> None:
    document = {"document": {"semantic_annotation": {"step": [[0]]}}}
    (rig,) = owner.get("/projects/lab/skeletons").json()["items"]
    refused = owner.post(f"/projects/lab/skeletons/{rig['id']}/annotations", json=document)
    assert (refused.status_code, refused.json()["code"]) == (404, "no-annotations")
    assert len(owner.get(ANNOTATIONS).json()["items"]) == 1
