"""Matching of the frames of two clips, in runs of frames, at the least cost.

A run consists of consecutive frames of both clips, whose frame numbers differ by a constant, the lag. Between runs,
frames are removed or inserted. First, candidates for the lags are found; then, the cheapest path through the pairs of
frames with these lags gives the runs. In this way, frames after an insertion remain matched, and motion that stands
still or repeats is not split into more runs than needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.difference.lags import exact_lags, similar_lags
from marey_motion.difference.poses import Poses, frame_costs

UNMATCHED = 0.25
"""Cost of a removed or inserted frame. A pair of different frames costs at most twice as much."""
NEW_RUN = 1.0
"""Cost of a change of the lag between two runs, in addition to the cost of each removed or inserted frame."""
AT_AN_END = 0.995
"""Cost of removed or inserted frames at the start or end of the clips, in addition to the cost of each frame.

It is below `NEW_RUN`, so that these places are preferred.
"""
WELL_MATCHED = 0.02
"""Cost up to which a frame counts as matched well, so that no further lags are tried for the frame."""
MOST_ROUNDS = 64
"""Maximum number of rounds of the search; the cheapest path with k changes of the lag needs at most k rounds."""
SHORTEST_REPLACEMENT = 10
"""Minimum number of consecutive, entirely different frames that are reported as removed and inserted."""


class Matching(NamedTuple):
    """Matched frames of two clips.

    Parameters
    ----------
    pairs : (n, 2) int    frames of the old clip and matched frames of the new clip, both in increasing order
    costs : (n,) float64    cost of each pair, from 0 for equal frames; see `frame_costs`
    total : float    cost of the matching, including removed and inserted frames
    """

    pairs: Ints
    costs: Floats
    total: float


def match_frames(before: Poses, after: Poses, *, search: bool = True) -> Matching:
    """Match the frames of two clips whose motions are equally fast, counted in frames.

    If the new clip was resampled or re-timed, `timing.compare_timing` first samples the old clip at the new speed.

    Parameters
    ----------
    before, after : Poses    n and m frames of the same joints
    search : bool    whether to search for similar frames if some frames of `before` have no nearly equal match

    Returns
    -------
    Matching    the cheapest matching among the candidates for lags
    """
    ends = (0, after.frame_count - before.frame_count)
    lags = tuple(dict.fromkeys((*ends, *exact_lags(before, after))))
    found = _cheapest(before, after, lags)
    poorly = _poorly_matched(found, before.frame_count)
    if search and len(poorly):
        more = tuple(dict.fromkeys((*lags, *similar_lags(before, after, poorly))))
        found = _cheapest(before, after, more)
    return _without_replacements(found)


def _poorly_matched(matching: Matching, count: int) -> Ints:
    """Return the frames of the old clip that have no match, or whose match costs more than `WELL_MATCHED`."""
    well = np.zeros(count, dtype=np.bool_)
    well[matching.pairs[matching.costs <= WELL_MATCHED, 0]] = True
    return np.flatnonzero(~well)


class _Diagonal(NamedTuple):
    """All pairs of frames with the same lag; the frames of the old clip are [start, stop).

    `costs` (stop - start + 1,) are the cumulative costs of the pairs, from 0 to the sum over all pairs.
    """

    lag: int
    start: int
    stop: int
    costs: Floats


def _cheapest(before: Poses, after: Poses, lags: Sequence[int]) -> Matching:
    """Find the cheapest matching whose pairs of frames all have one of the given lags."""
    diagonals = [_diagonal(before, after, lag) for lag in lags if -before.frame_count < lag < after.frame_count]
    reached = [_start_cost(one) + one.costs for one in diagonals]
    for _ in range(MOST_ROUNDS):
        improved = False
        for place, one in enumerate(diagonals):
            entered = _entered(diagonals, reached, place)
            along = one.costs + np.minimum.accumulate(entered - one.costs)
            improved |= bool(np.any(along < reached[place] - 1e-9))
            reached[place] = np.minimum(reached[place], along)
        if not improved:
            break
    ends = [
        float(values[-1]) + _end_cost(one, before.frame_count, after.frame_count)
        for one, values in zip(diagonals, reached, strict=True)
    ]
    last = int(np.argmin(ends))
    return _traced(diagonals, reached, last, ends[last])


def _diagonal(before: Poses, after: Poses, lag: int) -> _Diagonal:
    start, stop = max(0, -lag), min(before.frame_count, after.frame_count - lag)
    frames = np.arange(start, stop)
    costs = np.minimum(frame_costs(before, after, np.stack((frames, frames + lag), axis=1)), 2.0 * UNMATCHED)
    return _Diagonal(lag, start, stop, np.concatenate(([0.0], np.cumsum(costs))))


def _start_cost(one: _Diagonal) -> float:
    return abs(one.lag) * UNMATCHED + (AT_AN_END if one.lag else 0.0)


def _end_cost(one: _Diagonal, count_before: int, count_after: int) -> float:
    left = count_before - one.stop + count_after - (one.stop + one.lag)
    return left * UNMATCHED + (AT_AN_END if left else 0.0)


def _entered(diagonals: Sequence[_Diagonal], reached: Sequence[Floats], place: int) -> Floats:
    """Compute the least costs of paths that change from another diagonal to the diagonal with index `place`.

    `reached` contains, for each diagonal, the least cost of a path to each of its pairs, and to its end. Returns the
    costs (stop - start + 1,) of a change just before each pair of the diagonal, and at its end; infinite if impossible.
    """
    one = diagonals[place]
    least = np.full(len(one.costs), np.inf)
    for other, values in zip(diagonals, reached, strict=True):
        if other.lag == one.lag:
            continue
        shift = max(0, other.lag - one.lag)  # frames before that are removed on the way
        first, last = max(one.start, other.start + shift), min(one.stop, other.stop + shift)
        if first <= last:
            there = values[first - shift - other.start : last - shift - other.start + 1]
            here = slice(first - one.start, last - one.start + 1)
            np.minimum(least[here], there + (abs(other.lag - one.lag) * UNMATCHED + NEW_RUN), out=least[here])
    return least


def _traced(diagonals: Sequence[_Diagonal], reached: Sequence[Floats], place: int, total: float) -> Matching:
    """Follow the cheapest path from its end to its start and collect its pairs.

    The path ends on the diagonal with index `place` and costs `total`; `reached` are the costs as in `_entered`.
    """
    stop = diagonals[place].stop
    pieces: list[tuple[Ints, Floats]] = []
    while True:
        one = diagonals[place]
        entered = _entered(diagonals, reached, place)[: stop - one.start + 1] - one.costs[: stop - one.start + 1]
        entry = int(np.argmin(entered))
        starts_here = _start_cost(one) <= entered[entry] + 1e-9
        first = one.start if starts_here else one.start + entry
        frames = np.arange(first, stop)
        costs = np.diff(one.costs)[first - one.start : stop - one.start]
        pieces.append((np.stack((frames, frames + one.lag), axis=1), costs))
        if starts_here:
            break
        place, stop = _origin(diagonals, reached, place, first)
    pieces.reverse()
    return Matching(np.concatenate([pairs for pairs, _ in pieces]), np.concatenate([cost for _, cost in pieces]), total)


def _origin(diagonals: Sequence[_Diagonal], reached: Sequence[Floats], place: int, frame: int) -> tuple[int, int]:
    """Find the diagonal that the cheapest path leaves in order to enter diagonal `place` at `frame` of the old clip.

    `reached` are the costs as in `_entered`. Returns the index of the diagonal that is left, and the frame of the old
    clip at which the path leaves it.
    """
    one = diagonals[place]
    best, origin = np.inf, (place, frame)
    for number, (other, values) in enumerate(zip(diagonals, reached, strict=True)):
        left = frame - max(0, other.lag - one.lag)
        if other.lag == one.lag or not other.start <= left <= other.stop:
            continue
        cost = float(values[left - other.start]) + abs(other.lag - one.lag) * UNMATCHED + NEW_RUN
        if cost < best:
            best, origin = cost, (number, left)
    return origin


def _without_replacements(matching: Matching) -> Matching:
    """Remove runs of at least `SHORTEST_REPLACEMENT` consecutive pairs whose two frames differ entirely."""
    differing = matching.costs >= 2.0 * UNMATCHED - 1e-9
    edges = np.flatnonzero(np.diff(np.concatenate(([0], differing.astype(np.int8), [0]))))
    starts, stops = edges[::2], edges[1::2]
    kept = np.ones(len(differing), dtype=np.bool_)
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        if stop - start >= SHORTEST_REPLACEMENT:
            kept[start:stop] = False
    return Matching(matching.pairs[kept], matching.costs[kept], matching.total)
