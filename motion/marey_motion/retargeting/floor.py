"""The floor of a retargeted clip: how much deeper its hands and feet are below the floor than those of the source."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marey_motion.arrays import AnyFloats, Floats
from marey_motion.editing.ground import sole_heights
from marey_motion.importing.checks import CheckWarning
from marey_motion.retargeting.planning import RetargetPlan
from marey_motion.rigs.standard import SIDES

BELOW_M = 0.03
"""Depth of a hand or foot below the floor, in metres, above which the result has a warning."""
_KINDS = {"ankle": ("foot", "keep_feet"), "wrist": ("hand", "keep_hands")}


class Floor(NamedTuple):
    """Height of the floor in source and result, in metres: the height of the soles while the source stands."""

    source_m: float
    result_m: float


def depths_below_floor(before: AnyFloats, after: AnyFloats, plan: RetargetPlan, floor: Floor, end: str) -> Floats:
    """Compute how much deeper hands or feet of a result are below the floor than those of the source.

    The height of the floor is that of the soles, and a hand on the ground may be a little lower. Therefore, the depth
    of the source's hand or foot, times the scale, is allowed and subtracted.

    Parameters
    ----------
    before, after : (F, n, 3)    positions of joints and end sites in source and result, metres
    plan : RetargetPlan    joints and scale
    floor : Floor    height of the floor
    end : str    "wrist" or "ankle"

    Returns
    -------
    (F, 2) float64    depths of left and right, metres; 0 if not deeper than allowed
    """
    ends = [[joints[f"{side}_{end}"] for side in SIDES] for joints in (plan.source_joints, plan.target_joints)]
    allowed = np.maximum(floor.source_m - sole_heights(before, plan.source, ends[0]), 0.0)
    depths = floor.result_m - sole_heights(after, plan.target, ends[1])
    return np.asarray(np.maximum(depths - plan.scale * allowed, 0.0), dtype=np.float64)


def warn_below_floor(before: AnyFloats, after: AnyFloats, plan: RetargetPlan, floor: Floor) -> CheckWarning | None:
    """Warn if hands or feet are deeper below the floor than in the source (see `depths_below_floor`).

    Parameters
    ----------
    before, after : (F, n, 3)    positions of joints and end sites in source and result, metres
    plan : RetargetPlan    joints and scale
    floor : Floor    height of the floor

    Returns
    -------
    CheckWarning or None    None if no hand or foot is deeper than in the source by more than `BELOW_M`
    """
    places, joints, values, deep = [], [], {}, np.zeros(len(after), dtype=np.bool_)
    for end, (part, option) in _KINDS.items():
        if not all(f"{side}_{end}" in plan.target_joints for side in SIDES):
            continue
        depths = depths_below_floor(before, after, plan, floor, end)
        if depths.max() <= BELOW_M:
            continue
        frame, side = np.unravel_index(int(np.argmax(depths)), depths.shape)
        places.append(
            f"the {SIDES[int(side)]} {part} is up to {100.0 * depths.max():.1f} cm below it, in frame {frame} "
            f"({option} keeps it on the floor as far as the limb can)"
        )
        joints.append(plan.target.joint_names[plan.target_joints[f"{SIDES[int(side)]}_{end}"]])
        values[f"{part}_m"] = float(depths.max())
        deep |= (depths > BELOW_M).any(axis=1)
    if not places:
        return None
    frames = np.flatnonzero(deep)
    return CheckWarning(
        "below-floor",
        f"a part of the body is below the floor on which the source stands: {'; '.join(places)}",
        joints=tuple(joints),
        frames=(int(frames[0]), int(frames[-1]) + 1),
        values=values,
    )
