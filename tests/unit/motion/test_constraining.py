"""Constraints in ranges of frames, and the refinement of samples of a model by constraints."""

from collections.abc import Callable

import numpy as np
import pytest

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.constraining import Constraint, constrain_motion
from marey_motion.editing.finish import finish
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb, limb_ending_at
from marey_motion.editing.inverse_kinematics.targets import (
    Freedom,
    JointLimit,
    LookAtTarget,
    OrientationTarget,
    PositionTarget,
    chain_of,
)
from marey_motion.errors import EditError
from marey_motion.gait import generate_gait
from marey_motion.motion import Motion
from marey_motion.rigs import JointAxes, guess_axes, map_joints
from marey_motion.skeleton import Skeleton

BLEND = 15


@pytest.fixture(scope="module")
def walk() -> Clip:
    return generate_gait(1.2, 0.2, 2.0)


@pytest.fixture(scope="module")
def arm(walk: Clip) -> TwoBoneLimb:
    mapping = map_joints(walk.skeleton)
    wrist = mapping.indices(walk.skeleton, ("left_wrist",))[0]
    limb = limb_ending_at(walk.skeleton, mapping, wrist, guess_axes(walk.skeleton, mapping))
    assert limb is not None
    return limb


def _jolt(skeleton: Skeleton, motion: Motion) -> float:
    """Return the greatest change of a joint's velocity between frames, in metres per frame."""
    return float(np.abs(np.diff(motion.positions(skeleton), 2, axis=0)).max())


@pytest.mark.parametrize("whole_body", [False, True])
def test_a_held_wrist_stays_within_a_millimetre_and_nothing_changes_outside(
    walk: Clip, arm: TwoBoneLimb, whole_body: bool
) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    place = motion.positions(skeleton)[50, arm.end] + (0.0, 0.15, 0.1)
    joints, limb = (chain_of(skeleton, arm.end, 1), None) if whole_body else (arm.joints, arm)
    held = Constraint(PositionTarget(arm.end, place), 50, 65, joints, limb)
    made = constrain_motion(skeleton, motion, [held], blend_frames=BLEND)
    assert np.abs(made.motion.positions(skeleton)[50:65, arm.end] - place).max() < 1e-3
    assert made.residuals_before[0].min() > 0.1
    assert made.residuals_after[0].max() < 1.01e-4
    outside = np.r_[0 : 50 - BLEND, 65 + BLEND : walk.frame_count]
    assert made.motion.rotations[outside].tobytes() == motion.rotations[outside].tobytes()
    assert made.motion.root_translations.tobytes() == motion.root_translations.tobytes()
    # Carried over 18 cm in 15 frames, the wrist jolts more than the walk does; a slower start would swing out further.
    assert _jolt(skeleton, made.motion) < 1.6 * _jolt(skeleton, motion)


def test_a_single_frame_is_met_in_the_middle_of_its_window(walk: Clip, arm: TwoBoneLimb) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    place = motion.positions(skeleton)[60, arm.end] + (0.05, 0.2, 0.1)
    once = Constraint(PositionTarget(arm.end, place), 60, 61, arm.joints, arm)
    made = constrain_motion(skeleton, motion, [once], blend_frames=20)
    moved = np.linalg.norm(made.motion.positions(skeleton)[:, arm.end] - motion.positions(skeleton)[:, arm.end], axis=1)
    assert made.residuals_after[0][0] < 1e-9
    assert int(np.argmax(moved)) in range(57, 64)
    assert np.all(moved[[39, 81]] < 1e-9)
    assert moved[45] < moved[50] < moved[55]


def test_constraints_that_overlap_in_part_come_and_go_smoothly(walk: Clip, arm: TwoBoneLimb) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    head = skeleton.index_of("Head")
    place = motion.positions(skeleton)[50, arm.end] + (0.0, 0.2, 0.1)
    constraints = [
        Constraint(PositionTarget(arm.end, place), 50, 60, arm.joints, arm),
        Constraint(OrientationTarget(arm.end, (1.0, 0.0, 0.0, 0.0)), 58, 70, arm.joints, arm),
        Constraint(LookAtTarget(head, (0.0, 1.0, 5.0), (0, 0, 1)), 55, 80, chain_of(skeleton, head, 1)),
    ]
    made = constrain_motion(skeleton, motion, constraints, blend_frames=BLEND)
    assert made.residuals_after[0].max() < 1.01e-4
    assert made.residuals_after[1].max() < 1.01e-3
    assert made.residuals_after[2].max() < 1.01e-3
    assert _jolt(skeleton, made.motion) < 1.5 * _jolt(skeleton, motion)


def test_constraints_of_different_limbs_do_not_disturb_each_other(walk: Clip, arm: TwoBoneLimb) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    mapping = map_joints(skeleton)
    other = limb_ending_at(skeleton, mapping, mapping.indices(skeleton, ("right_wrist",))[0])
    assert other is not None
    places = motion.positions(skeleton)
    both = [
        Constraint(PositionTarget(one.end, places[40, one.end] + (0.0, 0.1, 0.1)), start, start + 10, one.joints, one)
        for one, start in ((arm, 40), (other, 45))
    ]
    together = constrain_motion(skeleton, motion, both, blend_frames=BLEND).motion
    apart = motion
    for one in both:
        apart = constrain_motion(skeleton, apart, [one], blend_frames=BLEND).motion
    assert together.rotations.tobytes() == apart.rotations.tobytes()


def test_an_orientation_over_a_range_is_met_about_all_axes(walk: Clip) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    head = skeleton.index_of("Head")
    wanted = quaternions.from_rotation_vector((0.2, 0.4, 0.9))
    turned = Constraint(OrientationTarget(head, wanted), 30, 40, chain_of(skeleton, head, skeleton.index_of("Neck")))
    made = constrain_motion(skeleton, motion, [turned], blend_frames=BLEND)
    spins = kinematics.as_global_rotations(skeleton, made.motion.rotations)[30:40, head]
    assert quaternions.angle_between(spins, wanted).max() < 1.01e-3


def test_limits_hold_in_the_constrained_frames(walk: Clip, arm: TwoBoneLimb) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    axes = guess_axes(skeleton, map_joints(skeleton))[skeleton.joint_names[arm.middle]]
    hinge = JointLimit.hinge(JointAxes(axes.twist, axes.swing), -1.0, 0.0, skeleton.rest_rotations[arm.middle])
    near = motion.positions(skeleton)[60, arm.start] + (0.1, 0.0, 0.1)  # asks for an elbow bent by more
    held = Constraint(PositionTarget(arm.end, near), 60, 70, arm.joints, arm)
    made = constrain_motion(skeleton, motion, [held], blend_frames=5, freedom=Freedom(limits={arm.middle: hinge}))
    turns = quaternions.multiply(
        quaternions.conjugate(skeleton.rest_rotations[arm.middle]), made.motion.rotations[60:70, arm.middle]
    )
    angles = quaternions.as_rotation_vector(turns) @ np.array(axes.swing)
    assert np.all(angles >= -1.0 - 1e-9)
    assert np.all(angles <= 1e-9)
    assert made.residuals_after[0].min() > 0.01


def test_the_same_constraints_give_the_same_bytes(walk: Clip, arm: TwoBoneLimb) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    held = [Constraint(PositionTarget(arm.end, (0.3, 1.2, 1.0)), 50, 60, chain_of(skeleton, arm.end, 1))]
    first, second = (constrain_motion(skeleton, motion, held, blend_frames=BLEND).motion for _ in range(2))
    assert first.rotations.tobytes() == second.rotations.tobytes()


def test_ranges_that_are_not_there_are_refused_by_number(walk: Clip, arm: TwoBoneLimb) -> None:
    motion = Motion.of(walk)
    good = Constraint(PositionTarget(arm.end, (0, 0, 0)), 0, 1, arm.joints, arm)
    for start, stop in ((110, 130), (5, 5), (-1, 3)):
        bad = Constraint(PositionTarget(arm.end, (0, 0, 0)), start, stop, arm.joints, arm)
        with pytest.raises(EditError, match=r"constraints\[1\]"):
            constrain_motion(walk.skeleton, motion, [good, bad], blend_frames=3)
    bad = Constraint(PositionTarget(arm.end, np.zeros((3, 3))), 0, 2, arm.joints, arm)
    with pytest.raises(EditError, match="3 values for 2 frames"):
        constrain_motion(walk.skeleton, motion, [bad], blend_frames=3)


def test_a_finish_meets_what_a_model_left_and_flags_what_it_could_not_reach(walk: Clip, arm: TwoBoneLimb) -> None:
    motion, skeleton = Motion.of(walk), walk.skeleton
    places = motion.positions(skeleton)
    near = Constraint(PositionTarget(arm.end, places[40, arm.end] + (0.0, 0.01, 0.0)), 40, 41, arm.joints, arm)
    far = Constraint(PositionTarget(arm.end, places[90, arm.end] + (0.0, 0.08, 0.0)), 90, 91, arm.joints, arm)
    done = finish(skeleton, motion, [near, far], window_frames=10)
    np.testing.assert_allclose(done.residual_before, (0.01, 0.08), atol=1e-9)
    assert done.residual_after.max() < 1e-9
    assert done.far.tolist() == [False, True]
    untouched = np.r_[0:30, 51:80, 101 : walk.frame_count]
    assert done.motion.rotations[untouched].tobytes() == motion.rotations[untouched].tobytes()


def test_joints_with_translations_keep_them(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    motion = Motion.of(tumbling(body, 30, translated=(8, 15)))
    wrist = body.index_of("LeftHand")
    place = motion.positions(body)[10, wrist] + 0.02
    held = [Constraint(PositionTarget(wrist, place), 10, 12, chain_of(body, wrist, 9))]
    made = constrain_motion(body, motion, held, blend_frames=4)
    assert made.motion.translations.tobytes() == motion.translations.tobytes()
    assert made.residuals_after[0].max() < 1.01e-4
