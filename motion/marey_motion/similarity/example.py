"""Example of a search: the poses of a window of a clip, and groups of similar poses for a first, rough comparison."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey_motion.arrays import Ints
from marey_motion.similarity.features import INDEX_RATE_HZ, ROTATED_JOINTS, ROTATIONS_AT, VECTORS, PoseFeatures, Rows
from marey_motion.similarity.shards import STEP_ROWS
from marey_motion.similarity.weighing import MetricTables

MOST_SAMPLES = 32
"""Maximum number of compared poses of a window: one in each step, or in every second step, every third, and so on."""
SHORTEST_SEPARATION_ROWS = 15
"""Least distance between the starts of two hits in a clip, in rows: half a second, even for a single pose."""
_SAMPLES_PER_GROUP = 2.0


@dataclass(frozen=True, eq=False)
class Example:
    """Window of a clip for which similar windows are searched.

    Parameters
    ----------
    poses : PoseFeatures    T sampled poses
    offsets : (T,) int64    rows from the start of the window to each pose, ascending from 0
    """

    poses: PoseFeatures
    offsets: Ints

    @cached_property
    def order(self) -> Ints:
        """Order (T,) in which poses are compared: poses far apart in time come first, because they differ most."""
        count = len(self.offsets)
        return np.argsort([int(f"{place:05b}"[::-1], 2) for place in range(count)], kind="stable")

    def rows_around(self, frame: float, rate_hz: float) -> tuple[int, int]:
        """Find the rows of the example's own clip at which windows start that overlap the example.

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
        """Least distance of the starts of two hits in a clip, in rows: the window's length, at least half a second."""
        return max(SHORTEST_SEPARATION_ROWS, int(self.offsets[-1]) + 1)


@dataclass(frozen=True, eq=False)
class GroupedExample:
    """Example whose samples (compared poses) are enclosed in a few balls, each with a centre and radii.

    Parameters
    ----------
    example : Example    T samples
    groups : (T,) int64    number of the ball that encloses each sample
    turns : (T,) int64    order in which samples are compared with rows: samples in wide balls come first, because their
        distances exceed the bound of the ball most
    centres : (G, WIDTH) float32    centres of the balls
    reaches : (G, 41) float32    radii of the balls: of each vector, then of each rotation
    """

    example: Example
    groups: Ints
    turns: Ints
    centres: Rows
    reaches: Rows


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


def grouped(example: Example, tables: MetricTables) -> GroupedExample:
    """Enclose similar samples of an example in balls; this affects only the time of a search, not its result.

    Parameters
    ----------
    example : Example    T samples
    tables : MetricTables    metric by which the similarity of samples is measured

    Returns
    -------
    GroupedExample    T samples in at most T / `_SAMPLES_PER_GROUP` balls, rounded up
    """
    from marey_motion.similarity.similarity_kernels import balls, group_samples

    rows = np.ascontiguousarray(example.poses.rows)
    groups, distances = np.zeros(len(rows), np.int64), np.empty(len(rows))
    count = group_samples(rows, tables, ROTATIONS_AT, math.ceil(len(rows) / _SAMPLES_PER_GROUP), groups, distances)
    starts = np.concatenate(([0], np.cumsum(np.bincount(groups, minlength=count))))
    centres = np.empty((rows.shape[1], count), np.float32)
    reaches = np.empty((VECTORS + len(ROTATED_JOINTS), count), np.float32)
    ordered = rows[np.argsort(groups, kind="stable")]
    balls(ordered, starts, len(rows), VECTORS, len(ROTATED_JOINTS), centres, reaches)
    reached = np.bincount(groups, distances, count) / np.bincount(groups, minlength=count)
    turns = example.order[np.argsort(-reached[groups[example.order]], kind="stable")]
    return GroupedExample(example, groups, turns, np.ascontiguousarray(centres.T), np.ascontiguousarray(reaches.T))
