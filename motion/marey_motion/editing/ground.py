"""The height of the ground, and the contacts of the feet with the ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import AnyFloats, Flags, Floats
from marey_motion.editing.annotations.contacts import Stance, find_stances
from marey_motion.editing.placement import shifted
from marey_motion.editing.take import EditFinding, Take
from marey_motion.importing.tracks import sole_points
from marey_motion.kinematics import forward_kinematics
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.commands import FindContacts, FindGround, MoveToGround
from marey_schemas.options.annotations import ContactOptions

FEET = ("left_foot", "right_foot")
LOWEST_SHARE = 0.05
"""Quantile of the height of the lower sole, over all frames, that counts as the ground if the lower foot never stands.
"""

SOLE_SHARE = 0.05
"""Height above the floor of the ball of a standing foot in a shoe, as a share of the length of the leg."""
STANDING_SHARE = 0.9
"""A rest pose counts as standing if the hip is higher above the ankle than this share of the leg's length."""


class Ground(NamedTuple):
    """An estimate of the ground.

    Parameters
    ----------
    height_m : height of the ground, metres
    standing_frames : number of frames in which the lower foot is in stance; the height is estimated from these frames
        or, if there are none, from the frames with the lowest feet
    sole_m : distance from the lowest joint or tip of a foot down to its sole, metres
    """

    height_m: float
    standing_frames: int
    sole_m: float = 0.0


def move_to_ground(take: Take, command: MoveToGround) -> Take:
    """Shift the motion vertically so that the ground is at height zero.

    Parameters
    ----------
    take : Take    F frames
    command : MoveToGround    height of the ground; if None, it is estimated and recorded

    Returns
    -------
    Take    F frames

    Raises
    ------
    MappingError    if the feet are not known
    """
    ground = estimate_ground(take, command.sole_m) if command.height_m is None else Ground(command.height_m, 0)
    moved = take.with_motion(shifted(take.motion, np.array((0.0, -ground.height_m, 0.0))))
    if command.height_m is not None:
        return moved
    return moved.with_finding(EditFinding("move_to_ground", ground._asdict()))


def find_ground(take: Take, command: FindGround) -> Take:
    """Find the height of the ground and record it; the motion stays as it is.

    Parameters
    ----------
    take : Take    F frames
    command : FindGround    the thickness of the soles; if None, it is estimated

    Returns
    -------
    Take    the same motion, with a finding that contains the height

    Raises
    ------
    MappingError    if the feet are not known
    """
    return take.with_finding(EditFinding("find_ground", estimate_ground(take, command.sole_m)._asdict()))


def find_contacts(take: Take, command: FindContacts) -> Take:
    """Record the frames in which each foot is planted, as the segments of an annotation.

    Parameters
    ----------
    take : Take    F frames
    command : FindContacts    limits of speed, durations and height

    Returns
    -------
    Take    the same motion, with a finding that contains the contacts

    Raises
    ------
    MappingError    if the feet are not known
    """
    stances = _stances(take, command)
    if command.height_limit_m is not None:
        heights = _soles_of(take)
        limit = _ground_of(heights, stances).height_m + command.height_limit_m
        stances = tuple(
            [one for one in foot if np.median(heights[one.start : one.end, side]) <= limit]
            for side, foot in enumerate(stances)
        )
    segments = [
        {"label": label, "start": one.start, "end": one.end}
        for label, foot in zip(FEET, stances, strict=True)
        for one in foot
    ]
    segments.sort(key=lambda one: (one["start"], one["label"]))
    values = {"frame_count": take.frame_count, "frame_rate_hz": take.frame_rate_hz, "segments": segments}
    return take.with_finding(EditFinding("find_contacts", values))


def estimate_ground(take: Take, sole_m: float | None = None) -> Ground:
    """Estimate the height of the ground: the median height of the lower sole while the foot of that sole is in stance.

    The median is hardly affected if a foot is below the floor in some frames, or is kept in the air for a while.

    Parameters
    ----------
    take : Take    F frames
    sole_m : float, optional    distance from the lowest joint or tip of a foot down to its sole, metres; None to
        estimate it

    Returns
    -------
    Ground    height in metres

    Raises
    ------
    MappingError    if the feet are not known
    """
    ground = _ground_of(_soles_of(take), _stances(take, ContactOptions()))
    sole = estimate_sole(take.skeleton, take.body.matching) if sole_m is None else sole_m
    return ground._replace(height_m=ground.height_m - sole, sole_m=sole)


def estimate_sole(skeleton: Skeleton, body: MatchingBody) -> float:
    """Estimate the distance from the lowest joint or tip of a foot down to its sole.

    Skeletons end at joints inside the foot, and the ball of a foot in a shoe is about `SOLE_SHARE` of the leg's length
    above the floor. If the lowest joint or tip of a foot is below the joint of its toes in a standing rest pose, the
    difference in height is subtracted.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    body : MatchingBody    its feet

    Returns
    -------
    float    metres, at least 0
    """
    rest = Motion(np.zeros((1, 3)), skeleton.rest_rotations[None], np.zeros((1, 0, 3)), ())
    heights = forward_kinematics(skeleton, rest.poses, end_sites=True)[0, :, 1]
    depths = []
    for ankle, toe, hip in zip(body.feet, body.toes, (body.lefts[0], body.rights[0]), strict=True):
        path = skeleton.path_to_root(ankle)
        leg = sum(float(np.linalg.norm(skeleton.offsets[joint])) for joint in path if joint > hip)
        stands = heights[hip] - heights[ankle] > STANDING_SHARE * leg
        hanging = float(heights[toe] - heights[sole_points(skeleton, ankle)].min()) if stands else 0.0
        depths.append(max(SOLE_SHARE * leg - hanging, 0.0))
    return float(np.mean(depths))


def sole_heights(points: AnyFloats, skeleton: Skeleton, ankles: Sequence[int]) -> Floats:
    """Compute the height of the lowest point of each foot.

    Parameters
    ----------
    points : (F, J + E, 3)    positions of joints and end sites, metres
    skeleton : Skeleton    J joints
    ankles : sequence of int    left and right ankle

    Returns
    -------
    (F, 2) float64    left and right, metres
    """
    soles = (sole_points(skeleton, ankle) for ankle in ankles)
    return np.stack([points[:, sole, 1].min(axis=1) for sole in soles], axis=1).astype(np.float64)


def lower_soles_in_stance(heights: Floats, stances: Sequence[Sequence[Stance]]) -> Flags:
    """Mark the feet from whose height the ground is estimated: the lower foot of each frame, if it is in stance.

    Parameters
    ----------
    heights : (F, 2) float64    heights of the soles, metres
    stances : stances of the left and of the right foot

    Returns
    -------
    (F, 2) bool    the lower foot of each frame, if it is in stance
    """
    standing = np.zeros(heights.shape, dtype=np.bool_)
    for side, foot in enumerate(stances):
        for one in foot:
            standing[one.start : one.end, side] = True
    lower = np.zeros_like(standing)
    np.put_along_axis(lower, np.argmin(heights, axis=1)[:, None], True, axis=1)
    return standing & lower


def heights_of_soles(skeleton: Skeleton, motion: Motion, ankles: Sequence[int]) -> Floats:
    """Compute the height of the lowest point of each foot, from the ankle down.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    ankles : sequence of int    n joints

    Returns
    -------
    (F, n) float64    metres
    """
    positions = forward_kinematics(
        skeleton,
        motion.poses,
        translations=motion.translations,
        translated_joints=motion.translated_joints,
        end_sites=True,
    )
    return sole_heights(positions, skeleton, ankles)


def _stances(take: Take, options: ContactOptions) -> tuple[list[Stance], ...]:
    clip = take.motion.as_clip(take.skeleton, take.frame_rate_hz)
    return find_stances(clip, take.body.matching, options)


def _ground_of(heights: Floats, stances: tuple[list[Stance], ...]) -> Ground:
    lower = heights[lower_soles_in_stance(heights, stances)]
    if lower.size == 0:
        return Ground(float(np.quantile(heights.min(axis=1), LOWEST_SHARE)), 0)
    return Ground(float(np.median(lower)), int(lower.size))


def _soles_of(take: Take) -> Floats:
    return heights_of_soles(take.skeleton, take.motion, take.body.matching.feet)
