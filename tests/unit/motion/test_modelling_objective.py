"""Constraints and the objective of a search (Herrmann et al. 2019, Equation 1), compared with plain computations."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.present import present
from tests.support.search_primitives import FRAMES, sliding, standard_joints, walking

from marey_motion import quaternions
from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import as_global_rotations, forward_directions, forward_kinematics, headings
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.constraints import InvalidConstraint
from marey_motion.modelling.search.objective import MOST_SOUGHT, build_objective
from marey_motion.modelling.search.steps import SeveralSteps, Step
from marey_schemas.search_constraints import (
    JointOrientationConstraint,
    JointPositionConstraint,
    KeyframeTimeConstraint,
    LookDirectionConstraint,
    RootHeadingConstraint,
    RootPositionConstraint,
)

PLACEMENT = Placement(0.7, 0.4, -0.3)
EVERY_KIND = (
    JointPositionConstraint(joint="left_wrist", at="middle", target_m=(0.2, None, 0.3), tolerance_m=0.02, weight=2.0),
    JointPositionConstraint(joint="head", at=4.25, target_m=(None, 1.5, None)),
    JointOrientationConstraint(joint="head", at=3.5, rotation=(1.0, 0.1, 0.2, 0.3)),
    LookDirectionConstraint(joint="head", at="end", direction=(0.1, -0.3, 1.0)),
    LookDirectionConstraint(joint="right_elbow", at=7.75, point_m=(0.0, 1.0, 3.0), axis=(1.0, 0.5, 0.0)),
    RootPositionConstraint(at="end", target_m=(0.1, 1.0)),
    RootPositionConstraint(at="start", target_m=(None, 0.2), tolerance_m=0.05),
    RootHeadingConstraint(at="end", heading_deg=166.0),
    KeyframeTimeConstraint(at=10.5, seconds=0.4),
    KeyframeTimeConstraint(at="end", seconds=1.1, tolerance_s=0.01, weight=3.0),
)


def world(primitive: MotionPrimitive, latents: Floats, frame: float) -> tuple[AnyFloats, AnyFloats]:
    """Return positions (n, J, 3) and rotations (n, J, 4) in the world, at a canonical frame."""
    poses = primitive.poses(latents, [frame])[:, 0]
    turn = quaternions.from_axis_angle((0.0, 1.0, 0.0), PLACEMENT.heading_rad)
    positions = quaternions.rotate_vectors(turn, forward_kinematics(primitive.skeleton, poses))
    rotations = as_global_rotations(primitive.skeleton, poses[:, 3:].reshape(len(poses), -1, 4))
    origin = np.array((PLACEMENT.x, 0.0, PLACEMENT.z))
    return positions + origin, quaternions.multiply(turn, rotations)


def angle_between(a: AnyFloats, b: AnyFloats) -> AnyFloats:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def frame_of(primitive: MotionPrimitive, at: float | str) -> float:
    moments = {"start": 0, "end": FRAMES - 1, **primitive.keyframes}
    return float(moments[at] if isinstance(at, str) else at)


def plain_error(primitive: MotionPrimitive, joints: dict[str, int], latents: Floats, constraint: Any) -> AnyFloats:
    """Return the error of one constraint, computed from whole poses."""
    frame = frame_of(primitive, constraint.at)
    positions, rotations = world(primitive, latents, frame)
    match constraint:
        case JointPositionConstraint():
            target = np.array([np.nan if value is None else value for value in constraint.target_m])
            return np.sqrt(np.nansum((positions[:, joints[constraint.joint]] - target) ** 2, axis=1))
        case RootPositionConstraint():
            target = np.array([np.nan if value is None else value for value in constraint.target_m])
            return np.sqrt(np.nansum((positions[:, joints["pelvis"]][:, [0, 2]] - target) ** 2, axis=1))
        case JointOrientationConstraint():
            wanted = quaternions.normalise(constraint.rotation)
            missing = quaternions.multiply(quaternions.conjugate(wanted), rotations[:, joints[constraint.joint]])
            return 2 * np.arccos(np.clip(np.abs(missing[:, 0]), 0, 1))
        case LookDirectionConstraint():
            axis = np.asarray(constraint.axis) / np.linalg.norm(constraint.axis)
            pointing = quaternions.rotate_vectors(rotations[:, joints[constraint.joint]], axis)
            direction: Any = constraint.direction
            if constraint.direction is None:
                direction = np.asarray(constraint.point_m) - positions[:, joints[constraint.joint]]
            return angle_between(pointing, np.broadcast_to(direction, pointing.shape))
        case RootHeadingConstraint():
            lefts, rights = ([joints[f"{side}_{part}"] for part in ("hip", "shoulder")] for side in ("left", "right"))
            found = [headings(forward_directions(one[None], lefts, rights))[0] for one in positions]
            return np.abs((np.array(found) - np.radians(constraint.heading_deg) + np.pi) % (2 * np.pi) - np.pi)
        case KeyframeTimeConstraint():
            passed = primitive.time_functions(latents)
            reached = [np.interp(frame, np.arange(FRAMES), one) for one in passed]
            return np.abs(np.array(reached) / primitive.frame_rate_hz - constraint.seconds)
    raise AssertionError(constraint)


def test_errors_are_those_of_the_whole_motions() -> None:
    primitive, _ = walking()
    latents = primitive.sample(50, 1)
    objective = build_objective(primitive, EVERY_KIND, standard_joints(), placement=PLACEMENT)
    found = objective.errors(latents)
    for column, constraint in zip(found.T, EVERY_KIND, strict=True):
        np.testing.assert_allclose(
            column, plain_error(primitive, standard_joints(), latents, constraint), atol=1e-9, err_msg=str(constraint)
        )


def kept_within(count: int) -> tuple[MotionPrimitive, Floats]:
    """Return a model that limits durations to 0.9 to 1.1 s, and latent vectors. Many of these exceed the limits."""
    free, _ = walking()
    latents = free.sample(count, 1)
    lasting = free.durations_s(latents)
    assert (lasting < 0.9).sum() > 3
    assert (lasting > 1.1).sum() > 3
    assert ((lasting > 0.9) & (lasting < 1.1)).sum() > 3
    return replace(free, duration_range_s=(0.9, 1.1)), latents


def test_times_are_those_of_motions_that_are_kept_within_their_range() -> None:
    primitive, latents = kept_within(50)
    wanted = (
        KeyframeTimeConstraint(at=10.5, seconds=0.4),
        KeyframeTimeConstraint(at="end", seconds=1.09),
        KeyframeTimeConstraint(at="end", seconds=0.91),
    )
    objective = build_objective(primitive, wanted, standard_joints())
    for column, constraint in zip(objective.errors(latents).T, wanted, strict=True):
        np.testing.assert_allclose(
            column, plain_error(primitive, standard_joints(), latents, constraint), atol=1e-9, err_msg=str(constraint)
        )
    for seconds in (0.85, 1.15):
        with pytest.raises(InvalidConstraint, match=r"0\.90 to 1\.10 s"):
            build_objective(primitive, [KeyframeTimeConstraint(at="end", seconds=seconds)], standard_joints())


def cut_off(count: int) -> tuple[MotionPrimitive, Floats]:
    """Return a model and latent vectors.

    The model limits time steps to the middle half of the vectors' time steps.
    """
    free, _ = walking()
    latents = free.sample(count, 1)
    drawn = np.log(np.diff(free.time_functions(latents), axis=1))
    limits = np.quantile(drawn, (0.25, 0.75))
    beyond = (drawn < limits[0]) | (drawn > limits[1])
    assert (beyond.any(axis=1) & ~beyond.all(axis=1)).sum() > 3
    return replace(free, log_slope_range=tuple(limits.tolist())), latents


@pytest.mark.parametrize("lasting_s", [None, (0.95, 1.05)])
def test_times_and_their_derivatives_are_those_of_motions_whose_steps_are_cut_off(
    lasting_s: tuple[float, float] | None,
) -> None:
    primitive, latents = cut_off(30)
    primitive = replace(primitive, duration_range_s=lasting_s)
    wanted = (KeyframeTimeConstraint(at=10.5, seconds=0.4), KeyframeTimeConstraint(at="end", seconds=1.0))
    objective = build_objective(primitive, wanted, standard_joints())
    for column, constraint in zip(objective.errors(latents).T, wanted, strict=True):
        np.testing.assert_allclose(
            column, plain_error(primitive, standard_joints(), latents, constraint), atol=1e-9, err_msg=str(constraint)
        )
    problem = SeveralSteps.of([Step(primitive, wanted, standard_joints())], PLACEMENT)
    for latent in latents:
        assert_derivatives(problem, latent)


def test_the_objective_is_the_sum_of_weighted_errors_in_their_tolerances() -> None:
    primitive, _ = walking()
    latents = primitive.sample(20, 2)
    objective = build_objective(primitive, EVERY_KIND, standard_joints(), placement=PLACEMENT)
    errors = objective.errors(latents)
    tolerances = [0.02, 0.01, np.radians(5), np.radians(5), np.radians(5), 0.01, 0.05, np.radians(5), 0.05, 0.01]
    weights = [2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 3.0]
    np.testing.assert_allclose(objective.costs(latents), errors @ (np.array(weights) / tolerances), rtol=1e-12)


def test_what_comes_out_for_one_does_not_depend_on_the_others() -> None:
    primitive, _ = walking()
    latents = primitive.sample(40, 3)
    objective = build_objective(primitive, EVERY_KIND, standard_joints())
    together = objective.costs(latents)
    assert np.array_equal(together, np.concatenate([objective.costs(one[None]) for one in latents]))


def test_a_quarter_turn_about_any_axis_is_an_error_of_a_quarter_turn() -> None:
    primitive, _ = walking()
    latents = primitive.sample(1, 4)
    poses = primitive.poses(latents, [0.0])[:, 0]
    head = as_global_rotations(primitive.skeleton, poses[:, 3:].reshape(1, -1, 4))[0, standard_joints()["head"]]
    for axis in np.eye(3):
        target = quaternions.multiply(head, quaternions.from_axis_angle(axis, np.pi / 2))
        objective = build_objective(
            primitive, [JointOrientationConstraint(joint="head", at=0, rotation=tuple(target))], standard_joints()
        )
        np.testing.assert_allclose(objective.errors(latents), np.pi / 2, atol=1e-12)


def test_a_heading_is_missed_by_the_shorter_way_round() -> None:
    primitive, _ = walking()
    latents = primitive.sample(5, 5)
    for turns in (-3, 0, 2):
        wanted = [RootHeadingConstraint(at="start", heading_deg=6.0 + 360.0 * turns)]
        assert build_objective(primitive, wanted, standard_joints()).errors(latents).max() < 0.5


def test_looking_the_opposite_way_is_half_a_turn_off() -> None:
    primitive = sliding()
    latents = primitive.sample(1, 0)
    for direction, angle in (((0, 0, 1), 0.0), ((0, 0, -1), np.pi), ((0, 2, 0), np.pi / 2)):
        objective = build_objective(primitive, [LookDirectionConstraint(joint="root", at=0, direction=direction)], {})
        np.testing.assert_allclose(objective.errors(latents), angle, atol=1e-12)


@pytest.mark.parametrize("constraint", EVERY_KIND, ids=lambda one: f"{type(one).__name__} {one.at}")
def test_derivatives_are_those_of_finite_differences(constraint: Any) -> None:
    primitive, _ = walking()
    problem = SeveralSteps.of([Step(primitive, (constraint,), standard_joints())], PLACEMENT)
    for latent in primitive.sample(5, 6):
        assert_derivatives(problem, latent)


def test_derivatives_of_times_are_those_of_finite_differences_where_the_whole_lasts_as_long_as_it_may() -> None:
    primitive, latents = kept_within(50)
    problem = SeveralSteps.of(
        [Step(primitive, (KeyframeTimeConstraint(at=10.5, seconds=0.4),), standard_joints())], PLACEMENT
    )
    for latent in latents:
        assert_derivatives(problem, latent)


def test_derivatives_of_steps_that_hang_together_are_those_of_finite_differences() -> None:
    primitive, _ = walking()
    steps = [Step(primitive, EVERY_KIND[:7], standard_joints()), Step(primitive, EVERY_KIND, standard_joints())] * 2
    problem = SeveralSteps.of(steps, PLACEMENT)
    assert_derivatives(problem, primitive.sample(len(steps), 7).ravel())


def assert_derivatives(problem: SeveralSteps, stacked: Floats) -> None:
    _, slopes = problem.linearise(stacked)
    step = 1e-5
    for column, direction in enumerate(np.eye(len(stacked))):
        ahead, behind = (problem.linearise(stacked + sign * step * direction)[0] for sign in (1, -1))
        measured = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(slopes[:, column], measured, atol=1e-6 * max(1.0, np.abs(slopes).max()))


@pytest.mark.parametrize(
    ("make", "where"),
    [
        (lambda: JointPositionConstraint(joint="head", at=0, target_m=(None, None, None)), "target_m"),
        (lambda: JointPositionConstraint(joint="head", at=0, target_m=(np.nan, 0.0, 0.0)), "target_m"),
        (lambda: JointPositionConstraint(joint="head", at=0, target_m=(0.0, 0.0, 0.0), tolerance_m=0.0), "tolerance_m"),
        (lambda: JointOrientationConstraint(joint="head", at=0, rotation=(0.0, 0.0, 0.0, 0.0)), "rotation"),
        (lambda: LookDirectionConstraint(joint="head", at=0), "direction"),
        (lambda: LookDirectionConstraint(joint="head", at=0, direction=(0, 0, 1), point_m=(0, 0, 1)), "direction"),
        (lambda: LookDirectionConstraint(joint="head", at=0, direction=(0, 0, 1), axis=(0, 0, 0)), "axis"),
        (lambda: RootPositionConstraint(at=0, target_m=(None, None)), "target_m"),
        (lambda: RootHeadingConstraint(at=0, heading_deg=np.inf), "heading_deg"),
        (lambda: KeyframeTimeConstraint(at=0, seconds=-1.0), "seconds"),
        (lambda: KeyframeTimeConstraint(at=0, seconds=1.0, weight=-1.0), "weight"),
    ],
)
def test_a_constraint_that_makes_no_sense_is_refused_by_its_field(make: Callable[..., Any], where: str) -> None:
    with pytest.raises(ValidationError, match=where):
        make()


@pytest.mark.parametrize(
    ("constraint", "message"),
    [
        (JointPositionConstraint(joint="tail", at=0, target_m=(0.0, 0.0, 0.0)), "no joint is called 'tail'"),
        (
            JointPositionConstraint(joint="head", at="contact", target_m=(0.0, 0.0, 0.0)),
            "no keyframe 'contact'; it has start, end, middle",
        ),
        (JointPositionConstraint(joint="head", at=-1.0, target_m=(0.0, 0.0, 0.0)), "the canonical frames are 0 to 30"),
        (RootPositionConstraint(at=FRAMES, target_m=(0.0, 0.0)), "the canonical frames are 0 to 30"),
    ],
)
def test_what_the_model_has_not_is_refused_by_the_place_of_the_constraint(constraint: Any, message: str) -> None:
    primitive, _ = walking()
    with pytest.raises(MotionError, match=message) as caught:
        build_objective(primitive, [RootPositionConstraint(at=0, target_m=(0.0, 0.0)), constraint], standard_joints())
    assert present(caught.value.where).startswith("constraints[1]")


def test_a_heading_needs_hips_and_shoulders() -> None:
    with pytest.raises(MotionError, match="left_hip"):
        build_objective(sliding(), [RootHeadingConstraint(at=0, heading_deg=0.0)], {})


def test_too_many_constraints_are_refused() -> None:
    with pytest.raises(InvalidConstraint, match="at most"):
        build_objective(sliding(), [RootPositionConstraint(at=0, target_m=(0.0, 0.0))] * (MOST_SOUGHT + 1), {})


def test_a_joint_may_be_named_as_the_skeleton_names_it() -> None:
    primitive, _ = walking()
    name = primitive.skeleton.joint_names[standard_joints()["left_wrist"]]
    latents = primitive.sample(3, 8)
    own, standard = (
        build_objective(
            primitive, [JointPositionConstraint(joint=one, at=0, target_m=(0.0, 0.0, 0.0))], standard_joints()
        ).errors(latents)
        for one in (name, "left_wrist")
    )
    assert np.array_equal(own, standard)
