"""Constraints on ranges of frames, met by inverse kinematics and blended into what is around them.

Constraints that move the same joints, or joints that carry each other's, are solved together; others apart. Where one
of them begins or ends while another one goes on, it is approached and left over the blend, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics, quaternions
from marey_motion.editing.displacement import displace, windows_around
from marey_motion.editing.inverse_kinematics import Limb, Solver, measure_residuals, solve
from marey_motion.editing.inverse_kinematics_targets import (
    Freedom,
    LookAtTarget,
    OrientationTarget,
    PositionTarget,
    SolverOptions,
    Target,
)
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Constraint:
    """A target that counts in the frames [start, stop).

    Parameters
    ----------
    target : its values are for all of these frames, or one for each
    joints : indices of the joints that may turn for it
    limb : the limb that these are, where they are one
    """

    target: Target
    start: int
    stop: int
    joints: tuple[int, ...]
    limb: Limb | None = None


@dataclass(frozen=True, eq=False)
class ConstrainedMotion:
    """A motion in which constraints are met as far as they can be.

    Parameters
    ----------
    motion : the whole motion
    residuals_before, residuals_after : what each constraint is missed by in each of its frames: metres, or radians
    """

    motion: Motion
    residuals_before: tuple[Floats, ...]
    residuals_after: tuple[Floats, ...]


def constrain_motion(
    skeleton: Skeleton,
    motion: Motion,
    constraints: Sequence[Constraint],
    *,
    blend_frames: int,
    freedom: Freedom | None = None,
    solver: Solver = "auto",
    options: SolverOptions | None = None,
) -> ConstrainedMotion:
    """Meet constraints in their frames and blend the change in and out before and after them.

    Parameters
    ----------
    motion : F frames
    blend_frames : frames before the first and after the last constrained one that may change; 0 for none
    freedom : limits, stiffness and whether the root moves; which joints turn is said by the constraints
    solver : "auto" takes the two-bone solver for limbs and least squares for everything else

    Raises `EditError` naming the constraint that cannot be asked for.
    """
    freedom = freedom or Freedom()
    for number, constraint in enumerate(constraints):
        _check_range(constraint, number, motion.frame_count)
    before = tuple(_residuals(skeleton, motion, constraint) for constraint in constraints)
    changed = motion
    for cluster in _clusters(skeleton, constraints, freedom.root_moves):
        solving = _Cluster(skeleton, cluster, freedom, solver, options or SolverOptions())
        changed = solving.constrained(changed, blend_frames)
    after = tuple(_residuals(skeleton, changed, constraint) for constraint in constraints)
    return ConstrainedMotion(changed, before, after)


def with_values(target: Target, values: Floats) -> Target:
    """The same target with other values (n, 3) or (n, 4)."""
    if isinstance(target, PositionTarget):
        return replace(target, position=values)
    return replace(target, point=values) if isinstance(target, LookAtTarget) else replace(target, rotation=values)


def current_values(skeleton: Skeleton, motion: Motion, target: Target) -> Floats:
    """The values (F, 3) or (F, 4) with which a target is met already; a look keeps the distance of what it looks at."""
    spins = kinematics.as_global_rotations(skeleton, motion.rotations)[:, target.joint]
    if isinstance(target, OrientationTarget):
        return np.asarray(spins, dtype=np.float64)
    tips = motion.positions(skeleton)[:, target.joint]
    tips = tips + quaternions.rotate_vectors(spins, np.asarray(target.offset, dtype=np.float64))
    if isinstance(target, PositionTarget):
        return tips
    axis = np.asarray(target.axis, dtype=np.float64)
    gaze = quaternions.rotate_vectors(spins, axis / np.linalg.norm(axis))
    far = np.linalg.norm(target.values - tips, axis=1, keepdims=True)
    return np.asarray(tips + far * gaze, dtype=np.float64)


def _check_range(constraint: Constraint, number: int, frames: int) -> None:
    start, stop = constraint.start, constraint.stop
    if not 0 <= start < stop <= frames:
        raise EditError(
            f"the frames {start}:{stop} are not there; there are {frames}",
            code="frames-missing",
            where=f"constraints[{number}]",
        )
    if len(constraint.target.values) not in (1, stop - start):
        raise EditError(
            f"{len(constraint.target.values)} values for {stop - start} frames", where=f"constraints[{number}]"
        )


def _residuals(skeleton: Skeleton, motion: Motion, constraint: Constraint) -> Floats:
    part = motion.at_frames(np.arange(constraint.start, constraint.stop))
    return measure_residuals(skeleton, part, [constraint.target])[:, 0]


def _clusters(
    skeleton: Skeleton, constraints: Sequence[Constraint], together: bool
) -> tuple[tuple[Constraint, ...], ...]:
    """Constraints that must be solved together: of which one turns a joint that turns or carries another's target."""
    clusters: list[tuple[set[int], set[int], list[Constraint]]] = []
    for constraint in constraints:
        turning = set(constraint.joints)
        carrying = set(skeleton.path_to_root(constraint.target.joint))
        members = [constraint]
        apart = []
        for cluster in clusters:
            if together or turning & (cluster[0] | cluster[1]) or carrying & cluster[0]:
                turning, carrying, members = turning | cluster[0], carrying | cluster[1], cluster[2] + members
            else:
                apart.append(cluster)
        clusters = [*apart, (turning, carrying, members)]
    return tuple(tuple(members) for _, _, members in clusters)


@dataclass(frozen=True, eq=False)
class _Cluster:
    """Constraints that are solved together, and how."""

    skeleton: Skeleton
    constraints: Sequence[Constraint]
    freedom: Freedom
    solver: Solver
    options: SolverOptions

    def constrained(self, motion: Motion, blend_frames: int) -> Motion:
        """The motion with these constraints met and blended in and out."""
        frames = np.unique(np.concatenate([np.arange(one.start, one.stop) for one in self.constraints]))
        given = motion.at_frames(frames)
        away = np.array([np.maximum(one.start - frames, frames - one.stop + 1) for one in self.constraints])
        wished = [_wished(one, frames) for one in self.constraints]
        solved = self._solve(given, away <= 0, wished)
        near = away <= blend_frames
        coming = np.flatnonzero((near & (away > 0)).any(axis=0))
        if coming.size:
            partly = solved.at_frames(coming)
            shares = np.clip(1.0 - away[:, coming] / (blend_frames + 1.0), 0.0, 1.0)
            approached = [
                self._between(partly, one, values[coming], share)
                for one, values, share in zip(self.constraints, wished, shares, strict=True)
            ]
            again = self._solve(partly, near[:, coming], approached)
            solved.rotations[coming], solved.root_translations[coming] = again.rotations, again.root_translations
        return displace(motion, frames, solved, windows_around(frames, blend_frames, motion.frame_count))

    def _solve(self, given: Motion, active: NDArray[np.bool_], values: Sequence[Floats]) -> Motion:
        """The n frames with those constraints met that are active (C, n) in each, at values (n, 3) or (n, 4)."""
        first = self.constraints[0].limb
        limb = first if all(one.limb == first for one in self.constraints) else None
        joints = tuple(sorted({joint for one in self.constraints for joint in one.joints}))
        rotations, roots = given.rotations.copy(), given.root_translations.copy()
        sets, which = np.unique(active, axis=1, return_inverse=True)
        for number, chosen in enumerate(sets.T):
            here = np.flatnonzero(which.reshape(-1) == number)
            targets = [with_values(self.constraints[i].target, values[i][here]) for i in np.flatnonzero(chosen)]
            solved = solve(
                self.skeleton,
                given.at_frames(here),
                targets,
                freedom=replace(self.freedom, joints=joints),
                limb=limb,
                solver=self.solver,
                options=self.options,
            )
            rotations[here], roots[here] = solved.motion.rotations, solved.motion.root_translations
        return given._replace(rotations=rotations, root_translations=roots)

    def _between(self, given: Motion, constraint: Constraint, wished: Floats, share: Floats) -> Floats:
        """Values (n, 3) or (n, 4) between what is, at a share of 0, and what is wished, at 1."""
        smooth = share * share * (3.0 - 2.0 * share)
        now = current_values(self.skeleton, given, with_values(constraint.target, wished))
        if isinstance(constraint.target, OrientationTarget):
            return np.asarray(quaternions.slerp(now, wished, smooth), dtype=np.float64)
        between = now + smooth[:, None] * (wished - now)
        return np.where(share[:, None] < 1.0, between, wished)


def _wished(constraint: Constraint, frames: Ints) -> Floats:
    """A constraint's values (n, 3) or (n, 4) in frames, outside of its own those of the nearest."""
    values = constraint.target.values
    rows = np.broadcast_to(values, (constraint.stop - constraint.start, values.shape[1]))
    return rows[np.clip(frames, constraint.start, constraint.stop - 1) - constraint.start]
