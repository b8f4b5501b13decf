"""Rows that a clip adds to a matching database: poses relative to the simulation root, and features."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics, quaternions
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.looping import LoopSeam, about_vertical, continue_motion
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.features import FeatureLayout, extract_features, in_root_frame, look_ahead
from marey_motion.matching.simulation_root import (
    DIRECTION_WINDOW_S,
    SimulationRoot,
    bone_root,
    rest_heading,
    simulation_root,
    window_frames,
)
from marey_motion.motion import Motion
from marey_schemas.options.matching import DatabaseOptions

CLAMPED_S = 1 / 3
"""Duration, in seconds, of the end of a clip where searches may not choose rows, because the look-ahead is cut off.

With the end policy "trim", this duration is the longest horizon instead. A loop that wraps has no such end.
"""


class ClipRows(NamedTuple):
    """The rows that one clip adds to a `MatchingDatabase`, in arrays with the same names, shapes and units."""

    features: Floats
    selectable: NDArray[np.bool_]
    root_positions: Floats
    root_headings: Floats
    pose_points: NDArray[np.float32]
    poses: NDArray[np.float32]
    contacts: NDArray[np.bool_]
    translations: NDArray[np.float32]
    translated_joints: tuple[int, ...]


def clip_rows(
    motion: Motion, seam: LoopSeam | None, body: MatchingBody, layout: FeatureLayout, options: DatabaseOptions
) -> ClipRows:
    """Compute the rows of a motion at the database's rate.

    Parameters
    ----------
    motion : Motion    F frames
    seam : LoopSeam or None    seam of a loop that looks ahead to its own beginning
    body : MatchingBody    the joints
    layout : FeatureLayout    D dimensions
    options : DatabaseOptions    rate, root mode and end policy

    Returns
    -------
    ClipRows    F rows

    Raises
    ------
    MotionError    if no frame has a facing direction
    """
    rate_hz, frames = options.rate_hz, motion.frame_count
    # A loop is seen going on at both ends, so that filters and differences know nothing of a cut.
    padding = 0 if seam is None else window_frames(DIRECTION_WINDOW_S, rate_hz)
    whole = motion if seam is None else continue_motion(motion, seam, padding, padding)
    positions = whole.positions(body.skeleton)
    bone = options.root_mode == "bone"
    root = bone_root(whole, body) if bone else simulation_root(positions, body, rate_hz)
    velocities = np.asarray(kinematics.velocities(positions, rate_hz), dtype=np.float64)
    contacts = kinematics.foot_contacts(positions[:, list(body.toes)], rate_hz)
    inner = slice(padding, padding + frames)
    root = SimulationRoot(root.positions[inner], root.headings[inner])
    ticks = np.round(np.array(layout.horizons_s) * rate_hz).astype(np.int64)
    future = look_ahead(root, ticks, wraps=seam is not None)
    points = in_root_frame(positions[inner, list(body.pose_joints)], root)
    return ClipRows(
        features=extract_features(layout, positions[inner], velocities[inner], root, future),
        selectable=_selectable(frames, ticks, options, wraps=seam is not None),
        root_positions=root.positions,
        root_headings=root.headings,
        pose_points=points.astype(np.float32),
        poses=_poses(motion, positions[inner, [body.carrier]], root, body),
        contacts=contacts[inner],
        **_translations(motion, body),
    )


def _selectable(frames: int, ticks: NDArray[np.int64], options: DatabaseOptions, *, wraps: bool) -> NDArray[np.bool_]:
    ahead = int(ticks[-1]) if options.end_policy == "trim" else round(CLAMPED_S * options.rate_hz)
    return np.full(frames, True) if wraps else np.arange(frames) < frames - ahead


def _poses(motion: Motion, carrier: Floats, root: SimulationRoot, body: MatchingBody) -> NDArray[np.float32]:
    """Compute poses (F, 3 + 4·J) relative to the root, as `MatchingDatabase` describes them.

    `carrier` (F, 1, 3) is the position of the joint that carries the body.
    """
    poses = motion.poses
    rotations = poses[:, 3:].reshape(motion.frame_count, -1, 4)
    facing = about_vertical(-root.headings)
    poses[:, :3] = in_root_frame(carrier, root)[:, 0]
    if body.carrier == 0:
        rotations[:, 0] = quaternions.multiply(facing, motion.rotations[:, 0])
    else:
        _set_joints_above_carrier(poses, rotations, facing, motion, body)
    return poses.astype(np.float32)


def _set_joints_above_carrier(
    poses: Floats, rotations: Floats, facing: Floats, motion: Motion, body: MatchingBody
) -> None:
    """Set the joints above the carrier to their rest pose relative to the root, without moving the carrier.

    `rotations` (F, J, 4) is a view of the rotations in `poses`; both are changed in place. `facing` (F, 4) are the
    rotations from the world to the root's frame.
    """
    skeleton = body.skeleton
    above = skeleton.path_to_root(body.carrier)[1:]
    turned: AnyFloats = quaternions.identity(motion.frame_count)
    for joint in (*above[::-1], body.carrier):
        turned = quaternions.multiply(turned, motion.rotations[:, joint])
    unturn = about_vertical(np.array(-rest_heading(body)))
    parent = quaternions.multiply(unturn, skeleton.rest_global_rotations[above[0]])
    rest = skeleton.rest_global_positions
    poses[:, :3] -= quaternions.rotate_vectors(unturn, rest[body.carrier] - rest[0])
    rotations[:, above] = skeleton.rest_rotations[list(above)]
    rotations[:, 0] = quaternions.multiply(unturn, skeleton.rest_rotations[0])
    rotations[:, body.carrier] = quaternions.multiply(
        quaternions.conjugate(parent), quaternions.multiply(facing, turned)
    )


def _translations(motion: Motion, body: MatchingBody) -> dict[str, Any]:
    """Collect the local translations of all joints that are not on the path from joint 0 to the carrier.

    The position of joint 0 in the poses already includes the translations on this path. Returns the fields
    `translations` and `translated_joints` of `ClipRows`.
    """
    path = body.skeleton.path_to_root(body.carrier)
    joints = [joint for joint in motion.translated_joints if joint not in path]
    kept = [slot for slot, joint in enumerate(motion.translated_joints) if joint in joints]
    return {"translations": motion.translations[:, kept].astype(np.float32), "translated_joints": tuple(joints)}
