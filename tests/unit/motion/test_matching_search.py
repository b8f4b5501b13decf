"""Exact search, compared with the distances of all rows in float64, summed one dimension after another."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from hypothesis.strategies import DataObject
from numpy.random import Generator
from tests.support.tiers import examples, is_soak

from marey_motion.arrays import Flags, Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.matching.search import LARGEST, Method, build_index, find_best, find_nearest
from marey_motion.matching.search_kernels import cost_of, nearest, nearest_weighted

METHODS: tuple[Method, ...] = ("boxes", "scan", "auto")


def true_costs(rows: Floats, query: Floats, weights: Floats | None = None) -> Floats:
    """Return the squared distances (N,) of rows from a query, summed in the order of the dimensions."""
    costs = np.zeros(len(rows))
    for d in range(rows.shape[1]):
        difference = rows[:, d] - query[d]
        costs += difference * difference * (1.0 if weights is None else weights[d])
    return costs


def true_nearest(
    rows: Floats, selectable: Flags, query: Floats, weights: Floats | None = None, skip: tuple[int, int] = (0, 0)
) -> tuple[int, float]:
    costs = true_costs(rows, query, weights)
    allowed = selectable.copy()
    allowed[skip[0] : skip[1]] = False
    costs[~allowed] = np.inf
    return int(costs.argmin()), costs.min()


def clips_of(rows: int, frames: int) -> Ints:
    return np.append(np.arange(0, rows, frames), rows)


def gait_like(rows: int, dimensions: int, rng: Generator) -> Floats:
    """Return clips of 90 rows; each clip is the sum of a few harmonics with a stride and a mean of its own."""
    clips = -(-rows // 90)
    time = np.arange(90)[:, None, None] / 60
    orders = np.arange(1, 4)
    phases = rng.uniform(0, 2 * np.pi, (clips, 1, dimensions, 3))
    sizes = rng.normal(size=(clips, 1, dimensions, 3)) / orders
    waves = (np.sin(2 * np.pi * 0.9 * time * orders + phases) * sizes).sum(-1)
    return (waves + rng.normal(size=(clips, 1, dimensions))).reshape(-1, dimensions)[:rows]


def quantised(rows: int, dimensions: int, rng: Generator) -> Floats:
    return rng.integers(0, 2, (rows, dimensions)).astype(float)


def denormal(rows: int, dimensions: int, rng: Generator) -> Floats:
    return rng.normal(size=(rows, dimensions)) * 1e-310


def tiny_squares(rows: int, dimensions: int, rng: Generator) -> Floats:
    return rng.normal(size=(rows, dimensions)) * 1e-21


def far_away(rows: int, dimensions: int, rng: Generator) -> Floats:
    return 1e6 + 1e-3 * gait_like(rows, dimensions, rng)


def huge(rows: int, dimensions: int, rng: Generator) -> Floats:
    return rng.uniform(-1, 1, (rows, dimensions)) * LARGEST


def of_all_sizes(rows: int, dimensions: int, rng: Generator) -> Floats:
    return rng.normal(size=(rows, dimensions)) * 10.0 ** rng.integers(-20, 15, (rows, dimensions))


def constant(rows: int, dimensions: int, rng: Generator) -> Floats:
    return np.full((rows, dimensions), 0.1)


def gaussian(rows: int, dimensions: int, rng: Generator) -> Floats:
    return rng.normal(size=(rows, dimensions))


DATABASES = (gait_like, gaussian, quantised, constant, denormal, tiny_squares, far_away, huge, of_all_sizes)


def queries_for(rows: Floats, count: int, rng: Generator) -> Floats:
    """Return queries: rows, rows with a small change or a change by one step of float32, and mixtures of two rows."""
    first, second = rng.integers(0, len(rows), (2, count))
    queries = rows[first].copy()
    half = rows.shape[1] // 2
    queries[::4, half:] = rows[second[::4], half:]
    queries[1::4] += rng.normal(scale=0.3, size=queries[1::4].shape) * np.abs(rows).mean()
    queries[2::4] = np.nextafter(queries[2::4].astype(np.float32), np.float32(1)).astype(float)
    return np.clip(queries, -LARGEST, LARGEST)


@pytest.mark.parametrize("make", DATABASES)
@pytest.mark.parametrize(("rows", "dimensions"), [(2500, 27), (700, 64), (40, 33), (1, 27)])
def test_a_search_finds_what_going_through_all_rows_finds(make: Callable[..., Any], rows: int, dimensions: int) -> None:
    rng = np.random.default_rng([rows, dimensions])
    features = make(rows, dimensions, rng)
    selectable = rng.random(rows) < 0.8
    selectable[rng.integers(rows)] = True
    queries = queries_for(features, 300 if is_soak() else 100, rng)
    warm = rng.integers(-1, rows, len(queries))
    truth = [true_nearest(features, selectable, query) for query in queries]
    for method in METHODS:
        index = build_index(features, clips_of(rows, 90), selectable, method=method)
        for warm_rows in (None, warm):
            found = find_nearest(index, queries, warm_rows=warm_rows)
            assert list(zip(*(part.tolist() for part in found), strict=True)) == truth


def test_many_queries_of_a_walking_database_are_answered_exactly() -> None:
    rng = np.random.default_rng(7)
    features = gait_like(6000, 27, rng)
    selectable = np.arange(6000) % 90 < 70
    queries = queries_for(features, 10_000 if is_soak() else 2_000, rng)
    index = build_index(features, clips_of(6000, 90), selectable, method="boxes")
    rows, costs = find_nearest(index, queries, warm_rows=rng.integers(0, 6000, len(queries)))
    for query, row, cost in zip(queries, rows, costs, strict=True):
        assert (row, cost) == true_nearest(features, selectable, query)


@settings(max_examples=examples(60, soak=150))
@given(st.data())
def test_differences_that_float32_cannot_show_still_decide(data: DataObject) -> None:
    """All rows are equal in float32, and differ by a few units in the last place of float64."""
    dimensions = data.draw(st.integers(1, 40))
    base = data.draw(arrays.arrays(float, dimensions, elements=st.floats(-1e6, 1e6)))
    steps = data.draw(arrays.arrays(np.int64, (data.draw(st.integers(1, 50)), dimensions), elements=st.integers(-3, 3)))
    features = base + steps * np.spacing(np.abs(base))
    away = data.draw(arrays.arrays(float, dimensions, elements=st.floats(-1e3, 1e3)))
    query = base + away * data.draw(st.sampled_from([0.0, 1e-12, 1e-3, 1.0]))
    selectable = np.ones(len(features), bool)
    for method in METHODS:
        index = build_index(features, clips_of(len(features), 20), selectable, method=method)
        rows, costs = find_nearest(index, query[None])
        assert (rows[0], costs[0]) == true_nearest(features, selectable, query)


def test_distances_whose_squares_float32_barely_holds_still_decide() -> None:
    """Each squared difference is about ten times the smallest positive float32, and is rounded to a multiple of it.

    In float32, the sum is 270 of these multiples for half of the rows, and 256 for the others. The true sums differ
    little.
    """
    rng = np.random.default_rng(2)
    step = 2.0**-149
    up, down = np.full(27, 9.51), np.repeat([10.49, 8.6], [13, 14])
    for _ in range(20):
        squares = np.repeat([up, down], 100, axis=0) + 1e-4 * rng.normal(size=(200, 27))
        features = rng.permutation(np.sqrt(squares * step), axis=0)
        for method in METHODS:
            index = build_index(features, clips_of(200, 90), np.ones(200, bool), method=method)
            rows, costs = find_nearest(index, np.zeros((1, 27)))
            assert (rows[0], costs[0]) == true_nearest(features, index.selectable, np.zeros(27))


@settings(max_examples=examples(100))
@given(st.data())
def test_any_numbers_in_range_are_searched_exactly(data: DataObject) -> None:
    shape = (data.draw(st.integers(1, 40)), data.draw(st.integers(1, 6)))
    numbers = st.floats(-LARGEST, LARGEST)
    features = data.draw(arrays.arrays(float, shape, elements=numbers))
    query = data.draw(arrays.arrays(float, shape[1], elements=numbers))
    weights = data.draw(arrays.arrays(float, shape[1], elements=st.floats(0, LARGEST)))
    selectable = data.draw(arrays.arrays(bool, shape[0]).filter(np.any))
    for method in METHODS:
        index = build_index(features, clips_of(shape[0], 17), selectable, method=method)
        rows, costs = find_nearest(index, query[None], weights=weights)
        assert (rows[0], costs[0]) == true_nearest(features, selectable, query, weights)


@pytest.mark.parametrize("method", METHODS)
def test_the_lowest_of_equal_rows_wins_wherever_the_search_starts(method: Method) -> None:
    rng = np.random.default_rng(3)
    features = np.tile(gait_like(360, 27, rng), (3, 1))
    selectable = np.ones(len(features), bool)
    selectable[:100] = False
    index = build_index(features, clips_of(len(features), 90), selectable, method=method)
    for copy in range(3):
        rows, costs = find_nearest(index, features, warm_rows=np.arange(len(features)) % 360 + 360 * copy)
        expected = np.arange(len(features)) % 360
        expected[expected < 100] += 360
        assert rows.tolist() == expected.tolist()
        assert not costs.any()


@pytest.mark.parametrize("method", METHODS)
def test_skipped_rows_are_not_chosen(method: Method) -> None:
    rng = np.random.default_rng(4)
    features = gait_like(900, 27, rng)
    selectable = np.arange(900) % 90 < 70
    index = build_index(features, clips_of(900, 90), selectable, method=method)
    centres = rng.integers(0, 900, 200)
    skips = np.stack([np.maximum(centres - 20, 0), np.minimum(centres + 21, 900)], axis=1)
    rows, costs = find_nearest(index, features[centres], warm_rows=centres, skips=skips)
    for centre, skip, row, cost in zip(centres, skips, rows, costs, strict=True):
        assert (row, cost) == true_nearest(features, selectable, features[centre], skip=skip)


@pytest.mark.parametrize("method", METHODS)
def test_where_all_rows_are_skipped_there_is_no_answer(method: Method) -> None:
    features = np.random.default_rng(5).normal(size=(300, 27))
    index = build_index(features, clips_of(300, 90), np.ones(300, bool), method=method)
    rows, costs = find_nearest(index, features[:2], warm_rows=np.array([0, -1]), skips=np.array([[0, 300], [0, 300]]))
    assert rows.tolist() == [-1, -1]
    assert np.isinf(costs).all()


@pytest.mark.parametrize("method", METHODS)
def test_weights_count_each_dimension_as_much_as_they_say(method: Method) -> None:
    rng = np.random.default_rng(6)
    features = gait_like(1500, 27, rng)
    selectable = np.ones(1500, bool)
    index = build_index(features, clips_of(1500, 90), selectable, method=method)
    trajectory_only = np.repeat([0.0, 1.0], [15, 12])
    for weights in (trajectory_only, rng.uniform(0, 3, 27), np.zeros(27), np.full(27, 1e12)):
        queries = queries_for(features, 100, rng)
        rows, costs = find_nearest(index, queries, weights=weights)
        for query, row, cost in zip(queries, rows, costs, strict=True):
            assert (row, cost) == true_nearest(features, selectable, query, weights)


@pytest.mark.parametrize("count", [0, 1, 7, 10_000])
def test_the_best_rows_come_in_order_of_cost_then_row(count: int) -> None:
    rng = np.random.default_rng(8)
    features = np.repeat(quantised(200, 5, rng), 3, axis=0)
    selectable = rng.random(600) < 0.7
    index = build_index(features, clips_of(600, 90), selectable)
    query = features[11] + 0.25
    rows, costs = find_best(index, query, count, skip=(30, 60))
    expected = true_costs(features, query)
    allowed = [row for row in range(600) if selectable[row] and not 30 <= row < 60]
    order = sorted(allowed, key=lambda row: (expected[row], row))[:count]
    assert rows.tolist() == order
    assert costs.tolist() == expected[order].tolist()


def test_the_first_of_the_best_rows_is_the_nearest_bit_for_bit() -> None:
    rng = np.random.default_rng(9)
    features = gait_like(1200, 27, rng)
    weights = rng.uniform(0, 2, 27)
    index = build_index(features, clips_of(1200, 90), np.arange(1200) % 90 < 70)
    queries = queries_for(features, 50, rng)
    rows, costs = find_nearest(index, queries, weights=weights)
    for query, row, cost in zip(queries, rows, costs, strict=True):
        best_rows, best_costs = find_best(index, query, 3, weights=weights)
        assert (best_rows[0], best_costs[0]) == (row, cost)


def test_compiled_callers_get_the_same_as_python_does() -> None:
    rng = np.random.default_rng(10)
    features = gait_like(900, 27, rng)
    index = build_index(features, clips_of(900, 90), np.ones(900, bool))
    weights = rng.uniform(0, 2, 27)
    for query in queries_for(features, 20, rng):
        assert nearest(index, query, 5, 100, 140) == true_nearest(features, index.selectable, query, skip=(100, 140))
        assert nearest_weighted(index, query, weights, 0, 50) == true_nearest(
            features, index.selectable, query, weights, skip=(0, 50)
        )
        assert cost_of(index, 17, query) == true_costs(features, query)[17]


def test_threads_that_share_an_index_find_the_same() -> None:
    rng = np.random.default_rng(11)
    features = gait_like(3000, 27, rng)
    index = build_index(features, clips_of(3000, 90), np.ones(3000, bool))
    batches = [queries_for(features, 200, rng) for _ in range(16)]
    alone = [find_nearest(index, batch) for batch in batches]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda batch: find_nearest(index, batch), batches))
    for (rows, costs), (other_rows, other_costs) in zip(alone, together, strict=True):
        assert rows.tobytes() == other_rows.tobytes()
        assert costs.tobytes() == other_costs.tobytes()


def test_smooth_motion_is_searched_by_boxes_and_noise_row_by_row_always_by_the_same_choice() -> None:
    rng = np.random.default_rng(12)
    everything = np.ones(9000, bool)
    smooth, noise = gait_like(9000, 27, rng), gaussian(9000, 27, rng)
    for _ in range(3):
        assert build_index(smooth, clips_of(9000, 90), everything).boxed
        assert not build_index(noise, clips_of(9000, 90), everything).boxed


def test_clips_without_selectable_rows_and_empty_clips_are_passed_over() -> None:
    rng = np.random.default_rng(13)
    features = gaussian(60, 27, rng)
    selectable = np.zeros(60, bool)
    selectable[[25, 26, 59]] = True
    starts = np.array([0, 20, 20, 30, 50, 60])
    for method in METHODS:
        index = build_index(features, starts, selectable, method=method)
        rows, _ = find_nearest(index, features[[26, 59]], warm_rows=np.array([0, 40]))
        assert rows.tolist() == [26, 59]


def test_a_database_in_which_nothing_can_be_chosen_says_so() -> None:
    with pytest.raises(MotionError, match="no row of the database can be selected") as caught:
        build_index(np.zeros((20, 27)), np.array([0, 20]), np.zeros(20, bool))
    assert caught.value.code == "nothing-selectable"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 2 * LARGEST])
def test_a_value_that_cannot_be_searched_is_named(value: float) -> None:
    features = np.zeros((20, 27))
    features[3, 5] = value
    with pytest.raises(MotionError, match="row 3, dimension 5"):
        build_index(features, np.array([0, 20]), np.ones(20, bool))


@pytest.mark.parametrize("starts", [[0], [0, 10], [5, 20], [0, 15, 10, 20]])
def test_clips_that_do_not_cover_the_rows_are_refused(starts: list[int]) -> None:
    with pytest.raises(MotionError, match="ascend from 0 to the number of rows, 20"):
        build_index(np.zeros((20, 27)), np.array(starts), np.ones(20, bool))


@pytest.mark.parametrize(
    ("queries", "weights", "message"),
    [
        (np.zeros((1, 26)), None, "27 dimensions"),
        (np.full((1, 27), np.nan), None, "finite"),
        (np.zeros((1, 27)), np.ones(26), "27 numbers"),
        (np.zeros((1, 27)), np.full(27, -1.0), "27 numbers"),
    ],
)
def test_queries_and_weights_that_do_not_fit_are_refused(queries: Floats, weights: Floats | None, message: str) -> None:
    index = build_index(np.zeros((20, 27)), np.array([0, 20]), np.ones(20, bool))
    with pytest.raises(MotionError, match=message):
        find_nearest(index, queries, weights=weights)
