"""Selection of the joints and canonical frames that constraints need, in the motions of a primitive.

The value of a spline at a fixed time is linear in the scores, so each channel of a joint costs one product with
precomputed numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MappingError
from marey_motion.modelling.primitive import MotionPrimitive

LEFTS, RIGHTS = ("left_hip", "left_shoulder"), ("right_hip", "right_shoulder")
"""Standard joints of both sides; the vectors from right to left joints give the direction that the body faces."""


class Tracked(NamedTuple):
    """A joint at a canonical frame, or a difference of joints.

    Parameters
    ----------
    frame : canonical frame
    joints : joints whose positions are added; the rotation of the first one is tracked
    minus : joints whose positions are subtracted, the same number as in `joints`; empty for a single joint
    """

    frame: float
    joints: tuple[int, ...]
    minus: tuple[int, ...] = ()


class Chains(NamedTuple):
    """Arrays from which n tracked points are computed for a latent vector.

    V is the number of joints that the points need, where a joint is counted once for each canonical frame; X is the
    number of channels of all these joints.

    Parameters
    ----------
    mean, directions : (X,), (k, X) mean channels, and their change per unit of each spatial score
    columns : (V,) first channel of each joint's quaternion; a root's translation precedes it
    parents : (V,) index of the parent among the V joints, -1 for roots
    offsets : (V, 3) metres
    term_starts, term_nodes, term_signs : (n + 1,), (t,), (t,) the joints whose positions make up each point
    held : (n,) 1 if the point is a position, which the placement turns and shifts; 0 if it is a difference of
        positions, which the placement only turns
    turned : (n,) the joint whose rotation is tracked with each point, as an index among the V joints
    """

    mean: Floats
    directions: Floats
    columns: Ints
    parents: Ints
    offsets: Floats
    term_starts: Ints
    term_nodes: Ints
    term_signs: Floats
    held: Floats
    turned: Ints


class Clocks(NamedTuple):
    """Arrays from which the time of n canonical frames, in seconds, is computed for a latent vector.

    A model has N canonical frames. A step is the time between two consecutive canonical frames, in frames of the
    motion.

    Parameters
    ----------
    mean, directions : (N - 1,), (k, N - 1) mean logarithms of the steps, and their change per unit of each temporal
        number of a latent vector
    weights : (n, N - 1) factors by which the steps are multiplied; their sum is the time, in seconds, at each of the n
        canonical frames
    frame_s : seconds of one frame
    range_s : (2,) shortest and longest duration of a motion; a longer or shorter motion is played faster or slower as a
        whole
    log_slope_bounds : (2,) limits to which logarithms of steps are clipped
    """

    mean: Floats
    directions: Floats
    weights: Floats
    frame_s: float
    range_s: Floats
    log_slope_bounds: Floats


def body_place(frame: float, standard_joints: Mapping[str, int]) -> Tracked:
    """Choose the point that represents the position of the body: the pelvis, or else the root.

    Parameters
    ----------
    frame : float    canonical frame
    standard_joints : mapping of str to int    joint index by standard name

    Returns
    -------
    Tracked    the joint at that frame
    """
    return Tracked(frame, (standard_joints.get("pelvis", 0),))


def facing(frame: float, standard_joints: Mapping[str, int]) -> Tracked:
    """Choose the points that give the body's axis from right to left.

    Parameters
    ----------
    frame : float    canonical frame
    standard_joints : mapping of str to int    joint index by standard name

    Returns
    -------
    Tracked    a difference of joints at that frame

    Raises
    ------
    MappingError    if hips or shoulders are not known
    """
    missing = [name for name in (*LEFTS, *RIGHTS) if name not in standard_joints]
    if missing:
        raise MappingError(
            f"a constraint on the heading, or a sequence of steps, needs {', '.join(missing)}, which the joint "
            "mapping of the skeleton does not contain; add them to the mapping"
        )
    lefts, rights = (tuple(standard_joints[name] for name in side) for side in (LEFTS, RIGHTS))
    return Tracked(frame, lefts, rights)


def track_points(primitive: MotionPrimitive, tracked: Sequence[Tracked]) -> Chains:
    """Prepare the joints that move tracked points, with the channels of these joints at the requested canonical frames.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    tracked : sequence of Tracked    n points

    Returns
    -------
    Chains    arrays for compiled code
    """
    nodes = _nodes(primitive, tracked)
    places = {node: place for place, node in enumerate(nodes)}
    frames = sorted({frame for frame, _ in nodes})
    mean, directions, columns = [], [], []
    width = 0
    for frame in frames:
        joints = [joint for at, joint in nodes if at == frame]
        channels = np.array([0, 1, 2, *(3 + 4 * joint + part for joint in joints for part in range(4))])
        row = primitive.spatial.basis.matrix([frame])[0]
        used = np.flatnonzero(row)
        mean.append(row[used] @ primitive.spatial.mean[np.ix_(used, channels)])
        directions.append(np.tensordot(primitive.spatial.directions[:, used][:, :, channels], row[used], axes=(1, 0)))
        columns += [width + 3 + 4 * place for place in range(len(joints))]
        width += len(channels)
    parents = primitive.skeleton.parents.tolist()
    terms = [[places[one.frame, joint] for joint in (*one.joints, *one.minus)] for one in tracked]
    return Chains(
        mean=_joined(mean, (0,)),
        directions=np.ascontiguousarray(_joined(directions, (primitive.spatial.count, 0))),
        columns=np.array(columns, dtype=np.int64),
        parents=np.array([places.get((frame, parents[joint]), -1) for frame, joint in nodes], dtype=np.int64),
        offsets=primitive.skeleton.offsets[[joint for _, joint in nodes]].reshape(-1, 3),
        term_starts=np.cumsum([0, *map(len, terms)], dtype=np.int64),
        term_nodes=np.array([place for one in terms for place in one], dtype=np.int64),
        term_signs=np.array([sign for one in tracked for sign in (*[1.0] * len(one.joints), *[-1.0] * len(one.minus))]),
        held=np.array([float(not one.minus) for one in tracked]),
        turned=np.array([places[one.frame, one.joints[0]] for one in tracked], dtype=np.int64),
    )


def track_times(primitive: MotionPrimitive, moments: Sequence[float]) -> Clocks:
    """Prepare arrays from which the times of canonical frames are computed for a latent vector.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    moments : sequence of float    n canonical frames

    Returns
    -------
    Clocks    arrays for compiled code
    """
    temporal = primitive.temporal
    steps = np.arange(primitive.frame_count - 1)
    passed = np.clip(np.asarray(moments, dtype=np.float64)[:, None] - steps, 0.0, 1.0)
    directions = np.tensordot(temporal.directions[..., 0], temporal.basis.at_frames, axes=(1, 1))
    return Clocks(
        mean=temporal.basis.at_frames @ temporal.mean[:, 0],
        directions=np.ascontiguousarray(directions / primitive.temporal_weight),
        weights=np.ascontiguousarray(passed / primitive.frame_rate_hz).reshape(len(moments), len(steps)),
        frame_s=1.0 / primitive.frame_rate_hz,
        range_s=np.array(primitive.duration_range_s or (0.0, np.inf)),
        log_slope_bounds=np.array(primitive.log_slope_bounds),
    )


def _nodes(primitive: MotionPrimitive, tracked: Sequence[Tracked]) -> list[tuple[float, int]]:
    """List the pairs of frame and joint that are needed: tracked joints and their ancestors, sorted."""
    found = {
        (one.frame, carrier)
        for one in tracked
        for joint in (*one.joints, *one.minus)
        for carrier in primitive.skeleton.path_to_root(joint)
    }
    return sorted(found)


def _joined(pieces: list[Floats], empty: tuple[int, ...]) -> Floats:
    return np.concatenate(pieces, axis=-1) if pieces else np.zeros(empty)
