"""Joints copied from other clips, and rotations added to joints."""

from dataclasses import replace
from math import degrees
from typing import Any, Literal

import numpy as np
import pytest
from tests.support.edited_takes import are_exactly, make_breathing_walk, make_walk, require_sound

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.registry import apply_edit
from marey_motion.errors import EditError, UnknownJoint
from marey_schemas.editing.commands import Paste, RotateJoint

ARM = ["LeftArm", "LeftForeArm", "LeftHand"]


def paste(clip: Clip, source: Clip, **given: Any) -> Clip:
    return apply_edit(clip, [Paste(source="other", joints=ARM, **given)], sources={"other": source})


def indices(clip: Clip, names: list[str]) -> list[int]:
    return [clip.skeleton.index_of(name) for name in names]


def turned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(quaternions.angle_between(a.astype(np.float64), b.astype(np.float64)))


def test_equal_lengths_are_copied_exactly_inside_and_go_over_at_the_borders() -> None:
    walk, run = make_walk(), make_walk(speed_m_s=3.0)
    pasted = paste(walk, run, frames=(40, 140), source_frames=(20, 120), border_s=0.2)
    arm = indices(walk, ARM)
    others = [joint for joint in range(walk.skeleton.joint_count) if joint not in arm]
    assert are_exactly(pasted.rotations[52:128, arm], run.rotations[32:108, arm])
    assert np.array_equal(pasted.rotations[:, others], walk.rotations[:, others])
    assert np.array_equal(pasted.poses[:40], walk.poses[:40])
    assert np.array_equal(pasted.poses[140:], walk.poses[140:])
    own = max(turned(clip.rotations[1:, arm], clip.rotations[:-1, arm]).max() for clip in (walk, run))
    assert turned(pasted.rotations[1:, arm], pasted.rotations[:-1, arm]).max() < 2.0 * own
    require_sound(pasted)


def test_a_stretch_of_another_length_is_fitted_to_the_range() -> None:
    walk, run = make_walk(), make_walk(speed_m_s=3.0)
    pasted = paste(walk, run, frames=(0, 101), source_frames=(30, 81), border_s=0.0)
    arm = indices(walk, ARM)
    assert turned(pasted.rotations[:101:2, arm], run.rotations[30:81, arm]).max() < 1e-5
    between = turned(pasted.rotations[1:100:2, arm], run.rotations[30:80, arm])
    assert between.max() < turned(run.rotations[31:81, arm], run.rotations[30:80, arm]).max()


def test_where_the_range_meets_an_end_there_is_no_border() -> None:
    walk, run = make_walk(), make_walk(speed_m_s=3.0)
    pasted = paste(walk, run)
    arm = indices(walk, ARM)
    assert are_exactly(pasted.rotations[:, arm], run.rotations[:, arm])


def test_translations_are_pasted_with_their_joints() -> None:
    still, breathing = make_walk(), make_breathing_walk()
    arm = still.skeleton.index_of("LeftArm")
    got = paste(still, breathing, frames=(30, 90), source_frames=(30, 90), border_s=0.1)
    assert got.translated_joints == (arm,)
    assert got.translations is not None
    assert breathing.translations is not None
    column = breathing.translated_joints.index(arm)
    assert np.array_equal(got.translations[36:84, 0], breathing.translations[36:84, column])
    assert np.allclose(got.translations[:30, 0], still.skeleton.offsets[arm], atol=1e-6)
    back = paste(breathing, still, frames=(30, 90), border_s=0.1)
    assert back.translations is not None
    assert np.allclose(back.translations[36:84, column], still.skeleton.offsets[arm], atol=1e-6)


def test_joints_whose_axes_differ_are_refused_by_name() -> None:
    walk = make_walk()
    rest = walk.skeleton.rest_rotations.copy()
    rest[walk.skeleton.index_of("LeftForeArm")] = quaternions.from_axis_angle([0.0, 1.0, 0.0], 0.5)
    other = replace(walk, skeleton=replace(walk.skeleton, rest_rotations=rest))
    with pytest.raises(
        EditError, match="joint LeftForeArm: the joint has different orientations in the rest poses"
    ) as refused:
        paste(walk, other)
    assert refused.value.code == "other-axes"


def test_what_is_not_there_cannot_be_copied() -> None:
    walk = make_walk()
    with pytest.raises(EditError, match=r"source_frames: the range 0:9999"):
        paste(walk, walk, source_frames=(0, 9999))
    with pytest.raises(UnknownJoint, match="LeftHand"):
        apply_edit(walk, [Paste(source="other", joints=["LeftHans"])], sources={"other": walk})


@pytest.mark.parametrize("space", ["joint", "parent", "world"])
def test_a_rotation_is_added_in_the_axes_that_are_asked_for(space: Literal["joint", "parent", "world"]) -> None:
    walk = make_walk(turn_rate_rad_s=0.5)
    joint = walk.skeleton.index_of("LeftArm")
    parent = int(walk.skeleton.parents[joint])
    axis, angle = np.array([0.3, -0.5, 0.8]), 0.7
    given = RotateJoint(joint="LeftArm", axis=tuple(axis), angle_deg=degrees(angle), space=space)
    bent = apply_edit(walk, [given])
    before, after = (
        kinematics.as_global_rotations(walk.skeleton, clip.rotations.astype(np.float64)) for clip in (walk, bent)
    )
    change = quaternions.multiply(after[:, joint], quaternions.conjugate(before[:, joint]))
    turn = quaternions.from_axis_angle(axis, angle)
    frame = {"world": np.array([1.0, 0.0, 0.0, 0.0]), "parent": before[:, parent], "joint": before[:, joint]}[space]
    wished = quaternions.multiply(frame, quaternions.multiply(turn, quaternions.conjugate(frame)))
    assert turned(np.asarray(change), np.broadcast_to(wished, change.shape)).max() < 1e-5
    back = apply_edit(bent, [given.replace(angle_deg=degrees(-angle))])
    assert turned(back.rotations, walk.rotations).max() < 1e-5


def test_a_rotation_of_a_range_grows_and_shrinks_over_its_borders() -> None:
    walk = make_walk()
    turn = RotateJoint(joint="Head", axis=(0.0, 1.0, 0.0), angle_deg=degrees(0.8), frames=(60, 120), border_s=0.3)
    bent = apply_edit(walk, [turn])
    head = walk.skeleton.index_of("Head")
    change = turned(bent.rotations[:, head], walk.rotations[:, head])
    assert np.array_equal(bent.poses[:60], walk.poses[:60])
    assert np.array_equal(bent.poses[120:], walk.poses[120:])
    assert np.allclose(change[78:102], 0.8, atol=1e-5)
    assert np.all(np.diff(change[59:79]) > 0.0)
    assert np.abs(np.diff(change)).max() < 0.1


def test_the_root_turns_in_the_axes_of_the_world() -> None:
    walk = make_walk()
    given = {"joint": "Hips", "axis": (0.0, 1.0, 0.0), "angle_deg": 20.0}
    in_world = apply_edit(walk, [RotateJoint(**given, space="world")])
    in_parent = apply_edit(walk, [RotateJoint(**given, space="parent")])
    assert np.array_equal(in_world.poses, in_parent.poses)
    assert np.array_equal(in_world.root_translations, walk.root_translations)
