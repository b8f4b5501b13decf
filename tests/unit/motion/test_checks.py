"""Checks of a motion: a finding is reported only if the motion has the fault, with joints, frames and numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.formats import read_motion, write_bvh
from marey_motion.gait import generate_gait, studio_skeleton
from marey_motion.importing.checks import CODES, CheckWarning, check_clip, on_the_floor, without_rest_pose
from marey_motion.importing.landmarks import find_landmarks
from marey_motion.kinematics import global_positions
from marey_schemas.options.imports import ImportOptions


@pytest.fixture(scope="module")
def walk() -> Clip:
    return generate_gait(1.3, 0.0, 3.0, 60.0)


@pytest.fixture(scope="module")
def standing() -> Clip:
    """Two seconds of the rest pose, a T-pose, on the floor."""
    skeleton = studio_skeleton()
    poses = np.zeros((120, 3 + 4 * skeleton.joint_count), np.float32)
    poses[:, 3::4] = 1.0
    poses[:, :3] = skeleton.offsets[0]
    return Clip(skeleton, 60.0, poses)


def found(clip: Clip, code: str) -> CheckWarning | None:
    return next((warning for warning in check_clip(clip) if warning.code == code), None)


def shifted(clip: Clip, shift: np.ndarray) -> Clip:
    poses = clip.poses.copy()
    poses[:, :3] += np.asarray(shift, np.float32)
    return replace(clip, poses=poses)


def joined(*clips: Clip) -> Clip:
    return replace(clips[0], poses=np.concatenate([clip.poses for clip in clips]))


def test_a_clean_walk_raises_no_warning(walk: Clip) -> None:
    assert check_clip(walk) == ()


def test_a_clean_run_raises_no_warning() -> None:
    assert check_clip(generate_gait(3.5, 0.0, 3.0, 60.0)) == ()


class TestRestPose:
    def test_rest_poses_at_both_ends_are_found_and_trimmed(self, walk: Clip, standing: Clip) -> None:
        clip = joined(standing.sliced(0, 20), walk, standing.sliced(0, 5))
        ranges = [warning.frames for warning in check_clip(clip) if warning.code == "rest-pose-frame"]
        assert ranges == [(0, 20), (200, 205)]
        trimmed, dropped = without_rest_pose(clip)
        assert dropped == (20, 5)
        np.testing.assert_array_equal(trimmed.poses, walk.poses)

    @pytest.mark.parametrize(("start", "end"), [(63, 64), (64, 65), (65, 63), (120, 100), (120, 0), (0, 120)])
    def test_long_rest_poses_are_counted_whole(self, walk: Clip, standing: Clip, start: int, end: int) -> None:
        parts = [standing.sliced(0, start)] if start else []
        clip = joined(*parts, walk, *([standing.sliced(0, end)] if end else []))
        assert without_rest_pose(clip)[1] == (start, end)

    def test_a_rest_pose_between_other_poses_is_no_finding(self, walk: Clip, standing: Clip) -> None:
        clip = joined(walk, standing.sliced(0, 20), walk)
        assert found(clip, "rest-pose-frame") is None
        assert without_rest_pose(clip) == (clip, (0, 0))

    @pytest.mark.parametrize("frames", [1, 2, 3])
    def test_a_rest_pose_alone_is_kept_and_reported_once(self, standing: Clip, frames: int) -> None:
        clip = standing.sliced(0, frames)
        ranges = [warning.frames for warning in check_clip(clip) if warning.code == "rest-pose-frame"]
        assert ranges == [(0, frames)]
        assert without_rest_pose(clip) == (clip, (0, 0))

    def test_what_the_options_mended_is_not_complained_about(self, walk: Clip, standing: Clip) -> None:
        poses = joined(standing.sliced(0, 20), walk).poses.copy()
        poses[:, 1] += 0.3
        clip = replace(walk, poses=poses)
        told = {}
        for mended in (False, True):
            options = ImportOptions(trim_rest_pose=mended, align_floor=mended)
            told[mended] = {
                warning.code for warning in read_motion(write_bvh(clip), "walk.bvh", options=options).warnings
            }
        # The jump was the one from the rest pose into the walk.
        assert told[False] - told[True] == {"rest-pose-frame", "rotation-jump", "floor-offset"}

    def test_a_t_pose_is_found_in_whatever_way_the_rig_rests(self, walk: Clip, standing: Clip) -> None:
        tilted = standing.poses.copy()
        elbow = standing.skeleton.index_of("LeftForeArm")
        tilted[:, 3 + 4 * elbow : 7 + 4 * elbow] = [np.cos(0.05), 0.0, np.sin(0.05), 0.0]
        clip = joined(replace(standing, poses=tilted).sliced(0, 3), walk)
        assert [w.frames for w in check_clip(clip) if w.code == "rest-pose-frame"] == [(0, 3)]

    @pytest.mark.parametrize(("turn_deg", "dropped"), [(0.3, (20, 0)), (1.0, (0, 0))])
    def test_a_pose_near_that_of_the_rig_is_rest_and_another_is_not(
        self, walk: Clip, turn_deg: float, dropped: tuple[int, int]
    ) -> None:
        rest = walk.skeleton.rest_rotations.copy()
        for side, angle in (("Left", -1.0), ("Right", 1.0)):  # arms down: no T
            rest[walk.skeleton.index_of(f"{side}Arm")] = quaternions.from_axis_angle((0.0, 0.0, 1.0), angle)
        turned = quaternions.multiply(rest, quaternions.from_axis_angle((1.0, 0.0, 0.0), np.radians(turn_deg)))
        poses = walk.poses.copy()
        poses[:20, 3:] = turned.reshape(-1)
        clip = replace(walk, skeleton=replace(walk.skeleton, rest_rotations=rest), poses=poses)
        assert without_rest_pose(clip)[1] == dropped

    def test_a_clip_of_nothing_but_rest_is_told_and_left_whole(self, standing: Clip) -> None:
        warning = found(standing, "rest-pose-frame")
        assert warning is not None
        assert warning.frames == (0, 120)
        assert without_rest_pose(standing) == (standing, (0, 0))

    def test_a_motion_without_rest_is_left_alone(self, walk: Clip) -> None:
        assert without_rest_pose(walk) == (walk, (0, 0))


class TestGround:
    @pytest.mark.parametrize("height_m", [-0.9, 0.25])
    def test_a_floor_at_another_height_is_measured_and_undone(self, walk: Clip, height_m: float) -> None:
        lifted = shifted(walk, np.array([0.0, height_m, 0.0]))
        warning = found(lifted, "floor-offset")
        assert warning is not None
        assert warning.values["floor_height_m"] == pytest.approx(height_m, abs=0.03)
        lowered, shift_m = on_the_floor(lifted)
        assert shift_m == pytest.approx(-height_m, abs=0.03)
        assert found(lowered, "floor-offset") is None

    def test_feet_that_sink_are_found_with_frame_and_depth(self, walk: Clip) -> None:
        sinking = np.zeros((walk.frame_count, 3))
        sinking[100:104, 1] = -0.2
        warning = found(shifted(walk, sinking), "floor-penetration")
        assert warning is not None
        assert warning.frames is not None
        assert 100 <= warning.frames[0] < warning.frames[1] <= 104
        assert warning.values["deepest_m"] == pytest.approx(0.2, abs=0.05)

    def test_a_walk_on_the_spot_is_found(self, walk: Clip) -> None:
        there = -walk.root_translations * np.array([1.0, 0.0, 1.0])
        warning = found(shifted(walk, there), "in-place-gait")
        assert warning is not None
        assert warning.values["slide_m_s"] == pytest.approx(1.3, rel=0.2)

    def test_feet_that_slide_under_a_travelling_body_are_found(self, walk: Clip) -> None:
        drift = np.outer(np.arange(walk.frame_count) / walk.frame_rate_hz, [1.0, 0.0, 0.0])
        warning = found(shifted(walk, drift), "foot-skate")
        assert warning is not None
        assert warning.values["slide_m_s"] == pytest.approx(1.0, rel=0.2)


class TestContinuity:
    def test_a_jump_of_the_root_is_found_with_its_frame(self, walk: Clip) -> None:
        jump = np.where(np.arange(walk.frame_count)[:, None] >= 50, [5.0, 0.0, 0.0], 0.0)
        warning = found(shifted(walk, jump), "teleport")
        assert warning is not None
        assert (warning.values["frame"], warning.frames, warning.joints) == (50, (49, 51), ("Hips",))

    def test_a_jump_of_a_joint_is_found_with_its_name(self, walk: Clip) -> None:
        poses = walk.poses.copy()
        wrist = walk.skeleton.index_of("LeftHand")
        poses[70:, 3 + 4 * wrist : 7 + 4 * wrist] = [0.0, 1.0, 0.0, 0.0]
        warning = found(replace(walk, poses=poses), "rotation-jump")
        assert warning is not None
        assert (warning.joints, warning.frames) == (("LeftHand",), (69, 71))
        assert warning.values["angle_deg"] > 150

    def test_a_limb_that_never_turns_is_found(self, walk: Clip) -> None:
        arm = [walk.skeleton.index_of(name) for name in ("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand")]
        poses = walk.poses.copy()
        for joint in arm:
            poses[:, 3 + 4 * joint : 7 + 4 * joint] = [1.0, 0.0, 0.0, 0.0]
        warning = found(replace(walk, poses=poses), "dead-joints")
        assert warning is not None
        assert set(warning.joints) == {walk.skeleton.joint_names[joint] for joint in arm}

    def test_joints_that_move_against_their_parents_are_told(self, walk: Clip) -> None:
        hand = walk.skeleton.index_of("LeftHand")
        moved = np.tile(walk.skeleton.offsets[hand], (walk.frame_count, 1, 1)).astype(np.float32)
        moved[:, 0, 1] += 0.02
        warning = found(replace(walk, translations=moved, translated_joints=(hand,)), "position-channels")
        assert warning is not None
        assert warning.joints == ("LeftHand",)
        assert warning.values["largest_m"] == pytest.approx(0.02, abs=1e-5)


def test_an_arm_that_turns_in_one_frame_only_is_not_dead(walk: Clip) -> None:
    poses = walk.poses.copy()
    arm = [walk.skeleton.index_of(name) for name in ("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand")]
    columns = np.concatenate([np.arange(3 + 4 * joint, 7 + 4 * joint) for joint in arm])
    poses[:, columns] = poses[0, columns]
    dead = found(replace(walk, poses=poses), "dead-joints")
    assert dead is not None
    assert set(dead.joints) == {walk.skeleton.joint_names[joint] for joint in arm}
    poses[1, columns[-4:]] = (0.0, 1.0, 0.0, 0.0)
    assert found(replace(walk, poses=poses), "dead-joints") is None


@pytest.mark.parametrize(("joint", "limb"), [("LeftFoot", "leg"), ("RightForeArm", "arm")])
def test_a_limb_whose_bone_has_no_length_is_found(walk: Clip, joint: str, limb: str) -> None:
    offsets = walk.skeleton.offsets.copy()
    bone = walk.skeleton.index_of(joint)
    offsets[bone] = 0.0
    short = replace(walk, skeleton=replace(walk.skeleton, offsets=offsets))
    warning = found(short, "uneven-limbs")
    assert warning is not None
    assert f"left {limb}" in warning.message
    assert warning.values["left_m"] != pytest.approx(warning.values["right_m"], rel=0.2)
    # The same bone, whose length the file states in position channels: the limbs are even.
    moved = np.tile(walk.skeleton.offsets[bone], (walk.frame_count, 1, 1)).astype(np.float32)
    assert found(replace(short, translations=moved, translated_joints=(bone,)), "uneven-limbs") is None


def test_limbs_that_differ_by_a_tenth_are_not_uneven(walk: Clip) -> None:
    offsets = walk.skeleton.offsets.copy()
    offsets[walk.skeleton.index_of("LeftFoot")] *= 0.8
    assert found(replace(walk, skeleton=replace(walk.skeleton, offsets=offsets)), "uneven-limbs") is None


def test_limbs_whose_names_are_unknown_or_of_which_one_hangs_on_the_other_are_not_compared(walk: Clip) -> None:
    offsets = walk.skeleton.offsets.copy()
    offsets[walk.skeleton.index_of("LeftFoot")] = 0.0
    short = replace(walk, skeleton=replace(walk.skeleton, offsets=offsets))
    landmarks = find_landmarks(walk.skeleton)
    hands = (walk.skeleton.index_of("LeftForeArm"), walk.skeleton.index_of("LeftHand"))
    for clip, known in (
        (short, replace(landmarks, by_names=False)),
        (walk, replace(landmarks, hands=hands)),
    ):
        assert "uneven-limbs" not in {warning.code for warning in check_clip(clip, known)}


def test_checks_change_nothing(walk: Clip) -> None:
    before = walk.poses.copy()
    check_clip(walk)
    np.testing.assert_array_equal(walk.poses, before)


def test_a_long_clip_is_looked_at_in_blocks_with_the_same_result(walk: Clip) -> None:
    back_and_forth = joined(*[walk] * 30)
    jumps = found(back_and_forth, "teleport")
    assert jumps is not None
    assert jumps.values["count"] == 29
    np.testing.assert_array_equal(global_positions(back_and_forth)[:180], global_positions(walk))


def test_every_warning_is_plain_json_with_a_code_of_the_table(walk: Clip, standing: Clip) -> None:
    import json

    clip = joined(standing, shifted(walk, np.array([0.0, 3.0, 40.0])))
    warnings = check_clip(clip)
    assert len(warnings) >= 3
    for warning in warnings:
        assert warning.code in CODES
        assert json.loads(json.dumps(warning.as_dict()))["message"] == warning.message


@pytest.mark.parametrize("code", CODES)
def test_codes_are_stable_slugs_with_an_explanation(code: str) -> None:
    assert code == code.lower().strip("-")
    assert CODES[code].endswith(".")
