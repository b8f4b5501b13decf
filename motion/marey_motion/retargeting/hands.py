"""Hands of a retargeted clip: they are moved to the positions of the source's hands, scaled to the target."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.clip import Clip
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb
from marey_motion.editing.inverse_kinematics.solving import solve_two_bone
from marey_motion.editing.inverse_kinematics.targets import PositionTarget
from marey_motion.editing.kept_feet import MOST_LIFTS, SUNK_M
from marey_motion.importing.checks import CheckWarning
from marey_motion.motion import Motion
from marey_motion.retargeting.floor import Floor, depths_below_floor
from marey_motion.retargeting.planning import RetargetPlan
from marey_motion.rigs.standard import SIDES
from marey_schemas.options.retargeting import HandsFrom

ELBOW_DAMPING_RAD = math.radians(10.0)
"""Bend of an elbow, in radians, below which the stretching of the arm is damped."""


class CorrectedHands(NamedTuple):
    """A clip whose hands have the scaled positions of the source's hands, and a finding about the changes."""

    clip: Clip
    check: CheckWarning


class _Arms(NamedTuple):
    """Positions (F, 2, 3) of both shoulders, elbows and wrists, metres."""

    shoulders: Floats
    elbows: Floats
    wrists: Floats

    @classmethod
    def of(cls, points: AnyFloats, joints: dict[str, int]) -> _Arms:
        """Select the joints by their standard names from positions (F, J, 3)."""
        return cls(
            *(
                points[:, [joints[f"{side}_{joint}"] for side in SIDES]].astype(np.float64)
                for joint in ("shoulder", "elbow", "wrist")
            )
        )

    @property
    def middle(self) -> Floats:
        """Middle (F, 3) of the shoulders."""
        return np.asarray(self.shoulders.mean(axis=1))

    @property
    def arm_m(self) -> float:
        """Mean length of the two arms, in metres."""
        bones = ((self.shoulders, self.elbows), (self.elbows, self.wrists))
        return sum(float(np.linalg.norm(a - b, axis=-1).mean()) for a, b in bones)

    @property
    def reach_m(self) -> float:
        """Distance, in metres, of a hand from the middle of the shoulders if the arms are stretched out sideways."""
        return self.arm_m + 0.5 * float(np.linalg.norm(self.shoulders[:, 0] - self.shoulders[:, 1], axis=-1).mean())


def keep_hands(source: Clip, result: Clip, plan: RetargetPlan, about: HandsFrom, floor: Floor | None) -> CorrectedHands:
    """Move the hands of a retargeted clip to the scaled positions of the source's hands.

    If `about` is "shoulders", the vector from the middle of the shoulders to a hand is that of the source, times a
    constant scale. The scale is the smaller of two ratios of target to source: the ratio of the arm lengths, and the
    ratio of the sideways reaches. So hands are within reach in front of the body and beside it. If `about` is "world",
    the world positions of the source's hands are scaled like the path of the pelvis; they may be out of reach.

    Shoulders and elbows turn; hands keep their orientations in the world. Elbows that nearly stretch are damped, so
    that they do not snap. Hands that would be below the floor are lifted to the floor.

    Parameters
    ----------
    source : Clip    F frames of the plan's source skeleton
    result : Clip    F frames of its target skeleton
    plan : RetargetPlan    joints, scale and limbs
    about : str    point from which positions are scaled: "shoulders" or "world"
    floor : Floor or None    floor below which no hand is moved; None if it is not known

    Returns
    -------
    CorrectedHands    F frames, with the hands moved

    Raises
    ------
    MappingError    if not both arms are mapped in both skeletons
    """
    limbs = plan.both_limbs("wrist")
    motion = Motion.of(result)
    before = _Arms.of(kinematics.global_positions(source), plan.source_joints)
    after = _Arms.of(motion.positions(plan.target), plan.target_joints)
    if about == "world":
        scale, targets = plan.scale, plan.scale * before.wrists
    else:
        scale = min(after.arm_m / before.arm_m, after.reach_m / before.reach_m)
        targets = after.middle[:, None] + scale * (before.wrists - before.middle[:, None])
    kept = _reached(motion, targets, plan, limbs)
    asked, lifted = targets, 0.0
    if floor is not None:
        points = kinematics.global_positions(source, end_sites=True)
        for _ in range(MOST_LIFTS):
            after_points = kinematics.global_positions(kept.as_clip(plan.target, 1.0), end_sites=True)
            depths = depths_below_floor(points, after_points, plan, floor, "wrist")
            if depths.max() <= SUNK_M:
                break
            targets = targets + depths[..., None] * (0.0, 1.0, 0.0)
            kept = _reached(motion, targets, plan, limbs)
        lifted = float((targets - asked)[..., 1].max())
    made = _Arms.of(kept.positions(plan.target), plan.target_joints)
    moved, missed = (float(np.linalg.norm(one - made.wrists, axis=-1).max()) for one in (after.wrists, targets))
    check = _check(moved, missed, lifted, scale, plan, limbs)
    return CorrectedHands(kept.as_clip(plan.target, source.frame_rate_hz), check)


def _reached(motion: Motion, targets: Floats, plan: RetargetPlan, limbs: Sequence[TwoBoneLimb]) -> Motion:
    """Move both wrists to their targets (F, 2, 3), or towards targets that the arms do not reach."""
    for side, limb in enumerate(limbs):
        motion = solve_two_bone(
            plan.target,
            motion,
            limb,
            PositionTarget(limb.end, targets[:, side]),
            ending="held",
            damping_zone_rad=ELBOW_DAMPING_RAD,
        ).motion
    return motion


def _check(
    moved: float, missed: float, lifted: float, scale: float, plan: RetargetPlan, limbs: tuple[TwoBoneLimb, ...]
) -> CheckWarning:
    return CheckWarning(
        "hands-kept",
        f"hands were moved by up to {100.0 * moved:.1f} cm to the positions of the source's hands, scaled by "
        f"{scale:.2f}; they miss these positions by at most {100.0 * missed:.1f} cm"
        + (f"; they were lifted to the floor by up to {100.0 * lifted:.1f} cm" if lifted else ""),
        joints=tuple(plan.target.joint_names[limb.end] for limb in limbs),
        values={"moved_m": moved, "missed_m": missed, "lifted_m": lifted, "scale": scale},
    )
