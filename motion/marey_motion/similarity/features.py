"""Features of poses for searches by example: inputs of the perceptual metric, at one frame rate for all clips.

A row of features belongs to one pose. It holds the positions and velocities of 15 standard joints and the rotations of
11 of them. Place and heading are removed as in `perception.measuring`. Rotations are relative to the rest pose, in the
axes of the body, so that skeletons with different joint axes can be compared. For two poses of one skeleton, the angles
between these rotations equal those of the metric.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats, Flags, Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_directions, headings
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.perception.measuring import MeasuredClip, measure_motion
from marey_motion.perception.metric import JOINT_CLASSES
from marey_schemas.documents.metrics import WITHOUT_ANGLES

INDEX_RATE_HZ = 30.0
"""Rows of features per second, in all clips. By default, the metric also measures velocities per 1/30 s."""
JOINTS = tuple(joint for joints in JOINT_CLASSES.values() for joint in joints)
ROTATED_JOINTS = tuple(joint for name in JOINT_CLASSES if name not in WITHOUT_ANGLES for joint in JOINT_CLASSES[name])
VECTORS = 2 * len(JOINTS)
"""Number of vectors of a row: positions, then velocities."""
ROTATIONS_AT = 3 * VECTORS
WIDTH = ROTATIONS_AT + 4 * len(ROTATED_JOINTS)
"""Numbers in a row of features: positions (m), velocities (m/s), rotations (unit quaternions)."""
_ROUNDED_FRAMES = 1e-6

Rows = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PoseFeatures:
    """Features of n poses of one clip.

    Parameters
    ----------
    rows : (n, WIDTH) float32    features; joints that the skeleton lacks have zero vectors and identity rotations
    present : (15,) bool    which of `JOINTS` the skeleton has
    """

    rows: Rows
    present: Flags


def clip_features(motion: Motion, body: MatchingBody, rate_hz: float) -> PoseFeatures:
    """Compute the features of a whole clip at `INDEX_RATE_HZ`.

    Parameters
    ----------
    motion : Motion    F frames
    body : MatchingBody    body of its skeleton
    rate_hz : float    frames per second

    Returns
    -------
    PoseFeatures    the first row is the first frame of the clip

    Raises
    ------
    MotionError    if no frame has a facing direction, the skeleton has no joint class, or a feature is not finite
    """
    count = int((motion.frame_count - 1) * INDEX_RATE_HZ / rate_hz + _ROUNDED_FRAMES) + 1
    return features_at(motion, body, rate_hz, np.arange(count) * (rate_hz / INDEX_RATE_HZ))


def features_at(motion: Motion, body: MatchingBody, rate_hz: float, times: AnyFloats) -> PoseFeatures:
    """Compute the features of poses at some times of a clip.

    Parameters
    ----------
    motion : Motion    F frames, with a second before and after the times as far as the clip has it: headings are
        smoothed over time, and velocities are differences of frames
    body : MatchingBody    body of its skeleton
    rate_hz : float    frames per second
    times : (n,) float64    fractional frames of the motion

    Returns
    -------
    PoseFeatures    n rows

    Raises
    ------
    MotionError    if no frame has a facing direction, the skeleton has no joint class, or a feature is not finite
    """
    measured = measure_motion(motion, body, rate_hz).at(np.asarray(times, np.float64))
    columns = _columns(measured, body)
    rows = np.zeros((len(times), WIDTH), np.float32)
    vectors = rows[:, :ROTATIONS_AT].reshape(len(times), 2, len(JOINTS), 3)
    vectors[:, 0, columns], vectors[:, 1, columns] = measured.positions, measured.velocities
    turns = rows[:, ROTATIONS_AT:].reshape(len(times), len(ROTATED_JOINTS), 4)
    turns[:, :, 0] = 1.0
    for point, column in enumerate(columns):
        if JOINTS[column] in ROTATED_JOINTS:
            joint = body.standard_joints[JOINTS[column]]
            turned = _from_rest(measured.rotations[:, point], body, joint)
            turns[:, ROTATED_JOINTS.index(JOINTS[column])] = turned
    if not np.isfinite(rows).all():
        raise MotionError(
            "the motion contains numbers that are not finite, or too large for float32; repair the clip",
            code="not-finite",
        )
    present = np.zeros(len(JOINTS), np.bool_)
    present[columns] = True
    return PoseFeatures(rows, present)


def mirrored(features: PoseFeatures) -> PoseFeatures:
    """Exchange left and right: reflect poses in the vertical plane of their heading.

    Parameters
    ----------
    features : PoseFeatures    n rows

    Returns
    -------
    PoseFeatures    n rows
    """
    rows = features.rows
    vectors = rows[:, :ROTATIONS_AT].reshape(len(rows), 2, len(JOINTS), 3)[:, :, _partners(JOINTS)]
    turns = rows[:, ROTATIONS_AT:].reshape(len(rows), len(ROTATED_JOINTS), 4)[:, _partners(ROTATED_JOINTS)]
    reflected = (vectors * np.array([-1, 1, 1], np.float32), turns * np.array([1, 1, -1, -1], np.float32))
    return PoseFeatures(
        np.concatenate([one.reshape(len(rows), -1) for one in reflected], axis=1), features.present[_partners(JOINTS)]
    )


def _partners(joints: tuple[str, ...]) -> list[int]:
    swapped = {"left": "right", "right": "left"}
    names = ["_".join(swapped.get(part, part) for part in joint.split("_")) for joint in joints]
    return [joints.index(name) for name in names]


def _columns(measured: MeasuredClip, body: MatchingBody) -> Ints:
    """Return the index in `JOINTS` of each measured joint."""
    known = [joint for name in measured.classes for joint in JOINT_CLASSES[name] if joint in body.standard_joints]
    return np.array([JOINTS.index(joint) for joint in known])


def _from_rest(rotations: Floats, body: MatchingBody, joint: int) -> NDArray[Any]:
    """Express local rotations (F, 4) relative to the rest pose, in axes in which the rest pose faces +z.

    With G the global rotations at rest, the result is G_parent · rotation · G_joint⁻¹. Both factors are constant, so
    the angle between two rotations of a joint is unchanged.
    """
    rest = body.skeleton.rest_global_rotations
    parent = int(body.skeleton.parents[joint])
    ahead = _rest_heading(body)
    facing = np.array([np.cos(ahead / 2), 0.0, np.sin(ahead / 2), 0.0])
    before = rest[parent] if parent >= 0 else np.array([1.0, 0.0, 0.0, 0.0])
    outer = quaternions.multiply(quaternions.conjugate(facing), before)
    inner = quaternions.multiply(quaternions.conjugate(rest[joint]), facing)
    return quaternions.multiply(quaternions.multiply(outer, rotations), inner)


def _rest_heading(body: MatchingBody) -> float:
    """Compute the heading of the rest pose in radians; 0 if it has no heading, such as a body that lies on its side."""
    try:
        facing = forward_directions(body.skeleton.rest_global_positions[None], body.lefts, body.rights)
    except MotionError:
        return 0.0
    return float(headings(facing)[0])
