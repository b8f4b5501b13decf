"""Timing of two clips: frames that were removed or inserted, and motion that was resampled or re-timed."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.difference.matching import UNMATCHED, WELL_MATCHED, Matching, match_frames
from marey_motion.difference.poses import Poses, time_offsets
from marey_motion.resampling import count_samples
from marey_schemas.documents.differences import FrameRun

SAME_PACE = 1e-9
WELL_EXPLAINED = 0.98
"""Share of the shorter clip's frames; if more are matched well, no other pace is tried."""
MUCH_BETTER = 0.5
"""Share of the cost at the first pace below which the cost at another pace must be for that pace to be chosen."""
MOST_REFINEMENTS = 4
ROUNDED_PACE = 1e-6
GREATEST_PACE = 16.0
"""Greatest factor between the numbers of frames of the same motion."""


class Timing(NamedTuple):
    """Correspondence of the frames of two clips.

    Parameters
    ----------
    pace : float    frames of the clip after for each matched frame of the clip before
    before : Poses    the clip before, sampled at that pace
    matching : Matching    pairs of frames of the sampled clip and of the clip after
    """

    pace: float
    before: Poses
    matching: Matching


def compare_timing(before: Poses, after: Poses, rate_ratio: float) -> Timing:
    """Find the pace at which the frames of two clips correspond best, and match them.

    Parameters
    ----------
    before, after : Poses    frames of the same joints
    rate_ratio : float    frame rate of the clip after, divided by that of the clip before

    Returns
    -------
    Timing    correspondence at the ratio of the frame rates, unless another pace explains much more
    """
    first, *others = _paces(before.frame_count, after.frame_count, rate_ratio)
    best = _at_pace(before, after, first, search=True)
    for pace in others:
        if _explains(best, after):
            break
        tried = _at_pace(before, after, pace, search=pace == 1.0)
        if pace != 1.0:
            tried = _refined(before, after, tried)
        if _share(tried, after) < MUCH_BETTER * _share(best, after):
            best = _at_pace(before, after, tried.pace, search=True)
    return best


def _paces(count_before: int, count_after: int, rate_ratio: float) -> list[float]:
    """Return the paces to try: the ratio of the frame rates, 1, and the ratio of the lengths."""
    paces = [rate_ratio, 1.0]
    if count_before > 1 and count_after > 1:
        paces.append((count_after - 1) / (count_before - 1))
    possible = [pace for pace in dict.fromkeys(paces) if 1.0 / GREATEST_PACE <= pace <= GREATEST_PACE]
    return [pace for pace in possible if pace == 1.0 or abs(pace - 1.0) > SAME_PACE]


def _at_pace(before: Poses, after: Poses, pace: float, *, search: bool) -> Timing:
    """Match the frames of two clips at a pace."""
    sampled = before
    if pace != 1.0:
        sampled = before.sampled(
            np.minimum(np.arange(count_samples(before.frame_count, 1.0, pace)) / pace, before.frame_count - 1.0)
        )
    return Timing(pace, sampled, match_frames(sampled, after, search=search))


def _refined(before: Poses, after: Poses, timing: Timing) -> Timing:
    """Correct a pace by the mean drift of the matched frames, and match the frames again."""
    for _ in range(MOST_REFINEMENTS):
        pairs = timing.matching.pairs
        if len(pairs) < 3:
            return timing
        times, weights = time_offsets(timing.before, after, pairs)
        slope = _weighted_slope(pairs[:, 0].astype(np.float64), times, weights)
        pace = _rounded(timing.pace / (1.0 + slope))
        tried = _at_pace(before, after, pace, search=False)
        if not tried.matching.costs.sum() < timing.matching.costs.sum():
            return timing
        timing = tried
    return timing


def _rounded(pace: float) -> float:
    """Return a simple fraction instead of a pace that differs from it by rounding only."""
    simple = float(Fraction(pace).limit_denominator(1000))
    return simple if abs(simple - pace) <= ROUNDED_PACE * pace else pace


def _weighted_slope(places: Floats, values: Floats, weights: Floats) -> float:
    """Return the slope of a straight line through values, by weighted least squares."""
    total = float(weights.sum())
    if total <= 0.0:
        return 0.0
    centred = places - float(weights @ places) / total
    spread = float(weights @ (centred * centred))
    return float(weights @ (centred * values)) / spread if spread > 0.0 else 0.0


def _explains(timing: Timing, after: Poses) -> bool:
    """Return whether nearly all frames of the shorter clip are matched well."""
    well = np.count_nonzero(timing.matching.costs <= WELL_MATCHED)
    return int(well) >= WELL_EXPLAINED * min(timing.before.frame_count, after.frame_count)


def _share(timing: Timing, after: Poses) -> float:
    """Return the cost of a matching as a share of the cost of removing and inserting all frames."""
    return timing.matching.total / (UNMATCHED * (timing.before.frame_count + after.frame_count))


def frame_runs(timing: Timing, count_before: int, count_after: int) -> tuple[FrameRun, ...]:
    """List the runs of matched, removed and inserted frames.

    Parameters
    ----------
    timing : Timing    the correspondence
    count_before, count_after : int    numbers of frames of the clips as stored

    Returns
    -------
    tuple of FrameRun    runs in order, which contain each frame of both clips once
    """
    edges = _edges(timing, count_before)
    runs: list[FrameRun] = []
    at_before = at_after = 0
    for (before_start, before_stop), (after_start, after_stop) in edges:
        runs += _unmatched((at_before, before_start), (at_after, after_start))
        runs.append(FrameRun(change="matched", before=(before_start, before_stop), after=(after_start, after_stop)))
        at_before, at_after = before_stop, after_stop
    runs += _unmatched((at_before, count_before), (at_after, count_after))
    return tuple(runs)


def _unmatched(before: tuple[int, int], after: tuple[int, int]) -> list[FrameRun]:
    runs = []
    if before[1] > before[0]:
        runs.append(FrameRun(change="removed", before=before, after=(after[0], after[0])))
    if after[1] > after[0]:
        runs.append(FrameRun(change="inserted", before=(before[1], before[1]), after=after))
    return runs


def _edges(timing: Timing, count_before: int) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the ranges of each run of matched frames in both clips, in frames of the stored clips."""
    pairs = timing.matching.pairs
    if not len(pairs):
        return []
    breaks = np.flatnonzero(np.any(np.diff(pairs, axis=0) != 1, axis=1)) + 1
    starts, stops = pairs[np.concatenate(([0], breaks))], pairs[np.concatenate((breaks, [len(pairs)])) - 1] + 1
    scaled = np.stack((_stored(starts[:, 0], timing, count_before), _stored(stops[:, 0], timing, count_before)), axis=1)
    return [
        ((int(first), int(last)), (int(start), int(stop)))
        for (first, last), start, stop in zip(scaled, starts[:, 1], stops[:, 1], strict=True)
    ]


def _stored(frames: Ints, timing: Timing, count: int) -> Ints:
    """Convert borders of the sampled clip to borders of the stored clip."""
    if timing.pace == 1.0:
        return frames
    borders = np.minimum(np.round(frames / timing.pace), count).astype(np.int64)
    return np.where(frames >= timing.before.frame_count, count, borders)
