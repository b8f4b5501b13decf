"""The period of a cyclic motion, and loops without a seam that are cut from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion import quaternions
from marey_motion.alignment.canonical import to_canonical
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_directions, headings
from marey_motion.looping import LoopSeam, about_vertical, rotated
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.perception.maps import paired_distances
from marey_motion.perception.measuring import MeasuredClip
from marey_motion.perception.metric import PerceptualMetric

SHORTEST_PERIOD_S, LONGEST_PERIOD_S = 0.6, 2.0
_SIGNIFICANT = 0.25
_LEAST_MOVED = 0.5


@dataclass(frozen=True, eq=False)
class Period:
    """The period of a cyclic motion.

    Parameters
    ----------
    frames : int    length of the period
    start : int    best first frame of a loop that is blended from two periods
    lags : (n,) int64    lags that were tried, in frames
    differences : (n,) float64    for each lag, the mean distance between two frames that are this lag apart
    """

    frames: int
    start: int
    lags: np.ndarray
    differences: Floats


def find_period(clip: MeasuredClip, metric: PerceptualMetric) -> Period:
    """Find the period of a clip: the first significant minimum of the mean distance along diagonals of its motion map.

    A minimum is significant if it is in the lowest quarter of the range of distances. This excludes half a cycle, which
    gives a shallow minimum because left and right are exchanged. The loop starts at a frame that differs enough from
    the frame half a period later. This excludes loops in which the body stands still. Of the possible starts, the frame
    that differs least from the frame one period later is chosen.

    Parameters
    ----------
    clip : MeasuredClip    F frames, at least two periods
    metric : PerceptualMetric    the metric

    Returns
    -------
    Period    period, start and the curve that was searched

    Raises
    ------
    MotionError    if there is no minimum between `SHORTEST_PERIOD_S` and `LONGEST_PERIOD_S`, or the clip is shorter
        than two periods
    """
    longest = min(int(LONGEST_PERIOD_S * clip.rate_hz) + 1, clip.frame_count // 2 + 1)
    lags = np.arange(max(1, int(SHORTEST_PERIOD_S * clip.rate_hz)), longest + 1)
    if len(lags) < 3:
        raise MotionError(
            f"the clip has {clip.frame_count} frames; two periods of at least {SHORTEST_PERIOD_S:g} s are needed",
            code="no-period",
        )
    means = np.array([_lagged(clip, int(lag), metric).mean() for lag in lags])
    inner = means[1:-1]
    limit = means.min() + _SIGNIFICANT * (means.max() - means.min())
    minima = np.flatnonzero((inner <= means[:-2]) & (inner < means[2:]) & (inner <= limit)) + 1
    minima = minima[2 * lags[minima] < clip.frame_count]
    if not len(minima):
        raise MotionError(
            f"the motion does not repeat itself after {SHORTEST_PERIOD_S:g} to {LONGEST_PERIOD_S:g} s, or has fewer "
            "than two periods; use a longer clip of steady walking or running",
            code="no-period",
        )
    period = int(lags[minima[0]])
    apart = _lagged(clip, period, metric)[: clip.frame_count - 2 * period]
    # Somebody who stands still repeats every pose, so frames of standing would make the best loop.
    moved = _lagged(clip, period // 2, metric)[: len(apart)]
    moves = moved >= _LEAST_MOVED * np.quantile(moved, 0.9)
    return Period(period, int(np.argmin(np.where(moves, apart, np.inf))), lags, means)


def cut_loop(motion: Motion, body: MatchingBody, period: Period) -> tuple[Motion, LoopSeam]:
    """Blend two periods of a motion into a loop without a seam.

    Frame k of a loop of P frames is a mixture of frames start + k and start + P + k of the motion. The weight of frame
    start + k is k / P. So the loop begins with frame start + P, and frame P of the loop would be frame start + P again.
    Rotations are interpolated by slerp. Changes of heading and steps on the ground are interpolated, then summed.

    Parameters
    ----------
    motion : Motion    F frames
    body : MatchingBody    body of its skeleton
    period : Period    period and start

    Returns
    -------
    motion : Motion    P frames, which begin at the origin and face +z
    seam : LoopSeam    movement to the next round, under which frame P equals frame 0

    Raises
    ------
    MotionError    if the motion has fewer than start + 2 P + 1 frames
    """
    start, length = period.start, period.frames
    if motion.frame_count <= start + 2 * length:
        raise MotionError(
            f"the motion has {motion.frame_count} frames; two periods of {length} frames from frame {start} need "
            f"{start + 2 * length + 1}",
            code="no-period",
        )
    canonical, _ = to_canonical(motion.sliced(start, start + 2 * length + 1), body)
    facing = np.unwrap(headings(forward_directions(canonical.positions(body.skeleton), body.lefts, body.rights)))
    early, late = (slice(first, first + length + 1) for first in (0, length))
    share = np.arange(length + 1) / length
    heading = _accumulated(_mixed(np.diff(facing[late]), np.diff(facing[early]), share[:-1]))
    places = canonical.root_translations
    steps = rotated(np.diff(places[:, ::2], axis=0), -facing[:-1])
    ground = _accumulated(rotated(_mixed(steps[length:], steps[:length], share[:-1]), heading[:-1]))
    rotations = canonical.rotations.copy()
    rotations[:, 0] = quaternions.multiply(about_vertical(-facing), rotations[:, 0])
    rotations = np.asarray(quaternions.slerp(rotations[late], rotations[early], share[:, None]))
    rotations[:, 0] = quaternions.multiply(about_vertical(heading), rotations[:, 0])
    heights = _mixed(places[late, 1], places[early, 1], share)
    made = canonical._replace(
        root_translations=np.stack((ground[:, 0], heights, ground[:, 1]), axis=1),
        rotations=np.asarray(quaternions.unroll(rotations), dtype=np.float64),
        translations=_mixed(canonical.translations[late], canonical.translations[early], share),
    )
    return made.sliced(0, length), LoopSeam(float(heading[-1]), ground[-1])


def _lagged(clip: MeasuredClip, lag: int, metric: PerceptualMetric) -> Floats:
    """Compute the distances (F - lag,) of frames that are `lag` frames apart."""
    return paired_distances(clip.sliced(0, clip.frame_count - lag), clip.sliced(lag, clip.frame_count), metric)


def _mixed(late: Floats, early: Floats, share: Floats) -> Floats:
    weight = share.reshape(-1, *[1] * (late.ndim - 1))
    return np.asarray((1.0 - weight) * late + weight * early)


def _accumulated(steps: Floats) -> Floats:
    return np.concatenate((np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)))
