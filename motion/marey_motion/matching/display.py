"""Displayed motion of a trial: chosen poses, blended by inertialisation and placed at the recorded root positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.kinematics import as_kernel_input, forward_kinematics
from marey_motion.matching.body import JointChain
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.inertialisation import decay_matrix
from marey_motion.matching.record import TrialRecord
from marey_schemas.options.matching import ControllerOptions


def displayed_clip(database: MatchingDatabase, record: TrialRecord, options: ControllerOptions) -> Clip:
    """Make a clip that shows a trial: joints are inertialised at every switch; the root has the recorded positions.

    Parameters
    ----------
    database : MatchingDatabase    the database that the trial used
    record : TrialRecord    T ticks
    options : ControllerOptions    options of the trial

    Returns
    -------
    Clip    T frames
    """
    joints = np.arange(database.body.skeleton.joint_count)
    poses, places = _inertialised(database, record.rows, joints, options.half_life_s)
    half = 0.5 * record.headings
    zero = np.zeros_like(half)
    facing = np.stack((np.cos(half), zero, np.sin(half), zero), axis=-1)
    poses[:, :3] = quaternions.rotate_vectors(facing, poses[:, :3])
    poses[:, (0, 2)] += record.positions
    poses[:, 3:7] = quaternions.multiply(facing, poses[:, 3:7])
    rotations = quaternions.unroll(poses[:, 3:].reshape(len(poses), -1, 4))
    poses[:, 3:] = rotations.reshape(len(poses), -1)
    return Clip(
        database.body.skeleton,
        record.rate_hz,
        poses.astype(np.float32),
        places.astype(np.float32) if database.translated_joints else None,
        database.translated_joints,
    )


def posed_rows(database: MatchingDatabase, rows: NDArray[np.int64]) -> Clip:
    """Make a clip of single rows, without blending: the root of each row is at the origin and faces +Z.

    Parameters
    ----------
    database : MatchingDatabase    the database
    rows : (T,) int64    its rows to show

    Returns
    -------
    Clip    T frames
    """
    places = None if database.translations is None else database.translations[rows]
    return Clip(
        database.body.skeleton, database.options.rate_hz, database.poses[rows], places, database.translated_joints
    )


def pose_costs(database: MatchingDatabase, rows: NDArray[np.int32], options: ControllerOptions) -> Floats:
    """Compute the distances between the displayed pose and the next one.

    Both poses are in the frame of the root. The displayed pose includes the remaining offsets of earlier switches; the
    next pose has no offsets. The next pose is the pose of the row chosen for the next tick or, at the last tick, of the
    row that would follow (at the end of a clip, of the displayed row itself).

    Parameters
    ----------
    database : MatchingDatabase    the database that the trial used
    rows : (T,) int32    displayed rows
    options : ControllerOptions    options of the trial

    Returns
    -------
    (T,) float64    metres, summed over the pose joints
    """
    points = displayed_points(database, rows, database.body.pose_chain, options)
    after = database.root_motion.successors[rows[-1]]
    following = np.append(rows[1:], after if after >= 0 else rows[-1])
    distances: Floats = np.linalg.norm(points - database.pose_points[following], axis=-1).sum(axis=-1)
    return distances


def displayed_points(
    database: MatchingDatabase, rows: NDArray[np.int32], chain: JointChain, options: ControllerOptions
) -> Floats:
    """Compute the displayed positions of joints, including the remaining offsets of earlier switches.

    Parameters
    ----------
    database : MatchingDatabase    the database that the trial used
    rows : (T,) int32    displayed rows
    chain : JointChain    the joints, with their ancestors
    options : ControllerOptions    options of the trial

    Returns
    -------
    (T, P, 3) float64    positions of the chain's ends in the frame of the root, metres
    """
    poses, places = _inertialised(database, rows, chain.joints, options.half_life_s)
    moved = np.flatnonzero(np.isin(chain.joints, database.translated_joints))
    shown = forward_kinematics(chain.skeleton, poses, translations=places, translated_joints=tuple(moved.tolist()))
    return np.asarray(shown[:, chain.ends], dtype=np.float64)


def switched_rows(database: MatchingDatabase, rows: NDArray[np.int32]) -> NDArray[np.int64]:
    """Find, for each tick, the row to which a search switched.

    The successor of the chosen row is displayed at the next tick.

    Parameters
    ----------
    database : MatchingDatabase    the database that the trial used
    rows : (T,) int32    displayed rows

    Returns
    -------
    (T,) int64    row to which the search at each tick switched; -1 for ticks at which the clip was continued
    """
    successors = database.root_motion.successors
    following = rows[1:].astype(np.int64)
    clips = np.searchsorted(database.starts, following, side="right") - 1
    first = following == database.starts[clips]
    chosen = np.where(first, database.starts[clips + 1], following) - 1  # before a clip's first row comes its last
    cuts = np.full(len(rows), -1, dtype=np.int64)
    cuts[:-1] = np.where(successors[rows[:-1]] == following, -1, chosen)
    return cuts


def _inertialised(
    database: MatchingDatabase, rows: NDArray[np.int32], joints: NDArray[np.int64], half_life_s: float
) -> tuple[Floats, Floats]:
    """Compute displayed poses (T, 3 + 4·K) of K joints, and local translations (T, M, 3) of M of these joints.

    `rows` (T,) are the displayed rows of the database. The poses are in the frame of the simulation root.
    """
    from marey_motion.matching import display_kernels

    rate_hz = database.options.rate_hz
    moved = np.flatnonzero(np.isin(database.translated_joints, joints))
    translations = database.translations
    if translations is None:
        translations = np.empty((database.row_count, 0, 3), dtype=np.float32)
    shown = np.empty((len(rows), 3 + 4 * len(joints)))
    places = np.empty((len(rows), len(moved), 3))
    display_kernels.inertialised(
        as_kernel_input(database.poses),
        as_kernel_input(translations),
        database.root_motion.successors,
        joints,
        moved,
        rows,
        switched_rows(database, rows),
        decay_matrix(half_life_s, 1.0 / rate_hz),
        rate_hz,
        shown,
        places,
    )
    return shown, places
