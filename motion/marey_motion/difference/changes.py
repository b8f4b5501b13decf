"""Changes between matched frames of two clips: of joint rotations, of the path of the body, and of translations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import CM_PER_M, Flags, Floats, Ints
from marey_motion.looping import rotated
from marey_schemas.documents.differences import JointChange, PathChange, PathMove, Range

NOISE_DEG = 0.01
"""Largest change of a rotation, in degrees, that is attributed to rounding."""
NOISE_CM = 0.01
"""Largest change of a position, in centimetres, that is attributed to rounding."""
JOINED_S = 0.1
"""Distance, in seconds, below which two ranges of frames are joined into one."""
POINT_M = 0.01
"""Extent in metres. A path of at most this extent counts as a point, whose turn cannot be measured."""
UNEXPLAINED = 0.1
"""Largest share of a path's mean change that may remain after a movement of the whole path is compensated.

If more remains, no such movement is reported.
"""
MOST_SPANS = 100
"""Maximum number of ranges in a list; if there are more, ranges are joined over the smallest gaps between them."""


class MatchedFrames(NamedTuple):
    """Frames of the new clip that are compared with frames of the old clip, and the rate of the new clip.

    Parameters
    ----------
    frames : (n,) int    increasing numbers of the matched frames of the new clip
    frame_rate_hz : float    frames per second of the new clip
    """

    frames: Ints
    frame_rate_hz: float


def spans_where(exceeds: Flags, matched: MatchedFrames) -> tuple[Range, ...]:
    """List the ranges of frames of the new clip in which a change exceeds a threshold.

    Parameters
    ----------
    exceeds : (n,) bool    whether the change in each matched frame exceeds the threshold
    matched : MatchedFrames    the matched frames of the new clip

    Returns
    -------
    tuple of ranges    frames of the new clip, half open and in order; ranges less than `JOINED_S` seconds apart are
        joined. If there would be more than `MOST_SPANS` ranges, ranges that are farther apart are joined, too
    """
    frames = matched.frames[exceeds]
    if not len(frames):
        return ()
    gaps = np.diff(frames) - 1
    greatest = JOINED_S * matched.frame_rate_hz
    if np.count_nonzero((gaps >= greatest) & (gaps > 0)) >= MOST_SPANS:
        greatest = float(np.sort(gaps)[-MOST_SPANS]) + 1.0
    breaks = np.flatnonzero((gaps >= greatest) & (gaps > 0))
    starts, stops = np.concatenate(([0], breaks + 1)), np.concatenate((breaks, [len(frames) - 1]))
    return tuple(zip(frames[starts].tolist(), (frames[stops] + 1).tolist(), strict=True))


def joint_changes(
    names: Sequence[str], changes: NDArray[np.floating], matched: MatchedFrames, *, threshold: float, noise: float
) -> tuple[JointChange, ...]:
    """Describe the changes of each joint whose largest change exceeds the noise.

    Parameters
    ----------
    names : sequence of str    names of J joints
    changes : (n, J) float    change of each joint in each matched frame, in degrees or centimetres
    matched : MatchedFrames    the matched frames
    threshold : float    a frame is listed for a joint if the joint's change exceeds this value; unit of `changes`
    noise : float    a joint is left out if its largest change does not exceed this value; unit of `changes`

    Returns
    -------
    tuple of JointChange    the joint with the largest change first
    """
    if not len(changes):
        return ()
    largest = changes.max(axis=0)
    order = [joint for joint in np.argsort(-largest, kind="stable").tolist() if largest[joint] > noise]
    return tuple(
        JointChange(joint=names[joint], **_exceeding(changes[:, joint].astype(np.float64), matched, threshold))
        for joint in order
    )


def path_change(
    joint: str, before: Floats, after: Floats, matched: MatchedFrames, threshold_cm: float, move: Move | None
) -> PathChange | None:
    """Describe the change of a joint's path.

    Parameters
    ----------
    joint : str    joint whose path is compared
    before, after : (n, 3) float64    positions of the joint in matched frames, metres
    matched : MatchedFrames    the matched frames
    threshold_cm : float    a frame is listed if its two positions are farther apart than this distance, centimetres
    move : Move or None    movement of the whole path from `before` to `after`

    Returns
    -------
    PathChange or None    None if no frames match, or if all positions are equal, apart from rounding
    """
    distances = CM_PER_M * np.linalg.norm(after - before, axis=1)
    if not len(distances) or distances.max() <= NOISE_CM:
        return None
    moved = None
    if move is not None:
        remaining = CM_PER_M * np.linalg.norm(move.applied(before) - after, axis=1)
        shift = tuple((CM_PER_M * move.shift_m).tolist())
        moved = PathMove(turn_deg=float(np.degrees(move.turn_rad)), shift_cm=shift, remaining_cm=float(remaining.max()))
    return PathChange(joint=joint, moved=moved, **_exceeding(distances, matched, threshold_cm))


def _exceeding(changes: Floats, matched: MatchedFrames, threshold: float) -> dict[str, Any]:
    """Summarise changes (n,) in matched frames, as the fields that `JointChange` and `PathChange` have in common.

    The fields are the mean and the maximum of the changes, the frame of the maximum in the new clip, and the ranges of
    its frames in which the change exceeds the threshold.
    """
    at = int(np.argmax(changes))
    return {
        "mean": float(changes.mean()),
        "largest": float(changes[at]),
        "largest_at": int(matched.frames[at]),
        "spans": spans_where(changes > threshold, matched),
    }


class Move(NamedTuple):
    """Rigid movement in the world: a turn about the vertical axis through the origin, then a shift.

    Parameters
    ----------
    turn_rad : float    angle of the turn, positive to the left
    shift_m : (3,) float64    shift after the turn
    """

    turn_rad: float
    shift_m: Floats

    def applied(self, positions: Floats) -> Floats:
        """Apply the movement to positions.

        Parameters
        ----------
        positions : (n, 3) float64    metres

        Returns
        -------
        (n, 3) float64    metres
        """
        turned = np.array(positions, dtype=np.float64)
        turned[:, [0, 2]] = rotated(turned[:, [0, 2]], self.turn_rad)
        return turned + self.shift_m


def whole_move(before: Floats, after: Floats) -> Move | None:
    """Find the rigid movement that brings one path as close as possible to another path, by least squares.

    Parameters
    ----------
    before, after : (n, 3) float64    positions in matched frames, metres

    Returns
    -------
    Move or None    None if the paths are empty or equal, or if the mean distance between them after the movement is
        more than `UNEXPLAINED` times the mean distance before it
    """
    change = np.linalg.norm(after - before, axis=1)
    if not len(change) or CM_PER_M * change.max() <= NOISE_CM:
        return None
    centre, target = before.mean(axis=0), after.mean(axis=0)
    a, b = before - centre, after - target
    sine = float(np.sum(a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]))
    cosine = float(np.sum(a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]))
    extent_m = float(np.sqrt(np.mean(a[:, [0, 2]] ** 2)))
    turn = Move(float(np.arctan2(sine, cosine)) if extent_m > POINT_M else 0.0, np.zeros(3))
    move = turn._replace(shift_m=target - turn.applied(before).mean(axis=0))
    remaining = np.linalg.norm(move.applied(before) - after, axis=1)
    return move if remaining.mean() <= UNEXPLAINED * change.mean() else None
