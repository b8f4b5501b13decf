"""Feet that keep their contacts and stay above the floor while the pose of the body is blended or smoothed.

If only rotations are blended, a foot that is on the ground in both poses may sink or slide in between. This module
therefore blends or smooths the positions of the ankles in the world, like that of the root, and solves the legs so that
they reach these positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import radians

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.editing.compute_budget import PER_PLANTED_NUMBER, PER_RIG
from marey_motion.editing.foot_plants import Foot, find_feet
from marey_motion.editing.ground import heights_of_soles
from marey_motion.editing.inverse_kinematics.solving import solve_two_bone
from marey_motion.editing.inverse_kinematics.targets import Neighbours, OrientationTarget, PositionTarget
from marey_motion.editing.limb_smoothing import LimbSmoother, largest_steps
from marey_motion.editing.take import Take
from marey_motion.errors import MappingError
from marey_motion.motion import Motion
from marey_motion.rigs import guess_axes
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import PlantOptions

SUNK_M = 1e-4
"""Depth of a sole below its floor, in metres, that counts as rounding."""
MOST_LIFTS = 5
"""Greatest number of times that feet are lifted and their legs solved again."""
SMOOTHING_S = 0.6
"""Longest time, in seconds, over which the movement of a leg is smoothed if its knee would jump."""
_ZONE_RAD = radians(PlantOptions().knee_damping_deg)
ROUNDING = 1e-9
"""Difference, in metres and in components of quaternions, up to which a foot counts as in place."""


def feet_of(take: Take) -> tuple[Foot, ...]:
    """Find the feet of a take.

    Parameters
    ----------
    take : Take    F frames

    Returns
    -------
    tuple of Foot    left and right; empty if the skeleton has no mapped legs, so that there are no feet to keep
    """
    take.budget.spend(PER_RIG)
    clip = take.motion.as_clip(take.skeleton, take.frame_rate_hz)
    try:
        axes = guess_axes(take.skeleton, take.body.mapping, clip)
        return find_feet(take.skeleton, take.body.mapping, axes)
    except MappingError:
        return ()


def feet_as_motion(skeleton: Skeleton, motion: Motion, feet: Sequence[Foot]) -> Motion:
    """Make a motion that consists of the feet only, and can be joined or smoothed like any other motion.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    feet : sequence of Foot    n feet

    Returns
    -------
    Motion    F frames; rotations (F, n, 4) and translations (F, n, 3) are those of the ankles in the world
    """
    ankles = [foot.leg.end for foot in feet]
    spins = np.asarray(kinematics.as_global_rotations(skeleton, motion.rotations), dtype=np.float64)
    places = np.asarray(motion.positions(skeleton), dtype=np.float64)
    still = np.zeros((motion.frame_count, 3))
    return Motion(still, spins[:, ankles], places[:, ankles], tuple(range(len(ankles))))


def with_feet(
    take: Take, motion: Motion, feet: Sequence[Foot], wanted: Motion, floors: Floats, frames: slice
) -> Motion:
    """Solve the legs so that the ankles follow given paths; soles are lifted where they would be below the floor.

    Parameters
    ----------
    take : Take    take whose skeleton and compute budget are used
    motion : Motion    F frames
    feet : sequence of Foot    n feet
    wanted : Motion    positions and rotations of the ankles in F frames, as a motion that `feet_as_motion` makes
    floors : (F, n) float64    height below which no sole may be, metres
    frames : slice    the frames to change

    Returns
    -------
    Motion    F frames
    """
    start, stop, _ = frames.indices(motion.frame_count)
    part = motion.sliced(start, stop)
    take.budget.spend(PER_PLANTED_NUMBER * part.rotations.size)
    ankles, spins = wanted.translations[start:stop].copy(), wanted.rotations[start:stop]
    now = feet_as_motion(take.skeleton, part, feet)
    apart = np.maximum(np.abs(ankles - now.translations).max(axis=-1), np.abs(spins - now.rotations).max(axis=-1))
    moved = apart.max(axis=1) > ROUNDING
    places = [np.asarray(one.positions(take.skeleton), dtype=np.float64) for one in (take.motion, motion)]
    usual = np.maximum(*(largest_steps(one) for one in places))
    reach = max(1.0, min(SMOOTHING_S * take.frame_rate_hz, 0.5 * (stop - start)))
    legs = [_Leg(take, foot, spins[:, number], usual, reach) for number, foot in enumerate(feet)]
    made = _solved(part, legs, ankles)
    for _ in range(MOST_LIFTS):
        sunk = np.maximum(
            floors[start:stop] - heights_of_soles(take.skeleton, made, [foot.leg.end for foot in feet]), 0.0
        )
        if sunk.max(initial=0.0) < SUNK_M:
            break
        ankles[..., 1] += sunk
        moved |= (sunk >= SUNK_M).any(axis=1)
        made = _solved(part, legs, ankles)
    rotations = motion.rotations.copy()
    rotations[start:stop][moved] = made.rotations[moved]
    return motion._replace(rotations=rotations)


def _solved(motion: Motion, legs: Sequence[_Leg], ankles: Floats) -> Motion:
    """Solve the n legs so that their ankles are at the positions `ankles` (F, n, 3)."""
    for number, leg in enumerate(legs):
        motion = leg.solved(motion, ankles[:, number])
    return motion


@dataclass(frozen=True, eq=False)
class _Leg:
    """A leg whose ankle is moved along a path, and gets the rotations `spins` (F, 4) in the world.

    `usual` (J,) are the largest steps of the joints between two frames, in metres; `reach` is the number of frames over
    which the movement is smoothed if the knee would jump.
    """

    take: Take
    foot: Foot
    spins: Floats
    usual: Floats
    reach: float

    def solved(self, motion: Motion, ankle: Floats) -> Motion:
        """Move the ankle to the positions `ankle` (F, 3), or only near them in frames in which the knee would jump."""
        leg = self.foot.leg
        usual = self.usual[[leg.middle, leg.end]]
        smoother = LimbSmoother(self.take.skeleton, leg, motion, usual, self.reach, 0.5 * _ZONE_RAD)
        coherent = Neighbours(np.arange(len(ankle)), self.reach)
        return smoother.solved(ankle, partial(self._reached, neighbours=coherent), self._reached(motion, ankle))

    def _reached(self, motion: Motion, ankle: Floats, neighbours: Neighbours | None = None) -> Motion:
        end = self.foot.leg.end
        if neighbours is not None:
            self.take.budget.spend(PER_PLANTED_NUMBER * motion.rotations.size)
        return solve_two_bone(
            self.take.skeleton, motion, self.foot.leg, PositionTarget(end, ankle),
            orientation=OrientationTarget(end, self.spins), damping_zone_rad=_ZONE_RAD, neighbours=neighbours,
        ).motion  # fmt: skip
