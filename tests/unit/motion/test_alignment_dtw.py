"""Dynamic time warping, compared with a simple dynamic program and with an enumeration of all paths."""

from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from tests.support.tiers import is_soak

from marey_motion.alignment.dtw import RangeBounds, align, distance_bound, distances, least_total, warped_distance
from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError

STEPS = ((1, 1), (1, 0), (0, 1))


def plain_total(costs: Floats) -> float:
    """Return the total cost of the best path, computed cell by cell with the recursion of textbooks."""
    n, m = costs.shape
    totals = np.full((n + 1, m + 1), np.inf)
    totals[0, 0] = 0.0
    for i, j in product(range(1, n + 1), range(1, m + 1)):
        totals[i, j] = costs[i - 1, j - 1] + min(totals[i - 1, j - 1], totals[i - 1, j], totals[i, j - 1])
    return float(totals[n, m])


def all_ways(n: int, m: int, max_run: int | None = None) -> Iterator[list[tuple[int, int]]]:
    """Yield every path from the first cell to the last one, as a list of cells."""

    def go(cells: list[tuple[int, int]], run_step: tuple[int, int] | None, run: int) -> Iterator[list[tuple[int, int]]]:
        i, j = cells[-1]
        if (i, j) == (n - 1, m - 1):
            yield cells
        for step in STEPS:
            there = i + step[0], j + step[1]
            length = run + 1 if step == run_step else 1
            barred = max_run is not None and step != (1, 1) and length > max_run
            if there[0] < n and there[1] < m and not barred:
                yield from go([*cells, there], step, length)

    yield from go([(0, 0)], None, 0)


def cheapest_way(costs: Floats, max_run: int | None = None) -> float | None:
    rows, columns = costs.shape
    return min((sum(costs[cell] for cell in way) for way in all_ways(rows, columns, max_run)), default=None)


def links_between_layers(max_run: int | None) -> list[tuple[int, tuple[int, int], int]]:
    """Return (layer, step, layer to which the step leads) for each step; each layer contains every cell once.

    The layer of a path depends on its last steps. In layer 0, the last step advanced in both motions. In the next
    `max_run` layers, the last 1 to `max_run` steps advanced in the first motion alone; in the remaining layers, in the
    second motion alone. Without a limit there is one layer.
    """
    if max_run is None:
        return [(0, step, 0) for step in STEPS]
    count = 1 + 2 * max_run
    links = [(layer, (1, 1), 0) for layer in range(count)]
    for first, step in ((1, (1, 0)), (1 + max_run, (0, 1))):
        run = range(first, first + max_run)
        for layer in range(count):
            after = layer + 1 if layer in run else first
            links += [(layer, step, after)] if after in run else []
    return links


def step_graph(n: int, m: int, max_run: int | None) -> Ints:
    """Return the nodes (2, e) at which each edge starts and ends; a node is an index into (layers, n, m)."""
    cells = np.arange(n * m).reshape(n, m)
    edges = [
        np.stack(
            (cells[: n - down, : m - right] + before * n * m, cells[down:, right:] + after * n * m), axis=-1
        ).reshape(-1, 2)
        for before, (down, right), after in links_between_layers(max_run)
    ]
    return np.concatenate(edges).T


def shortest_way(costs: Floats, edges: Ints) -> float:
    """Return the cost of the best path from the first cell to the last one, by Dijkstra's algorithm.

    An edge costs as much as the cell to which it leads. The path may end in any layer.
    """
    nodes = edges.max() + 1
    graph = coo_array((costs.ravel()[edges[1] % costs.size], tuple(edges)), shape=(nodes, nodes)).tocsr()
    return costs[0, 0] + dijkstra(graph, indices=0)[costs.size - 1 :: costs.size].min()


def walking_points(frames: int, speed: float = 1.0, phase: float = 0.0, points: int = 5, seed: int = 0) -> Floats:
    """Return points (frames, points, 3) that swing like limbs."""
    random = np.random.default_rng(seed)
    centres, swings, delays = (random.normal(size=(points, 3)) for _ in range(3))
    angle = speed * np.arange(frames)[:, None, None] / 8.0 + phase
    return centres + 0.3 * swings * np.sin(angle + delays)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2), (23, 31), (40, 17)])
def test_the_total_is_that_of_a_plain_dynamic_program(shape: tuple[int, int]) -> None:
    for seed in range(20):
        costs = np.random.default_rng(seed).random(shape)
        assert align(costs).total == pytest.approx(plain_total(costs), rel=1e-14)


@pytest.mark.parametrize("max_run", [None, 1, 3])
def test_totals_are_those_of_an_independent_library(max_run: int | None) -> None:
    edges = step_graph(23, 31, max_run)
    for seed in range(100 if is_soak() else 25):
        costs = np.random.default_rng(seed).random((23, 31))
        expected = shortest_way(costs, edges)
        assert align(costs, max_run=max_run).total == pytest.approx(expected, rel=0, abs=1e-12)
        assert least_total(costs, max_run=max_run) == pytest.approx(expected, rel=0, abs=1e-12)


@pytest.mark.parametrize("max_run", [None, 0, 1, 2, 3])
@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (4, 5), (5, 3), (5, 5)])
def test_no_way_that_keeps_the_limit_is_cheaper(shape: tuple[int, int], max_run: int | None) -> None:
    for seed in range(10):
        costs = np.random.default_rng(seed).random(shape)
        least = cheapest_way(costs, max_run)
        if least is None:
            with pytest.raises(MotionError, match="cannot be aligned"):
                align(costs, max_run=max_run)
        else:
            assert align(costs, max_run=max_run).total == pytest.approx(least, rel=1e-14)


@pytest.mark.parametrize("max_run", [None, 1, 2, 4])
def test_the_path_is_a_way_of_allowed_steps_that_costs_the_total(max_run: int | None) -> None:
    for seed in range(20):
        costs = np.random.default_rng(seed).random((25, 33))
        found = align(costs, max_run=max_run)
        path = found.path
        assert path[0].tolist() == [0, 0]
        assert path[-1].tolist() == [24, 32]
        steps = [tuple(step) for step in np.diff(path, axis=0).tolist()]
        assert set(steps) <= set(STEPS)
        assert costs[path[:, 0], path[:, 1]].sum() == pytest.approx(found.total, rel=1e-13)
        assert longest_run(steps) <= (max_run or 60)


def longest_run(steps: list[tuple[int, int]]) -> int:
    longest = run = 0
    for before, step in zip([None, *steps], steps, strict=False):
        run = 0 if step == (1, 1) else run + 1 if step == before else 1
        longest = max(longest, run)
    return longest


def test_a_wide_limit_changes_nothing() -> None:
    costs = np.random.default_rng(5).random((30, 34))
    assert align(costs, max_run=40).total == align(costs).total


def test_no_steps_in_one_motion_alone_leave_the_diagonal() -> None:
    costs = np.random.default_rng(6).random((12, 12))
    assert align(costs, max_run=0).path.tolist() == [[frame, frame] for frame in range(12)]


def test_of_equally_cheap_ways_the_one_with_steps_in_both_motions_is_taken() -> None:
    assert align(np.zeros((4, 4))).path.tolist() == [[0, 0], [1, 1], [2, 2], [3, 3]]
    assert align(np.zeros((4, 4)), max_run=2).path.tolist() == [[0, 0], [1, 1], [2, 2], [3, 3]]


def test_a_motion_played_slower_is_aligned_frame_by_frame_with_itself() -> None:
    motion = walking_points(40)
    slower = motion[np.repeat(np.arange(40), 2)]
    found = align(distances(motion, slower))
    assert found.total == 0.0
    assert np.array_equal(found.path[:, 0], found.path[:, 1] // 2)


def test_distances_are_mean_distances_of_points() -> None:
    a, b = walking_points(7, seed=1), walking_points(9, seed=2)
    expected = np.linalg.norm(a[:, None] - b[None], axis=-1).mean(axis=-1)
    assert np.allclose(distances(a, b), expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize("frames", [(1, 1), (1, 20), (35, 20), (20, 64)])
def test_the_distance_of_motions_is_the_total_of_their_alignment_per_frame_of_the_longer(
    frames: tuple[int, int],
) -> None:
    a, b = walking_points(frames[0], seed=3), walking_points(frames[1], 1.3, 0.4, seed=3)
    assert warped_distance(a, b) == pytest.approx(align(distances(a, b)).total / max(frames), rel=1e-13)
    assert warped_distance(a, b) == pytest.approx(warped_distance(b, a), rel=1e-13)


def test_a_limit_gives_up_exactly_what_is_above_it() -> None:
    a, b = walking_points(50, seed=4), walking_points(60, 1.2, seed=4)
    distance = warped_distance(a, b)
    assert warped_distance(a, b, limit=distance * 1.000001) == distance
    assert warped_distance(a, b, limit=distance * 0.999999) == np.inf


def test_the_bound_is_never_above_the_distance_and_tells_distant_motions_apart() -> None:
    for seed in range(30):
        a = walking_points(20 + seed, 1.0 + 0.05 * seed, seed=seed)
        b = walking_points(45 - seed, 1.4, 0.1 * seed, seed=seed + seed % 2)
        one_box, many = distance_bound(a, b, frames_per_box=1000), distance_bound(a, b, frames_per_box=5)
        assert 0.0 <= one_box <= many <= warped_distance(a, b)
    apart = walking_points(30) + 10.0
    assert distance_bound(walking_points(30), apart, frames_per_box=1000) > 5.0


def test_bounds_of_many_motions_at_once_are_those_of_one_box_about_each() -> None:
    motions = [walking_points(10 + 7 * seed, 1.0 + 0.1 * seed, 0.2 * seed, seed=seed) for seed in range(8)]
    stops = np.cumsum([len(motion) for motion in motions])
    ranges = RangeBounds(np.concatenate(motions), stops - np.array([len(motion) for motion in motions]), stops)
    for one in range(8):
        others = np.arange(one, 8)
        bounds = ranges.between(one, others)
        exact = [distance_bound(motions[one], motions[other], frames_per_box=1000) for other in others]
        np.testing.assert_allclose(bounds, exact, rtol=1e-9, atol=1e-12)
        assert all(
            bound <= warped_distance(motions[one], motions[other]) for bound, other in zip(bounds, others, strict=True)
        )
        limit = float(np.median(bounds))
        limited = ranges.between(one, others, limit=limit)
        np.testing.assert_array_equal(limited <= limit, bounds <= limit)
        np.testing.assert_array_equal(limited[limited <= limit], bounds[bounds <= limit])


def test_what_cannot_be_aligned_is_refused() -> None:
    with pytest.raises(MotionError, match="matrix"):
        align(np.zeros((0, 3)))
    with pytest.raises(MotionError, match="finite"):
        align(np.array([[0.0, np.nan]]))
    with pytest.raises(MotionError, match="max_run"):
        align(np.zeros((3, 3)), max_run=-1)
    with pytest.raises(MotionError, match="same number of points"):
        distances(walking_points(3, points=4), walking_points(3, points=5))
