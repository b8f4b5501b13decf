"""Feet of a retargeted clip: they stay in place on the floor while the feet of the source touch the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import runs
from marey_motion.editing.foot_plants import Foot, FootContacts, PlantedMotion, faded, find_contacts, plant_feet
from marey_motion.editing.ground import sole_heights
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb
from marey_motion.importing.checks import CheckWarning
from marey_motion.motion import Motion
from marey_motion.retargeting.floor import BELOW_M, Floor, depths_below_floor
from marey_motion.retargeting.planning import RetargetPlan
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import PlantOptions
from marey_schemas.wording import counted

_OPTIONS = PlantOptions()
FAST_KNEES = 1.25
"""Ratio of the greatest knee speed in the result to that in the source; above it, the result has a warning."""


class CorrectedFeet(NamedTuple):
    """A clip whose feet stay in place, and findings about the changes."""

    clip: Clip
    checks: tuple[CheckWarning, ...]


def keep_feet(source: Clip, result: Clip, plan: RetargetPlan, floor: Floor | None) -> CorrectedFeet:
    """Keep the feet of a retargeted clip in place while those of the source touch the floor.

    While a sole touches the floor, its height is the height of the source's sole times the scale. The feet are planted
    by `editing.foot_plants`, which lowers the root where the legs are too short, and damps knees that nearly stretch.

    Parameters
    ----------
    source : Clip    F frames of the plan's source skeleton
    result : Clip    F frames of its target skeleton
    plan : RetargetPlan    joints, scale and limbs
    floor : Floor or None    floor below which no foot is left; None if it is not known

    Returns
    -------
    CorrectedFeet    F frames, with the feet moved, and findings

    Raises
    ------
    MappingError    if not both legs are mapped in both skeletons
    """
    legs = zip(SIDES, plan.both_limbs("ankle"), strict=True)
    feet = [Foot(leg, _toe(plan.target_joints, side)) for side, leg in legs]
    rate = source.frame_rate_hz
    points = kinematics.global_positions(source, end_sites=True).astype(np.float64)
    contacts = [_contacts(points, plan, side, rate) for side in SIDES]
    motion, blend = Motion.of(result), max(1, round(_OPTIONS.blend_s * rate))
    after = kinematics.global_positions(result, end_sites=True)
    off = plan.scale * _soles(points, plan.source, plan.source_joints)
    off -= _soles(after, plan.target, plan.target_joints)
    lifts = [faded(one.toe | one.heel, off[:, [side]], blend)[:, 0] for side, one in enumerate(contacts)]
    if floor is not None:
        depths = depths_below_floor(points, after, plan, floor, "ankle")
        for side in np.flatnonzero(depths.max(axis=0) > BELOW_M).tolist():
            lifted = faded(depths[:, side] > BELOW_M, depths[:, [side]], blend)[:, 0]
            lifts[side] = np.maximum(lifts[side], np.maximum(lifted, depths[:, side]))
    planted = plant_feet(plan.target, motion, rate, feet, contacts=contacts, lifts=lifts, options=_OPTIONS)
    made = planted.motion.as_clip(plan.target, rate)
    before = _knee_speed(points, plan.source_joints, rate)
    now = _knee_speed(np.asarray(planted.motion.positions(plan.target)), plan.target_joints, rate)
    checks = [_check(planted, motion, plan, feet)]
    if now > FAST_KNEES * before:
        checks.append(_fast_knees(before, now))
    return CorrectedFeet(made, tuple(checks))


def _toe(joints: Mapping[str, int], side: str) -> int:
    return joints.get(f"{side}_toe", joints[f"{side}_ankle"])


def _contacts(points: Floats, plan: RetargetPlan, side: str, rate_hz: float) -> FootContacts:
    """Find the contacts of a foot of the source from its points (F, n, 3)."""
    joints = plan.source_joints
    ankle = joints[f"{side}_ankle"]
    leg = TwoBoneLimb(joints[f"{side}_hip"], joints[f"{side}_knee"], ankle)
    return find_contacts(points, Foot(leg, _toe(joints, side)), rate_hz, _OPTIONS)


def _soles(points: AnyFloats, skeleton: Skeleton, joints: Mapping[str, int]) -> Floats:
    return sole_heights(points, skeleton, [joints[f"{side}_ankle"] for side in SIDES])


def _knee_speed(points: Floats, joints: Mapping[str, int], rate_hz: float) -> float:
    """Compute the greatest speed, in degrees per second, at which a knee bends or stretches; `points` is (F, n, 3)."""
    fastest = 0.0
    for side in SIDES:
        hip, knee, ankle = (points[:, joints[f"{side}_{part}"]] for part in ("hip", "knee", "ankle"))
        thigh, shank = knee - hip, ankle - knee
        bend = np.arctan2(np.linalg.norm(np.cross(thigh, shank), axis=1), np.sum(thigh * shank, axis=1))
        fastest = max(fastest, float(np.abs(np.diff(bend)).max(initial=0.0)) * rate_hz)
    return float(np.degrees(fastest))


def _fast_knees(before: float, now: float) -> CheckWarning:
    return CheckWarning(
        "knees-fast",
        f"knees bend at up to {now:.0f} degrees per second, {now / max(before, 1e-9):.2f} times as fast as in the "
        "source, because the feet are kept in place; look at the clip before you use it",
        values={"source_deg_s": before, "result_deg_s": now},
    )


def _check(planted: PlantedMotion, before: Motion, plan: RetargetPlan, feet: Sequence[Foot]) -> CheckWarning:
    ankles = [foot.leg.end for foot in feet]
    moved = (one.positions(plan.target)[:, ankles] for one in (before, planted.motion))
    most = float(np.linalg.norm(np.subtract(*moved), axis=-1).max())
    count = sum(len(runs(one.toe | one.heel)) for one in planted.contacts)
    slid, slides, lowered = (100.0 * one for one in (planted.slide_before_m, planted.slide_after_m, planted.lowered_m))
    return CheckWarning(
        "feet-kept",
        f"feet were kept in place in {counted(count, 'contact')} and moved by at most {100.0 * most:.1f} cm; toes slid "
        f"by {slid:.1f} cm per contact on average, now by {slides:.1f} cm; the body was lowered by at most "
        f"{lowered:.1f} cm",
        joints=tuple(plan.target.joint_names[ankle] for ankle in ankles),
        values={
            "contacts": count,
            "moved_m": most,
            "slide_before_m": planted.slide_before_m,
            "slide_after_m": planted.slide_after_m,
            "lowered_m": planted.lowered_m,
        },
    )
