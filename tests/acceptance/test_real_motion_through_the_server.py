"""Upload of the BVH files of a real collection to a server, and their download in every format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.support.another_loader import files_to_compare, positions_by_another_loader
from tests.support.present import present
from tests.support.server_process import serving
from tests.support.tiers import is_soak

from marey_client import Marey
from marey_client.handles.clips import ClipHandle
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_motion.documents import clip_from_document, skeleton_from_document
from marey_motion.kinematics import global_positions
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.encoding.codecs import MEDIA_TYPES, decode_tree

pytestmark = pytest.mark.timeout(600)


@dataclass(frozen=True)
class Uploaded:
    """The collection of real motion after its upload to a server."""

    marey: Marey
    lab: ProjectHandle
    files: dict[str, Path]
    clips: dict[str, ClipHandle]


@pytest.fixture(scope="module")
def uploaded(mocap: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Uploaded]:
    """The collection on a server; outside the tier `soak`, only a few of the files with the same skeleton."""
    with serving(tmp_path_factory.mktemp("collection")) as server, server.client() as marey:
        lab = marey.project("lab")
        marey.transport.send("POST", "/projects", content=b'{"name": "lab"}')
        named = {file.name: file for file in find_files([mocap]).files if file.name.endswith(".bvh")}
        files = [named[name] for name in files_to_compare(list(named))]
        entries = lab.imports.upload(files)
        paths = {file.name: file.path for file in files}
        clips = {entry.name: lab.clips.get(entry.item) for entry in entries if entry.frames and entry.item}
        assert len(clips) >= len(files) - 3
        yield Uploaded(marey, lab, paths, clips)


def test_originals_come_back_byte_for_byte(uploaded: Uploaded, tmp_path: Path) -> None:
    for name, clip in uploaded.clips.items():
        assert clip.export(tmp_path, format="original").read_bytes() == uploaded.files[name].read_bytes(), name


def test_bvh_files_put_every_joint_where_the_clip_has_it(uploaded: Uploaded, tmp_path: Path) -> None:
    assert len(uploaded.clips) > 40
    for name, clip in list(uploaded.clips.items())[:: 1 if is_soak() else 4]:
        written = positions_by_another_loader(clip.export(tmp_path, format="bvh")) * 0.01
        assert np.abs(written - positions_of(uploaded.lab, clip)).max() < 1e-4, name


def test_ranges_of_frames_and_joints_equal_slices_of_the_whole(uploaded: Uploaded) -> None:
    for name, clip in uploaded.clips.items():
        whole = clip.motion()
        frames = slice(len(whole.poses) // 3, len(whole.poses) // 3 + 40)
        joints = list(whole.joints[1::3]) or list(whole.joints)
        part = clip.motion(frames=frames, joints=joints)
        chosen = [whole.joints.index(joint) for joint in joints]
        assert np.array_equal(part.rotations, whole.rotations[frames][:, chosen]), name
        assert np.array_equal(clip.motion(frames=frames).poses, whole.poses[frames]), name


def test_a_part_is_the_same_in_json_messagepack_and_bson(uploaded: Uploaded) -> None:
    for name, clip in list(uploaded.clips.items())[::8]:
        forms = [*MEDIA_TYPES, "application/msgpack; arrays=blocks", "application/bson; arrays=blocks"]
        trees = [motion_in(uploaded, clip, form) for form in forms]
        for tree in trees[1:]:
            poses = tree.pop("poses"), trees[0]["poses"]
            assert np.array_equal(poses[0].view(np.uint32), poses[1].view(np.uint32)), name
            moved, expected = tree.pop("translations", None), trees[0].get("translations")
            assert (moved is None) == (expected is None)
            assert moved is None or np.array_equal(moved, present(expected)), name
            assert tree == {key: value for key, value in trees[0].items() if key in tree}, name


def motion_in(uploaded: Uploaded, clip: ClipHandle, form: str) -> dict[str, Any]:
    response = uploaded.marey.transport.send("GET", f"{clip.url}/parts/motion", headers={"Accept": form})
    tree: dict[str, Any] = decode_tree(response.content, response.headers["Content-Type"].split(";")[0])
    return tree


def positions_of(lab: ProjectHandle, clip: ClipHandle) -> NDArray[np.float32]:
    """Return the positions (F, J, 3) of the joints in metres, computed from the clip's own documents."""
    motion = MotionDocument.model_validate(clip.part("motion"))
    skeleton = lab.skeletons.get(motion.skeleton.model_dump()["item"])
    return global_positions(clip_from_document(motion, skeleton_from_document(skeleton.hierarchy())))
