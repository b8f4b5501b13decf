"""Choice of the reference example of an alignment."""

import numpy as np
import pytest

from marey_motion.alignment.cost import cost_points, costs_between, frame_costs
from marey_motion.alignment.dtw import align
from marey_motion.alignment.reference import (
    MOST_COMPARED,
    compared_motions,
    medoid,
    nearest_mean_length,
    pairwise_totals,
)
from marey_motion.alignment.segments import align_sections
from marey_motion.arrays import Floats
from marey_schemas.options.alignment import CostOptions


def test_the_medoid_has_the_least_sum_of_costs() -> None:
    places = np.array([0.0, 1.0, 2.0, 3.0, 9.0])
    assert medoid(np.abs(places[:, None] - places[None])) == 2


def test_the_best_candidate_is_kept_and_not_the_last_one() -> None:
    """An earlier program never updated the best cost so far, and therefore chose the last candidate."""
    totals = np.array([[0.0, 1.0, 9.0], [1.0, 0.0, 8.0], [9.0, 8.0, 0.0]])
    assert medoid(totals) == 1
    assert medoid(totals[::-1, ::-1]) == 1


def test_of_examples_that_do_equally_well_the_first_is_taken_in_spite_of_rounding() -> None:
    totals = np.array([[0.0, 0.3, 0.6], [0.3, 0.0, 0.3], [0.6, 0.3, 0.0]])
    twins = np.block([[totals, totals], [totals, totals]])
    assert medoid(twins) == 1
    assert medoid(twins + np.diag([0, 1e-13, 0, 0, -1e-13, 0])) == 1


def test_an_example_that_cannot_be_aligned_with_others_is_no_medoid_if_there_is_a_better_one() -> None:
    far = np.inf
    totals = np.array([[0.0, 1.0, far], [1.0, 0.0, 5.0], [far, 5.0, 0.0]])
    assert medoid(totals) == 1


def test_the_nearest_to_the_mean_length_is_found_with_ties_to_the_first() -> None:
    assert nearest_mean_length([40, 53, 47, 60]) == 1
    assert nearest_mean_length([49, 51]) == 0


@pytest.mark.parametrize("count", [201, 800, 5000])
def test_of_many_motions_a_sample_is_compared_that_spreads_over_all(count: int) -> None:
    places = compared_motions(count)
    assert len(set(places)) == MOST_COMPARED
    assert places == sorted(places) == compared_motions(count)
    assert places[0] >= 0
    assert places[-1] < count
    tenths = np.histogram(places, bins=10, range=(0, count))[0]
    assert tenths.min() >= MOST_COMPARED // 20


def test_few_motions_are_all_compared() -> None:
    assert compared_motions(MOST_COMPARED) == list(range(MOST_COMPARED))


def clouds(seed: int = 0) -> list[Floats]:
    random = np.random.default_rng(seed)
    return [random.normal(size=(frames, 6, 3)).cumsum(axis=0) * 0.1 for frames in (12, 15, 9, 30, 13)]


@pytest.mark.parametrize("max_run", [None, 3, 1])
@pytest.mark.parametrize("threads", [1, 2])
def test_costs_of_pairs_are_those_of_aligning_each_section_of_each_two(max_run: int | None, threads: int) -> None:
    points, options = clouds(), CostOptions()
    bounds = [(0, len(cloud) // 3, len(cloud) - 1) for cloud in points]
    ready = [cost_points(cloud, options) for cloud in points]
    told = []
    totals = pairwise_totals(
        ready,
        bounds,
        lambda one, other: costs_between(one, other, options),
        max_run=max_run,
        threads=threads,
        progress=lambda *done: told.append(done),
    )
    assert np.array_equal(totals, totals.T)
    for i, one in enumerate(points):
        for j, other in enumerate(points):
            if i == j:
                assert totals[i, j] == 0.0
            elif np.isfinite(totals[i, j]):
                found = align_sections(
                    frame_costs(one, other), bounds[i], bounds[j], lambda costs: align(costs, max_run=max_run)
                )
                assert totals[i, j] == pytest.approx(found.total, rel=1e-12)
            else:
                lengths = np.diff(bounds[i]), np.diff(bounds[j])
                ratio = np.maximum(*lengths) / np.minimum(*lengths)
                assert max_run is not None
                assert ratio.max() > max_run
    assert told[-1] == (10, 10)
    assert [done for done, _ in told] == sorted(done for done, _ in told)
