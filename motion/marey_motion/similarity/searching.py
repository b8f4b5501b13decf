"""Exact search for the windows of many clips that resemble a window of a clip.

The rows of all clips (the features of their poses) are divided into steps of a few rows. For each step, a lower bound
of the distances of all windows that start in it is computed. The windows in the steps with the lowest bounds are
compared first. The distance of the worst hit among them is a limit: next, all windows are found whose distance is at
most the limit. So the result is the same as if all windows were compared. Of windows that overlap, only the nearest one
is a hit. If too few hits remain, more steps are compared, which gives a greater limit.

Windows can only overlap within a clip, so the best windows of a shard do not depend on other shards. The best windows
of the shards searched so far lower the limit for the next shards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import NamedTuple

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.perception.metric import PerceptualMetric
from marey_motion.similarity.example import Example, GroupedExample, grouped
from marey_motion.similarity.features import ROTATIONS_AT, mirrored
from marey_motion.similarity.shard_search import RankedWindow, SearchedShard, ShardSearch, Weighing
from marey_motion.similarity.shards import Shard
from marey_motion.similarity.weighing import MetricTables, metric_tables, require_searchable

_FIRST_STEPS = 128
_STEPS_PER_HIT = 12
_MORE_STEPS = 8


class Hit(NamedTuple):
    """Window that resembles the example, and its distance from the example.

    `shard`, `run` and `row` are the indices of the shard, of the run (the clip) in the shard, and of the window's first
    row in the run. `mirrored` is True if the mirrored example is nearer than the example itself.
    """

    shard: int
    run: int
    row: int
    distance: float
    mirrored: bool


def search_windows(
    shards: Sequence[SearchedShard],
    example: Example,
    metric: PerceptualMetric,
    count: int,
    *,
    mirror: bool = False,
    threads: int = 1,
) -> list[Hit]:
    """Find the windows with the least mean distance from an example, without overlaps.

    The nearest window is the first hit, and all windows that overlap it are dropped. The nearest of the remaining
    windows is the next hit, and so on.

    Parameters
    ----------
    shards : sequence of SearchedShard    shards to search
    example : Example    window to search for
    metric : PerceptualMetric    metric of poses
    count : int    greatest number of hits
    mirror : bool    also compare each window with the mirrored example, and take the lesser distance
    threads : int    number of threads

    Returns
    -------
    list of Hit    in ascending order of distance; the result is exact, and does not depend on the number of threads

    Raises
    ------
    MotionError    if the metric superposes pairs of poses, or needs joints that the example does not have
    """
    tables = _tables_for(example, metric)
    examples = [example] if not mirror else [example, Example(mirrored(example.poses), example.offsets)]
    with ThreadPoolExecutor(threads) as pool:
        search = _Searches(shards, [grouped(one, tables) for one in examples], metric, count, pool)
        return [search.as_hit(shards[number], number, window) for window, number in search.best()]


def search_clips(
    shards: Sequence[SearchedShard],
    example: Example,
    metric: PerceptualMetric,
    distance: float,
    count: int,
    *,
    below: bool = False,
    threads: int = 1,
) -> list[tuple[int, int]]:
    """Find the clips that have a window with at most a certain mean distance from an example.

    Parameters
    ----------
    shards : sequence of SearchedShard    shards to search
    example : Example    window to search for
    metric : PerceptualMetric    metric of poses
    distance : float    greatest distance
    count : int    greatest number of clips; the search ends when this number is found
    below : bool    find only windows whose distance is less than `distance`, not equal to it
    threads : int    number of threads

    Returns
    -------
    list of (int, int)    for each clip, the index of its shard and of its run in the shard, ascending; the result is
        exact

    Raises
    ------
    MotionError    if the metric superposes pairs of poses, or needs joints that the example does not have
    """
    most = float(np.nextafter(distance, -np.inf)) if below else distance
    examples = [grouped(example, _tables_for(example, metric))]
    with ThreadPoolExecutor(threads) as pool:
        return _Searches(shards, examples, metric, count, pool).clips_within(most)


def _tables_for(example: Example, metric: PerceptualMetric) -> MetricTables:
    require_searchable(metric)
    tables = metric_tables(metric, example.poses.present)
    if tables is None:
        raise MotionError(
            "the joint mapping of the example's skeleton lacks joints that the metric compares; map head, arms and "
            "legs, or use another metric",
            code="mapping-invalid",
        )
    return tables


_Found = list[tuple[RankedWindow, int]]
"""Windows, each with the index of its shard."""


class _Searches:
    """Searches of all shards."""

    def __init__(
        self,
        shards: Sequence[SearchedShard],
        examples: Sequence[GroupedExample],
        metric: PerceptualMetric,
        count: int,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._examples, self._count, self._pool = examples, count, pool
        self._weighing = Weighing(metric, [one.example.poses for one in examples])
        self._searches = list(pool.map(lambda shard: ShardSearch(shard, examples, self._weighing), shards))
        self._best: _Found = []
        """Best windows of the shards searched so far."""
        self._lock = Lock()

    def best(self) -> _Found:
        """Find the hits in all shards, in ascending order of distance."""
        wanted = max(_FIRST_STEPS, _STEPS_PER_HIT * self._count)
        while True:
            self._search_steps(wanted)
            if np.isfinite(most := self._worst()):
                self._search_up_to(most)
            if len(self._best) == self._count or wanted >= sum(len(one.least) for one in self._searches):
                return self._best
            wanted *= _MORE_STEPS

    def clips_within(self, most: float) -> list[tuple[int, int]]:
        """Find the indices of shard and run of the clips that have a window with a distance of at most `most`."""
        found = self._pool.map(lambda search: search.clips_within(most, self._count), self._searches)
        return [(number, run) for number, runs in enumerate(found) for run in runs][: self._count]

    def _search_steps(self, wanted: int) -> None:
        """Search, over all shards, the `wanted` steps with the lowest bounds."""
        lowest = [
            one.least if len(one.least) <= wanted else np.partition(one.least, wanted)[:wanted]
            for one in self._searches
        ]
        bounds = np.sort(np.concatenate([np.empty(0, np.float32), *lowest]))
        limit = bounds[wanted - 1] if wanted < len(bounds) else np.inf
        self._search_all(lambda search: search.best_in_steps(limit, wanted, self._count))

    def _search_up_to(self, most: float) -> None:
        """Find the best windows with distances up to a limit, which falls as soon as enough windows have been found.

        Each shard gives its exact best windows, so the worst of them is a valid limit for the remaining shards.
        """
        self._search_all(lambda search: search.best_up_to(min(most, self._worst()), self._count))

    def _search_all(self, best_of: Callable[[ShardSearch], list[RankedWindow]]) -> None:
        self._best = []

        def search(number: int) -> None:
            best = [(window, number) for window in best_of(self._searches[number])]
            with self._lock:
                self._best = sorted([*self._best, *best])[: self._count]

        list(self._pool.map(search, range(len(self._searches))))

    def _worst(self) -> float:
        best = self._best
        return best[-1][0].distance if len(best) == self._count else np.inf

    def as_hit(self, searched: SearchedShard, number: int, window: RankedWindow) -> Hit:
        """Convert a window to a hit, and find whether the example or its mirrored copy is nearer to the window."""
        hit = Hit(number, window.run, window.row, window.distance, False)
        if len(self._examples) == 1:
            return hit
        shard = searched.load()
        plain, turned = (self._exactly(one.example, shard, window) for one in self._examples)
        return hit._replace(mirrored=turned < plain)

    def _exactly(self, example: Example, shard: Shard, window: RankedWindow) -> float:
        from marey_motion.similarity.similarity_kernels import pose_distance

        known = self._weighing.tables(int(shard.joints[window.run]))
        assert known is not None, "hits are of skeletons that can be compared"
        rows = shard.rows[shard.runs.starts[window.run] + window.row + example.offsets]
        pairs = zip(example.poses.rows, rows, strict=True)
        return float(np.mean([pose_distance(one, row, known, ROTATIONS_AT) for one, row in pairs]))
