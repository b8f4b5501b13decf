"""Timing of two clips: frames that were removed or inserted, and motion that was resampled or re-timed."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import AnyInts, Floats, Ints
from marey_motion.difference.lags import likely_pace
from marey_motion.difference.matching import UNMATCHED, WELL_MATCHED, Matching, match_frames
from marey_motion.difference.poses import Poses, time_offsets
from marey_schemas.documents.differences import FrameRun

SAME_PACE = 1e-9
WELL_EXPLAINED = 0.98
"""Share of the shorter clip's frames. If this share is matched well, no other sampling of the old clip is tried."""
MUCH_BETTER = 0.5
"""Another sampling of the old clip is chosen only if its cost is less than this share of the least cost so far."""
SIMILAR_ENOUGH = 0.1
"""Largest accepted cost of a matching, as a share of the cost if all frames differed entirely.

A matching is accepted only if it also has fewer than `MANY_RUNS` runs.
"""
MANY_RUNS = 8
MOST_REFINEMENTS = 8
FEWEST_PAIRS = 8
SLOPES, FRAMES_APART = 20, 64
"""Distances over which `_refined` measures a slope, in matched frames.

The distance is alternately `FRAMES_APART` frames and 1 / `SLOPES` of all matched frames.
"""
FARTHEST_OFFSET = 2.0
"""Maximum offset, in frames, that is estimated from velocities."""
ROUNDED_FRAMES = 0.02
"""Deviation over the whole clip, in frames, that is attributed to rounding."""
GREATEST_PACE = 16.0
"""Greatest number of frames of the new clip per frame of the old clip that is tried; the least is its reciprocal."""


class Pace(NamedTuple):
    """Rate and start of the sampling of the old clip, whose samples correspond to the frames of the new clip.

    Parameters
    ----------
    samples_per_frame : float    number of samples for each frame of the old clip
    phase : float    place of the first sample, in frames of the old clip
    """

    samples_per_frame: float
    phase: float = 0.0

    def places(self, samples: AnyInts | Floats) -> Floats:
        """Compute the frames of the old clip at which samples are taken.

        Parameters
        ----------
        samples : (n,)    numbers of the samples, counted from 0

        Returns
        -------
        (n,) float64    fractional frame numbers of the old clip
        """
        return np.asarray(self.phase + samples / self.samples_per_frame, dtype=np.float64)


class Timing(NamedTuple):
    """Correspondence of the frames of two clips.

    Parameters
    ----------
    pace : Pace    sampling of the old clip
    before : Poses    the samples of the old clip
    matching : Matching    pairs of frames of the sampled clip and of the new clip
    """

    pace: Pace
    before: Poses
    matching: Matching


def compare_timing(before: Poses, after: Poses, rate_ratio: float) -> Timing:
    """Sample the old clip so that its samples correspond best to the frames of the new clip, and match them.

    Parameters
    ----------
    before, after : Poses    frames of the same joints
    rate_ratio : float    frame rate of the new clip, divided by that of the old clip

    Returns
    -------
    Timing    the old clip sampled at the frame rate of the new clip, or at another rate if frames then match much
        better
    """
    first, *others = _paces(before.frame_count, after.frame_count, rate_ratio)
    best = _at_pace(before, after, Pace(first), search=True)
    for pace in others:
        if _explains(best, after):
            return best
        best = _better(best, before, after, pace)
    if _share(best, after) > SIMILAR_ENOUGH or _run_count(best) >= MANY_RUNS:
        best = _better(best, before, after, likely_pace(before, after), search=True)
    return best


def _paces(count_before: int, count_after: int, rate_ratio: float) -> list[float]:
    """List the sampling rates to try, in samples per frame of the old clip.

    They are the ratio of the frame rates, 1, and the ratio of the durations in frames.
    """
    paces = [rate_ratio, 1.0]
    if count_before > 1 and count_after > 1:
        paces.append((count_after - 1) / (count_before - 1))
    possible = [pace for pace in dict.fromkeys(paces) if 1.0 / GREATEST_PACE <= pace <= GREATEST_PACE]
    return [pace for pace in possible if pace == 1.0 or abs(pace - 1.0) > SAME_PACE]


def _better(best: Timing, before: Poses, after: Poses, pace: float, *, search: bool = False) -> Timing:
    """Match the frames at another sampling rate, and refine this rate; return `best` unless the result is much better.

    `search` enables a search for similar frames (see `match_frames`) while the rate is refined.
    """
    if pace == 1.0:
        tried = _at_pace(before, after, Pace(1.0), search=True)
        return tried if _share(tried, after) < MUCH_BETTER * _share(best, after) else best
    tried = _refined(before, after, _at_pace(before, after, Pace(pace), search=search), search=search)
    if _share(tried, after) >= MUCH_BETTER * _share(best, after):
        return best
    return _at_pace(before, after, tried.pace, search=True)


def _at_pace(before: Poses, after: Poses, pace: Pace, *, search: bool) -> Timing:
    """Sample the old clip at the rate and start `pace`, and match the samples with the frames of the new clip.

    `search` enables a search for similar frames (see `match_frames`).
    """
    sampled = before
    if pace != Pace(1.0):
        count = int((before.frame_count - 1 - pace.phase) * pace.samples_per_frame + ROUNDED_FRAMES) + 1
        sampled = before.sampled(np.minimum(pace.places(np.arange(count)), before.frame_count - 1.0))
    return Timing(pace, sampled, match_frames(sampled, after, search=search))


def _refined(before: Poses, after: Poses, timing: Timing, *, search: bool) -> Timing:
    """Fit sampling rate and start to the matched frames, and match again, until the matching stops improving.

    The slope of the fit is measured over a short and over a long distance alternately: a short distance gives the right
    slope even if few frames are matched well, a long distance gives a more exact slope.
    """
    failed = False
    for attempt in range(MOST_REFINEMENTS):
        pairs = timing.matching.pairs
        offsets, weights = time_offsets(timing.before, after, pairs)
        near = (np.abs(offsets) <= FARTHEST_OFFSET) & (weights > 0.0)
        if np.count_nonzero(near) < FEWEST_PAIRS:
            return timing
        places = timing.pace.places(pairs[near, 0] + offsets[near])
        apart = FRAMES_APART if attempt % 2 == 0 else len(places) // SLOPES
        start, step = _robust_line(pairs[near, 1].astype(np.float64), places, weights[near], apart)
        if not 1.0 / GREATEST_PACE <= step <= GREATEST_PACE:
            return timing
        tried = _at_pace(before, after, _rounded(start, step, timing.before.frame_count), search=search)
        better = _share(tried, after) < _share(timing, after)
        if failed and not better:
            return timing
        failed = not better
        timing = tried if better else timing
    return timing


def _rounded(start: float, step: float, count: int) -> Pace:
    """Convert a fitted line to a sampling of the old clip: sample n is at frame `start` + n·`step`.

    The rate is rounded to a simple fraction, and the start to a whole frame, if rounding moves none of the `count`
    samples by more than `ROUNDED_FRAMES` frames.
    """
    pace = 1.0 / step
    simple = float(Fraction(pace).limit_denominator(1000))
    if abs(simple - pace) * count <= ROUNDED_FRAMES * pace:
        pace = simple
    if abs(start - round(start)) <= ROUNDED_FRAMES:
        start = round(start)
    phase = start % (1.0 / pace)
    return Pace(pace, 0.0 if 1.0 / pace - phase <= SAME_PACE else phase)


def _robust_line(places: Floats, values: Floats, weights: Floats, apart: int) -> tuple[float, float]:
    """Fit a straight line to values (n,) at places (n,); return its value at place 0, and its slope.

    The values may jump where frames were removed; `weights` (n,) are their reliability. The first estimate of the slope
    is the median slope over pairs of values whose indices differ by `apart`.
    """
    apart = max(1, min(apart, len(places) - 1))
    slope = float(np.median((values[apart:] - values[:-apart]) / (places[apart:] - places[:-apart])))
    start = float(np.median(values - slope * places))
    for _ in range(2):
        near = np.abs(values - start - slope * places) <= 1.0
        if np.count_nonzero(near) >= FEWEST_PAIRS:
            start, slope = _line(places[near], values[near], weights[near])
    return start, slope


def _line(places: Floats, values: Floats, weights: Floats) -> tuple[float, float]:
    """Fit a straight line by weighted least squares; return its value at place 0, and its slope."""
    total = float(weights.sum())
    if total <= 0.0:
        return 0.0, 0.0
    at, level = float(weights @ places) / total, float(weights @ values) / total
    centred = places - at
    spread = float(weights @ (centred * centred))
    slope = float(weights @ (centred * (values - level))) / spread if spread > 0.0 else 0.0
    return level - slope * at, slope


def _explains(timing: Timing, after: Poses) -> bool:
    """Return whether nearly all frames of the shorter clip are matched well."""
    well = np.count_nonzero(timing.matching.costs <= WELL_MATCHED)
    return int(well) >= WELL_EXPLAINED * min(timing.before.frame_count, after.frame_count)


def _run_count(timing: Timing) -> int:
    return int(np.count_nonzero(np.any(np.diff(timing.matching.pairs, axis=0) != 1, axis=1))) + 1


def _share(timing: Timing, after: Poses) -> float:
    """Return the cost of a matching as a share, from 0 to 1, of the cost if all frames differed entirely.

    The cost of the frames by which one clip is longer than the other is left out.
    """
    counts = timing.before.frame_count, after.frame_count
    return (timing.matching.total - UNMATCHED * abs(counts[0] - counts[1])) / (2.0 * UNMATCHED * min(counts))


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
    """List the ranges of each run of matched frames: in the old and in the new clip, in frames of the stored clips."""
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
    """Convert starts or ends of runs, in frames of the sampled old clip, to frames of that clip as stored.

    `count` is the number of frames of the stored clip.
    """
    if timing.pace == Pace(1.0):
        return frames
    borders = np.clip(np.round(timing.pace.places(frames)), 0, count)
    borders = np.where(frames == 0, 0, np.where(frames >= timing.before.frame_count, count, borders))
    return borders.astype(np.int64)
