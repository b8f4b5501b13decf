"""Targets and movable joints, packed into arrays for the kernels of inverse kinematics.

Only the K joints between the root and the targets matter; they are numbered so that parents come before children.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from marey_motion.arrays import Flags, Floats, Ints
from marey_motion.editing.inverse_kinematics.targets import (
    ANGLE_LENGTH_M,
    Freedom,
    LookAtTarget,
    OrientationTarget,
    PositionTarget,
    Target,
)
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

_KINDS: dict[type, int] = {PositionTarget: 0, OrientationTarget: 1, LookAtTarget: 2}


class JointChains(NamedTuple):
    """Arrays about K joints.

    Parameters
    ----------
    parents, offsets : (K,), (F or 1, K, 3) index of each joint's parent, and offset from it in metres
    movable, stiffness : (K,) whether a solver may turn the joint, and its resistance, from 0 (turns freely) to below 1
    limited, limits : (K,), (K, 14) whether the joint has limits, and the limits as `JointLimit.row`
    carries : (K, C) whether a target moves with a joint
    root_moves : whether a solver may shift the root
    """

    parents: Ints
    offsets: Floats
    movable: Flags
    stiffness: Floats
    limited: Flags
    limits: Floats
    carries: Flags
    root_moves: bool


class Targets(NamedTuple):
    """Arrays about C targets.

    Parameters
    ----------
    kinds, joints : (C,) kind of each target (0 position, 1 orientation, 2 look-at), and index of the target's joint
    values : (F or 1, C, 4) position, quaternion or point to look at, in the world
    axes : (C, 3) 1 for each constrained coordinate of a target position, else 0
    directions, offsets : (C, 3) look-at axis and place of the target's point, both in the frame of the joint
    scales : (C,) factors of the errors
    """

    kinds: Ints
    joints: Ints
    values: Floats
    axes: Floats
    directions: Floats
    offsets: Floats
    scales: Floats


class SolverResult(NamedTuple):
    """Results of a solver for F frames and C targets.

    `before` and `after` (F, C) are the errors of the targets in the given and in the solved poses, in metres or
    radians. `iterations` (F,) are the numbers of iterations, and `reached` (F,) whether all targets are reached.
    """

    before: Floats
    after: Floats
    iterations: Ints
    reached: Flags


class DescentScratch(NamedTuple):
    """Scratch arrays of cyclic coordinate descent, for one pose of K joints and C targets.

    Parameters
    ----------
    spins, places : (K, 4), (K, 3) rotations and positions of the joints in the world
    tips, turns, errors : (C, 3), (C, 4), (C, 3) positions of the targets' points, rotations of their joints, errors
    matrix, form, vectors : (3, 3), (4, 4), (4, 4) intermediate results in the search for a joint's best rotation
    """

    spins: Floats
    places: Floats
    tips: Floats
    turns: Floats
    errors: Floats
    matrix: Floats
    form: Floats
    vectors: Floats


class LeastSquaresScratch(NamedTuple):
    """Scratch arrays of the least-squares solver: for one pose, as in `DescentScratch`, and for one step.

    The unknowns are displacements of the pose from the pose at the start, `first` and `first_root`. `trial` and
    `trial_root` are the pose after a step; the other arrays are terms of the equations of the step.
    """

    spins: Floats
    places: Floats
    tips: Floats
    turns: Floats
    errors: Floats
    first: Floats
    first_root: Floats
    trial: Floats
    trial_root: Floats
    displacement_weights: Floats
    displacement: Floats
    gradient: Floats
    step: Floats
    inverse_diagonal: Floats
    jacobian: Floats
    scaled_rows: Floats
    scaled_errors: Floats
    right: Floats
    matrix: Floats
    blocked: Ints
    outward: Floats


class IkProblem(NamedTuple):
    """Input of a solver, and the poses that the solver changes.

    Parameters
    ----------
    joints : (K,) indices in the skeleton
    body : parents, offsets, limits and stiffness of these joints
    targets : the C targets
    roots, rotations : (F, 3) in metres and (F, K, 4) local rotations, copied from the motion
    """

    joints: Ints
    body: JointChains
    targets: Targets
    roots: Floats
    rotations: Floats

    @property
    def found(self) -> SolverResult:
        """Make empty arrays for the results of a solver."""
        frames, count = len(self.roots), len(self.targets.kinds)
        return SolverResult(
            np.zeros((frames, count)), np.zeros((frames, count)), np.zeros(frames, np.int64), np.zeros(frames, np.bool_)
        )

    @property
    def descent_scratch(self) -> DescentScratch:
        """Make scratch arrays for cyclic coordinate descent."""
        room = self._pose_room()
        return DescentScratch(**room, matrix=np.zeros((3, 3)), form=np.zeros((4, 4)), vectors=np.zeros((4, 4)))

    def least_squares_scratch(self, regularisation_m: float) -> LeastSquaresScratch:
        """Make scratch arrays for least squares.

        Parameters
        ----------
        regularisation_m : float    error, in metres, that costs as much as a displacement of one radian

        Returns
        -------
        LeastSquaresScratch    scratch arrays
        """
        movable = int(self.body.movable.sum())
        joints, unknowns, errors = len(self.joints), 3 * movable + 3, 3 * len(self.targets.kinds)
        displacement_weights = np.full(unknowns, regularisation_m**2)
        displacement_weights[:-3] /= np.repeat((1.0 - self.body.stiffness[self.body.movable]) ** 2, 3)
        return LeastSquaresScratch(
            **self._pose_room(),
            first=np.zeros((joints, 4)),
            first_root=np.zeros(3),
            trial=np.zeros((joints, 4)),
            trial_root=np.zeros(3),
            displacement_weights=displacement_weights,
            displacement=np.zeros(unknowns),
            gradient=np.zeros(unknowns),
            step=np.zeros(unknowns),
            inverse_diagonal=np.zeros(unknowns),
            jacobian=np.zeros((errors, unknowns)),
            scaled_rows=np.zeros((errors, unknowns)),
            scaled_errors=np.zeros(errors),
            right=np.zeros(errors),
            matrix=np.zeros((errors, errors)),
            blocked=np.zeros(movable, np.int64),
            outward=np.zeros((movable, 3)),
        )

    def _pose_room(self) -> dict[str, Floats]:
        joints, count = len(self.joints), len(self.targets.kinds)
        shapes = {"spins": (joints, 4), "places": (joints, 3), "tips": (count, 3), "turns": (count, 4)}
        return {name: np.zeros(shape) for name, shape in (shapes | {"errors": (count, 3)}).items()}

    def put_back(self, motion: Motion) -> Motion:
        """Write the poses of this problem into a motion.

        Parameters
        ----------
        motion : Motion    F frames

        Returns
        -------
        Motion    F frames with the solved joints
        """
        rotations = motion.rotations.copy()
        rotations[:, self.joints] = self.rotations
        return motion._replace(root_translations=self.roots, rotations=rotations)


def pose_problem(skeleton: Skeleton, motion: Motion, targets: Sequence[Target], freedom: Freedom) -> IkProblem:
    """Pack the frames of a motion, the joints that may turn, and the targets into arrays for the kernels.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    targets : sequence of targets    C targets
    freedom : Freedom    joints that may turn

    Returns
    -------
    IkProblem    arrays for the kernels

    Raises
    ------
    EditError    if a target is invalid; the error names the target and its defect
    """
    for number, target in enumerate(targets):
        if not 0 <= target.joint < skeleton.joint_count:
            raise EditError(
                f"there is no joint {target.joint}; the skeleton has the joints 0 to {skeleton.joint_count - 1}",
                where=f"targets[{number}]",
            )
    if not targets:
        raise EditError("inverse kinematics needs at least one target", where="targets")
    paths = [set(skeleton.path_to_root(target.joint)) for target in targets]
    joints = sorted(set[int]().union(*paths))
    carries = np.array([[joint in path for path in paths] for joint in joints], dtype=np.bool_)
    body = _body(skeleton, motion, joints, carries, freedom)
    packed = _targets(joints, targets, motion.frame_count)
    roots, rotations = (
        np.array(one, dtype=np.float64, order="C") for one in (motion.root_translations, motion.rotations[:, joints])
    )
    return IkProblem(np.array(joints, dtype=np.int64), body, packed, roots, rotations)


def _body(skeleton: Skeleton, motion: Motion, joints: list[int], carries: Flags, freedom: Freedom) -> JointChains:
    count = len(joints)
    may_turn = set(joints if freedom.joints is None else freedom.joints)
    movable = np.array([joint in may_turn for joint in joints], dtype=np.bool_)
    if not movable.any() and not freedom.root_moves:
        raise EditError(
            "turning the chosen joints moves none of the targets; include a joint between the root and a target",
            code="chain-invalid",
            where="joints",
        )
    limits, limited, stiffness = np.zeros((count, 14)), np.zeros(count, np.bool_), np.zeros(count)
    for k, joint in enumerate(joints):
        stiffness[k] = freedom.stiffness.get(joint, 0.0)
        if joint in freedom.limits:
            limited[k], limits[k] = True, freedom.limits[joint].row
    places = {joint: k for k, joint in enumerate(joints)}
    parents = np.array([places.get(parent, -1) for parent in skeleton.parents[joints].tolist()], dtype=np.int64)
    offsets = np.array(skeleton.offsets[joints][None], dtype=np.float64, order="C")
    moving = [number for number, joint in enumerate(motion.translated_joints) if joint in places]
    if moving:
        offsets = np.repeat(offsets, motion.frame_count, axis=0)
        offsets[:, [places[motion.translated_joints[number]] for number in moving]] = motion.translations[:, moving]
    return JointChains(parents, offsets, movable, stiffness, limited, limits, carries, bool(freedom.root_moves))


def _targets(joints: list[int], targets: Sequence[Target], frames: int) -> Targets:
    count = len(targets)
    values = [_checked_values(target, number, frames) for number, target in enumerate(targets)]
    rows = max(len(value) for value in values)
    packed = Targets(
        np.array([_KINDS[type(target)] for target in targets], dtype=np.int64),
        np.array([joints.index(target.joint) for target in targets], dtype=np.int64),
        np.zeros((rows, count, 4)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros(count),
    )
    for number, (target, value) in enumerate(zip(targets, values, strict=True)):
        packed.values[:, number, : value.shape[1]] = value
        packed.scales[number] = _scale(target, number)
        if isinstance(target, PositionTarget):
            packed.axes[number] = [axis in target.axes for axis in "xyz"]
        if not isinstance(target, OrientationTarget):
            packed.offsets[number] = _vector(target.offset, f"targets[{number}].offset")
        if isinstance(target, LookAtTarget):
            axis = _vector(target.axis, f"targets[{number}].axis")
            length = float(np.linalg.norm(axis))
            if length < 1e-9:
                raise EditError("a direction must not have length zero", where=f"targets[{number}].axis")
            packed.directions[number] = axis / length
    return packed


def _checked_values(target: Target, number: int, frames: int) -> Floats:
    try:
        values = target.values
    except ValueError as error:
        raise EditError(str(error), where=f"targets[{number}]") from None
    if len(values) not in (1, frames):
        raise EditError(
            f"the target has {len(values)} values for {frames} frames; give one value, or one per frame",
            where=f"targets[{number}]",
        )
    if isinstance(target, PositionTarget) and (not target.axes or set(target.axes) - set("xyz")):
        raise EditError(
            f"axes must be one or more of x, y and z, such as 'xz', not {target.axes!r}",
            where=f"targets[{number}].axes",
        )
    return values


def _scale(target: Target, number: int) -> float:
    if not (np.isfinite(target.weight) and target.weight > 0.0):
        raise EditError(f"the weight must be a positive number, not {target.weight}", where=f"targets[{number}].weight")
    unit = 1.0 if isinstance(target, PositionTarget) else ANGLE_LENGTH_M
    return float(np.sqrt(target.weight)) * unit


def _vector(values: Any, where: str) -> Floats:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise EditError("the vector must be three finite numbers", where=where)
    return vector
