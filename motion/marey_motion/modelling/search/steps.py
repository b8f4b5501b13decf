"""Sequences of several motions, with constraints on each of them.

Each step is placed in the world so that its pelvis begins above the point of the ground where the pelvis of the
previous step ended, with the same heading. Ground position and heading are thus continuous for any latent vectors.
Continuity of the *transition joints* (hands and feet) and of the height of the pelvis is a constraint.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search import slope_kernels
from marey_motion.modelling.search.constraints import InvalidConstraint
from marey_motion.modelling.search.objective import AT_ORIGIN, Linearised, Objective, as_row, build_objective
from marey_motion.modelling.search.tracking import Chains, Tracked, body_place, facing, track_points
from marey_schemas.options.searching import TransitionOptions
from marey_schemas.search_constraints import SearchConstraint

MOST_SEARCH_STEPS = 32


@dataclass(frozen=True, eq=False)
class Step:
    """One motion of a sequence, with its constraints.

    Parameters
    ----------
    standard_joints : joint index by standard name; a sequence of steps needs hips and shoulders, for the direction
        the body faces
    """

    primitive: MotionPrimitive
    constraints: tuple[SearchConstraint, ...]
    standard_joints: Mapping[str, int]


DEFAULT_TRANSITIONS = TransitionOptions()


class StepStart(NamedTuple):
    """Start of a step that continues the previous step.

    The fields are the placement at which the step begins in the world, and the positions of the transition joints at
    that moment, by standard name.
    """

    placement: Placement
    joints: Mapping[str, Floats]


class Measured(NamedTuple):
    """Errors of the motions of some latent vectors.

    Parameters
    ----------
    placements : position and heading in the world at which each step begins
    errors : errors (m,) of each step's constraints, in metres, radians or seconds
    jumps_m : for each transition, the distances (1 + joints,) by which the pelvis and the transition joints jump
    """

    placements: tuple[Placement, ...]
    errors: tuple[Floats, ...]
    jumps_m: tuple[Floats, ...]


class _Link(NamedTuple):
    """One step of a sequence, ready to be evaluated.

    Parameters
    ----------
    objective : the step's constraints. If the sequence has several steps, the objective also computes the points that
        `_ends` lists; they come before the points of the constraints
    beginning : pelvis, and axis of the body from right to left, at the start of the step; they determine how the step
        is placed at the end of the previous step
    first : index of the step's first number in the stacked latent vectors of all steps
    """

    objective: Objective
    beginning: Chains
    first: int


class _PlacedStep(NamedTuple):
    """A step placed in the world after the steps before it; W is the total length of the latent vectors of all steps.

    Parameters
    ----------
    placement : (3,) heading, x and z in the world at which the step begins
    found : the step's constraints, linearised
    jumps : (j, 3) displacements of pelvis and transition joints, in metres, from the end of the previous step to the
        start of this one; j is 0 for the first step
    jump_slopes : (j, 3, W) derivatives of the jumps
    """

    placement: Floats
    found: Linearised
    jumps: Floats
    jump_slopes: Floats


@dataclass(frozen=True, eq=False)
class SeveralSteps:
    """Constraints on several motions and on the continuity between them.

    Parameters
    ----------
    joints : the transition joints that all steps have, by standard name
    start : placement of the first step in the world
    """

    links: tuple[_Link, ...]
    joints: tuple[str, ...]
    start: Placement
    transitions: TransitionOptions

    @classmethod
    def of(
        cls, steps: Sequence[Step], start: Placement = AT_ORIGIN, transitions: TransitionOptions = DEFAULT_TRANSITIONS
    ) -> SeveralSteps:
        """Prepare steps for the search.

        Parameters
        ----------
        steps : sequence of Step    the steps with their constraints
        start : Placement    position and heading in the world at which the first step begins
        transitions : TransitionOptions    continuity between steps

        Returns
        -------
        SeveralSteps    ready to be evaluated

        Raises
        ------
        InvalidConstraint    naming step and constraint
        """
        if not 1 <= len(steps) <= MOST_SEARCH_STEPS:
            raise InvalidConstraint(f"a search has 1 to {MOST_SEARCH_STEPS} steps, not {len(steps)}", where="steps")
        joints = tuple(name for name in transitions.joints if all(name in step.standard_joints for step in steps))
        alone = len(steps) == 1
        links: list[_Link] = []
        first = 0
        for number, step in enumerate(steps):
            try:
                links.append(_link(step, () if alone else _ends(step, joints), first))
            except MotionError as error:
                place = ".".join(part for part in (f"steps[{number}]", error.where) if part)
                raise InvalidConstraint(error.message, code=error.code, where=place) from None
            first += step.primitive.dimensions
        return cls(tuple(links), joints, start, transitions)

    @property
    def priors(self) -> Sequence[LatentMixture]:
        """Distributions that give the likelihoods of the steps' motions."""
        return tuple(one.objective.primitive.prior for one in self.links)

    def parts(self, stacked: Floats) -> tuple[Floats, ...]:
        """Split stacked latent vectors.

        Parameters
        ----------
        stacked : (W,) float64    latent vectors one after the other

        Returns
        -------
        tuple of (L,) float64    the latent vector of each step
        """
        return tuple(np.split(stacked, [one.first for one in self.links[1:]]))

    def linearise(self, stacked: Floats) -> tuple[Floats, Floats]:
        """Compute the errors of all constraints and all jumps, with their derivatives.

        Parameters
        ----------
        stacked : (W,) float64    latent vectors one after the other

        Returns
        -------
        residuals : (r,) float64    errors in multiples of their tolerances
        derivatives : (r, W) float64    of the residuals with respect to the latent vectors
        """
        placed = list(self._place_steps(stacked, len(self.links)))
        residuals = [part for one in placed for part in (one.found.residuals, self._scale * one.jumps.ravel())]
        jumps = [self._scale * one.jump_slopes.reshape(one.jumps.size, len(stacked)) for one in placed]
        slopes = [part for one, jump in zip(placed, jumps, strict=True) for part in (one.found.slopes, jump)]
        return np.concatenate(residuals), np.concatenate(slopes)

    def start_of_next(self, latents: Sequence[Floats]) -> StepStart:
        """Compute the start of a step that continues the motion of given steps.

        Parameters
        ----------
        latents : sequence of (L,) float64    latent vectors of the given steps, with which the sequence begins

        Returns
        -------
        StepStart    placement at the end of the last given step, and the positions of the transition joints there, in
            metres; the start of the sequence, without joints, if no step is given
        """
        if not latents:
            return StepStart(self.start, {})
        *_, last = self._place_steps(np.concatenate(latents), len(latents))
        ended = last.found.points[2 + len(self.joints) :]
        placement = Placement(_heading(ended[1]), float(ended[0, 0]), float(ended[0, 2]))
        return StepStart(placement, dict(zip(self.joints, ended[2:], strict=False)))

    def measure(self, stacked: Floats) -> Measured:
        """Compute placements, errors and jumps.

        Parameters
        ----------
        stacked : (W,) float64    latent vectors one after the other

        Returns
        -------
        Measured    metres, radians and seconds
        """
        placed = list(self._place_steps(stacked, len(self.links)))
        placements = tuple(Placement(*one.placement.tolist()) for one in placed)
        errors = tuple(
            replace(link.objective, placement=placement).errors(latent[None])[0]
            for link, placement, latent in zip(self.links, placements, self.parts(stacked), strict=True)
        )
        return Measured(placements, errors, tuple(np.linalg.norm(one.jumps, axis=1) for one in placed[1:]))

    @cached_property
    def _scale(self) -> float:
        return float(np.sqrt(self.transitions.weight) / self.transitions.tolerance_m)

    def _place_steps(self, stacked: Floats, count: int) -> Iterator[_PlacedStep]:
        """Place the first `count` steps, each at the end of the one before; `stacked` (W,) are all latent vectors."""
        ends = 2 + len(self.joints)
        jumping = [0, *range(2, ends)]
        placement, moved = as_row(self.start), np.zeros((3, len(stacked)))
        before: Linearised | None = None
        for link in self.links[:count]:
            if before is not None:
                placement, moved = _carry_on(before.points[ends:], before.point_slopes[ends:], link, stacked)
            found = link.objective.linearise(stacked, link.first, placement, moved)
            if before is None:
                yield _PlacedStep(placement, found, np.zeros((0, 3)), np.zeros((0, 3, len(stacked))))
            else:
                ended = [ends + place for place in jumping]
                jumps = found.points[jumping] - before.points[ended]
                yield _PlacedStep(placement, found, jumps, found.point_slopes[jumping] - before.point_slopes[ended])
            before = found


def _ends(step: Step, joints: Sequence[str]) -> tuple[Tracked, ...]:
    """List the points of a step that are compared with the same points of adjacent steps.

    Raises `MappingError` if hips or shoulders are not mapped.

    The points at the start of the step come first: the pelvis, the axis of the body from right to left, and the
    transition joints `joints`. The same points at the end of the step follow.
    """
    return tuple(
        one
        for frame in (0.0, float(step.primitive.frame_count - 1))
        for one in (
            body_place(frame, step.standard_joints),
            facing(frame, step.standard_joints),
            *(Tracked(frame, (step.standard_joints[name],)) for name in joints),
        )
    )


def _link(step: Step, ends: Sequence[Tracked], first: int) -> _Link:
    objective = build_objective(step.primitive, step.constraints, step.standard_joints, also=ends)
    return _Link(objective, track_points(step.primitive, ends[:2]), first)


def _carry_on(points: Floats, slopes: Floats, link: _Link, stacked: Floats) -> tuple[Floats, Floats]:
    """Place a step so that it begins where the previous step ended.

    `points` (2 or more, 3) describes the end of the previous step: row 0 is the position of the pelvis, and row 1 the
    axis of the body from right to left. `slopes` (2 or more, 3, W) are the derivatives of the rows with respect to the
    latent vectors `stacked` (W,) of all steps. Returns the placement (3,) of the step, as heading, x and z, and its
    derivatives (3, W).
    """
    width = len(stacked)
    begun, begun_slopes = np.empty((2, 3)), np.empty((2, 3, width))
    still = np.zeros((3, width))
    slope_kernels.track(
        link.beginning, np.zeros(3), still, stacked, link.first, begun, np.empty((2, 4)), begun_slopes,
        np.empty((2, 3, width)),
    )  # fmt: skip
    heading = _heading(points[1]) - _heading(begun[1])
    heading_slopes = _heading_slopes(points[1], slopes[1]) - _heading_slopes(begun[1], begun_slopes[1])
    cos, sin = np.cos(heading), np.sin(heading)
    # About the vertical, (x, z) turn to (cos x + sin z, cos z - sin x).
    x, z = cos * begun[0, 0] + sin * begun[0, 2], cos * begun[0, 2] - sin * begun[0, 0]
    x_slopes = cos * begun_slopes[0, 0] + sin * begun_slopes[0, 2] + z * heading_slopes
    z_slopes = cos * begun_slopes[0, 2] - sin * begun_slopes[0, 0] - x * heading_slopes
    placement = np.array((heading, points[0, 0] - x, points[0, 2] - z))
    return placement, np.stack((heading_slopes, slopes[0, 0] - x_slopes, slopes[0, 2] - z_slopes))


def _heading(across: Floats) -> float:
    """Compute the heading of a body, in radians, from the axis (3,) of the body from right to left."""
    return float(np.arctan2(-across[2], across[0]))


def _heading_slopes(across: Floats, slopes: Floats) -> Floats:
    square = across[0] ** 2 + across[2] ** 2
    return np.asarray((across[2] * slopes[0] - across[0] * slopes[2]) / square)
