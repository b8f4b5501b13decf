"""Arguments of the SDK: one value or several, in short forms."""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import httpx
import numpy as np
import pytest
from tests.support.scripted_server import ScriptedServer, folder

from marey_client.downloads import saved_atomically
from marey_client.errors import BadArgument, MareyError
from marey_client.handles.clips import MotionArrays
from marey_client.handles.edits import as_edit
from marey_client.handles.searches import search_request
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_client.transport import BLOCKS
from marey_schemas.encoding.codecs import decode_tree, encode_tree

NOW = "2026-01-01T00:00:00Z"
CLIP = {
    "id": "clip_1", "kind": "clip", "name": "walk", "collection": "raw", "revision": 1, "rev": 4, "created_at": NOW,
    "updated_at": NOW, "summary": {"skeleton": "skeleton_1"},
}  # fmt: skip
SKELETON = {**CLIP, "id": "skeleton_1", "kind": "skeleton", "summary": {}}
JOB = {
    "id": "job_1", "project": "lab", "kind": "retarget", "state": "queued", "params": {}, "inputs": {}, "into": "",
    "priority": 0, "seed": 0, "attempt": 0, "fence": 0, "max_attempts": 3, "author": "ada", "created_at": NOW,
    "run_at": NOW, "rev": 1,
}  # fmt: skip


def test_folders_and_files_may_be_named_by_texts(script: ScriptedServer, tmp_path: Path) -> None:
    script.answers = [httpx.Response(200, json=CLIP), httpx.Response(200, content=b"motion")]
    clip = script.marey().project("lab").clips.get("clip_1")
    written = clip.export(f"{tmp_path}/out", format="bvh")
    assert written == tmp_path / "out" / "walk.bvh"
    assert written.read_bytes() == b"motion"


def test_poses_that_were_read_are_put_back_as_the_next_revision(script: ScriptedServer) -> None:
    motion = {
        "schema": "marey/motion@1", "skeleton": {"item": "skeleton_1", "revision": 1}, "frame_rate_hz": 30.0,
        "joints": ["Hips"], "poses": np.tile(np.array([0, 1, 0, 1, 0, 0, 0], np.float32), (3, 1)),
    }  # fmt: skip
    stored = encode_tree(motion, "application/msgpack", arrays="blocks")
    script.answers = [
        httpx.Response(200, json=CLIP),
        httpx.Response(200, content=stored, headers={"Content-Type": BLOCKS}),
        httpx.Response(200, json={**CLIP, "revision": 2, "rev": 5}),
    ]
    clip = script.marey().project("lab").clips.get("clip_1")
    read: MotionArrays = clip.motion()
    moved = read.model_copy(update={"poses": read.poses + np.array([1, 0, 0, 0, 0, 0, 0], np.float32)})
    assert clip.put_motion(moved, message="to the left").revision == 2
    sent = decode_tree(script.requests[-1].content, "application/msgpack", max_bytes=1 << 20)
    assert sent["poses"][:, 0].tolist() == [1, 1, 1]
    assert {name: sent[name] for name in motion if name != "poses"} == {
        name: value for name, value in motion.items() if name != "poses"
    }
    assert script.requests[-1].headers["If-Match"] == '"4.json"'


def test_a_folder_is_retargeted_by_its_path_as_it_is_edited_and_evaluated(script: ScriptedServer) -> None:
    page = {"items": [CLIP], "next_cursor": None}
    target = {"items": [{**SKELETON, "id": "skeleton_2"}]}
    answers = [httpx.Response(200, json=answer) for answer in (target, page, SKELETON)]
    script.answers = [folder("raw"), *answers, httpx.Response(202, json=JOB)]
    script.marey().project("lab").retarget("raw", "skeletons/mixamo", into="walks")
    asked = json.loads(script.requests[-1].content)
    assert asked["inputs"] == {"clips": [{"collection": "raw"}], "skeleton": {"item": "skeleton_2"}}


def test_a_disk_that_is_full_is_told_with_the_file_that_did_not_fit(tmp_path: Path) -> None:
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*walk\.bvh'"),
        saved_atomically(tmp_path / "walk.bvh"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_arrives_has_the_mode_that_the_process_gives_without_the_mask_being_changed_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mask = os.umask(0o027)
    monkeypatch.setattr(os, "umask", None)  # it is the whole process's: other threads would get it
    try:
        with saved_atomically(tmp_path / "walk.bvh") as file:
            file.write(b"HIERARCHY")
    finally:
        monkeypatch.undo()
        os.umask(mask)
    assert (tmp_path / "walk.bvh").stat().st_mode & 0o777 == 0o640


def test_a_folder_in_the_place_of_a_file_that_arrives_is_told_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    (tmp_path / "walk.bvh").mkdir()
    with pytest.raises(OSError, match=r"walk\.bvh"), saved_atomically(tmp_path / "walk.bvh"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["walk.bvh"]


def query_of(request: httpx.Request) -> dict[str, str]:
    return dict(request.url.params)


def test_one_joint_or_tag_or_command_needs_no_list_and_is_not_read_letter_by_letter(script: ScriptedServer) -> None:
    motion = {
        "schema": "marey/motion@1", "skeleton": {"item": "skeleton_1", "revision": 1}, "frame_rate_hz": 30.0,
        "joints": ["Hips"], "poses": np.tile(np.array([0, 1, 0, 1, 0, 0, 0], np.float32), (3, 1)),
    }  # fmt: skip
    stored = encode_tree(motion, "application/msgpack", arrays="blocks")
    read = httpx.Response(200, content=stored, headers={"Content-Type": BLOCKS})
    made = httpx.Response(201, json=CLIP)
    script.answers = [httpx.Response(200, json=CLIP), read, read, made, made]
    project = script.marey().project("lab")
    clip = project.clips.get("clip_1")
    clip.motion(joints="Hips")
    clip.motion(joints=["Hips", "Spine"])
    assert [query_of(request)["joints"] for request in script.requests[1:]] == ["Hips", "Hips,Spine"]
    for tags in ("walk", ["walk"]):
        project.clips.create("walk", {"motion": {"schema": "marey/motion@1"}}, tags=tags)
        sent = decode_tree(script.requests[-1].content, "application/msgpack", max_bytes=1 << 20)
        assert list(sent["tags"]) == ["walk"]


def test_one_digest_one_folder_one_command_and_one_constraint_need_no_list(
    script: ScriptedServer, tmp_path: Path
) -> None:
    digest = "sha256:" + "0" * 64
    script.answers = [httpx.Response(200, json={"missing": [digest]})]
    assert script.marey().blobs.missing(digest) == {digest}
    assert json.loads(script.requests[0].content) == {"digests": [digest]}
    (tmp_path / "walk.bvh").write_bytes(b"HIERARCHY")
    assert [file.name for file in find_files(str(tmp_path)).files] == ["walk.bvh"]
    assert [file.name for file in find_files(tmp_path).files] == ["walk.bvh"]
    assert [command.command for command in as_edit({"command": "trim", "start": 1}).commands] == ["trim"]
    constraint = {"type": "root_position", "at": 0, "target_m": [0, 1]}
    assert search_request(constraint) == search_request([constraint])


MISTAKES: dict[str, Callable[[ProjectHandle], object]] = {
    "unit": lambda lab: lab.upload("/tmp", unit=cast(Any, "parsec")),
    "name": lambda lab: lab.clips.create("a/b", {"motion": {}}),
    "path": lambda lab: lab.collections.create("/a//b"),
    "role: give 'reader', 'contributor', 'maintainer' or 'owner', not 'emperor'": lambda lab: lab.members.put(
        "ann", cast(Any, "emperor")
    ),
    "samples": lambda lab: lab.evaluate("raw", **cast(Any, {"samples": -1})),
    "url": lambda lab: lab.webhooks.create("ftp://x", kinds=["item.created"]),
    "commands": lambda lab: as_edit([{"command": "nope"}]),
    "parts": lambda lab: lab.clips.create("walk", {}),
}


@pytest.mark.parametrize("named", MISTAKES)
def test_a_wrong_argument_is_an_error_of_this_package_that_names_it(script: ScriptedServer, named: str) -> None:
    with pytest.raises(BadArgument, match=f"^{named}") as wrong:
        MISTAKES[named](script.marey().project("lab"))
    assert isinstance(wrong.value, MareyError)
    assert isinstance(wrong.value, ValueError)
    assert script.requests == []


def test_a_project_is_created_by_its_name_and_a_wrong_name_is_explained(script: ScriptedServer) -> None:
    created = {
        "id": "project_1",
        "name": "lab",
        "visibility": "private",
        "created_at": NOW,
        "updated_at": NOW,
        "rev": 1,
    }
    script.answers = [httpx.Response(201, json=created)]
    assert script.marey().create_project("lab").name == "lab"
    assert json.loads(script.requests[0].content) == {"name": "lab"}
    with pytest.raises(BadArgument, match="name: the text must have at most 64 lower-case letters"):
        script.marey().create_project("My Lab")
