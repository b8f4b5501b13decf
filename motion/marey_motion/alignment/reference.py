"""Choice of the motion that all others are aligned with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

import numpy as np

from marey_motion.alignment.dtw import least_total
from marey_motion.arrays import Floats

Points = TypeVar("Points")
Advance = Callable[[int, int], None]
"""Function called with the number of finished alignments and the number of all alignments."""

SAME = 1e-9
"""Relative difference below which two sums of costs count as equal."""

MOST_COMPARED = 200
"""Greatest number of motions that are compared with each other to find the medoid.

The number of pairs grows with the square of the number of motions: 200 motions form 19,900 pairs. With a probability of
99 %, a random sample of 200 motions contains one of the best 2.3 % of all motions (0.977^200 = 1 %).
"""

_SAMPLE_SEED = 0


def nearest_mean_length(frame_counts: Sequence[int]) -> int:
    """Choose the motion whose number of frames is nearest to the mean number.

    Parameters
    ----------
    frame_counts : sequence of int    frames of each motion

    Returns
    -------
    int    index; the first one if several are equally good
    """
    return int(np.argmin(np.abs(np.array(frame_counts) - np.mean(frame_counts))))


def medoid(totals: Floats) -> int:
    """Choose the motion with the least sum of alignment costs to all motions.

    Only the motions that can be aligned with the largest number of other motions (at finite costs) are considered.

    Parameters
    ----------
    totals : (n, n) float64    costs of aligning each pair

    Returns
    -------
    int    index; the first one if several are equally good
    """
    impossible = np.isinf(totals).sum(axis=1)
    sums = np.where(np.isinf(totals), 0.0, totals).sum(axis=1)
    sums[impossible > impossible.min()] = np.inf
    return int(np.flatnonzero(sums <= sums.min() * (1.0 + SAME))[0])


def compared_motions(count: int) -> list[int]:
    """Choose the motions that are compared with each other to find the medoid: all, or a random sample of them.

    The choice depends on the number of motions alone, so the same motions in the same order give the same medoid.

    Parameters
    ----------
    count : int    number of motions

    Returns
    -------
    list of int    increasing indices, at most `MOST_COMPARED`
    """
    if count <= MOST_COMPARED:
        return list(range(count))
    drawn = np.random.Generator(np.random.Philox(_SAMPLE_SEED)).permutation(count)[:MOST_COMPARED]
    return sorted(drawn.tolist())


def pairwise_totals(
    points: Sequence[Points],
    bounds: Sequence[Sequence[int]],
    costs_of: Callable[[Points, Points], Floats],
    *,
    max_run: int | None,
    threads: int = 1,
    progress: Advance | None = None,
) -> Floats:
    """Compute the costs of aligning each pair of motions, section by section.

    The cost does not depend on the order of a pair, so each pair is aligned once.

    Parameters
    ----------
    points : sequence    points of each motion, in any form that `costs_of` accepts
    bounds : sequence of sequences of int    bounds of each motion's sections; all motions have the same number of
        bounds
    costs_of : callable    called as costs_of(points, points of another motion); returns their costs (n, m)
    max_run : int or None    slope limit of `dtw.align`
    threads : int    threads to use
    progress : callable, optional    called as progress(done, total)

    Returns
    -------
    (n, n) float64    in the unit of the costs; infinite where alignment is impossible
    """
    count = len(points)
    totals = np.zeros((count, count))

    def fill(first: int) -> None:
        for other in range(first + 1, count):
            costs = costs_of(points[first], points[other])
            totals[first, other] = _sectioned_total(costs, bounds[first], bounds[other], max_run)

    done, pairs = 0, count * (count - 1) // 2
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for first, _ in enumerate(pool.map(fill, range(count - 1))):
            done += count - 1 - first
            if progress is not None:
                progress(done, pairs)
    return totals + totals.T


def _sectioned_total(costs: Floats, bounds: Sequence[int], others: Sequence[int], max_run: int | None) -> float:
    sections = zip(pairwise(bounds), pairwise(others), strict=True)
    parts = [
        least_total(costs[start : stop + 1, other_start : other_stop + 1], max_run=max_run)
        for (start, stop), (other_start, other_stop) in sections
    ]
    inner = [float(costs[one, other]) for one, other in zip(bounds[1:-1], others[1:-1], strict=True)]
    return sum(parts) - sum(inner)
