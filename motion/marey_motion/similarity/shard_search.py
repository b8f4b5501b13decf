"""Search of one shard: bounds of its steps, and the windows whose distance from an example is at most a limit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import Flags, Floats, Ints
from marey_motion.perception.metric import PerceptualMetric
from marey_motion.similarity.example import GroupedExample
from marey_motion.similarity.features import ROTATIONS_AT, VECTORS, PoseFeatures, Rows
from marey_motion.similarity.shards import STEP_ROWS, STEPS_PER_BALL, Shard, joints_of
from marey_motion.similarity.weighing import MetricTables, metric_tables

_CLIP_STEPS = 4_096
"""Number of steps whose windows are compared at a time in a search for clips."""

Windows = Mapping[int, tuple[int, int]]
"""Half-open ranges of rows, by run, in which no hit may start."""


@dataclass(frozen=True, eq=False)
class SearchedShard:
    """Shard to search, with the runs and windows that are excluded from the search.

    Parameters
    ----------
    load : function    returns the shard; called whenever the arrays of the shard are needed, so that not all shards
        must be mapped into memory at once
    ranks : (R,) int64    rank of each run among all clips; of windows with equal distances, the lowest rank comes first
    closed : (R,) bool    True for runs that are not searched
    closed_windows : mapping of int to tuple of int    by run, a half-open range of rows in which no hit may start
    """

    load: Callable[[], Shard]
    ranks: Ints
    closed: Flags
    closed_windows: Windows = field(default_factory=dict)


class RankedWindow(NamedTuple):
    """Window of a shard; hits are sorted by distance, rank of the clip, and row."""

    distance: float
    rank: int
    row: int
    run: int


class ComparedRuns(NamedTuple):
    """Runs of a shard whose skeletons have the same joints, with the tables by which they are compared.

    Parameters
    ----------
    tables : MetricTables    tables of the metric
    chosen : (R,) bool    True for the runs with these joints
    ranges : (n, 2) int64    half-open ranges of the balls of these runs
    """

    tables: MetricTables
    chosen: Flags
    ranges: Ints


class Weighing:
    """Tables of a metric for the joints that the examples and a clip have in common, cached by the clip's joints."""

    def __init__(self, metric: PerceptualMetric, examples: Sequence[PoseFeatures]) -> None:
        self._metric, self._present = metric, np.logical_and.reduce([one.present for one in examples])
        self._known: dict[int, MetricTables | None] = {}

    def tables(self, joints: int) -> MetricTables | None:
        """Return the tables by which clips with certain joints are compared with the examples.

        Parameters
        ----------
        joints : int    joints of the clips, as encoded by `shards.presence`

        Returns
        -------
        MetricTables or None    the tables; None if the clips lack joints that the metric needs
        """
        if joints not in self._known:
            self._known[joints] = metric_tables(self._metric, joints_of(joints) & self._present)
        return self._known[joints]

    def kinds(self, searched: SearchedShard, shard: Shard, length: int) -> list[ComparedRuns]:
        """Group the searched runs of a shard by the joints that their skeletons have.

        Parameters
        ----------
        searched : SearchedShard    the shard, with the runs that are not searched
        shard : Shard    content of the shard
        length : int    rows from the first to the last compared pose of a window; shorter runs have no window

        Returns
        -------
        list of ComparedRuns    one for each set of joints that has the joints that the metric needs
        """
        short = np.diff(shard.runs.starts) <= length
        joints, balls = np.where(searched.closed | short, -1, shard.joints), shard.runs.balls
        edges = np.concatenate(([0], np.flatnonzero(joints[1:] != joints[:-1]) + 1, [len(joints)]))
        values = joints[edges[:-1]]
        kinds = []
        for kind in set(values.tolist()) - {-1}:
            known = self.tables(kind)
            if known is not None:
                mine = values == kind
                ranges = np.stack([balls[edges[:-1][mine]], balls[edges[1:][mine]]], axis=1)
                kinds.append(ComparedRuns(known, joints == kind, ranges))
        return kinds


class ShardSearch:
    """Search of a shard: computes bounds of all steps, and then the distances of windows in some of them.

    The bounds of poses stay in memory, because later calls need them again: 4 bytes for each ball and group of samples.
    The arrays of the shard do not stay in memory.

    Parameters
    ----------
    searched : SearchedShard    the shard to search
    examples : sequence of GroupedExample    the example, or the example and its mirrored copy; the distance of a window
        is the lesser of the distances from both
    weighing : Weighing    tables of the metric
    """

    def __init__(self, searched: SearchedShard, examples: Sequence[GroupedExample], weighing: Weighing) -> None:
        self._searched, self._examples = searched, examples
        shard = searched.load()
        self._runs = shard.runs
        self._kinds = weighing.kinds(searched, shard, int(examples[0].example.offsets[-1]))
        self._bounds = [self._bound(one, shard) for one in examples]
        """Bounds of poses (G, balls) and of the sums of windows (S,), for each example."""
        sums = [each for _, each in self._bounds]
        self.least: Rows = sums[0] if len(sums) == 1 else np.minimum(*sums)
        """Lower bounds (S,) of the sums of distances of the windows that start in each step; infinity if none does."""

    def best_in_steps(self, limit: float, most: int, count: int) -> list[RankedWindow]:
        """Find the best windows in the steps with the lowest bounds.

        Parameters
        ----------
        limit : float    greatest bound of a step
        most : int    greatest number of steps to search
        count : int    greatest number of windows

        Returns
        -------
        list of RankedWindow    ascending, without overlaps
        """
        steps = np.flatnonzero((self.least <= limit) & (self.least < np.inf))[:most]
        return self._best(steps, np.inf, count)

    def best_up_to(self, most: float, count: int) -> list[RankedWindow]:
        """Find the best windows with distances up to a limit.

        Parameters
        ----------
        most : float    greatest distance
        count : int    greatest number of windows

        Returns
        -------
        list of RankedWindow    ascending, without overlaps
        """
        from marey_motion.similarity.similarity_kernels import loosened

        limit = loosened(most, len(self._examples[0].groups))
        return self._best(np.flatnonzero(self.least <= np.float32(limit)), most, count)

    def clips_within(self, most: float, count: int) -> list[int]:
        """Find the runs that have a window with a distance of at most `most`.

        The step with the lowest bound of every run is compared first, then the next two steps of every run, then the
        next four, and so on. As soon as a run has been found, its other steps are skipped.

        Parameters
        ----------
        most : float    greatest distance
        count : int    greatest number of runs; the search ends when this number is found

        Returns
        -------
        list of int    indices of runs, ascending
        """
        from marey_motion.similarity.similarity_kernels import loosened

        limit = loosened(most, len(self._examples[0].groups))
        left = np.flatnonzero(self.least <= np.float32(limit))
        runs = np.searchsorted(self._runs.firsts, left, side="right") - 1
        by_run = np.lexsort((self.least[left], runs))
        left, runs = left[by_run], runs[by_run]
        rounds = np.log2(np.arange(len(runs)) - np.searchsorted(runs, runs) + 1).astype(np.int64)
        order = np.argsort(rounds, kind="stable")
        left, runs = left[order], runs[order]
        found: list[int] = []
        while len(left) and len(found) < count:
            found += self._runs_within(np.sort(left[:_CLIP_STEPS]), most)
            unknown = ~np.isin(runs[_CLIP_STEPS:], found)
            left, runs = left[_CLIP_STEPS:][unknown], runs[_CLIP_STEPS:][unknown]
        return sorted(found)[:count]

    def _runs_within(self, steps: Ints, most: float) -> list[int]:
        """Find the runs that have a window, starting in one of `steps`, with a distance of at most `most`."""
        runs, rows, distances = self._windows(steps, most)
        near = distances <= most
        for run, (low, high) in self._searched.closed_windows.items():
            near &= (runs != run) | (rows < low) | (rows >= high)
        return list(np.unique(runs[near]).tolist())

    def _bound(self, query: GroupedExample, shard: Shard) -> tuple[Rows, Rows]:
        from marey_motion.similarity.bounding_kernels import pose_bounds, step_sums

        poses = np.full((len(query.centres), shard.centres.shape[1]), np.inf, np.float32)
        for tables, _, ranges in self._kinds:
            pose_bounds(query.centres, query.reaches, shard.centres, shard.radii, ranges, tables, VECTORS, poses)
        sums = np.empty(shard.runs.firsts[-1], np.float32)
        steps = query.example.offsets // STEP_ROWS
        step_sums(poses, query.groups, steps, shard.runs.firsts, shard.runs.balls, STEPS_PER_BALL, sums)
        return poses, sums

    def _best(self, steps: Ints, most: float, count: int) -> list[RankedWindow]:
        """Find the nearest windows without overlaps that start in `steps`, in ascending order of distance."""
        if not len(steps):
            return []
        runs, rows, distances = self._windows(steps, most)
        ranks = self._searched.ranks[runs]
        separation_rows = self._examples[0].example.separation_rows
        hits: list[RankedWindow] = []
        for at in np.lexsort((rows, ranks, distances)):
            row, run = int(rows[at]), int(runs[at])
            low, high = self._searched.closed_windows.get(run, (0, 0))
            if low <= row < high or any(run == hit.run and abs(row - hit.row) < separation_rows for hit in hits):
                continue
            hits.append(RankedWindow(float(distances[at]), int(ranks[at]), row, run))
            if len(hits) == count:
                break
        return hits

    def _windows(self, steps: Ints, most: float) -> tuple[Ints, Ints, Floats]:
        """Return run, first row and distance of windows in `steps`; windows farther than `most` may be left out."""
        runs = np.searchsorted(self._runs.firsts, steps, side="right") - 1
        places, columns, distances = self._distances(steps, runs, most)
        runs = runs[places]
        return runs, (steps[places] - self._runs.firsts[runs]) * STEP_ROWS + columns, distances

    def _distances(self, steps: Ints, runs: Ints, most: float) -> tuple[Ints, Ints, Floats]:
        """Compute the distances of windows that start in `steps`; windows farther than `most` may be left out.

        Returns, for each window, the index of its step in `steps`, its first row within the step, and its distance.
        """
        from marey_motion.similarity.similarity_kernels import step_distances

        shard = self._searched.load()
        out = np.full((len(steps), STEP_ROWS), np.inf)
        layout = (STEP_ROWS, STEPS_PER_BALL, VECTORS, np.empty(len(shard.radii), np.float32))
        for tables, chosen, _ in self._kinds:
            mine = np.flatnonzero(chosen[runs])
            found = np.full((len(mine), STEP_ROWS), np.inf)
            for query, (poses, sums) in zip(self._examples, self._bounds, strict=True):
                one = query.example
                samples = (one.poses.rows, one.offsets, query.groups, one.order, query.turns)
                bounds = (poses, sums[steps[mine]])
                step_distances(
                    samples, shard.rows, bounds, steps[mine], self._runs, layout, tables, ROTATIONS_AT, most, found
                )
            out[mine] = found
        places, columns = np.nonzero(out < np.inf)
        return places, columns, out[places, columns]
