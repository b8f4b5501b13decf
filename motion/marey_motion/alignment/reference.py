"""Which of several motions all others are aligned with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from marey_motion.alignment.cost import CostOptions, CostPoints, costs_between
from marey_motion.alignment.dtw import least_total
from marey_motion.arrays import Floats

Advance = Callable[[int, int], None]
"""Told how many alignments are done, and of how many."""

SAME = 1e-9
"""Sums of costs that differ by less than this share of them are ties."""


def nearest_mean_length(frame_counts: Sequence[int]) -> int:
    """The motion whose number of frames is nearest to the mean; of several, the first."""
    return int(np.argmin(np.abs(np.array(frame_counts) - np.mean(frame_counts))))


def medoid(totals: Floats) -> int:
    """The motion with the least sum of the costs (n, n) of aligning it with each; of several, the first.

    Motions that cannot be aligned with some others (infinite costs) come after those that can with more.
    """
    impossible = np.isinf(totals).sum(axis=1)
    sums = np.where(np.isinf(totals), 0.0, totals).sum(axis=1)
    sums[impossible > impossible.min()] = np.inf
    return int(np.flatnonzero(sums <= sums.min() * (1.0 + SAME))[0])


def pairwise_totals(
    points: Sequence[CostPoints],
    bounds: Sequence[Sequence[int]],
    options: CostOptions,
    *,
    max_run: int | None,
    threads: int = 1,
    progress: Advance | None = None,
) -> Floats:
    """Costs (n, n) of aligning each two motions, section by section; infinite where that is not possible.

    Both directions cost the same, so that each two are aligned once.

    Parameters
    ----------
    points : of each motion
    bounds : of each motion's sections, equally many
    """
    count = len(points)
    totals = np.zeros((count, count))

    def fill(first: int) -> None:
        for other in range(first + 1, count):
            costs = costs_between(points[first], points[other], options)
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
