"""Clips and skeletons of Marey's predecessor: handedness, both forms of each document, and every encoding."""

from __future__ import annotations

import bz2
import json
from collections.abc import Callable
from typing import Any

import bson
import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import FormatError, FormatLimit
from marey_motion.formats import read_motion, write_motion, write_predecessor_skeleton
from marey_motion.formats.predecessor import encoding as predecessor_encoding
from marey_motion.formats.predecessor.skeleton import SkeletonForm
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import Skeleton, same_hierarchy

NAMES = {"json": "take.json", "bson": "take.bson", "bson.bz2": "take.bz2"}

TWO_BONES: dict[str, Any] = {
    "root": "hip",
    "jointDescs": [
        {"name": "hip", "offset": [0, 0, 0], "rotation": [-1, 0, 0, 0], "targetName": "hip", "children": ["knee"]},
        {"name": "knee", "offset": [-30, 0, 0], "rotation": [-1, 0, 0, 0], "targetName": "knee", "children": ["end"]},
        {"name": "end", "offset": [0, -40, 0], "rotation": [-1, 0, 0, 0], "targetName": "end", "children": []},
    ],
    "jointSequence": ["hip", "knee"],
}
HALF = float(np.sqrt(0.5))
TWO_POSES: dict[str, Any] = {
    "poses": [
        [-100, 90, 10, -1, 0, 0, 0, -1, 0, 0, 0],
        # hip: a quarter turn about +y, which stands as (-w, -x, y, z)
        [-100, 90, 10, -HALF, 0, HALF, 0, -1, 0, 0, 0],
    ],
    "frame_time": 1 / 30,
    "joint_sequence": ["hip", "knee"],
}


def read(document: dict[str, Any], skeleton: dict[str, Any] | None = TWO_BONES) -> Any:
    companion = None if skeleton is None else json.dumps(skeleton).encode()
    return read_motion(json.dumps(document).encode(), "take.json", companion=companion)


def test_stored_clips_are_mirrored_in_x_and_in_centimetres() -> None:
    imported = read(TWO_POSES)
    np.testing.assert_allclose(imported.skeleton.offsets[1], [0.3, 0, 0])
    np.testing.assert_allclose(imported.skeleton.end_sites[0].offset, [0, -0.4, 0])
    placed = global_positions(imported.clip)
    np.testing.assert_allclose(placed[0], [[1.0, 0.9, 0.1], [1.3, 0.9, 0.1]], atol=1e-6)
    # +x turned a quarter about +y points to -z.
    np.testing.assert_allclose(placed[1], [[1.0, 0.9, 0.1], [1.0, 0.9, -0.2]], atol=1e-6)
    assert imported.clip.frame_rate_hz == 30.0


def test_the_roots_translation_is_added_to_its_offset() -> None:
    raised = json.loads(json.dumps(TWO_BONES))
    raised["jointDescs"][0]["offset"] = [-1, 2, 3]
    np.testing.assert_allclose(read(TWO_POSES, raised).clip.root_translations[0], [1.01, 0.92, 0.13], atol=1e-6)


def test_engine_frames_mean_the_same_as_rows() -> None:
    frames = [
        {
            "rootTranslation": dict(zip("xyz", row[:3], strict=True)),
            "rotations": [dict(zip("wxyz", row[3 + 4 * j : 7 + 4 * j], strict=True)) for j in range(2)],
        }
        for row in TWO_POSES["poses"]
    ]
    other = read({"frames": frames, "frameTime": 1 / 30, "jointSequence": ["hip", "knee"], "events": []})
    np.testing.assert_array_equal(other.clip.poses, read(TWO_POSES).clip.poses)


def test_joints_that_a_clip_leaves_out_stay_at_rest() -> None:
    rows = {**TWO_POSES, "poses": [row[:7] for row in TWO_POSES["poses"]], "joint_sequence": ["hip"]}
    np.testing.assert_array_equal(read(rows).clip.rotations[:, 1], [[1, 0, 0, 0]] * 2)


def test_columns_of_tips_that_some_writers_added_are_dropped_when_they_are_zero() -> None:
    padded = {**TWO_POSES, "poses": [[*row, 0, 0, 0, 0] for row in TWO_POSES["poses"]]}
    np.testing.assert_array_equal(read(padded).clip.poses, read(TWO_POSES).clip.poses)


def test_sign_flips_and_lengths_are_mended_with_a_warning() -> None:
    flipped = json.loads(json.dumps(TWO_POSES))
    flipped["poses"][1][3:7] = [2 * HALF, 0, -2 * HALF, 0]
    imported = read(flipped)
    np.testing.assert_allclose(imported.clip.poses, read(TWO_POSES).clip.poses, atol=1e-6)
    assert {"non-unit-quaternions", "sign-flips-unrolled"} <= {warning.code for warning in imported.warnings}


@pytest.mark.parametrize("encoding", list(NAMES))
@pytest.mark.parametrize("form", ["poses", "frames"])
@pytest.mark.parametrize("skeleton_form", ["database", "file"])
def test_clips_survive_every_form_and_encoding(
    body: Skeleton, tumbling: Callable[..., Clip], skeleton_form: SkeletonForm, form: str, encoding: str
) -> None:
    turned = np.asarray(quaternions.normalise(np.random.default_rng(3).normal(size=(body.joint_count, 4))), np.float64)
    skeleton = Skeleton(body.joint_names, body.parents, body.offsets, turned, body.end_sites)
    clip = tumbling(skeleton)
    document = write_predecessor_skeleton(skeleton, form=skeleton_form)
    data = write_motion(clip, "predecessor", form=form, encoding=encoding)
    imported = read_motion(data, NAMES[encoding], companion=document)
    assert imported.clip is not None
    np.testing.assert_allclose(global_positions(imported.clip), global_positions(clip), atol=2e-6)
    np.testing.assert_allclose(np.abs(np.sum(imported.clip.rotations * clip.rotations, axis=2)), 1.0, atol=1e-6)


@pytest.mark.parametrize("form", ["database", "file"])
def test_skeletons_survive_both_forms(body: Skeleton, form: SkeletonForm) -> None:
    imported = read_motion(write_predecessor_skeleton(body, form=form), "body.json")
    assert imported.clip is None
    assert same_hierarchy(imported.skeleton, body, tolerance_m=1e-9)


def described(document: dict[str, Any]) -> list[dict[str, Any]]:
    """Return all nodes of a skeleton document, which may have either form."""
    if "jointDescs" in document:
        return list(document["jointDescs"])
    nodes = [document["root"]]
    for node in nodes:
        nodes += node["children"]
    return nodes


@pytest.mark.parametrize("form", ["database", "file"])
def test_rest_rotations_survive_both_forms(body: Skeleton, form: SkeletonForm) -> None:
    turned = np.asarray(quaternions.normalise(np.random.default_rng(8).normal(size=(body.joint_count, 4))), np.float64)
    skeleton = Skeleton(body.joint_names, body.parents, body.offsets, turned, body.end_sites)
    written = write_predecessor_skeleton(skeleton, form=form)
    assert same_hierarchy(read_motion(written, "body.json").skeleton, skeleton, tolerance_m=1e-9)
    nodes = described(json.loads(written))
    assert {node["name"] for node in nodes} > set(body.joint_names)
    lengths = [np.linalg.norm(node["rotation"]) for node in nodes]
    np.testing.assert_allclose(lengths, 1.0, rtol=0, atol=1e-12)


def test_joints_that_move_against_their_parents_are_refused_by_name(
    body: Skeleton, tumbling: Callable[..., Clip]
) -> None:
    with pytest.raises(FormatError) as refused:
        write_motion(tumbling(body, translated=(3,)), "predecessor")
    assert refused.value.joint == "LeftFoot"


def test_a_clip_without_its_skeleton_is_refused_with_the_reason() -> None:
    with pytest.raises(FormatError, match="together with its skeleton document"):
        read(TWO_POSES, None)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joint_sequence": ["hip", "ankle"]}, "ankle"),
        ({"joint_sequence": ["hip", "hip"]}, "twice"),
        ({"joint_sequence": "hip"}, "joint_sequence"),
        ({"poses": []}, "poses"),
        ({"poses": [[1, 2]]}, "rows of 11"),
        ({"poses": [[1, 2], [3]]}, "equal length"),
        ({"poses": [["a"] * 11]}, "numbers"),
        ({"poses": [[0] * 11]}, "not a rotation"),
        ({"poses": [[*TWO_POSES["poses"][0], 1, 0, 0, 0]]}, "15 columns"),
        ({"frame_time": 0}, "Frame Time"),
        ({"frame_time": "fast"}, "frame_time"),
    ],
)
def test_a_wrong_field_of_a_clip_is_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(FormatError, match=words):
        read({**TWO_POSES, **change})


@pytest.mark.parametrize(
    ("joint", "change", "words"),
    [
        (0, {"children": ["knee", "toe"]}, "toe"),
        (0, {"children": []}, "no parent"),
        (2, {"children": ["knee"]}, "child"),
        (1, {"name": "hip"}, "twice"),
        (1, {"offset": [0, 0]}, "3 numbers"),
        (1, {"rotation": [0, 0, 0, 0]}, "zero"),
        (1, {"rotation": None}, "rotation"),
    ],
)
def test_a_wrong_field_of_a_skeleton_is_named(joint: int, change: dict[str, Any], words: str) -> None:
    document = json.loads(json.dumps(TWO_BONES))
    document["jointDescs"][joint] |= change
    with pytest.raises(FormatError, match=words):
        read(document, None)


def test_a_joint_that_is_not_below_the_root_is_named() -> None:
    document = json.loads(json.dumps(TWO_BONES))
    lost = {"offset": [0, 0, 0], "rotation": [-1, 0, 0, 0]}
    for name, child in (("left", "right"), ("right", "left")):
        document["jointDescs"].append({**lost, "name": name, "targetName": name, "children": [child]})
    with pytest.raises(FormatError, match="not below the root 'hip'") as refused:
        read(document, None)
    assert refused.value.joint == "left"


@pytest.mark.parametrize(
    "data",
    [
        b"{",
        b"[" * 100_000,
        b'{"poses": ' + b"[" * 100_000,
        b'{"a": NaN, "poses": 1}',
        b"\x05\x00\x00\x00\x00",
        b"\xff\xff\xff\x7f\x00rubbish",
        bz2.compress(b"rubbish"),
        bz2.compress(bson.encode({"poses": []}))[:-4],
        b"BZh9rubbish",
    ],
)
def test_damaged_documents_are_refused(data: bytes) -> None:
    with pytest.raises(FormatError) as refused:
        read_motion(data, "take.bson")
    assert refused.value.file == "take.bson"


def test_a_document_that_unpacks_to_too_much_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predecessor_encoding, "MOST_UNPACKED_BYTES", 1 << 20)
    bomb = bz2.compress(bytes(1 << 22))
    assert len(bomb) < 1 << 10
    with pytest.raises(FormatLimit, match="unpacks to more"):
        read_motion(bomb, "bomb.bz2")
