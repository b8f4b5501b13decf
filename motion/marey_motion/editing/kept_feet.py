"""Feet that keep their contacts and stay above the floor while the pose of the body is blended or smoothed.

Blending rotations moves feet on paths that nobody chose: a foot that is on the ground in both poses may sink or slide
in between. Here the ankles are blended or smoothed as points of the world, as the root is, and the legs are solved to
reach them.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import radians

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.editing.compute_budget import PER_PLANTED_NUMBER, PER_RIG
from marey_motion.editing.foot_plants import Foot, find_feet
from marey_motion.editing.ground import heights_of_soles
from marey_motion.editing.inverse_kinematics.solving import solve_two_bone
from marey_motion.editing.inverse_kinematics.targets import OrientationTarget, PositionTarget
from marey_motion.editing.take import Take
from marey_motion.errors import MappingError
from marey_motion.motion import Motion
from marey_motion.rigs import guess_axes
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import PlantOptions

SUNK_M = 1e-4
"""Depth of a sole below its floor, in metres, that counts as rounding."""
MOST_LIFTS = 3
"""Greatest number of times that feet are lifted and their legs solved again."""
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
    """Describe the feet of a motion as a motion of their own, which can be joined or smoothed like any motion.

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
    """Move the feet of some frames to given places, and up to the floor where their soles would be below it.

    Parameters
    ----------
    take : Take    the skeleton
    motion : Motion    F frames
    feet : sequence of Foot    n feet
    wanted : Motion    ankles of F frames, as of `feet_as_motion`
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
    made = _solved(take.skeleton, part, feet, ankles, spins)
    for _ in range(MOST_LIFTS):
        sunk = np.maximum(
            floors[start:stop] - heights_of_soles(take.skeleton, made, [foot.leg.end for foot in feet]), 0.0
        )
        if sunk.max(initial=0.0) < SUNK_M:
            break
        ankles[..., 1] += sunk
        moved |= (sunk >= SUNK_M).any(axis=1)
        made = _solved(take.skeleton, part, feet, ankles, spins)
    rotations = motion.rotations.copy()
    rotations[start:stop][moved] = made.rotations[moved]
    return motion._replace(rotations=rotations)


def _solved(skeleton: Skeleton, motion: Motion, feet: Sequence[Foot], ankles: Floats, spins: Floats) -> Motion:
    """Solve the legs so that the ankles get the places (F, n, 3) and rotations (F, n, 4) in the world."""
    zone = radians(PlantOptions().knee_damping_deg)
    for number, foot in enumerate(feet):
        place = PositionTarget(foot.leg.end, ankles[:, number])
        turn = OrientationTarget(foot.leg.end, spins[:, number])
        motion = solve_two_bone(
            skeleton, motion, foot.leg, place, orientation=turn, damping_zone_rad=zone
        ).motion  # fmt: skip
    return motion
