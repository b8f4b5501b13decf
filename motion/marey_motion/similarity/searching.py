"""Exact search for the windows of many clips that resemble a window of a clip.

Every step of rows has a lower bound of the distances of the windows that start in it. The steps with the lowest bounds
are compared first. Once enough hits are known, only steps whose bound is not above the worst hit are left, and all of
these are compared. So the result is that of comparing all windows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Flags, Ints
from marey_motion.errors import MotionError
from marey_motion.perception.metric import PerceptualMetric
from marey_motion.similarity.features import INDEX_RATE_HZ, ROTATIONS_AT, VECTORS, PoseFeatures, mirrored
from marey_motion.similarity.shards import STEP_ROWS, STEPS_PER_BALL, Runs, Shard, joints_of
from marey_motion.similarity.weighing import MetricTables, metric_tables, require_searchable

MOST_SAMPLES = 32
"""Greatest number of poses of a window that are compared: one in each step, or in every second step, and so on."""
SHORTEST_SEPARATION_ROWS = 15
"""Hits in one clip start at least half a second apart, even if the example is a single pose."""
_FIRST_STEPS = 256
_STEPS_PER_HIT = 16
_MORE_STEPS = 8
_CLIP_STEPS = 4_096

Windows = Mapping[int, tuple[int, int]]
"""Half-open ranges of rows, by run, in which no hit may start."""


@dataclass(frozen=True, eq=False)
class Example:
    """Window of a clip that is searched for.

    Parameters
    ----------
    poses : PoseFeatures    T sampled poses
    offsets : (T,) int64    rows from the start of the window to each pose, ascending from 0
    """

    poses: PoseFeatures
    offsets: Ints

    @cached_property
    def order(self) -> Ints:
        """Order in which poses are compared: first those that are far apart, which differ in different ways."""
        count = len(self.offsets)
        return np.argsort([int(f"{place:05b}"[::-1], 2) for place in range(count)], kind="stable")

    def rows_around(self, frame: float, rate_hz: float) -> tuple[int, int]:
        """Find the rows at which the windows start that overlap the example.

        Parameters
        ----------
        frame : float    first frame of the example in its clip
        rate_hz : float    frames per second of the clip

        Returns
        -------
        tuple of int    half-open range of rows of the clip
        """
        row = frame * INDEX_RATE_HZ / rate_hz
        return math.floor(row - self.separation_rows) + 1, math.ceil(row + self.separation_rows)

    @property
    def separation_rows(self) -> int:
        """Least distance of the starts of two hits in one clip: the length of the window."""
        return max(SHORTEST_SEPARATION_ROWS, int(self.offsets[-1]) + 1)


@dataclass(frozen=True, eq=False)
class SearchedShard:
    """Shard, and what of it is searched.

    Parameters
    ----------
    load : function    returns the shard; called whenever its arrays are needed, so that not all need be mapped
    ranks : (R,) int64    place of each run in an order of all clips, which decides between equal distances
    closed : (R,) bool    runs that are not searched
    closed_windows : mapping of int to tuple of int    ranges of rows of a run in which no hit may start
    """

    load: Callable[[], Shard]
    ranks: Ints
    closed: Flags
    closed_windows: Windows = field(default_factory=dict)


class Hit(NamedTuple):
    """Window that resembles the example: its shard, run and first row in the run, and its distance."""

    shard: int
    run: int
    row: int
    distance: float
    mirrored: bool


def sample_offsets(duration_s: float) -> Ints:
    """Choose the poses of a window that are compared.

    Parameters
    ----------
    duration_s : float    seconds from the first to the last pose of the window

    Returns
    -------
    (T,) int64    rows from the start of the window, ascending from 0
    """
    steps = int(duration_s * INDEX_RATE_HZ / STEP_ROWS + 1e-6)
    return np.arange(0, steps + 1, steps // MOST_SAMPLES + 1) * STEP_ROWS


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

    The hit with the least distance is taken first; the hits that overlap it are dropped, and so on.

    Parameters
    ----------
    shards : sequence of SearchedShard    what is searched
    example : Example    window to search for
    metric : PerceptualMetric    metric of poses
    count : int    greatest number of hits
    mirror : bool    also compare each window with the mirrored example, and take the lesser distance
    threads : int    number of threads

    Returns
    -------
    list of Hit    in ascending order of distance; the same as without bounds

    Raises
    ------
    MotionError    if the metric superposes pairs of poses, or needs joints that the example does not have
    """
    _require_comparable(example, metric)
    examples = [example] if not mirror else [example, Example(mirrored(example.poses), example.offsets)]
    with ThreadPoolExecutor(threads) as pool:
        search = _WindowSearch(shards, examples, metric, pool)
        return [search.told(*hit) for hit in search.best(count)]


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
    shards : sequence of SearchedShard    what is searched
    example : Example    window to search for
    metric : PerceptualMetric    metric of poses
    distance : float    greatest distance
    count : int    greatest number of clips; the search ends when so many are found
    below : bool    exclude the distance itself
    threads : int    number of threads

    Returns
    -------
    list of tuple of int    shard and run of each clip, ascending; the same as without bounds

    Raises
    ------
    MotionError    as for `search_windows`
    """
    most = float(np.nextafter(distance, -np.inf)) if below else distance
    _require_comparable(example, metric)
    with ThreadPoolExecutor(threads) as pool:
        return _WindowSearch(shards, [example], metric, pool).clips_within(most, count)


def _require_comparable(example: Example, metric: PerceptualMetric) -> None:
    require_searchable(metric)
    if metric_tables(metric, example.poses.present) is None:
        raise MotionError(
            "the skeleton of the example has none of the joints that the metric compares", code="mapping-invalid"
        )


class _Place(NamedTuple):
    """Start of a window: number of the shard, run, and row in the run."""

    shard: int
    run: int
    row: int


class _WindowSearch:
    """State of a search: bounds of all steps, and the distances of windows in the steps compared so far."""

    def __init__(
        self,
        shards: Sequence[SearchedShard],
        examples: Sequence[Example],
        metric: PerceptualMetric,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._shards, self._examples, self._metric, self._pool = shards, examples, metric, pool
        self._known_tables: dict[int, MetricTables | None] = {}
        found = list(pool.map(self._bound, shards))
        self._runs = [runs for _, runs in found]
        self._ends = np.cumsum([len(bounds) for bounds, _ in found])
        self._bounds = np.concatenate([np.empty(0, np.float32), *(bounds for bounds, _ in found)])
        self._limits = np.full(len(self._bounds), -1.0)
        """Greatest distance up to which the windows of each step are known."""
        self._distances = np.full((len(self._bounds), STEP_ROWS), np.inf)

    def best(self, count: int) -> list[tuple[_Place, float]]:
        """Find the places and distances of the hits."""
        hits: list[tuple[_Place, float]] = []
        possible = int(np.isfinite(self._bounds).sum())
        wanted, most = min(max(_FIRST_STEPS, _STEPS_PER_HIT * count), possible), np.inf
        while len(left := self._unknown(wanted, most)):
            self._compare(left, most)
            hits = self._without_overlaps(count)
            most = hits[-1][1] if len(hits) == count else np.inf
            if np.isinf(most):
                wanted = min(wanted * _MORE_STEPS, possible)
        return hits

    def told(self, place: _Place, distance: float) -> Hit:
        """Describe a hit, and find whether the example or its mirrored copy is nearer."""
        apart = [self._exactly(one, place) for one in self._examples]
        return Hit(*place, distance, len(apart) > 1 and apart[1] < apart[0])

    def clips_within(self, most: float, count: int) -> list[tuple[int, int]]:
        """Find the shard and run of up to `count` clips that have a window up to a distance.

        For each clip, the step with the lowest bound comes first, then its next two, its next four, and so on. The
        steps of clips that were found are not compared any more.
        """
        left = np.flatnonzero(self._bounds <= most)
        offsets = np.cumsum([0, *(len(runs.starts) - 1 for runs in self._runs)])
        places = self._places(left, np.zeros_like(left))
        clips = offsets[places[:, 0]] + places[:, 1]
        by_clip = np.lexsort((self._bounds[left], clips))
        left, clips = left[by_clip], clips[by_clip]
        rounds = np.log2(np.arange(len(clips)) - np.searchsorted(clips, clips) + 1).astype(np.int64)
        order = np.argsort(rounds, kind="stable")
        left, clips = left[order], clips[order]
        found: list[int] = []
        while len(left) and len(found) < count:
            steps, here = left[:_CLIP_STEPS], clips[:_CLIP_STEPS]
            self._compare(np.sort(steps), most)
            new = np.unique(here[self._distances[steps].min(axis=1) <= most])
            found += new.tolist()
            unknown = ~np.isin(clips[_CLIP_STEPS:], new)
            left, clips = left[_CLIP_STEPS:][unknown], clips[_CLIP_STEPS:][unknown]
        chosen = np.sort(found).astype(np.int64)[:count]
        shards = np.searchsorted(offsets, chosen, side="right") - 1
        return list(zip(shards.tolist(), (chosen - offsets[shards]).tolist(), strict=True))

    def _bound(self, searched: SearchedShard) -> tuple[NDArray[np.float32], Runs]:
        """Compute the bounds of a shard's steps: infinity where no window starts, or none may."""
        from marey_motion.similarity.similarity_kernels import pose_bounds, step_bounds

        shard = searched.load()
        least = np.full(shard.runs.firsts[-1], np.inf, np.float32)
        for example in self._examples:
            poses = np.full((len(example.offsets), shard.centres.shape[1]), np.inf, np.float32)
            for tables, chosen in self._tables(searched, shard):
                mine = np.repeat(chosen, np.diff(shard.runs.balls))
                pose_bounds(example.poses.rows, shard.centres, shard.radii, mine, tables, VECTORS, poses)
            out = np.empty_like(least)
            step_bounds(poses, example.offsets // STEP_ROWS, shard.runs.firsts, shard.runs.balls, STEPS_PER_BALL, out)
            np.minimum(least, out, out=least)
        return least, shard.runs

    def _tables(self, searched: SearchedShard, shard: Shard) -> list[tuple[MetricTables, Flags]]:
        """List the tables for the skeletons in a shard, each with the runs (R,) that are searched with them."""
        made = []
        for joints in map(int, np.unique(shard.joints[~searched.closed])):
            tables = self._tables_for(joints)
            if tables is not None:
                made.append((tables, (shard.joints == joints) & ~searched.closed))
        return made

    def _tables_for(self, joints: int) -> MetricTables | None:
        """Compute the tables for the example and clips with these joints; equal tables are computed once."""
        if joints not in self._known_tables:
            present = np.logical_and.reduce([joints_of(joints), *(one.poses.present for one in self._examples)])
            self._known_tables[joints] = metric_tables(self._metric, present)
        return self._known_tables[joints]

    def _unknown(self, wanted: int, most: float) -> Ints:
        """List the steps, ascending, that may hold windows up to a distance, and have not been compared up to it.

        Without a distance, the `wanted` steps with the lowest bounds are meant.
        """
        if np.isinf(most):
            chosen = np.argpartition(self._bounds, wanted - 1)[:wanted] if wanted else np.empty(0, np.int64)
        else:
            chosen = np.flatnonzero(self._bounds <= most)
        return np.sort(chosen[self._limits[chosen] < most])

    def _compare(self, steps: Ints, most: float) -> None:
        """Compute the distances of the windows that start in some steps, as far as they are at most `most`."""
        numbers = np.searchsorted(self._ends, steps, side="right")
        parts = [(number, steps[numbers == number]) for number in np.unique(numbers)]
        list(self._pool.map(lambda part: self._compare_in(part[0], part[1], most), parts))
        self._limits[steps] = most

    def _compare_in(self, number: int, steps: Ints, most: float) -> None:
        from marey_motion.similarity.similarity_kernels import step_distances

        searched = self._shards[number]
        shard, inner = searched.load(), steps - self._first_step(number)
        out = np.full((len(steps), STEP_ROWS), np.inf)
        runs = np.searchsorted(shard.runs.firsts, inner, side="right") - 1
        places = (shard.runs.starts, shard.runs.firsts, STEP_ROWS)
        for tables, chosen in self._tables(searched, shard):
            mine = np.flatnonzero(chosen[runs])
            found = np.full((len(mine), STEP_ROWS), np.inf)
            for example in self._examples:
                poses = (example.poses.rows[example.order], example.offsets[example.order], shard.rows, inner[mine])
                step_distances(*poses, *places, tables, ROTATIONS_AT, most, found)
            out[mine] = found
        for run, (low, high) in searched.closed_windows.items():
            here = np.flatnonzero(runs == run)
            rows = (inner[here] - shard.runs.firsts[run])[:, None] * STEP_ROWS + np.arange(STEP_ROWS)
            out[here] = np.where((rows >= low) & (rows < high), np.inf, out[here])
        self._distances[steps] = out

    def _without_overlaps(self, count: int) -> list[tuple[_Place, float]]:
        """Take the least distance, drop the windows that overlap it, and so on."""
        steps, columns = np.nonzero(np.isfinite(self._distances))
        left, places = self._distances[steps, columns], self._places(steps, columns)
        ranks = np.empty(len(left), np.int64)
        for number in np.unique(places[:, 0]):
            here = places[:, 0] == number
            ranks[here] = self._shards[number].ranks[places[here, 1]]
        hits: list[tuple[_Place, float]] = []
        while len(hits) < count and len(left) and np.isfinite(least := left.min()):
            equal = np.flatnonzero(left == least)
            best = equal[np.lexsort((places[equal, 2], ranks[equal]))[0]]
            hits.append((_Place(*map(int, places[best])), float(least)))
            near = np.abs(places[:, 2] - places[best, 2]) < self._examples[0].separation_rows
            left[(ranks == ranks[best]) & near] = np.inf
        return hits

    def _places(self, steps: Ints, columns: Ints) -> Ints:
        """Find shard, run and row in the run of windows (n, 3)."""
        places = np.empty((len(steps), 3), np.int64)
        places[:, 0] = np.searchsorted(self._ends, steps, side="right")
        for number in np.unique(places[:, 0]):
            here = places[:, 0] == number
            inner, firsts = steps[here] - self._first_step(number), self._runs[number].firsts
            runs = np.searchsorted(firsts, inner, side="right") - 1
            places[here, 1] = runs
            places[here, 2] = (inner - firsts[runs]) * STEP_ROWS + columns[here]
        return places

    def _first_step(self, number: int) -> int:
        return int(self._ends[number - 1]) if number else 0

    def _exactly(self, example: Example, place: _Place) -> float:
        from marey_motion.similarity.similarity_kernels import pose_distance

        searched = self._shards[place.shard]
        shard = searched.load()
        tables = self._tables_for(int(shard.joints[place.run]))
        rows = shard.rows[shard.runs.starts[place.run] + place.row + example.offsets]
        apart = [
            pose_distance(one, row, tables, ROTATIONS_AT) for one, row in zip(example.poses.rows, rows, strict=True)
        ]
        return float(np.mean(apart))
