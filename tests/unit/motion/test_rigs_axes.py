"""Twist and swing axes have the same anatomical meaning for any local axes, rest pose and proportions of a rig."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.support.present import present

from marey_motion import kinematics, quaternions
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.clip import Clip
from marey_motion.errors import ClipError, MappingError
from marey_motion.rigs import JointMapping, axes_from_motion, guess_axes, map_joints, rest_pose_doubts
from marey_motion.rigs.axes import JointAxes
from marey_motion.rigs.conventions import conventional_axes
from marey_motion.skeleton import EndSite, Skeleton

X, Y, Z = np.eye(3)
PARTS = ("trunk", "left arm", "left leg", "right arm", "right leg")


def at_rest(skeleton: Skeleton, axes: dict[str, JointAxes], name: str) -> tuple[AnyFloats, AnyFloats]:
    """Return twist and swing axis of a joint in the world, in the rest pose."""
    rotation = skeleton.rest_global_rotations[skeleton.index_of(name)]
    twist, swing = (quaternions.rotate_vectors(rotation, axis) for axis in (axes[name].twist, axes[name].swing))
    return twist, swing


def with_arms(body: Skeleton, direction_left: tuple[float, float, float]) -> Skeleton:
    """Return the body with straight arms that point in another direction; the right arm mirrors the left arm."""
    offsets = body.offsets.copy()
    for name in ("LeftForeArm", "LeftHand"):
        length = np.linalg.norm(offsets[body.index_of(name)])
        offsets[body.index_of(name)] = length * np.array(direction_left)
        offsets[body.index_of(name.replace("Left", "Right"))] = length * np.array(direction_left) * (-1, 1, 1)
    return replace(body, offsets=offsets, end_sites=())


@pytest.mark.parametrize(
    ("joint", "twist", "swing"),
    [
        ("Hips", Y, X),
        ("Spine", Y, X),
        ("Spine2", Y, X),
        ("Head", Y, X),
        ("LeftUpLeg", -Y, X),
        ("RightUpLeg", -Y, X),
        ("RightLeg", -Y, X),
        ("LeftToeBase", Z, X),
        ("LeftArm", X, Y),
        ("LeftForeArm", X, Y),
        ("LeftHand", X, Y),
        ("RightArm", -X, -Y),
        ("RightForeArm", -X, -Y),
        ("RightHand", -X, -Y),
    ],
)
def test_in_a_t_pose_the_axes_are_those_of_a_drawing(body: Skeleton, joint: str, twist: Floats, swing: Floats) -> None:
    axes = guess_axes(body, map_joints(body))

    np.testing.assert_allclose(axes[joint].twist, twist, atol=1e-12)
    np.testing.assert_allclose(axes[joint].swing, swing, atol=1e-12)
    assert rest_pose_doubts(body, map_joints(body)) == ()


def test_every_mapped_joint_has_unit_axes_at_a_right_angle(body: Skeleton) -> None:
    mapping = map_joints(body)
    axes = guess_axes(body, mapping)

    assert set(axes) == set(mapping.joints.values())
    for one in axes.values():
        assert np.linalg.norm(one.twist) == pytest.approx(1.0)
        assert np.linalg.norm(one.swing) == pytest.approx(1.0)
        assert np.dot(one.twist, one.swing) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("lowered", np.radians([0, 20, 45, 70, 90]))
def test_an_arm_lowered_sideways_takes_its_swing_axis_along(body: Skeleton, lowered: float) -> None:
    posed = with_arms(body, (np.cos(lowered), -np.sin(lowered), 0.0))
    axes = guess_axes(posed, map_joints(posed))

    np.testing.assert_allclose(axes["LeftForeArm"].swing, [np.sin(lowered), np.cos(lowered), 0], atol=1e-12)
    np.testing.assert_allclose(axes["RightForeArm"].swing, [np.sin(lowered), -np.cos(lowered), 0], atol=1e-12)


def test_arms_stretched_forward_hinge_about_the_left_as_hanging_ones_do(body: Skeleton) -> None:
    posed = with_arms(body, (0.0, 0.0, 1.0))
    axes = guess_axes(posed, map_joints(posed))

    np.testing.assert_allclose(axes["LeftArm"].swing, X, atol=1e-12)
    np.testing.assert_allclose(axes["RightArm"].swing, X, atol=1e-12)


def test_a_hand_with_fingers_swings_across_its_palm(body: Skeleton) -> None:
    hand = body.index_of("LeftHand")
    skeleton = Skeleton(
        (*body.joint_names, "LeftHandIndex1", "LeftHandPinky1"),
        np.append(body.parents, [hand, hand]),
        np.concatenate((body.offsets, [[0.09, 0.03, 0.0], [0.09, -0.03, 0.0]])),  # thumb side up
        quaternions.identity(body.joint_count + 2),
    )
    axes = guess_axes(skeleton, map_joints(skeleton))

    # The thumb is up, so the back of the left hand looks backwards while the elbow's axis still points up.
    np.testing.assert_allclose(axes["LeftHand"].swing, -Z, atol=1e-12)
    np.testing.assert_allclose(axes["LeftForeArm"].swing, Y, atol=1e-12)


def reframed(clip: Clip, seed: int) -> tuple[Clip, AnyFloats]:
    """Return the same motion on a rig with other local axes, whose bones have random directions at rest."""
    body = clip.skeleton
    random = np.random.default_rng(seed)
    frames = quaternions.normalise(random.normal(size=(body.joint_count, 4)))
    above = frames[body.parents[1:]]
    offsets = body.offsets.copy()
    offsets[1:] = quaternions.rotate_vectors(quaternions.conjugate(above), offsets[1:])
    turned = [quaternions.rotate_vectors(quaternions.conjugate(frames[at.joint]), at.offset) for at in body.end_sites]
    sites = tuple(replace(at, offset=one.astype(np.float64)) for at, one in zip(body.end_sites, turned, strict=True))
    skeleton = replace(body, offsets=offsets, end_sites=sites)
    rotations = quaternions.multiply(kinematics.global_rotations(clip).astype(np.float64), frames)
    local = kinematics.as_local_rotations(skeleton, rotations)
    poses = np.concatenate((clip.root_translations, local.reshape(clip.frame_count, -1)), axis=1).astype(np.float32)
    return Clip(skeleton, clip.frame_rate_hz, poses), frames


@pytest.fixture
def exercising(body: Skeleton) -> Clip:
    """A clip that begins in a T-pose with lowered arms; then knees and elbows bend and the body turns."""
    frames = 50
    phase = np.linspace(0, 4 * np.pi, frames)
    rotations = quaternions.identity(frames, body.joint_count)
    bend = 0.6 + 0.5 * np.sin(phase)

    def turn(joint: str, axis: Floats, angle: Floats) -> None:
        at = body.index_of(joint)
        rotations[:, at] = quaternions.multiply(
            rotations[:, at], quaternions.from_axis_angle(np.tile(axis, (frames, 1)), angle)
        )

    turn("Hips", Y, 0.3 * phase)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        turn(f"{side}UpLeg", X, -0.5 * bend)
        turn(f"{side}Leg", X, bend)
        turn(f"{side}Arm", Z, np.full(frames, -sign * 1.2))
        turn(f"{side}ForeArm", Y, -sign * bend)
    poses = np.concatenate((np.tile([0.0, 0.95, 0.0], (frames, 1)), rotations.reshape(frames, -1)), axis=1)
    return Clip(body, 60.0, poses.astype(np.float32))


@pytest.mark.parametrize("seed", range(5))
def test_axes_do_not_depend_on_the_frames_that_a_rig_gives_its_joints(
    body: Skeleton, exercising: Clip, seed: int
) -> None:
    clip, frames = reframed(exercising, seed)
    rotated = replace(
        clip.skeleton,
        rest_rotations=kinematics.as_local_rotations(clip.skeleton, frames).astype(np.float64),
        offsets=np.concatenate((body.offsets[:1], clip.skeleton.offsets[1:])),
    )
    np.testing.assert_allclose(rotated.rest_global_positions, body.rest_global_positions, atol=1e-12)
    axes, expected = guess_axes(rotated, map_joints(rotated)), guess_axes(body, map_joints(body))

    for name in expected:
        for found, wanted in zip(at_rest(rotated, axes, name), at_rest(body, expected, name), strict=True):
            np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_where_the_rest_pose_is_no_body_a_motion_tells_the_same_axes(
    body: Skeleton, exercising: Clip, seed: int
) -> None:
    clip, frames = reframed(exercising, seed)
    mapping = map_joints(clip.skeleton)
    assert rest_pose_doubts(clip.skeleton, mapping) == PARTS
    axes, expected = guess_axes(clip.skeleton, mapping, clip), guess_axes(body, map_joints(body))

    for name in expected:
        for kind in ("twist", "swing"):
            in_body = quaternions.rotate_vectors(frames[body.index_of(name)], getattr(axes[name], kind))
            angle = np.degrees(np.arccos(np.clip(in_body @ getattr(expected[name], kind), -1, 1)))
            assert angle < 12.0, (name, kind, angle)


def test_only_the_part_that_rests_oddly_is_doubted(body: Skeleton) -> None:
    offsets = body.offsets.copy()
    for name in ("LeftForeArm", "LeftHand"):
        offsets[body.index_of(name)] = [0.0, 0.3, 0.0]
    raised = replace(body, offsets=offsets)

    assert rest_pose_doubts(raised, map_joints(raised)) == ("left arm",)


def test_a_tip_that_an_exporter_misplaced_is_not_the_end_of_a_hand(body: Skeleton) -> None:
    sites = tuple(replace(site, offset=np.array([9.0, 9.0, 9.0])) for site in body.end_sites if site.joint == 15)
    odd = replace(body, end_sites=sites)

    np.testing.assert_allclose(guess_axes(odd, map_joints(odd))["LeftHand"].twist, X, atol=1e-12)


def test_a_toe_joint_straight_below_the_ankle_leaves_the_foot_pointing_forward(body: Skeleton) -> None:
    offsets = body.offsets.copy()
    sites = []
    for side in ("Left", "Right"):
        offsets[body.index_of(f"{side}ToeBase")] = [0.0, -0.04, 0.0]
        sites.append(EndSite(body.index_of(f"{side}ToeBase"), np.array([0.0, 0.0, 0.2])))
    odd = replace(body, offsets=offsets, end_sites=tuple(sites))
    axes = guess_axes(odd, map_joints(odd))

    assert rest_pose_doubts(odd, map_joints(odd)) == ()
    for joint in ("LeftFoot", "RightFoot"):
        assert axes[joint].twist[2] > 0.97
    for joint in ("LeftFoot", "RightFoot", "LeftToeBase"):
        np.testing.assert_allclose(axes[joint].swing, X, atol=1e-12)
    np.testing.assert_allclose(axes["LeftToeBase"].twist, Z, atol=1e-12)


def test_axes_need_two_sides(body: Skeleton) -> None:
    mapping = JointMapping(None, {"pelvis": "Hips", "head": "Head"}, 0.1, "manual")
    with pytest.raises(MappingError, match="both"):
        guess_axes(body, mapping)


@pytest.mark.parametrize(("joint", "parent"), [("LeftForeArm", "LeftArm"), ("LeftHand", "LeftForeArm")])
def test_an_arm_without_length_is_refused_by_its_joints_and_what_to_do(body: Skeleton, joint: str, parent: str) -> None:
    offsets = body.offsets.copy()
    offsets[body.index_of(joint)] = 0.0
    told = rf"{parent} \(.*{joint} \(.*at the same position.*map left_\w+ to a joint further on"
    with pytest.raises(MappingError, match=told):
        guess_axes(replace(body, offsets=offsets), map_joints(body))


def test_legs_alone_have_axes_too(body: Skeleton) -> None:
    legs = Skeleton(body.joint_names[:9], body.parents[:9], body.offsets[:9], body.rest_rotations[:9])
    axes = guess_axes(legs, map_joints(legs))

    np.testing.assert_allclose(axes["LeftLeg"].swing, X, atol=1e-12)
    np.testing.assert_allclose(axes["Hips"].twist, Y, atol=1e-12)


def test_hips_alone_do_not_tell_where_up_is(body: Skeleton) -> None:
    mapping = JointMapping(None, {"left_hip": "LeftUpLeg", "right_hip": "RightUpLeg"}, 0.1, "manual")
    with pytest.raises(MappingError, match="two of three heights"):
        guess_axes(body, mapping)


def test_a_motion_of_another_skeleton_tells_nothing(body: Skeleton, tumbling: Callable[..., Any]) -> None:
    other = replace(body, offsets=body.offsets * 2)
    with pytest.raises(ClipError, match="the skeleton of this motion differs"):
        guess_axes(body, map_joints(body), tumbling(other))


WALKS = (
    "bandai-namco-1/dataset-1_walk_normal_001.bvh",
    "cmu-iclone-bvh/002_01.bvh",
    "rigs/game-engine/custom_skeleton_walk_example.bvh",
    "rigs/makehuman/walk1.bvh",
    "rigs/misc/walk01.bvh",
    "rigs/snu-mass/walk.bvh",
    "rigs/snu-mss/walk.bvh",
)


@pytest.mark.parametrize("file", WALKS)
def test_in_a_real_walk_bones_point_down_and_hinges_point_left_on_every_rig(mocap: Path, file: str) -> None:
    from marey_motion.formats import read_motion

    path = mocap / file
    clip = read_motion(path.read_bytes(), path.name).clip
    skeleton, mapping = present(clip).skeleton, map_joints(present(clip).skeleton)
    axes = guess_axes(skeleton, mapping, clip)
    positions, rotations = kinematics.global_positions(present(clip)), kinematics.global_rotations(present(clip))
    hips = mapping.indices(skeleton, ("left_hip", "right_hip"))
    left = positions[:, hips[0]] - positions[:, hips[1]]
    left /= np.linalg.norm(left, axis=1, keepdims=True)

    def mean_along(joint: str, kind: str, direction: NDArray[Any]) -> float:
        turned = quaternions.rotate_vectors(
            rotations[:, skeleton.index_of(mapping.joints[joint])], getattr(axes[mapping.joints[joint]], kind)
        )
        return float(np.mean(np.sum(turned * direction, axis=1)))

    for side in ("left", "right"):
        for joint in ("hip", "knee"):
            assert mean_along(f"{side}_{joint}", "twist", -Y) > 0.75
            assert mean_along(f"{side}_{joint}", "swing", left) > 0.9
        assert mean_along(f"{side}_ankle", "swing", left) > 0.85
        assert mean_along(f"{side}_shoulder", "twist", -Y) > 0.7
        assert mean_along(f"{side}_elbow", "swing", left) > 0.4
    for joint in ("pelvis", "spine_2", "head"):
        assert mean_along(joint, "twist", Y) > 0.85
        assert mean_along(joint, "swing", left) > 0.9


FOLDED = {
    "bandai-namco": "bandai-namco-2/dataset-2_walk-turn-left_normal_003.bvh",
    "game-engine": "rigs/game-engine/custom_skeleton_walk_example.bvh",
    "geno": "rigs/geno/Geno_stance.bvh",
    "mh-cmu": "rigs/game-engine/vis_example.bvh",
    "reallusion": "cmu-iclone-bvh/002_01.bvh",
}
STEADY = ("hip", "knee", "shoulder")


@pytest.mark.parametrize("rig", FOLDED)
def test_the_stated_axes_of_a_known_rig_are_those_that_its_hinges_show(mocap: Path, rig: str) -> None:
    from marey_motion.formats import read_motion

    path = mocap / FOLDED[rig]
    clip = present(read_motion(path.read_bytes(), path.name).clip)
    mapping = map_joints(clip.skeleton)
    assert mapping.rig == rig
    assert rest_pose_doubts(clip.skeleton, mapping)
    assert axes_from_motion(clip.skeleton, mapping) == frozenset()

    stated = guess_axes(clip.skeleton, mapping)
    moved = guess_axes(clip.skeleton, mapping, clip)
    assert all(moved[joint] == stated[joint] for name, joint in mapping.joints.items() if name != "root")
    shown = guess_axes(clip.skeleton, replace(mapping, rig=None), clip)
    agreeing = {name: np.dot(stated[joint].swing, shown[joint].swing) for name, joint in mapping.joints.items()}
    for name in (f"{side}_{part}" for side in ("left", "right") for part in STEADY):
        assert agreeing[name] > 0.9, name
    for name in agreeing.keys() - {"root"}:  # a take holds other joints in any way, but not reversed
        assert agreeing[name] > 0.4 or name.endswith("_finger_tip"), name


def test_a_rig_that_contradicts_the_stated_axes_of_its_names_is_read_from_a_motion(mocap: Path) -> None:
    from marey_motion.formats import read_motion

    path = mocap / FOLDED["bandai-namco"]
    body = present(read_motion(path.read_bytes(), path.name).clip).skeleton
    turned = quaternions.from_axis_angle(Z, np.array(np.pi / 2))
    other = replace(body, offsets=quaternions.rotate_vectors(turned, body.offsets).astype(np.float64))

    assert axes_from_motion(body, map_joints(body)) == frozenset()
    assert map_joints(other).rig == "bandai-namco"
    assert "LowerArm_L" in axes_from_motion(other, map_joints(other))


@pytest.mark.parametrize("tilt_rad", [0.0, 0.2])
def test_the_stated_axes_of_a_known_rig_turn_with_its_rest_pose_and_its_bones(mocap: Path, tilt_rad: float) -> None:
    from marey_motion.formats import read_motion

    path = mocap / FOLDED["bandai-namco"]
    body = present(read_motion(path.read_bytes(), path.name).clip).skeleton
    stated = guess_axes(body, map_joints(body))["LowerArm_L"]
    shoulder, wrist = body.index_of("UpperArm_L"), body.index_of("Hand_L")
    rest, offsets = body.rest_rotations.copy(), body.offsets.copy()
    rest[shoulder] = quaternions.from_axis_angle(Z, np.array(0.3))
    tilt = quaternions.from_axis_angle(np.array(stated.swing), np.array(tilt_rad))
    offsets[wrist] = quaternions.rotate_vectors(tilt, offsets[wrist])
    other = replace(body, rest_rotations=rest, offsets=offsets)

    found = guess_axes(other, map_joints(other))["LowerArm_L"]
    np.testing.assert_allclose(found.twist, offsets[wrist] / np.linalg.norm(offsets[wrist]), atol=1e-6)
    np.testing.assert_allclose(found.swing, stated.swing, atol=1e-6)


def test_a_bone_with_a_joint_in_between_has_the_stated_twist() -> None:
    """The offset of the elbow is in the frame of the joint in between, which may be turned."""
    offsets = np.array([[0.0, 1.4, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
    parents = np.array([-1, 0, 1], dtype=np.int32)
    arm = Skeleton(("Shoulder", "Between", "Elbow"), parents, offsets, quaternions.identity(3))
    joints = {"left_shoulder": 0, "left_elbow": 2}
    found = conventional_axes(arm, "bandai-namco", joints, {"left_shoulder": "left_elbow"})
    np.testing.assert_array_equal(found["left_shoulder"][0], X)
