"""Exact nearest neighbours, as motion matching needs them, compared with numpy, scipy's KDTree and faiss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from benchmarks.material import matching_features
from benchmarks.timing import Row, Timing, time_in_turn
from marey_motion.matching.search import SearchIndex, build_index, find_nearest

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

TRIALS, SEARCHES = 40, 25
SEARCH_EVERY_ROWS = 6
NEW_GOAL_EVERY = 10
POSE_DIMENSIONS = 15
CLIPS_PER_HELD_OUT = 10
LEAST_AHEAD = 20
# Rows, how many of the queries the peers answer, repeats, microseconds a query may take.
SIZES = ((6_108, 1_000, 7, 10), (78_897, 200, 5, 30), (1_000_000, 20, 3, 2_000))
GOAL = 3
# This peer calculates in float32: of rows that are as near as that can tell, it may name another.
FLAT = "faiss flat"
FLOAT32_EXCESS = 1e-5


@dataclass(frozen=True)
class _Play:
    """Queries (Q, D) of characters that motion matching controls, and the row (Q,) displayed at each query."""

    queries: Floats
    shown: Rows


def run() -> list[Row]:
    """Measure on one thread. All libraries answer the same queries; in float64, they must find the same rows."""
    faiss.omp_set_num_threads(1)
    return [_race(*size, hard) for size in SIZES for hard in (False, True)]


def _race(row_count: int, peer_queries: int, repeats: int, goal_us: int, hard: bool) -> Row:
    rows, starts, desired = _database(row_count)
    selectable = np.ones(row_count, np.bool_)
    for stop in starts[1:]:
        selectable[max(0, stop - LEAST_AHEAD) : stop] = False
    index = build_index(rows, starts, selectable)
    play = _play(index, starts, desired, hard)
    some = np.linspace(0, len(play.queries) - 1, peer_queries).astype(int)
    found, costs = find_nearest(index, play.queries, warm_rows=play.shown)
    peers = _peers(rows, selectable)
    for name, answer in peers.items():
        theirs = answer(play.queries[some])
        if name != FLAT:
            assert (theirs == found[some]).all(), f"{name} finds other rows"
        excess = np.square(rows[theirs] - play.queries[some]).sum(axis=1) - costs[some]
        assert (excess <= FLOAT32_EXCESS * (1 + costs[some])).all(), f"{name} finds rows that are farther away"

    ours, *peer_times = time_in_turn(
        lambda: find_nearest(index, play.queries, warm_rows=play.shown),
        *(lambda answer=answer: answer(play.queries[some]) for answer in peers.values()),
        repeats=repeats,
    )
    us = ours.median_s * 1e6 / len(play.queries)
    quickest = min(timing.median_s for timing in peer_times) * 1e6 / peer_queries
    return Row(
        f"nearest row, {'another desired trajectory' if hard else 'a trajectory half way to the desired one'}",
        f"{row_count:,} rows",
        ours.shown(1e6 / len(play.queries), "µs"),
        ", ".join(_shown(name, timing, peer_queries) for name, timing in zip(peers, peer_times, strict=True)),
        quickest / us,
        f"≥ {GOAL}x the quickest, ≤ {goal_us:,} µs",
        quickest / us >= GOAL and us <= goal_us,
    )


def _shown(name: str, timing: Timing, queries: int) -> str:
    return f"{name} {timing.median_s * 1e6 / queries:,.0f}"


def _peers(rows: Floats, selectable: NDArray[np.bool_]) -> dict[str, Callable[[Floats], Rows]]:
    chosen = np.flatnonzero(selectable)
    kept = np.ascontiguousarray(rows[chosen])
    tree = KDTree(kept)
    flat: Any = faiss.IndexFlatL2(rows.shape[1])
    flat.add(kept.astype(np.float32))

    def numpy_answers(queries: Floats) -> Rows:
        return chosen[[int(np.square(kept - query).sum(axis=1).argmin()) for query in queries]]

    return {
        "numpy": numpy_answers,
        "KDTree": lambda queries: chosen[tree.query(queries)[1]],
        FLAT: lambda queries: chosen[flat.search(queries.astype(np.float32), 1)[1][:, 0]],
    }


def _database(row_count: int) -> tuple[Floats, Rows, Floats]:
    """Return normalised rows (N, D), the first row of each clip (row indices, with N at the end), and trajectories.

    The trajectories come from clips that are held out. The rows come from all other clips, followed by rows of
    copies of these clips with random changes of scale and offset. Copies are added until there are `row_count` rows.
    """
    clips = matching_features()
    rng = np.random.default_rng(row_count)
    order = rng.permutation(len(clips))
    held_out = -(-len(clips) // CLIPS_PER_HELD_OUT)
    desired = np.concatenate([clips[number] for number in order[:held_out]])[:, POSE_DIMENSIONS:]
    dimensions = desired.shape[1] + POSE_DIMENSIONS
    parts: list[Floats] = []
    starts = [0]
    while starts[-1] < row_count:
        for number in order[held_out:]:
            part = clips[number][: row_count - starts[-1]]
            if len(parts) >= len(order) - held_out:
                part = part * rng.normal(1.0, 0.08, dimensions) + rng.normal(0.0, 0.1, dimensions)
            parts.append(part)
            starts.append(starts[-1] + len(part))
            if starts[-1] == row_count:
                break
    return np.concatenate(parts), np.array(starts), desired


def _play(index: SearchIndex, starts: Rows, desired: Floats, hard: bool) -> _Play:
    """Return the queries of trials: a character searches again and again for a row that leads it towards a goal.

    A query has the pose of the displayed row and the trajectory to the goal. After a search, the character plays on
    from the row that was found, until the next query.
    """
    rng = np.random.default_rng(1)
    stops = np.repeat(starts[1:], np.diff(starts))
    shown = rng.choice(np.flatnonzero(index.selectable), TRIALS)
    queries, rows = [], []
    at = np.zeros(TRIALS, dtype=np.int64)
    for search in range(SEARCHES):
        if search % NEW_GOAL_EVERY == 0:
            at = rng.integers(0, len(desired), TRIALS)
        query = index.rows[shown]
        share = 1.0 if hard else 0.5
        query[:, POSE_DIMENSIONS:] += share * (desired[at] - query[:, POSE_DIMENSIONS:])
        queries.append(query)
        rows.append(shown)
        found, _ = find_nearest(index, query, warm_rows=shown)
        shown = np.minimum(found + SEARCH_EVERY_ROWS, stops[found] - 1)
        at = np.minimum(at + SEARCH_EVERY_ROWS, len(desired) - 1)
    # One trial after the other, as they are played.
    return _Play(np.stack(queries, axis=1).reshape(-1, index.rows.shape[1]), np.stack(rows, axis=1).reshape(-1))
