"""Previews of edits over HTTP: each equals the result of a job, or is a precise error."""

from math import degrees
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.edited_takes import make_walk
from tests.support.rest_server import Server

from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, mapping_to_document, skeleton_to_document
from marey_motion.editing.compute_budget import PER_COMMAND, PER_NUMBER
from marey_motion.editing.registry import apply_edit
from marey_motion.kinematics import global_positions
from marey_motion.rigs import guess_axes, map_joints
from marey_schemas.access import ProjectChange, Role, Visibility
from marey_schemas.documents.references import RevisionRef
from marey_schemas.editing.commands import Face, Smooth
from marey_schemas.encoding.codecs import BSON, JSON, MSGPACK, decode_tree, encode_tree
from marey_server.motions import previewing

CLIPS = "/projects/lab/clips"


@pytest.fixture(scope="module")
def walk() -> Clip:
    return make_walk(turn_rate_rad_s=0.4, seconds=2.0)


@pytest.fixture
def skeleton(owner: httpx.Client, walk: Clip) -> str:
    mapping = map_joints(walk.skeleton)
    parts = {
        "hierarchy": skeleton_to_document(walk.skeleton).model_dump(mode="json", by_alias=True),
        "mapping": mapping_to_document(mapping, guess_axes(walk.skeleton, mapping)).model_dump(
            mode="json", by_alias=True
        ),
    }
    return made(owner, "/projects/lab/skeletons", {"name": "body", "parts": parts})


def made(client: httpx.Client, url: str, body: dict[str, Any]) -> str:
    answer = client.post(url, content=encode_tree(body, MSGPACK), headers={"Content-Type": MSGPACK})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def add_clip(client: httpx.Client, skeleton: str, name: str, clip: Clip) -> str:
    motion = clip_to_document(clip, RevisionRef(item=skeleton, revision=1)).model_dump(by_alias=True)
    return made(client, CLIPS, {"name": name, "parts": {"motion": motion}})


@pytest.fixture
def clip(owner: httpx.Client, skeleton: str, walk: Clip) -> str:
    return add_clip(owner, skeleton, "walk", walk)


def preview(client: httpx.Client, clip: str, **body: Any) -> httpx.Response:
    return client.post(f"{CLIPS}/{clip}/edit-preview", json=body)


MIRROR = [{"command": "mirror"}]


def test_frames_of_the_edited_motion_come_in_any_media_type(owner: httpx.Client, clip: str, walk: Clip) -> None:
    commands = [{"command": "smooth"}, {"command": "face", "heading_deg": 90}]
    body = {"commands": commands, "frames": [30, 50], "fields": ["motion", "positions"]}
    edited = apply_edit(walk, [Smooth(), Face(heading_deg=degrees(np.pi / 2))])
    for media_type in (JSON, MSGPACK, BSON):
        answer = owner.post(f"{CLIPS}/{clip}/edit-preview", json=body, headers={"Accept": media_type})
        assert answer.status_code == 200, (media_type, answer.text)
        shown = decode_tree(answer.content, media_type)
        told = shown["frame_count"], list(shown["frames"]), shown["pieces"]
        assert told == (walk.frame_count, [30, 50], 1), media_type
        assert np.array_equal(shown["motion"]["poses"], edited.poses[30:50]), media_type
        assert np.array_equal(shown["positions"], global_positions(edited.sliced(30, 50))), media_type
        assert shown["motion"]["skeleton"]["revision"] == 1, media_type


def test_what_lies_beyond_the_end_is_left_out(owner: httpx.Client, clip: str, walk: Clip) -> None:
    shown = preview(owner, clip, commands=MIRROR, frames=[100, 10_000], fields=[]).json()
    assert shown["frames"] == [100, walk.frame_count]
    assert "motion" not in shown
    answer = preview(owner, clip, commands=MIRROR, frames=[500, 600])
    assert (answer.status_code, answer.json()["code"]) == (422, "no-frames")


def test_a_stored_edit_and_other_clips_can_be_named(owner: httpx.Client, skeleton: str, clip: str, walk: Clip) -> None:
    other = add_clip(owner, skeleton, "other", make_walk(seconds=1.0))
    commands = [{"command": "concatenate", "source": other}]
    edit = {"schema": "marey/edit@1", "commands": commands}
    edit_id = made(owner, "/projects/lab/edits", {"name": "longer", "parts": {"edit": edit}})
    by_item = preview(owner, clip, edit={"item": edit_id}, fields=["motion"]).json()
    assert by_item["frame_count"] == walk.frame_count + 60
    assert by_item == preview(owner, clip, commands=commands, fields=["motion"]).json()
    missing = preview(owner, clip, commands=[{"command": "concatenate", "source": "clip_none"}])
    assert missing.status_code == 404


def test_a_piece_of_a_split_can_be_looked_at(owner: httpx.Client, clip: str, walk: Clip) -> None:
    split = [{"command": "split", "at": [40]}]
    shown = preview(owner, clip, commands=split, piece=1, fields=["motion"]).json()
    assert (shown["pieces"], shown["frame_count"]) == (2, walk.frame_count - 40)
    assert preview(owner, clip, commands=split, piece=2).json()["code"] == "no-piece"


def test_findings_come_with_it(owner: httpx.Client, clip: str) -> None:
    shown = preview(owner, clip, commands=[{"command": "find_contacts"}], fields=["findings"]).json()
    (finding,) = shown["findings"]
    assert finding["command"] == "find_contacts"
    assert {one["label"] for one in finding["segments"]} == {"left_foot", "right_foot"}


def test_nothing_is_stored(owner: httpx.Client, clip: str) -> None:
    def state() -> list[Any]:
        return [owner.get(f"/projects/lab/{kind}").json()["items"] for kind in ("clips", "edits", "skeletons")]

    before = state()
    assert preview(owner, clip, commands=MIRROR).status_code == 200
    assert state() == before


SENSELESS: list[Any] = [
    ({}, "", "either commands or an edit"),
    ({"commands": MIRROR, "edit": {"item": "edit_x"}}, "", "either commands or an edit"),
    ({"commands": []}, "", "either commands or an edit"),
    ({"commands": [{"command": "wobble"}]}, "/commands/0", "wobble"),
    ({"commands": [{"command": "trim", "upto": 5}]}, "/commands/0/upto", "no field of this name"),
    ({"commands": [{"command": "trim", "start": 9, "stop": 3}]}, "/commands/0", "must be after"),
    ({"commands": [{"command": "retime", "speed": 0}]}, "/commands/0/speed", "0.01"),
    ({"commands": [{"command": "rotate", "angle_deg": "left"}]}, "/commands/0/angle_deg", "number"),
    ({"commands": [{"command": "rotate", "angle_deg": 5, "axis": [0, 0, 0]}]}, "/commands/0/axis", "axis"),
    ({"commands": MIRROR * 300}, "/commands", "256"),
    ({"commands": MIRROR, "frames": [5, 5]}, "/frames", "must be after"),
    ({"commands": MIRROR, "frames": [-1, 5]}, "/frames/0", "must be at least 0"),
    ({"commands": MIRROR, "fields": ["mesh"]}, "/fields/0", "motion"),
]


def test_requests_that_make_no_sense_are_refused_with_the_field(owner: httpx.Client, clip: str) -> None:
    for body, pointer, told in SENSELESS:
        answer = preview(owner, clip, **body)
        assert answer.status_code == 422, (body, answer.text)
        (error, *_) = answer.json()["errors"]
        assert (error["pointer"], told in error["detail"]) == (pointer, True), (body, error)


def test_commands_that_cannot_be_applied_are_refused_with_their_number(owner: httpx.Client, clip: str) -> None:
    answer = preview(owner, clip, commands=[*MIRROR, {"command": "trim", "start": 5000}])
    assert (answer.status_code, answer.json()["code"]) == (422, "frames-missing")
    assert "commands[1] (trim)" in answer.json()["detail"]
    assert answer.json()["errors"][0]["pointer"] == "/commands"


def test_what_would_take_long_is_left_to_a_job(
    owner: httpx.Client, clip: str, walk: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = preview(owner, clip, commands=[{"command": "resample", "frame_rate_hz": 100_000}])
    assert (answer.status_code, answer.json()["code"]) == (413, "preview-too-large")
    monkeypatch.setattr(previewing, "MOST_WORK", 3 * (PER_COMMAND + PER_NUMBER * walk.poses.size))
    assert preview(owner, clip, commands=MIRROR * 3).status_code == 200
    answer = preview(owner, clip, commands=MIRROR * 4)
    assert (answer.status_code, answer.json()["code"]) == (413, "preview-too-large")
    monkeypatch.setattr(previewing, "MOST_WORK", 5e9)
    monkeypatch.setattr(previewing, "MOST_SHOWN", 50 * walk.poses.shape[1])
    assert preview(owner, clip, commands=MIRROR, frames=[0, 50]).status_code == 200
    answer = preview(owner, clip, commands=MIRROR, frames=[0, 51])
    assert "request at most 50" in answer.json()["detail"]


def test_readers_may_look_and_strangers_may_not(server: Server, owner: httpx.Client, clip: str) -> None:
    reader, stranger = (server.client(server.make_user(name)) for name in ("rita", "sven"))
    invited = owner.put("/projects/lab/members/rita", json={"role": Role.READER.value})
    assert invited.status_code < 300, invited.text
    assert preview(reader, clip, commands=MIRROR).status_code == 200
    assert preview(stranger, clip, commands=MIRROR).status_code == 404
    assert preview(server.client(), clip, commands=MIRROR).status_code == 404


def test_only_clips_are_edited(owner: httpx.Client, skeleton: str) -> None:
    answer = owner.post(f"/projects/lab/skeletons/{skeleton}/edit-preview", json={"commands": MIRROR})
    assert (answer.status_code, answer.json()["code"]) == (404, "not-a-clip")


def test_a_body_that_is_hardly_recognised_is_not_mirrored_but_trimmed(owner: httpx.Client, walk: Clip) -> None:
    parts = {"hierarchy": skeleton_to_document(walk.skeleton).model_dump(mode="json", by_alias=True)}
    mapping = mapping_to_document(map_joints(walk.skeleton), {}).model_copy(update={"confidence": 0.1})
    parts["mapping"] = mapping.model_dump(mode="json", by_alias=True)
    doubtful = made(owner, "/projects/lab/skeletons", {"name": "doubtful", "parts": parts})
    clip = add_clip(owner, doubtful, "of a doubtful body", walk)
    assert preview(owner, clip, commands=[{"command": "trim", "stop": 20}]).status_code == 200
    answer = preview(owner, clip, commands=MIRROR)
    assert (answer.status_code, answer.json()["code"]) == (422, "mapping-uncertain")


def test_guests_of_a_public_project_may_look(server: Server, owner: httpx.Client, clip: str) -> None:
    body = ProjectChange(visibility=Visibility.PUBLIC).model_dump(mode="json", exclude_unset=True)
    changed = owner.patch("/projects/lab", json=body, headers={"If-Match": "*"})
    assert changed.status_code == 200, changed.text
    assert preview(server.client(), clip, commands=MIRROR).status_code == 200


HELD = {"kind": "position", "joint": "left_wrist", "point_m": [0.1, 1.0, 0.2]}


@pytest.mark.parametrize(
    "costly",
    [
        {"command": "plant_feet"},
        {"command": "smooth", "window_s": 60},
        {"command": "constrain", "solver": "least_squares", "constraints": [HELD]},
        {"command": "constrain", "constraints": [{**HELD, "frames": [start, start + 5]} for start in range(40)]},
    ],
)
def test_each_command_counts_by_how_long_it_takes(
    owner: httpx.Client, clip: str, walk: Clip, monkeypatch: pytest.MonkeyPatch, costly: dict[str, Any]
) -> None:
    monkeypatch.setattr(previewing, "MOST_WORK", 1.4 * (PER_COMMAND + PER_NUMBER * walk.poses.size))
    assert preview(owner, clip, commands=MIRROR).status_code == 200
    answer = preview(owner, clip, commands=[costly])
    assert (answer.status_code, answer.json()["code"]) == (413, "preview-too-large")


def test_dozens_of_constraints_solved_together_on_a_long_clip_are_left_to_a_job(
    owner: httpx.Client, skeleton: str
) -> None:
    long = add_clip(owner, skeleton, "long", make_walk(turn_rate_rad_s=0.0, seconds=60.0))
    together = [{**HELD, "offset_m": [0.1 * number, 0, 0]} for number in range(40)]
    command = {"command": "constrain", "solver": "least_squares", "root_moves": True, "constraints": together}
    answer = preview(owner, long, commands=[command], frames=[0, 2])
    assert (answer.status_code, answer.json()["code"]) == (413, "preview-too-large")
    answer = preview(owner, long, commands=[{"command": "split", "at": list(range(1, 1001))}, *MIRROR * 20])
    assert (answer.status_code, answer.json()["code"]) == (413, "preview-too-large")
