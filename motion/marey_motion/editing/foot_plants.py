"""Foot plants: feet that are on the ground are kept in place, so that they do not slide.

A toe contact fixes the position of the toe, and a heel contact fixes the ankle: a foot with both contacts is still, a
foot with only a toe contact rolls about the toe. The corrections are blended in and out with B-splines. Legs are solved
in closed form, with damping near straight knees; if a leg is too short, the root is lowered a little (Kovar, Schreiner
and Gleicher 2002, Footskate cleanup for motion capture editing).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Flags, Floats
from marey_motion.editing.annotations.contacts import runs, without_short
from marey_motion.editing.displacement import spread_displacements, windows_around
from marey_motion.editing.ground import heights_of_soles
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb, limb_ending_at
from marey_motion.editing.inverse_kinematics.solving import solve_two_bone
from marey_motion.editing.inverse_kinematics.targets import OrientationTarget, PositionTarget
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_motion.rigs import JointAxes, JointMapping
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import PlantOptions

MOST_LOWERING_M = 0.1
"""Greatest distance, in metres, by which the root is lowered so that the legs reach the planted feet."""
SHORTEST_CONTACT_S = 0.06
"""Duration, in seconds, below which a contact counts as noise."""
MOST_SUNK_M = 0.005
"""Greatest permitted depth of a planted sole below the floor, in metres, while the foot rolls."""
# Metres; smaller values are rounding errors.
SHORTEST_LOWERING_M = 1e-9


@dataclass(frozen=True)
class Foot:
    """One foot: its leg, and its toe joint or, if no toe joint is mapped, its ankle."""

    leg: TwoBoneLimb
    toe: int


def find_feet(skeleton: Skeleton, mapping: JointMapping, axes: Mapping[str, JointAxes] | None) -> tuple[Foot, ...]:
    """Find the left and the right foot of a skeleton.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    mapping : JointMapping    its standard joints
    axes : mapping of str to JointAxes or None    axes by joint name (`rigs.guess_axes`); None if they are not known

    Returns
    -------
    tuple of Foot    left and right

    Raises
    ------
    MappingError    if the mapping does not define both legs
    """
    feet = []
    for side in SIDES:
        *_, ankle = mapping.indices(skeleton, (f"{side}_hip", f"{side}_knee", f"{side}_ankle"))
        leg = limb_ending_at(skeleton, mapping, ankle, axes)
        assert leg is not None, "all three joints are mapped"
        toe = f"{side}_toe"
        feet.append(Foot(leg, mapping.indices(skeleton, (toe,))[0] if toe in mapping.joints else ankle))
    return tuple(feet)


class FootContacts(NamedTuple):
    """Flags (F,) of the frames in which a foot touches the ground with its toe and with its heel."""

    toe: Flags
    heel: Flags


@dataclass(frozen=True, eq=False)
class PlantedMotion:
    """A motion whose planted feet do not slide.

    Parameters
    ----------
    motion : the whole motion
    contacts : frames in which each foot touches the ground
    slide_before_m, slide_after_m : mean distance that a toe slides during a contact; 0 if there are no contacts
    lowered_m : largest distance by which the root is lowered
    """

    motion: Motion
    contacts: tuple[FootContacts, ...]
    slide_before_m: float
    slide_after_m: float
    lowered_m: float


class _Plan(NamedTuple):
    """Targets of a foot in each frame, in the world: position (F, 3) and rotation (F, 4) of the ankle.

    `firmness` (F,) is 1 in frames in which the foot is planted, and decreases to 0 around them.
    """

    ankle: Floats
    rotation: Floats
    firmness: Floats


def plant_feet(
    skeleton: Skeleton,
    motion: Motion,
    frame_rate_hz: float,
    feet: Sequence[Foot],
    *,
    contacts: Sequence[FootContacts] | None = None,
    lifts: Sequence[Floats] | None = None,
    options: PlantOptions | None = None,
) -> PlantedMotion:
    """Fix planted feet to the ground: bend the legs, and lower the root where the legs do not reach.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    frame_rate_hz : float    frames per second
    feet : sequence of Foot    leg and toe of each foot
    contacts : sequence of FootContacts, optional    contacts of each foot; detected by speed if None
    lifts : sequence of (F,) float64, optional    metres by which each foot is moved up before it is planted
    options : PlantOptions, optional    limits and transitions

    Returns
    -------
    PlantedMotion    F frames, contacts and sliding distances in metres

    Raises
    ------
    EditError    if the contacts do not have one flag per frame of the motion
    """
    options = options or PlantOptions()
    positions = motion.positions(skeleton)
    contacts = contacts or tuple(find_contacts(positions, foot, frame_rate_hz, options) for foot in feet)
    for one in contacts:
        if len(one.toe) != motion.frame_count or len(one.heel) != motion.frame_count:
            raise EditError(
                f"the contacts have {len(one.toe)} flags for the toe and {len(one.heel)} for the heel; both "
                f"must have one flag for each of the motion's {motion.frame_count} frames",
                where="contacts",
            )
    blend = max(1, round(options.blend_s * frame_rate_hz))
    spins = np.asarray(kinematics.as_global_rotations(skeleton, motion.rotations), dtype=np.float64)
    lifts = lifts or [np.zeros(motion.frame_count)] * len(feet)
    plans = [
        _plan(positions + lift[:, None, None] * (0.0, 1.0, 0.0), spins, foot, touching, blend)
        for foot, touching, lift in zip(feet, contacts, lifts, strict=True)
    ]
    zone = math.radians(options.knee_damping_deg)
    lowering = _lowering(positions, feet, plans, zone, blend)
    lowered = motion._replace(root_translations=motion.root_translations - lowering[:, None] * (0.0, 1.0, 0.0))
    planted = lowered
    for foot, plan in zip(feet, plans, strict=True):
        planted = _with_leg(skeleton, planted, motion, foot, plan, lowering, zone)
    sunk = _sunk_m(skeleton, motion, planted, feet, blend)
    if sunk.any():
        planted = lowered
        for number, (foot, plan) in enumerate(zip(feet, plans, strict=True)):
            lift = _enveloped(sunk[:, number], max(1, blend // 2))
            lifted = plan._replace(ankle=plan.ankle + lift[:, None] * (0.0, 1.0, 0.0))
            planted = _with_leg(skeleton, planted, motion, foot, lifted, lowering, zone)
    before, after = (_slide(points, feet, contacts) for points in (positions, planted.positions(skeleton)))
    return PlantedMotion(planted, tuple(contacts), before, after, float(lowering.max(initial=0.0)))


def _sunk_m(skeleton: Skeleton, motion: Motion, planted: Motion, feet: Sequence[Foot], blend: int) -> Floats:
    """Compute the depth (F, n), in metres, of planted soles below a limit, which is `MOST_SUNK_M` below their floor.

    The depth is 0 for soles above the limit. The floor of a sole in a frame is the lowest height that the sole has in
    `motion`, the motion before planting, from `blend` frames before this frame to `blend` frames after it.
    """
    from scipy.ndimage import minimum_filter1d

    ankles = [foot.leg.end for foot in feet]
    before, after = (heights_of_soles(skeleton, one, ankles) for one in (motion, planted))
    floors = minimum_filter1d(before, 2 * blend + 1, axis=0, mode="nearest")
    return np.asarray(np.maximum(floors - after - MOST_SUNK_M, 0.0), dtype=np.float64)


def find_contacts(positions: Floats, foot: Foot, frame_rate_hz: float, options: PlantOptions) -> FootContacts:
    """Find the frames in which a foot touches the ground, with its toe (if the toe is slow) or heel (if the ankle is).

    Contacts shorter than `SHORTEST_CONTACT_S` are removed as noise; then gaps shorter than this duration are closed.

    Parameters
    ----------
    positions : (F, J, 3) float64    joint positions, metres
    foot : Foot    leg and toe
    frame_rate_hz : float    frames per second
    options : PlantOptions    limits

    Returns
    -------
    FootContacts    flags (F,) of toe and heel
    """
    points = positions[:, (foot.toe, foot.leg.end)]
    touching = kinematics.foot_contacts(points, frame_rate_hz, speed_limit_m_s=options.speed_m_s)
    shortest = SHORTEST_CONTACT_S * frame_rate_hz
    for side in touching.T:
        for start, stop in runs(side):
            if stop - start < shortest:
                side[start:stop] = False
    toe, heel = (~without_short(~side, shortest) for side in touching.T)
    return FootContacts(toe, heel)


def foot_slide_m(positions: Floats, foot: Foot, contacts: FootContacts) -> Floats:
    """Measure the distance on the ground that the toe covers during each contact.

    Parameters
    ----------
    positions : (F, J, 3) float64    joint positions, metres
    foot : Foot    leg and toe
    contacts : FootContacts    n contacts

    Returns
    -------
    (n,) float64    metres
    """
    steps = np.linalg.norm(np.diff(positions[:, foot.toe][:, (0, 2)], axis=0), axis=1)
    return np.array([steps[start : stop - 1].sum() for start, stop in runs(contacts.toe)])


def _slide(positions: Floats, feet: Sequence[Foot], contacts: Sequence[FootContacts]) -> float:
    slides = np.concatenate([foot_slide_m(positions, *one) for one in zip(feet, contacts, strict=True)])
    return float(slides.mean()) if slides.size else 0.0


def _plan(positions: Floats, spins: Floats, foot: Foot, contacts: FootContacts, blend: int) -> _Plan:
    """Compute the targets of a foot, in which planted toes and heels stay in place.

    While no heel is planted, the ankle follows the toe. `positions` (F, J, 3) and `spins` (F, J, 4) are the positions
    and rotations of the joints in the world. The targets are blended in and out over `blend` frames.
    """
    ankle, toe = positions[:, foot.leg.end], positions[:, foot.toe]
    places = toe.copy()
    for start, stop in runs(contacts.toe):
        places[start:stop] = np.median(toe[start:stop], axis=0)
    shift = faded(contacts.toe, places - toe, blend)
    heel = _standing_heels(contacts, blend)
    firm_toe, firm_heel = (np.clip(faded(one, np.ones((len(toe), 1)), blend), 0.0, 1.0) for one in (contacts.toe, heel))
    led, length = ankle + shift, np.linalg.norm(ankle - toe, axis=1, keepdims=True)
    own = led.copy()
    for start, stop in runs(heel):
        place = np.median(led[start:stop], axis=0)
        if contacts.toe[start:stop].any():
            touching = start + int(np.argmax(contacts.toe[start:stop]))
            place = _at_distance(place, places[touching], length[touching])
        own[start:stop] = place
    target = led + faded(heel, own - led, blend)
    target += firm_toe * (_at_distance(target, toe + shift, length) - target)
    turn = _turn_between(toe - ankle, toe + shift - target)
    rotation = quaternions.multiply(turn, spins[:, foot.leg.end])
    return _Plan(target, np.asarray(rotation, dtype=np.float64), np.maximum(firm_toe, firm_heel)[:, 0])


def _standing_heels(contacts: FootContacts, blend: int) -> Flags:
    """Find the frames (F,) in which a heel is kept in place: its contacts, minus the frames in which it has to move.

    Each toe contact moves the ankle, because the ankle follows the toe. So a heel that stays planted from one toe
    contact to the next would jump. It is therefore released in the last `blend` frames before the toe lands again (in
    fewer if the toe is up for a shorter time), and moves to its next position in these frames.
    """
    heel = contacts.heel.copy()
    for (_, lifted), (landed, _) in pairwise(runs(contacts.toe)):
        if heel[lifted - 1 : landed + 1].all():
            heel[max(lifted, landed - blend) : landed] = False
    return heel


def faded(flags: Flags, values: Floats, blend: int) -> Floats:
    """Keep values in frames with a flag, and let them fade to zero before and after these frames.

    Parameters
    ----------
    flags : (F,) bool    True in the frames whose values are kept
    values : (F, c) float64    values; those of frames without a flag are not used
    blend : int    number of frames within which the values fade; all other frames are zero

    Returns
    -------
    (F, c) float64    the values over all frames
    """
    frames = np.flatnonzero(flags)
    blended = np.zeros_like(values)
    for window in windows_around(frames, blend, len(flags)):
        here = frames[(frames >= window.start) & (frames < window.stop)]
        blended[window.start : window.stop] = spread_displacements(here, values[here], window)
    return blended


def _at_distance(points: Floats, centres: Floats, lengths: Floats) -> Floats:
    """Move points (..., 3) towards or away from centres to a distance of `lengths` (..., 1)."""
    ways = points - centres
    far = np.linalg.norm(ways, axis=-1, keepdims=True)
    return np.asarray(centres + ways * (lengths / np.maximum(far, 1e-9)), dtype=np.float64)


def _turn_between(before: Floats, after: Floats) -> Floats:
    """Compute the shortest rotations (F, 4) between vectors (F, 3); the identity if one of the vectors is zero."""
    known = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)) > 1e-6
    turns = quaternions.identity(len(before))
    turns[known] = quaternions.between_vectors(before[known], after[known])
    return np.asarray(turns, dtype=np.float64)


def _lowering(positions: Floats, feet: Sequence[Foot], plans: Sequence[_Plan], zone: float, blend: int) -> Floats:
    """Compute how far (F,), in metres, the root must be lowered so that the legs reach the planted feet.

    The motion of a knee is damped if the leg is within `zone` radians of straight (see `solve_two_bone`), so that the
    leg misses its target slightly. To avoid this, the root is lowered by at most `MOST_LOWERING_M`.
    """
    from marey_motion.editing.inverse_kinematics import two_bone_kernels

    wanted = np.zeros(len(positions))
    for foot, plan in zip(feet, plans, strict=True):
        hip, knee, ankle = (positions[:, joint] for joint in (foot.leg.start, foot.leg.middle, foot.leg.end))
        bones = np.linalg.norm(knee - hip, axis=1), np.linalg.norm(ankle - knee, axis=1)
        reach = two_bone_kernels.undamped_reach(np.linalg.norm(hip - ankle, axis=1), *bones, zone)
        way = hip - plan.ankle
        across = np.minimum(np.hypot(way[:, 0], way[:, 2]), reach)
        short = way[:, 1] - np.sqrt(reach**2 - across**2)
        wanted = np.maximum(wanted, plan.firmness * short)
    wanted[wanted < SHORTEST_LOWERING_M] = 0.0
    return np.minimum(_enveloped(wanted, blend), MOST_LOWERING_M)


def _enveloped(values: Floats, blend: int) -> Floats:
    """Compute a smooth curve (F,) that is nowhere below the values (F,), which are at least 0.

    The curve is zero in frames farther than 2·`blend` frames from any positive value. It changes slowly, so that the
    body does not bob.
    """
    from scipy.ndimage import convolve1d, maximum_filter1d  # imported here, because this import is slow

    weights = np.hanning(2 * blend + 3)[1:-1]
    highest = maximum_filter1d(values, 2 * blend + 1, mode="nearest")
    return np.asarray(convolve1d(highest, weights / weights.sum(), mode="nearest"), dtype=np.float64)


def _with_leg(
    skeleton: Skeleton, planted: Motion, motion: Motion, foot: Foot, plan: _Plan, lowering: Floats, zone: float
) -> Motion:
    """Move a leg to its planned targets in the frames in which these targets or the root differ from `motion`.

    `planted` is the motion with the root lowered by `lowering` (F,) metres; `zone` is as in `_lowering`.
    """
    ankle = foot.leg.end
    now = motion.positions(skeleton)[:, ankle]
    frames = np.flatnonzero((np.abs(plan.ankle - now).max(axis=1) > 0.0) | (lowering > 0.0))
    if not frames.size:
        return planted
    solved = solve_two_bone(
        skeleton,
        planted.at_frames(frames),
        foot.leg,
        PositionTarget(ankle, plan.ankle[frames]),
        orientation=OrientationTarget(ankle, plan.rotation[frames]),
        damping_zone_rad=zone,
    )
    rotations = planted.rotations.copy()
    rotations[frames] = solved.motion.rotations
    return planted._replace(rotations=rotations)
