"""Bending angles of knees and elbows, and the angles by which they exceed an allowed range.

Knees and elbows can be measured on any skeleton, because their bending angle is the angle between two bones. The angles
of other joints depend on the pose in which a rig defines them as 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.rigs import JointAxes, JointMapping
from marey_motion.rigs.axes import rest_pose_doubts
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import Skeleton
from marey_schemas.options.quality import QualityOptions


class Hinge(NamedTuple):
    """Knee or elbow.

    Parameters
    ----------
    joint : "knee" or "elbow"
    start, middle, end : joint indices of hip, knee and ankle, or of shoulder, elbow and wrist
    axis : (3,) float64    axis, in the frame of `start`, about which the hinge bends in its natural direction; None if
        the axis is not known, so that the sign of the bending angle cannot be measured
    """

    joint: str
    start: int
    middle: int
    end: int
    axis: Floats | None


def find_hinges(skeleton: Skeleton, mapping: JointMapping, axes: Mapping[str, JointAxes]) -> tuple[Hinge, ...]:
    """Find the mapped knees and elbows of a skeleton.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    mapping : JointMapping    its standard joints
    axes : mapping of str to JointAxes    anatomical axes by joint name

    Returns
    -------
    tuple of Hinge    the hinges; knees have an axis if the rest pose shows it; elbows have none, because rigs twist the
        forearm in different joints
    """
    doubtful = rest_pose_doubts(skeleton, mapping)
    found = []
    for side in SIDES:
        for joint, start, end in (("knee", "hip", "ankle"), ("elbow", "shoulder", "wrist")):
            names = [mapping.joints.get(f"{side}_{one}") for one in (start, joint, end)]
            if None in names:
                continue
            first, middle, last = (skeleton.index_of(str(name)) for name in names)
            known = joint == "knee" and f"{side} leg" not in doubtful and names[0] in axes
            axis = np.asarray(axes[str(names[0])].swing) if known else None
            found.append(Hinge(joint, first, middle, last, axis))
    return tuple(found)


def bend_deg(hinge: Hinge, positions: Floats, rotations: Floats) -> Floats:
    """Compute the bend of a hinge: 0 when both bones are in one line.

    Parameters
    ----------
    hinge : Hinge    the hinge
    positions : (F, J, 3) float64    positions of the joints, metres
    rotations : (F, J, 4) float64    rotations of the joints in the world

    Returns
    -------
    (F,) float64    degrees, -180 to 180; negative where the hinge bends against its natural direction
    """
    upper = positions[:, hinge.middle] - positions[:, hinge.start]
    lower = positions[:, hinge.end] - positions[:, hinge.middle]
    across = np.cross(upper, lower)
    size = np.degrees(np.arctan2(np.linalg.norm(across, axis=-1), np.sum(upper * lower, axis=-1)))
    if hinge.axis is None:
        return np.asarray(size)
    axis = quaternions.rotate_vectors(rotations[:, hinge.start], np.broadcast_to(hinge.axis, upper.shape))
    return np.asarray(np.where(np.sum(across * axis, axis=-1) < 0.0, -size, size))


def limit_excess_deg(
    hinges: tuple[Hinge, ...], positions: Floats, rotations: Floats, options: QualityOptions
) -> Floats | None:
    """Compute the greatest angle by which any hinge exceeds its range in each frame.

    Parameters
    ----------
    hinges : tuple of Hinge    the hinges
    positions : (F, J, 3) float64    positions of the joints, metres
    rotations : (F, J, 4) float64    rotations of the joints in the world
    options : QualityOptions    the ranges

    Returns
    -------
    (F,) float64 or None    degrees, at least 0; None without hinges
    """
    if not hinges:
        return None
    excess = []
    for hinge in hinges:
        bend = bend_deg(hinge, positions, rotations)
        least, most = (options.knee_least_deg, options.knee_most_deg) if hinge.joint == "knee" else (
            -180.0, options.elbow_most_deg
        )  # fmt: skip
        excess.append(np.maximum(np.maximum(bend - most, least - bend), 0.0))
    return np.asarray(np.max(excess, axis=0))
