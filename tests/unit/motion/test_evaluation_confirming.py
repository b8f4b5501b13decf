"""Effects of changed sets are confirmed in replicates that had no part in choosing the change."""

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.suggestion_cases import OPTIONS, wandering_tracks
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.evaluation.improvement.effects import confirmation_replicates, effect_of, estimation_replicates
from marey_motion.evaluation.improvement.objective import headline_means
from marey_motion.evaluation.improvement.optimise import Optimisation, optimise, with_total
from marey_motion.evaluation.improvement.resimulation import NONE, Resimulation
from marey_motion.evaluation.improvement.selection import without_sources
from marey_motion.evaluation.improvement.sweep import SweepRow, group_influences
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.replicates import measure_run, run_of, simulate
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.search import build_index
from marey_schemas.options.improvement import ObjectiveOptions, OptimisationOptions, SuggestionOptions
from marey_schemas.options.matching import FeatureWeights

TURNS = ("turn_left", "turn_right")
SEED = 9


@pytest.fixture(scope="module")
def pool() -> MatchingDatabase:
    """A database of random clips, and of two turns that may be added."""
    turns = [arc_track(2.0, turn_rate, 6.0, uid=uid) for uid, turn_rate in zip(TURNS, (50.0, -50.0), strict=True)]
    return synthetic_database([*wandering_tracks(4), *turns])


def offsets(database: MatchingDatabase, replicates: range) -> list[float]:
    """Return the mean distance from the path in each replicate, computed without a `Resimulation`."""
    options = OPTIONS.replace(seed=SEED)
    index = build_index(database.normaliser.apply(database.features), database.starts, database.selectable)
    looks, found = LooksMeter(database, options.controller), []
    for number in replicates:
        runs = [run_of(trial, number, options) for trial in suite_trials(options)]
        records = [simulate(database, index, options, run) for run in runs]
        measured = [measure_run(database, options, looks, *pair) for pair in zip(runs, records, strict=True)]
        found.append(headline_means(measured)["offset_mean"])
    return found


def test_an_effect_is_the_paired_difference_of_evaluations_in_the_same_replicates(pool: MatchingDatabase) -> None:
    replicates = range(5, 8)
    simulation = Resimulation(pool, OPTIONS, replicates=replicates, seed=SEED)
    effect = effect_of(simulation, ObjectiveOptions(), NONE, frozenset(["clip_001"]))
    without = offsets(without_sources(pool, ["clip_001"]), replicates)
    change = np.array(without) - offsets(pool, replicates)
    told = effect.headlines["offset_mean"]
    assert told.change == pytest.approx(change.mean(), abs=1e-12)
    assert told.replicates == 3
    assert told.low is not None
    assert told.high is not None
    assert told.low < told.change < told.high
    again = effect_of(simulation, ObjectiveOptions(), NONE, frozenset(["fast_000"]))
    assert again.nothing, "no trial needs this clip"


def test_choices_and_confirmations_have_no_replicate_in_common() -> None:
    how = SuggestionOptions(estimation_replicates=4, confirmation_replicates=8)
    ranges = [estimation_replicates(how), confirmation_replicates(how), confirmation_replicates(how, 1)]
    assert [list(one)[:: len(one) - 1] for one in ranges] == [[0, 3], [4, 11], [12, 19]]
    for count in (1, 2):
        with pytest.raises(ValidationError, match="have no interval; choose at least 3, or 0"):
            SuggestionOptions(confirmation_replicates=count)


@pytest.fixture(scope="module")
def confirmed(pool: MatchingDatabase) -> Optimisation:
    aim = OptimisationOptions(objective=ObjectiveOptions(seconds=0.0), max_steps=4)
    once, others, fresh = (
        Resimulation(pool, OPTIONS, replicates=numbers, seed=SEED) for numbers in ((0,), range(1, 5), range(5, 9))
    )
    return with_total(optimise(once, aim, confirming=others, absent=TURNS), fresh, aim)


def test_only_steps_whose_gain_is_confirmed_in_other_replicates_are_made(confirmed: Optimisation) -> None:
    assert {source for step in confirmed.steps for source in step.sources} & set(TURNS), "turns help where turns lack"
    for step in confirmed.steps[1:]:
        assert step.confirmed is not None
        assert step.confirmed.improves(1)
    assert confirmed.ended == "not confirmed"
    for one in confirmed.unconfirmed:
        assert one.estimated_gain > 0.0
        assert not one.effect.improves(len(confirmed.unconfirmed))
    assert confirmed.unconfirmed
    assert confirmed.total is not None
    assert confirmed.total.objective.change < 0.0


def test_the_best_weight_of_a_group_is_confirmed_and_corrected_for_the_number_of_groups() -> None:
    base = FeatureWeights()
    noise = 0.01 * np.random.default_rng(5).normal(size=8)

    def row(objective: float, values: np.ndarray, **weights: float) -> SweepRow:
        return SweepRow(base.replace(**weights), {}, {}, objective, tuple(values.tolist()))

    found = group_influences(
        [
            row(1.0, 1.0 + noise),
            row(0.9, 0.9 + noise[::-1], hip_velocity=0.5),
            row(0.8, 1.0 + noise[::-1], trajectory_positions=2.0),
            row(1.2, 1.2 + noise, left_foot_position=2.0),
        ]
    )
    verdicts = {one.group: one.confirmed and one.confirmed.verdict for one in found}
    assert verdicts == {"hip_velocity": "better", "trajectory_positions": "unclear", "left_foot_position": None}
