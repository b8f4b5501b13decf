"""Limbs of two bones, such as arms and legs, and the targets that such a limb can meet without other joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.editing.inverse_kinematics.targets import OrientationTarget, PositionTarget, Target
from marey_motion.rigs import JointAxes, JointMapping
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import Skeleton

LIMBS = (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
"""Standard joints of limbs with two bones, from top to end, without the side."""


@dataclass(frozen=True)
class TwoBoneLimb:
    """A chain of two bones, such as an arm or a leg; joints between its three joints keep their local rotations.

    Parameters
    ----------
    start, middle, end : indices of shoulder, elbow, wrist, or hip, knee, ankle
    hinge : unit axis about which the limb bends, in the frame of the middle joint. It is used where the limb is nearly
        straight or a little overstretched, because such a pose does not define an axis; if None, an arbitrary axis is
        used there
    """

    start: int
    middle: int
    end: int
    hinge: tuple[float, float, float] | None = None

    @property
    def joints(self) -> tuple[int, int, int]:
        """Indices of the three joints: end, middle, start."""
        return self.end, self.middle, self.start


def limb_ending_at(
    skeleton: Skeleton, mapping: JointMapping, joint: int, axes: Mapping[str, JointAxes] | None = None
) -> TwoBoneLimb | None:
    """Find the arm or leg whose wrist or ankle is a given joint.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    mapping : JointMapping    standard joints of the skeleton
    joint : int    index of the joint
    axes : mapping of str to JointAxes, optional    axes by joint name (`rigs.guess_axes`); if None, the bending
        direction of straight limbs is unknown

    Returns
    -------
    TwoBoneLimb or None    None if the joint is not the wrist or ankle of a limb whose three joints are mapped
    """
    for side in SIDES:
        for root, middle, end in LIMBS:
            names = [mapping.joints.get(f"{side}_{part}") for part in (root, middle, end)]
            if None in names or skeleton.joint_names[joint] != names[2]:
                continue
            top, mid = (skeleton.index_of(str(name)) for name in names[:2])
            swing = None if axes is None else axes[str(names[1])].swing
            # Knees bend about their swing axis, elbows stretch about it.
            hinge = swing if swing is None or middle == "elbow" else (-swing[0], -swing[1], -swing[2])
            return TwoBoneLimb(top, mid, joint, hinge)
    return None


def straight_hinge(
    skeleton: Skeleton, mapping: JointMapping, joint: int, axes: JointAxes
) -> tuple[JointAxes, NDArray[np.float64]]:
    """Find the rotation of a hinge at angle 0, and the axis about which its angle is positive.

    The angle of a knee or an elbow is its bend on every skeleton: 0 in a straight limb, whether or not the limb is
    straight in the rest pose, and positive in the natural direction. Other joints are at 0 in the rest pose.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    mapping : JointMapping    its standard joints
    joint : int    index of the hinge
    axes : JointAxes    axes of the hinge, a result of `rigs.guess_axes`

    Returns
    -------
    axes : JointAxes    the given axes; for an elbow, the swing axis is reversed, so that positive angles bend the limb
    reference : (4,) float64    local rotation at angle 0
    """
    rest = skeleton.rest_rotations[joint].astype(np.float64)
    for side in SIDES:
        for start, middle, end in LIMBS:
            names = [mapping.joints.get(f"{side}_{part}") for part in (start, middle, end)]
            if None in names or skeleton.joint_names[joint] != names[1]:
                continue
            bend = np.array(axes.swing if middle == "knee" else np.negative(axes.swing))
            first, last = (skeleton.index_of(str(names[end])) for end in (0, 2))
            places = skeleton.rest_global_positions.astype(np.float64)
            upper, lower = places[joint] - places[first], places[last] - places[joint]
            hinge = quaternions.rotate_vectors(skeleton.rest_global_rotations[joint].astype(np.float64), bend)
            angle = np.arctan2(np.cross(upper, lower) @ hinge, upper @ lower)
            x, y, z = (float(component) for component in bend)
            straight = quaternions.multiply(rest, quaternions.from_rotation_vector(-angle * bend))
            return JointAxes(axes.twist, (x, y, z)), np.asarray(straight, dtype=np.float64)
    return axes, rest


def limb_targets(
    targets: Sequence[Target], limb: TwoBoneLimb | None
) -> tuple[PositionTarget, OrientationTarget | None] | None:
    """Select the targets that the closed form for two bones can meet: position and orientation of a limb's end.

    Parameters
    ----------
    targets : sequence of targets    all targets
    limb : TwoBoneLimb or None    the limb

    Returns
    -------
    (PositionTarget, OrientationTarget or None) or None    None if there is no limb, if the position is not given in all
        axes, or if there are other targets
    """
    positions = [target for target in targets if isinstance(target, PositionTarget)]
    orientations = [target for target in targets if isinstance(target, OrientationTarget)]
    fits = len(positions) == 1 and len(orientations) <= 1 and len(positions) + len(orientations) == len(targets)
    if limb is None or not fits or len(set(positions[0].axes)) < 3 or {t.joint for t in targets} != {limb.end}:
        return None
    return positions[0], orientations[0] if orientations else None
