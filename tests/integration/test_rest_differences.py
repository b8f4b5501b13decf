"""Differences between revisions over HTTP."""

from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.edited_takes import make_walk
from tests.support.rest_server import Server

from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_schemas.documents.differences import Difference
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_server.motions import comparing

CLIPS = "/projects/lab/clips"


@pytest.fixture(scope="module")
def walk() -> Clip:
    return make_walk(turn_rate_rad_s=0.4, seconds=2.0)


@pytest.fixture
def skeleton(owner: httpx.Client, walk: Clip) -> str:
    hierarchy = skeleton_to_document(walk.skeleton).model_dump(mode="json", by_alias=True)
    return make(owner, "/projects/lab/skeletons", {"name": "body", "parts": {"hierarchy": hierarchy}})


def make(client: httpx.Client, url: str, body: dict[str, Any]) -> str:
    answer = client.post(url, content=encode_tree(body, MSGPACK), headers={"Content-Type": MSGPACK})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def put(client: httpx.Client, url: str, tree: Any) -> None:
    answer = client.put(url, content=encode_tree(tree, MSGPACK), headers={"Content-Type": MSGPACK, "If-Match": "*"})
    assert answer.is_success, answer.text


def motion_of(clip: Clip, skeleton: str) -> dict[str, Any]:
    return clip_to_document(clip, RevisionRef(item=skeleton, revision=1)).model_dump(by_alias=True)


@pytest.fixture
def clip(owner: httpx.Client, skeleton: str, walk: Clip) -> str:
    """The id of a clip with three revisions: the walk, its frames from frame 12 on, and a changed description."""
    info = {"schema": "marey/clip-info@1", "action": "walk"}
    made = make(owner, CLIPS, {"name": "walk", "parts": {"motion": motion_of(walk, skeleton), "info": info}})
    put(owner, f"{CLIPS}/{made}/parts/motion", motion_of(walk.sliced(12, walk.frame_count), skeleton))
    put(owner, f"{CLIPS}/{made}/parts/info", {**info, "action": "run"})
    return made


def compare(client: httpx.Client, path: str, **query: Any) -> Difference:
    answer = client.get(f"{path}/difference", params=query, headers={"Accept": MSGPACK})
    assert answer.status_code == 200, answer.text
    return Difference.model_validate(decode_tree(answer.content, MSGPACK))


def test_the_newest_revision_is_compared_with_the_one_before_it(owner: httpx.Client, clip: str) -> None:
    found = compare(owner, f"{CLIPS}/{clip}")
    assert (found.before.revision, found.after.revision) == (2, 3)
    assert found.parts == {"info": "changed"}
    assert found.motion is None
    assert [(one.part, one.pointer, one.before, one.after) for one in found.fields] == [
        ("info", "/action", "walk", "run")
    ]


def test_removed_frames_are_found_between_any_two_revisions(owner: httpx.Client, clip: str, walk: Clip) -> None:
    found = compare(owner, f"{CLIPS}/{clip}", **{"from": 1, "to": 3})
    assert set(found.parts) == {"info", "motion"}
    assert found.motion is not None
    count = walk.frame_count
    assert [(run.change, run.before, run.after) for run in found.motion.runs] == [
        ("removed", (0, 12), (0, 0)),
        ("matched", (12, count), (0, count - 12)),
    ]
    assert not found.motion.rotations
    assert found.plot is None


def test_a_revision_does_not_differ_from_itself(owner: httpx.Client, clip: str) -> None:
    found = compare(owner, f"{CLIPS}/{clip}", **{"from": 2, "to": 2})
    assert not found.parts
    assert not found.fields


def test_values_to_draw_are_returned_on_request(owner: httpx.Client, clip: str, walk: Clip) -> None:
    found = compare(owner, f"{CLIPS}/{clip}", **{"from": 1, "to": 2, "plot": "true"})
    assert found.plot is not None
    assert found.plot.rotation_deg.shape == (walk.frame_count - 12, walk.skeleton.joint_count)
    np.testing.assert_array_equal(found.plot.path_before_m, walk.root_translations[:, [0, 2]])


def test_another_item_of_the_kind_can_be_compared(owner: httpx.Client, skeleton: str, clip: str, walk: Clip) -> None:
    poses = walk.poses.copy()
    poses[:, 0] += 0.5
    other = make(owner, CLIPS, {"name": "moved", "parts": {"motion": motion_of(replace(walk, poses=poses), skeleton)}})
    found = compare(owner, f"{CLIPS}/{clip}", **{"from": 1, "to_item": other})
    assert (found.before.name, found.after.name, found.after.revision) == ("walk", "moved", 1)
    assert found.parts == {"info": "removed", "motion": "changed"}
    assert found.motion is not None
    assert found.motion.path is not None
    assert found.motion.path.moved is not None
    assert found.motion.path.moved.shift_cm == pytest.approx((50.0, 0.0, 0.0), abs=1e-3)


def refused(client: httpx.Client, path: str, **query: Any) -> tuple[int, str]:
    answer = client.get(f"{path}/difference", params=query)
    return answer.status_code, answer.json()["code"]


def test_revisions_and_items_that_do_not_exist_are_refused(owner: httpx.Client, skeleton: str, clip: str) -> None:
    assert refused(owner, f"{CLIPS}/{clip}", to=9) == (404, "no-revision")
    assert refused(owner, f"{CLIPS}/{clip}", to_item=skeleton) == (404, "no-item")
    assert refused(owner, f"/projects/lab/skeletons/{skeleton}") == (404, "no-revision")
    assert refused(owner, f"{CLIPS}/{clip}", threshold_deg=0)[0] == 400


def test_motions_that_are_too_large_are_refused(
    owner: httpx.Client, clip: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparing, "MOST_NUMBERS", 1000)
    assert refused(owner, f"{CLIPS}/{clip}", **{"from": 1}) == (413, "difference-too-large")


def test_only_members_see_a_difference_and_only_in_their_project(server: Server, clip: str, walk: Clip) -> None:
    stranger = server.client(server.make_user("stranger"))
    assert refused(stranger, f"{CLIPS}/{clip}") == (404, "no-project")
    own = server.client(server.make_project("elsewhere", owner="other"))
    body = skeleton_to_document(walk.skeleton).model_dump(mode="json", by_alias=True)
    body_id = make(own, "/projects/elsewhere/skeletons", {"name": "body", "parts": {"hierarchy": body}})
    made = make(own, "/projects/elsewhere/clips", {"name": "own", "parts": {"motion": motion_of(walk, body_id)}})
    assert refused(own, f"/projects/elsewhere/clips/{made}", to_item=clip) == (404, "no-item")
