"""Inverse kinematics of one arm and of whole bodies, compared with scipy's least squares and Marey's predecessor.

The times of the predecessor are published times for a walk of 47 frames and 78 joints. The same setup is repeated here
with a generated walk. A target for the wrist is the position of the wrist with random noise of 8 cm (standard deviation
per axis).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares  # pyrefly: ignore[implicit-reexport]  # scipy collects its names when it runs

from benchmarks.material import with_fingers
from benchmarks.timing import Row, time_in_turn
from marey_motion import kinematics, quaternions
from marey_motion.editing.constraining import Constraint, constrain_motion
from marey_motion.editing.inverse_kinematics.limbs import limb_ending_at
from marey_motion.editing.inverse_kinematics.solving import SolvedPoses, solve_ccd, solve_least_squares, solve_two_bone
from marey_motion.editing.inverse_kinematics.targets import (
    Freedom,
    LookAtTarget,
    PositionTarget,
    SolverOptions,
    Target,
    chain_of,
)
from marey_motion.gait import generate_gait
from marey_motion.motion import Motion
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton

Floats = NDArray[np.float64]

FRAMES, BATCH, TARGETS, PEER_TARGETS = 47, 1000, 30, 5
SPREAD_M = 0.08
GOAL = 10
# Milliseconds per constraint: chain to the root, arm only, several constraints, one with its displacement map.
CCD_MS, ARM_MS, SEVERAL_MS, EDIT_MS = 3.7, 7.0, 5.5, 28.0
OPTIONS = SolverOptions(most_iterations=50)

Solver = Callable[..., SolvedPoses]


def run() -> list[Row]:
    """Run all measurements of this module on one thread."""
    clip = generate_gait(1.3, 0.2, BATCH / 60.0)
    skeleton = clip.skeleton
    motion = Motion.of(clip)
    wrist, spine, head = map_joints(skeleton).indices(skeleton, ("left_wrist", "spine", "head"))
    limb = limb_ending_at(skeleton, map_joints(skeleton), wrist, guess_axes(skeleton, map_joints(skeleton)))
    assert limb is not None
    to_root, arm = Freedom(chain_of(skeleton, wrist, spine)), Freedom(limb.joints)
    near = motion.positions(skeleton)[:, wrist] + np.random.default_rng(0).normal(0.0, SPREAD_M, (BATCH, 3))
    single = [(motion.at_frames(np.array([f])), [PositionTarget(wrist, near[f])]) for f in range(TARGETS)]
    look = LookAtTarget(head, (0.5, 1.4, 30.0), axis=(0.0, 0.0, 1.0))
    several: list[tuple[Motion, Sequence[Target]]] = [(one, [*targets, look]) for one, targets in single]
    return [
        _each("CCD, wrist, chain to the root", skeleton, single, to_root, partial(solve_ccd, options=OPTIONS), CCD_MS),
        _each("CCD, wrist, arm only", skeleton, single, arm, partial(solve_ccd, options=OPTIONS), ARM_MS),
        _each("least squares, wrist, chain to the root", skeleton, single, to_root, solve_least_squares, CCD_MS),
        _each("least squares, wrist and look", skeleton, several, Freedom(), solve_least_squares, SEVERAL_MS),
        _two_bone(skeleton, motion, near),
        _batch(skeleton, motion, near, to_root),
        _edit(skeleton, motion, near),
    ]


def _each(
    job: str,
    skeleton: Skeleton,
    problems: Sequence[tuple[Motion, Sequence[Target]]],
    freedom: Freedom,
    solver: Solver,
    stated_ms: float,
) -> Row:
    """Time one call per problem, as when a user drags a hand; return a row with the ratio to `stated_ms`."""
    solved = [solver(skeleton, one, targets, freedom=freedom) for one, targets in problems]
    reached = sum(bool(one.reached[0]) for one in solved)

    def ours() -> None:
        for one, targets in problems:
            solver(skeleton, one, targets, freedom=freedom)

    def theirs() -> None:
        for one, targets in problems[:PEER_TARGETS]:
            _with_scipy(skeleton, one, targets, freedom)

    own, peer = time_in_turn(ours, theirs, repeats=5)
    own_ms, peer_ms = own.median_s * 1e3 / len(problems), peer.median_s * 1e3 / PEER_TARGETS
    return Row(
        f"inverse kinematics: {job}",
        f"{len(problems)} calls, {reached} reached",
        f"{own_ms * 1e3:.0f} µs",
        f"scipy {peer_ms:.1f} ms; the predecessor's, as measured elsewhere: {stated_ms} ms",
        stated_ms / own_ms,
        f"≥ {GOAL}x the predecessor",
        stated_ms / own_ms >= GOAL,
    )


def _with_scipy(skeleton: Skeleton, motion: Motion, targets: Sequence[Target], freedom: Freedom) -> float:
    """Minimise the same objective with `least_squares` of scipy and our kinematics; return the remaining cost."""
    carried = {joint for target in targets for joint in skeleton.path_to_root(target.joint)}
    joints = sorted(carried if freedom.joints is None else carried & set(freedom.joints))
    rotations = motion.rotations.copy()

    def errors(displacement: Floats) -> Floats:
        turns = quaternions.from_rotation_vector(displacement.reshape(-1, 3))
        rotations[0, joints] = quaternions.multiply(motion.rotations[0, joints], turns)
        moved = motion._replace(rotations=rotations)
        places, spins = moved.positions(skeleton)[0], kinematics.as_global_rotations(skeleton, rotations)[0]
        missed = []
        for target in targets:
            if isinstance(target, PositionTarget):
                missed.append(places[target.joint] - target.values[0])
            elif isinstance(target, LookAtTarget):
                way = target.values[0] - places[target.joint]
                gaze = quaternions.rotate_vectors(spins[target.joint], np.asarray(target.axis))
                missed.append(0.1 * (gaze - way / np.linalg.norm(way)))
        return np.concatenate([*missed, OPTIONS.regularisation_m * displacement])

    return float(least_squares(errors, np.zeros(3 * len(joints))).cost)


def _two_bone(skeleton: Skeleton, motion: Motion, near: Floats) -> Row:
    wrist = map_joints(skeleton).indices(skeleton, ("left_wrist",))[0]
    limb = limb_ending_at(skeleton, map_joints(skeleton), wrist)
    assert limb is not None
    part = motion.at_frames(np.arange(TARGETS))
    freedom, options = Freedom(limb.joints), SolverOptions()
    targets = [PositionTarget(wrist, near[:TARGETS])]
    closed, iterative = time_in_turn(
        lambda: solve_two_bone(skeleton, motion, limb, PositionTarget(wrist, near)),
        lambda: solve_least_squares(skeleton, part, targets, freedom=freedom, options=options),
    )
    own_us, peer_us = closed.median_s * 1e6 / BATCH, iterative.median_s * 1e6 / TARGETS
    reached = int(solve_two_bone(skeleton, motion, limb, PositionTarget(wrist, near)).reached.sum())
    return Row(
        "inverse kinematics: two bones in closed form",
        f"{BATCH} frames in one call, {reached} in reach",
        f"{own_us:.2f} µs a frame",
        f"own least squares {peer_us:.0f} µs; the predecessor's CCD, as measured elsewhere: {ARM_MS} ms",
        ARM_MS * 1e3 / own_us,
    )


def _batch(skeleton: Skeleton, motion: Motion, near: Floats, freedom: Freedom) -> Row:
    wrist = map_joints(skeleton).indices(skeleton, ("left_wrist",))[0]
    solved = solve_least_squares(skeleton, motion, [PositionTarget(wrist, near)], freedom=freedom)
    one = motion.at_frames(np.array([0]))
    own, peer = time_in_turn(
        lambda: solve_least_squares(skeleton, motion, [PositionTarget(wrist, near)], freedom=freedom),
        lambda: _with_scipy(skeleton, one, [PositionTarget(wrist, near[0])], freedom),
        repeats=5,
    )
    own_us, peer_us = own.median_s * 1e6 / BATCH, peer.median_s * 1e6
    return Row(
        "inverse kinematics: least squares, batch",
        f"{BATCH} frames in one call, {int(solved.reached.sum())} reached",
        f"{own_us:.1f} µs a frame",
        f"scipy {peer_us / 1e3:.1f} ms a frame",
        peer_us / own_us,
        f"≥ {GOAL}x",
        peer_us / own_us >= GOAL,
    )


def _edit(skeleton: Skeleton, motion: Motion, near: Floats) -> Row:
    """Measure a constraint in one frame of a walk with fingers; the correction is blended over the whole walk."""
    body = with_fingers(skeleton, 78, skeleton.joint_names[map_joints(skeleton).indices(skeleton, ("left_wrist",))[0]])
    rotations = np.asarray(quaternions.identity(FRAMES, body.joint_count), dtype=np.float64)
    rotations[:, [body.index_of(name) for name in skeleton.joint_names]] = motion.rotations[:FRAMES]
    walk = Motion(motion.root_translations[:FRAMES].copy(), rotations, np.zeros((FRAMES, 0, 3)), ())
    wrist, spine = map_joints(body).indices(body, ("left_wrist", "spine"))
    frame = FRAMES // 2
    wanted = [Constraint(PositionTarget(wrist, near[frame]), frame, frame + 1, chain_of(body, wrist, spine))]
    made = constrain_motion(body, walk, wanted, blend_frames=frame - 1)
    assert made.residuals_after[0][0] < 1e-3
    assert made.motion.rotations[0].tobytes() == walk.rotations[0].tobytes()
    (own,) = time_in_turn(lambda: constrain_motion(body, walk, wanted, blend_frames=frame - 1))
    return Row(
        "inverse kinematics: one constraint and its displacement map",
        f"{FRAMES} frames x {body.joint_count} joints; exactly nothing outside of the window",
        own.shown(1e3, "ms"),
        f"the predecessor's, as measured elsewhere: {EDIT_MS:.0f} ms, leaks 0.002",
        EDIT_MS / (own.median_s * 1e3),
        f"≥ {GOAL}x",
        EDIT_MS / (own.median_s * 1e3) >= GOAL,
    )
