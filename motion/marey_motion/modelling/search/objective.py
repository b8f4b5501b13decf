"""Errors of motions with respect to constraints: costs of many latent vectors, or residuals and slopes of one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import radians
from typing import NamedTuple

import numpy as np

from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search import objective_kernels as kernels
from marey_motion.modelling.search import slope_kernels
from marey_motion.modelling.search.constraints import InvalidConstraint, frame_at, joint_index, tolerance_of
from marey_motion.modelling.search.tracking import (
    Chains,
    Clocks,
    Tracked,
    body_place,
    facing,
    track_points,
    track_times,
)
from marey_schemas.search_constraints import (
    JointOrientationConstraint,
    JointPositionConstraint,
    KeyframeTimeConstraint,
    LookDirectionConstraint,
    RootHeadingConstraint,
    RootPositionConstraint,
    SearchConstraint,
)

MOST_SOUGHT = 256
AT_ORIGIN = Placement(0.0, 0.0, 0.0)


class Rows(NamedTuple):
    """Constraints as arrays, with one row per constraint.

    Parameters
    ----------
    kinds : (m,) kinds of constraints, numbered in `objective_kernels`
    items : (m,) index of the tracked point or, for a time, index of the canonical frame among the `Clocks`
    targets : (m, 4) position, quaternion, direction, heading or time
    axes : (m, 3) for positions, 1 for each coordinate that is constrained, else 0; for directions, the axis in the
        joint's frame
    """

    kinds: Ints
    items: Ints
    targets: Floats
    axes: Floats


class Linearised(NamedTuple):
    """Constraints linearised at one latent vector; W is the total length of the latent vectors of all steps.

    Parameters
    ----------
    points : (n, 3) the tracked points in the world, metres
    point_slopes : (n, 3, W) derivatives of the tracked points
    residuals : (3 m,) three numbers for each of m constraints: its error divided by its tolerance, times the square
        root of its weight
    slopes : (3 m, W) derivatives of the residuals
    """

    points: Floats
    point_slopes: Floats
    residuals: Floats
    slopes: Floats


@dataclass(frozen=True, eq=False)
class Objective:
    """Constraints on the motions of a primitive, ready to be evaluated.

    Parameters
    ----------
    constraints : the m constraints
    placement : position and heading, in the world of the targets, at which the motions begin
    """

    primitive: MotionPrimitive
    constraints: tuple[SearchConstraint, ...]
    placement: Placement
    chains: Chains
    clocks: Clocks
    rows: Rows

    def errors(self, latents: Floats) -> Floats:
        """Compute the error of each constraint.

        Parameters
        ----------
        latents : (n, L) float64    latent vectors

        Returns
        -------
        (n, m) float64    metres, radians or seconds
        """
        out = np.empty((len(latents), len(self.constraints)))
        kernels.errors(self.chains, self.clocks, self.rows, as_row(self.placement), np.ascontiguousarray(latents), out)
        return out

    def costs(self, latents: Floats) -> Floats:
        """Sum weight · error / tolerance over the constraints (Herrmann et al. 2019, Equation 1).

        Parameters
        ----------
        latents : (n, L) float64    latent vectors

        Returns
        -------
        (n,) float64    costs
        """
        out = np.empty(len(latents))
        kernels.costs(self.prices, self.errors(latents), out)
        return out

    def linearise(self, stacked: Floats, first: int, placement: Floats, moved: Floats) -> Linearised:
        """Compute errors and their derivatives with respect to the latent vectors of all steps.

        Parameters
        ----------
        stacked : (W,) float64    latent vectors of all steps, one after the other
        first : int    index in `stacked` of the first number of this step
        placement : (3,) float64    heading, x and z in the world at which the motion begins; replaces the placement of
            this objective
        moved : (3, W) float64    derivatives of the placement

        Returns
        -------
        Linearised    residuals and derivatives
        """
        width, items, clocks = len(stacked), len(self.chains.turned), len(self.clocks.weights)
        points, turns = np.empty((items, 3)), np.empty((items, 4))
        point_slopes, turn_slopes = np.empty((items, 3, width)), np.empty((items, 3, width))
        slope_kernels.track(self.chains, placement, moved, stacked, first, points, turns, point_slopes, turn_slopes)
        times, time_slopes = np.empty(clocks), np.empty((clocks, width))
        slope_kernels.keep_time(self.clocks, stacked, first + self.primitive.spatial.count, times, time_slopes)
        residuals, slopes = np.empty((len(self.constraints), 3)), np.empty((len(self.constraints), 3, width))
        slope_kernels.linearise(
            self.rows, points, turns, times, point_slopes, turn_slopes, time_slopes, residuals, slopes
        )
        scaled, steep = residuals * self._scales[:, None], slopes * self._scales[:, None, None]
        return Linearised(points, point_slopes, scaled.ravel(), steep.reshape(scaled.size, width))

    @cached_property
    def _scales(self) -> Floats:
        return np.array([np.sqrt(one.weight) / tolerance_of(one) for one in self.constraints])

    @cached_property
    def prices(self) -> Floats:
        """Weight of each constraint divided by its tolerance, (m,) float64."""
        return np.array([one.weight / tolerance_of(one) for one in self.constraints])


def build_objective(
    primitive: MotionPrimitive,
    constraints: Sequence[SearchConstraint],
    standard_joints: Mapping[str, int],
    *,
    placement: Placement = AT_ORIGIN,
    also: Sequence[Tracked] = (),
) -> Objective:
    """Prepare constraints for evaluation.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    constraints : sequence of constraints    m constraints
    standard_joints : mapping of str to int    joint index by standard name, as far as they are known
    placement : Placement    start of the motions in the world of the targets
    also : sequence of Tracked    points to track in addition to those of the constraints; they come first

    Returns
    -------
    Objective    ready to be evaluated

    Raises
    ------
    InvalidConstraint    naming the constraint and its defect
    """
    if len(constraints) > MOST_SOUGHT:
        raise InvalidConstraint(
            f"the search has {len(constraints)} constraints; at most {MOST_SOUGHT} are allowed", where="constraints"
        )
    tracked = {one: place for place, one in enumerate(also)}
    moments: dict[float, int] = {}
    rows = []
    for number, constraint in enumerate(constraints):
        try:
            rows.append(_row(primitive, constraint, standard_joints, tracked, moments))
        except MotionError as error:
            place = ".".join(part for part in (f"constraints[{number}]", error.where) if part)
            raise InvalidConstraint(error.message, code=error.code, where=place) from None
    return Objective(
        primitive=primitive,
        constraints=tuple(constraints),
        placement=placement,
        chains=track_points(primitive, list(tracked)),
        clocks=track_times(primitive, list(moments)),
        rows=_as_rows(rows),
    )


def as_row(placement: Placement) -> Floats:
    """Convert a placement to an array.

    Parameters
    ----------
    placement : Placement    heading and position

    Returns
    -------
    (3,) float64    heading in radians, x and z in metres
    """
    return np.array((placement.heading_rad, placement.x, placement.z))


class _ResidualRow(NamedTuple):
    kind: int
    item: int
    target: tuple[float, ...]
    axis: tuple[float, ...] = ()


def _row(
    primitive: MotionPrimitive,
    constraint: SearchConstraint,
    standard_joints: Mapping[str, int],
    tracked: dict[Tracked, int],
    moments: dict[float, int],
) -> _ResidualRow:
    """Convert a constraint to numbers, and add the points and times that it needs to `tracked` and `moments`.

    `tracked` maps each point, and `moments` each canonical frame, to its index.
    """
    frame = frame_at(primitive, constraint.at)

    def place(one: Tracked) -> int:
        return tracked.setdefault(one, len(tracked))

    match constraint:
        case KeyframeTimeConstraint():
            _require_possible(primitive, constraint, frame)
            return _ResidualRow(kernels.TIME, moments.setdefault(frame, len(moments)), (constraint.seconds,))
        case RootHeadingConstraint():
            return _ResidualRow(
                kernels.HEADING, place(facing(frame, standard_joints)), (radians(constraint.heading_deg),)
            )
        case RootPositionConstraint():
            x, z = constraint.target_m
            return _position_row(place(body_place(frame, standard_joints)), (x, None, z))
        case _:
            joint = place(Tracked(frame, (joint_index(primitive, constraint.joint, standard_joints),)))
    match constraint:
        case JointPositionConstraint():
            return _position_row(joint, constraint.target_m)
        case JointOrientationConstraint():
            return _ResidualRow(kernels.ORIENTATION, joint, _unit(constraint.rotation))
        case LookDirectionConstraint(point_m=None, direction=direction):
            assert direction is not None  # one of the two is there
            return _ResidualRow(kernels.DIRECTION, joint, _unit(direction), _unit(constraint.axis))
        case LookDirectionConstraint(point_m=point):
            assert point is not None
            return _ResidualRow(kernels.POINT, joint, point, _unit(constraint.axis))


def _require_possible(primitive: MotionPrimitive, constraint: KeyframeTimeConstraint, frame: float) -> None:
    """Raise `InvalidConstraint` if no motion of the primitive can reach the canonical frame at the required time."""
    if primitive.duration_range_s is None:
        return
    least, most = primitive.duration_range_s
    ends = frame == primitive.frame_count - 1
    if constraint.seconds > most or (ends and constraint.seconds < least):
        raise InvalidConstraint(
            f"the constraint's time is not possible: motions of the model {primitive.name} last "
            f"{least:.2f} to {most:.2f} s",
            where="seconds",
        )


def _position_row(item: int, target: tuple[float | None, ...]) -> _ResidualRow:
    counted = tuple(float(value is not None) for value in target)
    return _ResidualRow(kernels.POSITION, item, tuple(value or 0.0 for value in target), counted)


def _unit(values: tuple[float, ...]) -> tuple[float, ...]:
    array = np.asarray(values)
    return tuple((array / np.linalg.norm(array)).tolist())


def _as_rows(rows: Sequence[_ResidualRow]) -> Rows:
    targets, axes = np.zeros((len(rows), 4)), np.zeros((len(rows), 3))
    for number, row in enumerate(rows):
        targets[number, : len(row.target)] = row.target
        axes[number, : len(row.axis)] = row.axis
    kinds = np.array([row.kind for row in rows], dtype=np.int64)
    return Rows(kinds, np.array([row.item for row in rows], dtype=np.int64), targets, axes)
