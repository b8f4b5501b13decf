"""Inverse kinematics, compared with closed forms, finite differences and an independent optimiser."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import pytest
from scipy.optimize import least_squares  # pyrefly: ignore[implicit-reexport]  # scipy collects its names when it runs
from tests.support.constraint_derivatives import constraint_jacobian

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb, limb_ending_at
from marey_motion.editing.inverse_kinematics.solving import (
    SolvedPoses,
    measure_residuals,
    solve,
    solve_ccd,
    solve_least_squares,
    solve_two_bone,
)
from marey_motion.editing.inverse_kinematics.targets import (
    ANGLE_LENGTH_M,
    Freedom,
    JointLimit,
    LookAtTarget,
    OrientationTarget,
    PositionTarget,
    SolverOptions,
    Target,
    chain_of,
)
from marey_motion.errors import EditError, MotionError
from marey_motion.formats import read_motion
from marey_motion.gait import game_skeleton, generate_gait, studio_skeleton
from marey_motion.motion import Motion
from marey_motion.rigs import JointAxes, guess_axes, map_joints
from marey_motion.skeleton import Skeleton

EXACT = SolverOptions(tolerance_m=0.0, tolerance_rad=0.0, most_iterations=400)
ITERATIVE = (solve_ccd, solve_least_squares)


@pytest.fixture(params=["studio", "game", "tumbled"])
def skeleton(request: pytest.FixtureRequest, body: Skeleton) -> Skeleton:
    """Three skeletons; the joints of the last one have random local axes."""
    if request.param == "studio":
        return studio_skeleton()
    return game_skeleton() if request.param == "game" else _with_odd_axes(body)


Solver = Literal["ccd", "least_squares", "two_bone"]


def limb_of(body: Skeleton, start: str, middle: str, end: str) -> TwoBoneLimb:
    return TwoBoneLimb(body.index_of(start), body.index_of(middle), body.index_of(end))


def _with_odd_axes(body: Skeleton) -> Skeleton:
    """Return the same rest pose with local axes that are rotated at random."""
    frames = quaternions.normalise(np.random.default_rng(3).normal(size=(body.joint_count, 4)))
    above = np.concatenate((quaternions.identity(1), frames[body.parents[1:]]))
    return replace(
        body,
        offsets=np.asarray(quaternions.rotate_vectors(quaternions.conjugate(above), body.offsets), np.float64),
        rest_rotations=np.asarray(quaternions.multiply(quaternions.conjugate(above), frames), np.float64),
        end_sites=(),
    )


def _moved(skeleton: Skeleton, frames: int = 12, seed: int = 1, size_rad: float = 0.3) -> Motion:
    """Return the rest pose with every joint rotated a little."""
    random = np.random.default_rng(seed)
    turns = quaternions.from_rotation_vector(random.normal(0.0, size_rad, (frames, skeleton.joint_count, 3)))
    rotations = np.asarray(quaternions.multiply(skeleton.rest_rotations, turns), dtype=np.float64)
    roots = skeleton.offsets[0] + random.normal(0.0, 0.1, (frames, 3))
    return Motion(roots, rotations, np.zeros((frames, 0, 3)), ())


def _joint(skeleton: Skeleton, standard: str) -> int:
    return map_joints(skeleton).indices(skeleton, (standard,))[0]


def _cost(targets: Sequence[Target], residuals: np.ndarray) -> np.ndarray:
    scales = [t.weight * (1.0 if isinstance(t, PositionTarget) else ANGLE_LENGTH_M**2) for t in targets]
    return (residuals**2) @ np.array(scales)


def _spins(skeleton: Skeleton, motion: Motion, joint: int) -> np.ndarray:
    return kinematics.as_global_rotations(skeleton, motion.rotations)[:, joint]


def _targets_everywhere(skeleton: Skeleton, motion: Motion) -> list[Target]:
    """Return targets of every kind near the present poses. Some have offsets, or concern only some axes."""
    random = np.random.default_rng(5)
    places = motion.positions(skeleton)
    wrist, ankle, head = (_joint(skeleton, name) for name in ("left_wrist", "right_ankle", "head"))
    turn = quaternions.from_rotation_vector(random.normal(0.0, 0.4, (motion.frame_count, 3)))
    return [
        PositionTarget(wrist, places[:, wrist] + random.normal(0, 0.1, (motion.frame_count, 3)), offset=(0.1, 0.02, 0)),
        PositionTarget(ankle, places[:, ankle] + 0.05, axes="xz", weight=2.0),
        OrientationTarget(wrist, quaternions.multiply(turn, _spins(skeleton, motion, wrist)), weight=0.5),
        LookAtTarget(head, (0.4, 1.2, 2.0), axis=(0.1, 0.2, 1.0), offset=(0.0, 0.05, 0.08)),
    ]


def test_derivatives_of_all_kinds_of_targets_are_those_of_finite_differences(skeleton: Skeleton) -> None:
    motion = _moved(skeleton, frames=1)
    targets = _targets_everywhere(skeleton, motion)
    freedom = Freedom(root_moves=True)
    _, jacobian, joints = constraint_jacobian(skeleton, motion, targets, freedom)
    step = 1e-6

    def errors(column: int, size: float) -> np.ndarray:
        rotations, roots = motion.rotations.copy(), motion.root_translations.copy()
        joint, axis = divmod(column, 3)
        if joint < len(joints):
            turn = quaternions.from_rotation_vector(size * np.eye(3)[axis])
            rotations[0, joints[joint]] = quaternions.multiply(rotations[0, joints[joint]], turn)
        else:
            roots[0, axis] += size
        moved = motion._replace(rotations=rotations, root_translations=roots)
        return constraint_jacobian(skeleton, moved, targets, freedom)[0]

    differences = [(errors(c, step) - errors(c, -step)) / (2 * step) for c in range(jacobian.shape[1])]
    np.testing.assert_allclose(jacobian, np.transpose(differences), atol=1e-6)
    assert np.abs(jacobian).max() > 0.1


@pytest.mark.parametrize("angle", [1e-7, 0.3, 3.0, np.pi - 1e-4])
def test_derivatives_hold_for_small_and_for_nearly_half_turns(body: Skeleton, angle: float) -> None:
    motion = _moved(body, frames=1)
    head = body.index_of("Head")
    turned = quaternions.multiply(quaternions.from_axis_angle((0.6, 0.8, 0.0), angle), _spins(body, motion, head)[0])
    targets = [OrientationTarget(head, turned)]
    errors, jacobian, joints = constraint_jacobian(body, motion, targets)
    assert np.linalg.norm(errors) == pytest.approx(angle * ANGLE_LENGTH_M, rel=1e-6)
    step = 1e-6
    for column in range(3 * len(joints)):
        sides = []
        for sign in (1.0, -1.0):
            rotations = motion.rotations.copy()
            turn = quaternions.from_rotation_vector(sign * step * np.eye(3)[column % 3])
            rotations[0, joints[column // 3]] = quaternions.multiply(rotations[0, joints[column // 3]], turn)
            sides.append(constraint_jacobian(body, motion._replace(rotations=rotations), targets)[0])
        np.testing.assert_allclose(jacobian[:, column], (sides[0] - sides[1]) / (2 * step), atol=2e-6)


def test_least_squares_finds_what_an_independent_optimiser_finds(skeleton: Skeleton) -> None:
    motion = _moved(skeleton, frames=1)
    wrist = _joint(skeleton, "left_wrist")
    place = motion.positions(skeleton)[0, wrist]
    targets: list[Target] = [
        PositionTarget(wrist, place + np.array([0.1, 0.15, 0.05])),
        LookAtTarget(_joint(skeleton, "head"), (1.0, 1.0, 1.5), axis=(0.0, 0.0, 1.0)),
    ]
    joints = chain_of(skeleton, wrist, _joint(skeleton, "left_shoulder"))
    joints += chain_of(skeleton, _joint(skeleton, "head"), _joint(skeleton, "neck"))
    freedom, options = Freedom(joints), SolverOptions(0.0, 0.0, 400, regularisation_m=0.05)

    def errors(displacement: np.ndarray) -> np.ndarray:
        rotations = motion.rotations.copy()
        order = np.array(sorted(joints))
        turns = quaternions.from_rotation_vector(displacement.reshape(-1, 3))
        rotations[0, order] = quaternions.multiply(rotations[0, order], turns)
        missed = constraint_jacobian(skeleton, motion._replace(rotations=rotations), targets, freedom)[0]
        return np.concatenate((missed, 0.05 * displacement))

    theirs = least_squares(errors, np.zeros(3 * len(joints)), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    ours = solve_least_squares(skeleton, motion, targets, freedom=freedom, options=options)
    moved = quaternions.multiply(quaternions.conjugate(motion.rotations), ours.motion.rotations)
    own = quaternions.as_rotation_vector(moved)[0, sorted(joints)].ravel()
    assert np.sum(errors(own) ** 2) == pytest.approx(2 * theirs.cost, rel=1e-6)
    np.testing.assert_allclose(own, theirs.x, atol=1e-4)


@pytest.mark.parametrize("solver", ITERATIVE)
def test_a_wrist_comes_as_near_to_a_target_as_an_independent_optimiser_brings_it(
    body: Skeleton, solver: Callable[..., SolvedPoses]
) -> None:
    motion = _moved(body, frames=1)
    wrist = body.index_of("LeftHand")
    joints = chain_of(body, wrist, body.index_of("LeftArm"))
    shoulder = motion.positions(body)[0, body.index_of("LeftArm")]
    for target in (shoulder + np.array([0.2, 0.3, 0.1]), shoulder + np.array([0.5, 0.6, 0.1])):
        targets = [PositionTarget(wrist, target)]

        def errors(displacement: np.ndarray, targets: list[PositionTarget] = targets) -> np.ndarray:
            rotations = motion.rotations.copy()
            order = sorted(joints)
            turns = quaternions.from_rotation_vector(displacement.reshape(-1, 3))
            rotations[0, order] = quaternions.multiply(rotations[0, order], turns)
            return constraint_jacobian(body, motion._replace(rotations=rotations), targets)[0]

        theirs = np.sqrt(2 * least_squares(errors, np.zeros(3 * len(joints))).cost)
        options = SolverOptions(most_iterations=500)
        ours = solver(body, motion, targets, freedom=Freedom(joints), options=options)
        assert ours.residual_after[0, 0] <= theirs + 2e-3
        assert ours.reached[0] == (theirs < 1e-4)


@pytest.mark.parametrize("solver", ITERATIVE)
def test_no_solver_leaves_targets_worse_than_they_were(skeleton: Skeleton, solver: Callable[..., SolvedPoses]) -> None:
    motion = _moved(skeleton, frames=25, seed=9, size_rad=0.6)
    targets = _targets_everywhere(skeleton, motion)
    solved = solver(skeleton, motion, targets)
    before, after = _cost(targets, solved.residual_before), _cost(targets, solved.residual_after)
    assert np.all(after <= before)
    assert np.median(after / before) < 0.02
    np.testing.assert_allclose(solved.residual_before, measure_residuals(skeleton, motion, targets), atol=1e-12)
    np.testing.assert_allclose(solved.residual_after, measure_residuals(skeleton, solved.motion, targets), atol=1e-12)


@pytest.mark.parametrize("solver", ITERATIVE)
def test_a_target_far_away_stretches_the_body_towards_it(body: Skeleton, solver: Callable[..., SolvedPoses]) -> None:
    motion = _moved(body, frames=3)
    wrist, shoulder = body.index_of("LeftHand"), body.index_of("LeftArm")
    target = np.array([50.0, 20.0, 10.0])
    solved = solver(body, motion, [PositionTarget(wrist, target)], freedom=Freedom(chain_of(body, wrist, shoulder)))
    places = solved.motion.positions(body)
    ways = (places[:, wrist] - places[:, shoulder], target - places[:, shoulder])
    directions = [way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways]
    assert np.all(np.sum(directions[0] * directions[1], axis=1) > 0.9995)
    assert np.all(np.linalg.norm(ways[0], axis=1) > 0.995 * 0.54)
    assert not solved.reached.any()


@pytest.mark.parametrize("solver", ITERATIVE)
def test_an_orientation_about_every_axis_counts(skeleton: Skeleton, solver: Callable[..., SolvedPoses]) -> None:
    motion = _moved(skeleton, frames=1)
    head = _joint(skeleton, "head")
    for axis in np.eye(3):
        for angle in (0.5 * np.pi, np.pi):
            about_own_axis = quaternions.from_axis_angle(axis, angle)
            wanted = quaternions.multiply(_spins(skeleton, motion, head)[0], about_own_axis)
            targets = [OrientationTarget(head, wanted)]
            assert measure_residuals(skeleton, motion, targets)[0, 0] == pytest.approx(angle)
            solved = solver(skeleton, motion, targets)
            assert solved.reached[0]
            assert quaternions.angle_between(_spins(skeleton, solved.motion, head)[0], wanted) < 1e-3


@pytest.mark.parametrize("solver", ITERATIVE)
@pytest.mark.parametrize("point", [(2.0, 1.0, 1.0), (0.3, 1.9, -3.0)])
def test_a_head_looks_at_a_point(
    skeleton: Skeleton, solver: Callable[..., SolvedPoses], point: tuple[float, float, float]
) -> None:
    motion = _moved(skeleton, frames=4)
    head, eye = _joint(skeleton, "head"), np.array([0.0, 0.06, 0.09])
    solved = solver(skeleton, motion, [LookAtTarget(head, point, axis=(1.0, 0.0, 2.0), offset=eye)])
    spins = _spins(skeleton, solved.motion, head)
    eyes = solved.motion.positions(skeleton)[:, head] + quaternions.rotate_vectors(spins, eye)
    gaze = quaternions.rotate_vectors(spins, np.array([1.0, 0.0, 2.0]) / np.sqrt(5.0))
    ways = point - eyes
    assert solved.reached.all()
    assert np.all(np.sum(gaze * ways, axis=1) / np.linalg.norm(ways, axis=1) > np.cos(1.01e-3))


def test_the_body_looks_straight_behind_itself(body: Skeleton) -> None:
    rest = Motion(body.offsets[:1].copy(), body.rest_rotations[None].copy(), np.zeros((1, 0, 3)), ())
    head = body.index_of("Head")
    behind = rest.positions(body)[0, head] - (0.0, 0.0, 3.0)
    for solver in ITERATIVE:
        assert solver(body, rest, [LookAtTarget(head, behind, axis=(0.0, 0.0, 1.0))]).reached[0]


def test_only_the_axes_that_count_are_met(body: Skeleton) -> None:
    motion = _moved(body, frames=5)
    wrist = body.index_of("RightHand")
    before = motion.positions(body)[:, wrist]
    for solver in ITERATIVE:
        solved = solver(body, motion, [PositionTarget(wrist, (9.0, 1.3, 9.0), axes="y")])
        after = solved.motion.positions(body)[:, wrist]
        assert np.abs(after[:, 1] - 1.3).max() <= 1e-4
        assert np.abs(after[:, (0, 2)] - before[:, (0, 2)]).max() < 0.35


def test_weights_decide_between_targets_that_contradict_each_other(body: Skeleton) -> None:
    motion = _moved(body, frames=1)
    wrist = body.index_of("LeftHand")
    place = motion.positions(body)[0, wrist]
    first, second = place + np.array([0.0, 0.1, 0.0]), place - np.array([0.0, 0.1, 0.0])
    for solver in ITERATIVE:
        targets = [PositionTarget(wrist, first, weight=3.0), PositionTarget(wrist, second)]
        solved = solver(body, motion, targets, options=SolverOptions(most_iterations=1000))
        np.testing.assert_allclose(solved.motion.positions(body)[0, wrist], 0.75 * first + 0.25 * second, atol=2e-3)


def test_the_root_moves_only_where_it_may(body: Skeleton) -> None:
    motion = _moved(body, frames=2)
    ankle = body.index_of("LeftFoot")
    target = [PositionTarget(ankle, (3.0, 0.1, 2.0))]
    held = solve_least_squares(body, motion, target)
    free = solve_least_squares(body, motion, target, freedom=Freedom(root_moves=True))
    assert np.array_equal(held.motion.root_translations, motion.root_translations)
    assert not held.reached.any()
    assert free.reached.all()
    with pytest.raises(EditError, match="cannot shift the root"):
        solve_ccd(body, motion, target, freedom=Freedom(root_moves=True))


def _swing_and_twist(limit: JointLimit, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turns = quaternions.multiply(quaternions.conjugate(limit.reference), rotations)
    twist, swing = quaternions.twist_swing(turns, limit.axis)
    vector = quaternions.as_rotation_vector(swing)
    across = np.stack(
        (vector @ np.array(limit.side), vector @ np.cross(np.array(limit.axis), np.array(limit.side))), axis=-1
    )
    return across, quaternions.as_rotation_vector(twist) @ np.array(limit.axis)


@pytest.mark.parametrize("solver", ITERATIVE)
def test_limits_are_never_left(body: Skeleton, solver: Callable[..., SolvedPoses]) -> None:
    axes = JointAxes(twist=(1.0, 0.0, 0.0), swing=(0.0, 1.0, 0.0))
    elbow, shoulder, spine = (body.index_of(name) for name in ("LeftForeArm", "LeftArm", "Spine1"))
    limits = {
        elbow: JointLimit.hinge(axes, -2.4, 0.1),
        shoulder: JointLimit.cone(axes, (0.9, 0.5), (-0.6, 0.4)),
        spine: JointLimit.cone(JointAxes((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)), 0.2, (-0.1, 0.1)),
    }
    motion = _moved(body, frames=60, size_rad=0.5)
    wrist = body.index_of("LeftHand")
    target = motion.positions(body)[:, wrist] + np.random.default_rng(2).normal(0.0, 0.3, (60, 3))
    freedom = Freedom(chain_of(body, wrist, body.index_of("Spine")), limits=limits)
    solved = solver(body, motion, [PositionTarget(wrist, target)], freedom=freedom)
    for joint, limit in limits.items():
        across, twist = _swing_and_twist(limit, solved.motion.rotations[:, joint])
        halves = np.array(limit.swing_rad)
        assert np.all(twist >= limit.twist_rad[0] - 1e-9)
        assert np.all(twist <= limit.twist_rad[1] + 1e-9)
        if halves.all():
            assert np.all(np.linalg.norm(across / halves, axis=1) <= 1.0 + 1e-9)
        else:
            assert np.abs(across).max() < 1e-9
    assert solved.residual_after.mean() < 0.1 * solved.residual_before.mean()


@pytest.mark.parametrize("solver", ITERATIVE)
def test_a_hinge_reaches_what_its_angle_allows(body: Skeleton, solver: Callable[..., SolvedPoses]) -> None:
    rest = Motion(body.offsets[:1].copy(), body.rest_rotations[None].copy(), np.zeros((1, 0, 3)), ())
    elbow, wrist = body.index_of("LeftForeArm"), body.index_of("LeftHand")
    limit = JointLimit.hinge(JointAxes((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), -2.0, 0.0)
    at_elbow = rest.positions(body)[0, elbow]
    freedom = Freedom((elbow,), limits={elbow: limit})
    for angle, allowed in ((-1.2, -1.2), (-2.6, -2.0), (0.7, 0.0)):
        target = at_elbow + 0.26 * np.array([np.cos(angle), 0.0, -np.sin(angle)])
        solved = solver(body, rest, [PositionTarget(wrist, target)], freedom=freedom)
        _, twist = _swing_and_twist(limit, solved.motion.rotations[:, elbow])
        assert twist[0] == pytest.approx(allowed, abs=1e-3)


def test_a_stiff_joint_turns_less(body: Skeleton) -> None:
    motion = _moved(body, frames=8)
    wrist, shoulder = body.index_of("LeftHand"), body.index_of("LeftArm")
    target = [PositionTarget(wrist, motion.positions(body)[:, wrist] + (0.0, 0.12, 0.1))]
    for solver in ITERATIVE:
        turned = []
        for stiffness in ({}, {shoulder: 0.95}):
            solved = solver(body, motion, target, freedom=Freedom(stiffness=stiffness))
            assert solved.reached.all()
            angle = quaternions.angle_between(motion.rotations[:, shoulder], solved.motion.rotations[:, shoulder])
            turned.append(angle)
        assert np.all(turned[1] < 0.5 * turned[0])


@pytest.mark.parametrize("standard", ["left_wrist", "right_wrist", "left_ankle", "right_ankle"])
def test_two_bones_meet_every_place_they_can_reach(skeleton: Skeleton, standard: str) -> None:
    motion = _moved(skeleton, frames=200)
    end = _joint(skeleton, standard)
    limb = limb_ending_at(skeleton, map_joints(skeleton), end, guess_axes(skeleton, map_joints(skeleton)))
    assert limb is not None
    places = motion.positions(skeleton)
    bones = ((limb.start, limb.middle), (limb.middle, end))
    lengths = [np.linalg.norm(places[:, a] - places[:, b], axis=1) for a, b in bones]
    first, second = (length[:, None] for length in lengths)
    random = np.random.default_rng(4)
    ways = random.normal(size=(200, 3))
    ways *= random.uniform(np.abs(first - second), first + second) / np.linalg.norm(ways, axis=1, keepdims=True)
    target = places[:, limb.start] + ways
    solved = solve_two_bone(skeleton, motion, limb, PositionTarget(end, target))
    assert np.abs(solved.motion.positions(skeleton)[:, end] - target).max() < 1e-9
    assert solved.reached.all()
    assert np.array_equal(solved.motion.rotations[:, end], motion.rotations[:, end])


def test_two_bones_stay_in_the_plane_of_the_limb(body: Skeleton) -> None:
    motion = _moved(body, frames=50)
    limb = limb_of(body, "LeftUpLeg", "LeftLeg", "LeftFoot")
    places = motion.positions(body)
    nearer = places[:, limb.start] + 0.8 * (places[:, limb.end] - places[:, limb.start])
    after = solve_two_bone(body, motion, limb, PositionTarget(limb.end, nearer)).motion.positions(body)

    def normals(points: np.ndarray) -> np.ndarray:
        across = np.cross(points[:, limb.middle] - points[:, limb.start], points[:, limb.end] - points[:, limb.middle])
        return across / np.linalg.norm(across, axis=1, keepdims=True)

    np.testing.assert_allclose(normals(after), normals(places), atol=1e-9)


@pytest.mark.parametrize("far", [0.9, 100.0])
def test_two_bones_stretch_towards_what_they_cannot_reach(body: Skeleton, far: float) -> None:
    motion = _moved(body, frames=20)
    limb = limb_of(body, "LeftArm", "LeftForeArm", "LeftHand")
    way = np.array([2.0, 1.0, -2.0]) / 3.0
    start = motion.positions(body)[:, limb.start]
    solved = solve_two_bone(body, motion, limb, PositionTarget(limb.end, start + far * way))
    np.testing.assert_allclose(solved.motion.positions(body)[:, limb.end], start + 0.54 * way, atol=1e-7)
    assert not solved.reached.any()


def test_a_limb_that_is_straight_or_folded_bends_about_its_hinge(body: Skeleton) -> None:
    rest = Motion(body.offsets[:1].copy(), body.rest_rotations[None].copy(), np.zeros((1, 0, 3)), ())
    knee_axes = guess_axes(body, map_joints(body))
    ankle = body.index_of("LeftFoot")
    limb = limb_ending_at(body, map_joints(body), ankle, knee_axes)
    assert limb is not None
    hip = rest.positions(body)[0, limb.start]
    solved = solve_two_bone(body, rest, limb, PositionTarget(ankle, hip - (0.0, 0.6, 0.0)))
    knee = solved.motion.positions(body)[0, limb.middle]
    assert solved.reached.all()
    assert knee[2] > hip[2] + 0.2  # forwards, as knees do
    assert abs(knee[0] - hip[0]) < 1e-9
    for target in (hip, hip + 1e-14):
        folded = solve_two_bone(body, rest, limb, PositionTarget(ankle, target))
        assert np.isfinite(folded.motion.rotations).all()


def _bending_leg(body: Skeleton, bends_rad: np.ndarray, aside_rad: float) -> tuple[Motion, TwoBoneLimb]:
    """Return a motion in which the knee of the hanging left leg bends forwards by `angles`, and the limb of this leg.

    The axis of the knee is turned to the side by `aside_rad`.
    """
    frames = len(bends_rad)
    rotations = np.repeat(body.rest_rotations[None], frames, axis=0)
    limb = limb_ending_at(body, map_joints(body), body.index_of("LeftFoot"), guess_axes(body, map_joints(body)))
    assert limb is not None
    assert limb.hinge is not None
    axis = quaternions.rotate_vectors(quaternions.from_axis_angle((0.0, 1.0, 0.0), aside_rad), -np.array(limb.hinge))
    rotations[:, limb.middle] = quaternions.from_rotation_vector(bends_rad[:, None] * axis)
    return Motion(np.repeat(body.offsets[:1], frames, axis=0), rotations, np.zeros((frames, 0, 3)), ()), limb


@pytest.mark.parametrize("aside_deg", [0.0, 25.0])
@pytest.mark.parametrize("distance", [0.95, 0.985])
def test_a_limb_bends_as_its_hinge_says_even_where_it_is_beyond_straight(
    body: Skeleton, distance: float, aside_deg: float
) -> None:
    motion, limb = _bending_leg(body, np.radians(np.arange(-12.0, 70.0, 0.25)), np.radians(aside_deg))
    hip = motion.positions(body)[:, limb.start]
    length = np.linalg.norm(body.offsets[limb.middle]) + np.linalg.norm(body.offsets[limb.end])
    target = hip - distance * length * np.array((0.0, 1.0, 0.0))
    solved = solve_two_bone(body, motion, limb, PositionTarget(limb.end, target))
    assert solved.reached.all()
    knees = solved.motion.positions(body)[:, limb.middle]
    assert (knees[:, 2] - hip[:, 2]).min() > 0.02  # forwards, as knees do
    # Neighbours differ by a quarter of a degree: what is made of them differs by little, too.
    steps = quaternions.angle_between(solved.motion.rotations[1:], solved.motion.rotations[:-1])
    assert np.degrees(steps.max()) < 2.0


@pytest.mark.parametrize("bend_deg", [0.5, 6.0, 14.9, 15.1, 22.0, 30.1, 80.0])
def test_a_limb_that_is_where_it_shall_be_stays_as_it_is(body: Skeleton, bend_deg: float) -> None:
    motion, limb = _bending_leg(body, np.radians([bend_deg]), np.radians(25.0))
    target = motion.positions(body)[:, limb.end]
    solved = solve_two_bone(body, motion, limb, PositionTarget(limb.end, target))
    assert quaternions.angle_between(solved.motion.rotations, motion.rotations).max() < 1e-6


def test_the_end_of_a_limb_keeps_or_gets_an_orientation(body: Skeleton) -> None:
    motion = _moved(body, frames=30)
    limb = limb_of(body, "LeftArm", "LeftForeArm", "LeftHand")
    places, spins = motion.positions(body), _spins(body, motion, limb.end)
    near = places[:, limb.start] + 0.7 * (places[:, limb.end] - places[:, limb.start])
    held = solve_two_bone(body, motion, limb, PositionTarget(limb.end, near), ending="held")
    assert quaternions.angle_between(_spins(body, held.motion, limb.end), spins).max() < 1e-9
    wanted = quaternions.multiply(quaternions.from_rotation_vector((0.3, -0.5, 0.9)), spins)
    tool = (0.08, 0.01, 0.0)
    given = solve_two_bone(
        body, motion, limb, PositionTarget(limb.end, near, offset=tool), orientation=OrientationTarget(limb.end, wanted)
    )
    assert given.reached.all()
    tips = given.motion.positions(body)[:, limb.end] + quaternions.rotate_vectors(wanted, tool)
    assert np.abs(tips - near).max() < 1e-9


def test_a_limb_that_is_left_as_it_was_says_whether_its_targets_are_reached(body: Skeleton) -> None:
    """An orientation that turns a tool away from its position increases the error; such frames keep their pose."""
    motion, random = _moved(body, frames=400, seed=3, size_rad=0.9), np.random.default_rng(0)
    limb, tool = limb_of(body, "LeftArm", "LeftForeArm", "LeftHand"), (0.0, 0.3, 0.0)
    spins = _spins(body, motion, limb.end)
    tips = motion.positions(body)[:, limb.end] + quaternions.rotate_vectors(spins, tool)
    position = PositionTarget(limb.end, tips + random.normal(0.0, 0.02, tips.shape), offset=tool)
    turns = quaternions.from_rotation_vector(random.normal(0.0, 0.3, (400, 3)))
    orientation = OrientationTarget(limb.end, quaternions.multiply(spins, turns))
    options = SolverOptions(tolerance_m=0.3, tolerance_rad=0.01)
    solved = solve_two_bone(body, motion, limb, position, orientation=orientation, options=options)
    assert (solved.iterations == 0).any()
    errors = measure_residuals(body, solved.motion, [position, orientation])
    np.testing.assert_array_equal(solved.reached, (errors <= (0.3, 0.01)).all(axis=1))


@pytest.mark.parametrize("solver", ["ccd", "least_squares"])
def test_an_orientation_turns_the_end_of_a_limb_alone_unless_a_limit_stops_it(
    body: Skeleton, solver: Literal["ccd", "least_squares"]
) -> None:
    motion = _moved(body, frames=3)
    limb = limb_of(body, "LeftArm", "LeftForeArm", "LeftHand")
    wanted = quaternions.multiply(quaternions.from_rotation_vector((0.3, -0.4, 0.5)), _spins(body, motion, limb.end))
    target = OrientationTarget(limb.end, wanted)
    free = solve(body, motion, [target], freedom=Freedom(limb.joints), limb=limb, solver=solver)
    assert free.reached.all()
    turned = quaternions.angle_between(free.motion.rotations, motion.rotations).max(axis=0) > 1e-6
    assert np.flatnonzero(turned).tolist() == [limb.end]
    limits = {limb.end: JointLimit.hinge(JointAxes((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), -0.1, 0.1)}
    for joints in (limb.joints, None):
        limited = solve(body, motion, [target], freedom=Freedom(joints, limits=limits), limb=limb, solver=solver)
        assert limited.reached.all()


@pytest.mark.parametrize("solver", ["auto", "ccd", "least_squares"])
@pytest.mark.parametrize("fixed", ["LeftHand", "LeftForeArm"])
def test_a_limb_turns_no_joint_that_may_not_turn(
    body: Skeleton, solver: Literal["auto", "ccd", "least_squares"], fixed: str
) -> None:
    motion = _moved(body, frames=3)
    limb = limb_of(body, "LeftArm", "LeftForeArm", "LeftHand")
    wanted = quaternions.multiply(quaternions.from_rotation_vector((0.3, -0.4, 0.5)), _spins(body, motion, limb.end))
    near = motion.positions(body)[:, limb.start] + (0.3, 0.1, 0.1)
    joints = tuple(joint for joint in limb.joints if joint != body.index_of(fixed))
    targets: tuple[Target, ...] = (OrientationTarget(limb.end, wanted), PositionTarget(limb.end, near))
    for target in targets:
        solved = solve(body, motion, [target], freedom=Freedom(joints), limb=limb, solver=solver)
        turned = quaternions.angle_between(solved.motion.rotations, motion.rotations).max(axis=0) > 1e-9
        assert set(np.flatnonzero(turned).tolist()) <= set(joints)


@pytest.mark.parametrize("solver", ["ccd", "least_squares"])
def test_a_limb_helps_its_end_only_in_frames_that_the_end_cannot_reach_alone(
    body: Skeleton, solver: Literal["ccd", "least_squares"]
) -> None:
    still = _moved(body, frames=1)
    frames, limb = 101, limb_of(body, "LeftArm", "LeftForeArm", "LeftHand")
    roots, rotations = (np.repeat(part, frames, axis=0) for part in (still.root_translations, still.rotations))
    motion = Motion(roots, rotations, np.zeros((frames, 0, 3)), ())
    turns = quaternions.from_rotation_vector(np.linspace(0.0, 1.2, frames)[:, None] * (0.6, 0.0, 0.8))
    target = OrientationTarget(limb.end, quaternions.multiply(turns, _spins(body, motion, limb.end)))
    axes = JointAxes((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    limits = {limb.end: JointLimit.cone(axes, 0.5, (-0.5, 0.5), reference=still.rotations[0, limb.end])}
    asked = Freedom(limb.joints, limits=limits)
    alone = solve(body, motion, [target], freedom=replace(asked, joints=(limb.end,)), solver=solver)
    solved = solve(body, motion, [target], freedom=asked, limb=limb, solver=solver)
    assert solved.reached.all()
    assert 20 < alone.reached.sum() < 80
    reached = alone.reached
    assert quaternions.angle_between(solved.motion.rotations, alone.motion.rotations)[reached].max() < 1e-6
    assert quaternions.angle_between(solved.motion.rotations[1:], solved.motion.rotations[:-1]).max() < 0.1
    assert np.array_equal(solved.residual_before, alone.residual_before)


def test_damping_keeps_a_stretching_limb_from_snapping_straight(body: Skeleton) -> None:
    frames = 101
    rest = Motion(
        np.repeat(body.offsets[:1], frames, axis=0),
        np.repeat(body.rest_rotations[None], frames, axis=0),
        np.zeros((frames, 0, 3)),
        (),
    )
    limb = limb_of(body, "LeftUpLeg", "LeftLeg", "LeftFoot")
    rest.rotations[:, limb.middle] = quaternions.from_axis_angle((1.0, 0.0, 0.0), 0.8)
    hip = rest.positions(body)[:, limb.start]
    target = hip - np.linspace(0.75, 0.86, frames)[:, None] * (0.0, 1.0, 0.0)

    def knee_angles(zone: float) -> np.ndarray:
        solved = solve_two_bone(body, rest, limb, PositionTarget(limb.end, target), damping_zone_rad=zone)
        return 2.0 * np.arccos(np.clip(np.abs(solved.motion.rotations[:, limb.middle, 0]), 0.0, 1.0))

    snapping, damped = knee_angles(0.0), knee_angles(0.6)
    assert np.abs(np.diff(damped)).max() < 0.5 * np.abs(np.diff(snapping)).max()
    assert snapping[-1] < 1e-6
    np.testing.assert_allclose(damped[:30], snapping[:30], atol=1e-12)


@pytest.mark.parametrize("solver", ["ccd", "least_squares", "two_bone"])
def test_frames_together_are_solved_as_each_alone(
    skeleton: Skeleton, solver: Literal["ccd", "least_squares", "two_bone"]
) -> None:
    motion = _moved(skeleton, frames=40)
    wrist = _joint(skeleton, "left_wrist")
    limb = limb_ending_at(skeleton, map_joints(skeleton), wrist)
    places = motion.positions(skeleton)[:, wrist] + np.random.default_rng(1).normal(0, 0.1, (40, 3))
    together = solve(skeleton, motion, [PositionTarget(wrist, places)], limb=limb, solver=solver)
    for frame in range(40):
        one = motion.at_frames(np.array([frame]))
        alone = solve(skeleton, one, [PositionTarget(wrist, places[frame])], limb=limb, solver=solver)
        assert alone.motion.rotations.tobytes() == together.motion.rotations[frame : frame + 1].tobytes()
        assert alone.residual_after.tobytes() == together.residual_after[frame : frame + 1].tobytes()


def test_joints_that_may_not_turn_keep_their_bits(skeleton: Skeleton) -> None:
    motion = _moved(skeleton, frames=6)
    wrist = _joint(skeleton, "left_wrist")
    chain = chain_of(skeleton, wrist, _joint(skeleton, "left_shoulder"))
    others = np.setdiff1d(np.arange(skeleton.joint_count), chain)
    kept = motion.rotations.copy()
    for solver in ITERATIVE:
        solved = solver(skeleton, motion, [PositionTarget(wrist, (0.3, 1.2, 0.4))], freedom=Freedom(chain))
        assert np.array_equal(solved.motion.rotations[:, others], motion.rotations[:, others])
        assert np.array_equal(solved.motion.root_translations, motion.root_translations)
        np.testing.assert_allclose(np.linalg.norm(solved.motion.rotations, axis=-1), 1.0, atol=1e-12)
    assert np.array_equal(motion.rotations, kept)


def test_joints_with_translations_of_their_own_are_reckoned_with(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    motion = Motion.of(tumbling(body, 10, translated=(14, 15)))
    wrist = body.index_of("LeftHand")
    target = motion.positions(body)[:, wrist] + (0.05, 0.1, 0.0)
    for solver in ITERATIVE:
        solved = solver(body, motion, [PositionTarget(wrist, target)])
        missed = np.linalg.norm(solved.motion.positions(body)[:, wrist] - target, axis=1)
        np.testing.assert_allclose(missed, solved.residual_after[:, 0], atol=1e-12)
        assert solved.reached.mean() >= 0.9


def test_the_solver_that_fits_is_chosen(body: Skeleton) -> None:
    motion = _moved(body, frames=1)
    limb = limb_of(body, "LeftArm", "LeftForeArm", "LeftHand")
    near = motion.positions(body)[0, limb.start] + (0.3, 0.1, 0.1)
    exact = solve(body, motion, [PositionTarget(limb.end, near)], limb=limb)
    assert exact.residual_after[0, 0] < 1e-12
    with pytest.raises(EditError, match="one position target in all axes"):
        solve(body, motion, [PositionTarget(limb.end, near, axes="xy")], limb=limb, solver="two_bone")
    far = motion.positions(body)[0, limb.start] + np.array([0.5, 0.25, 0.1])
    chain = Freedom(chain_of(body, limb.end, body.index_of("Spine")))
    assert not solve(body, motion, [PositionTarget(limb.end, far)], limb=limb).reached[0]
    assert solve(body, motion, [PositionTarget(limb.end, far)], limb=limb, freedom=chain).reached[0]
    several: list[Target] = [PositionTarget(limb.end, near), LookAtTarget(body.index_of("Head"), near, axis=(0, 0, 1))]
    assert solve(body, motion, several).reached.all()


@pytest.mark.parametrize(
    ("target", "says"),
    [
        (PositionTarget(99, (0, 0, 0)), "there is no joint 99; the skeleton has the joints 0 to 21"),
        (PositionTarget(3, (0, np.nan, 0)), "finite"),
        (PositionTarget(3, (0, 0)), "shape"),
        (PositionTarget(3, np.zeros((7, 3))), "7 values for 2 frames"),
        (PositionTarget(3, (0, 0, 0), axes=cast(Any, "ab")), "axes must be one or more of x, y and z"),
        (PositionTarget(3, (0, 0, 0), weight=0.0), "positive"),
        (OrientationTarget(3, (0, 0, 0, 0)), "length zero"),
        (LookAtTarget(3, (0, 0, 1), axis=(0, 0, 0)), "must not have length zero"),
    ],
)
def test_targets_that_make_no_sense_are_refused_by_name(body: Skeleton, target: Target, says: str) -> None:
    motion = _moved(body, frames=2)
    good = PositionTarget(2, (0.0, 0.0, 0.0))
    for solver in ITERATIVE:
        with pytest.raises(MotionError, match=says) as raised:
            solver(body, motion, [good, target])
        assert "targets[1]" in str(raised.value)


def test_chains_and_limits_that_make_no_sense_are_refused(body: Skeleton) -> None:
    with pytest.raises(EditError, match="RightArm is not an ancestor of the target's joint LeftHand"):
        chain_of(body, body.index_of("LeftHand"), body.index_of("RightArm"))
    with pytest.raises(EditError, match="turning the chosen joints moves none of the targets"):
        solve_ccd(body, _moved(body), [PositionTarget(3, (0, 0, 0))], freedom=Freedom((15,)))
    with pytest.raises(EditError, match="twist"):
        JointLimit.hinge(JointAxes((1, 0, 0), (0, 1, 0)), 0.5, 0.1)
    with pytest.raises(EditError, match="perpendicular"):
        JointLimit.cone(JointAxes((1, 0, 0), (1, 0, 0)), 0.5)
    with pytest.raises(EditError, match="at least one target"):
        solve_least_squares(body, _moved(body), [])


def test_walking_people_reach_with_either_hand() -> None:
    clip = generate_gait(1.2, 0.1, 1.0)
    motion = Motion.of(clip)
    for side in ("left", "right"):
        wrist = _joint(clip.skeleton, f"{side}_wrist")
        top = _joint(clip.skeleton, "spine")
        target = motion.positions(clip.skeleton)[:, wrist] + np.random.default_rng(0).normal(0, 0.08, (60, 3))
        freedom = Freedom(chain_of(clip.skeleton, wrist, top))
        for solver in ITERATIVE:
            assert solver(clip.skeleton, motion, [PositionTarget(wrist, target)], freedom=freedom).reached.all()


@pytest.mark.parametrize("name", ["cmu-amc/07/07_01-walk.amc", "bandai-namco-2/*raise-up*right-hand*_normal_001.bvh"])
def test_captured_people_reach_with_either_hand(mocap: Path, name: str) -> None:
    path = sorted(mocap.glob(name))[0]
    companion = next(path.parent.glob("*.asf")).read_bytes() if path.suffix == ".amc" else None
    clip = read_motion(path.read_bytes(), path.name, companion=companion).clip
    assert clip is not None
    skeleton, mapping = clip.skeleton, map_joints(clip.skeleton)
    motion = Motion.of(clip).at_frames(np.arange(0, clip.frame_count, 5))
    for side in ("left", "right"):
        wrist = _joint(skeleton, f"{side}_wrist")
        shift = np.random.default_rng(0).normal(0.0, 0.05, (motion.frame_count, 3))
        target = [PositionTarget(wrist, motion.positions(skeleton)[:, wrist] + shift)]
        freedom = Freedom(chain_of(skeleton, wrist, _joint(skeleton, "spine")))
        for solver in ITERATIVE:
            assert solver(skeleton, motion, target, freedom=freedom).reached.mean() > 0.97
        limb = limb_ending_at(skeleton, mapping, wrist, guess_axes(skeleton, mapping, clip))
        assert limb is not None
        exact = solve(skeleton, motion, target, limb=limb, solver="two_bone")
        assert exact.reached.mean() > 0.3
        assert exact.residual_after[exact.reached].max() < 1e-9
        assert np.all(exact.residual_after <= exact.residual_before + 1e-9)
