"""Effects of changed sets are confirmed in replicates that had no part in choosing the change."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.suggestion_cases import OPTIONS, UNWANTED, wandering_tracks
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.evaluation.compare import paired_change, probability
from marey_motion.evaluation.improvement import optimise as searching
from marey_motion.evaluation.improvement.effects import (
    Effect,
    confirmation_replicates,
    effect_of,
    estimation_replicates,
)
from marey_motion.evaluation.improvement.objective import headline_means
from marey_motion.evaluation.improvement.optimise import CONFIRMED_AT_ONCE, Optimisation, optimise, with_total
from marey_motion.evaluation.improvement.resimulation import NONE, Resimulation
from marey_motion.evaluation.improvement.selection import without_sources
from marey_motion.evaluation.improvement.sweep import SweepRow, group_influences
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.replicates import measure_run, run_of, simulate
from marey_motion.evaluation.result import TrialResult
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.search import build_index
from marey_schemas.options.evaluation import EvaluationOptions
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
    offset = effect.headlines["offset_mean"]
    assert offset.change == pytest.approx(change.mean(), abs=1e-12)
    assert offset.replicates == 3
    assert offset.low is not None
    assert offset.high is not None
    assert offset.low < offset.change < offset.high
    again = effect_of(simulation, ObjectiveOptions(), NONE, frozenset(["fast_000"]))
    assert {one.verdict for one in again.headlines.values()} == {"same"}, "no trial needs this clip"


def test_choices_and_confirmations_have_no_replicate_in_common() -> None:
    for estimation, evaluation in ((4, EvaluationOptions()), (10, EvaluationOptions(replicates=2))):
        how = SuggestionOptions(estimation_replicates=estimation)
        confirmations = [confirmation_replicates(how, evaluation, turn) for turn in (0, 1)]
        assert [len(one) for one in confirmations] == [8, 8]
        used = [number for one in confirmations for number in one]
        chosen_from = {*estimation_replicates(how), *range(evaluation.replicates)}
        assert len({*used, *chosen_from}) == len(used) + len(chosen_from)
    for count in (1, 2):
        with pytest.raises(ValidationError, match="are too few for an interval; choose at least 3, or 0"):
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
        assert step.confirmed.improves
    assert confirmed.ended == "not confirmed"
    for one in confirmed.unconfirmed:
        assert one.estimated_gain > 0.0
        assert not one.effect.improves
    assert confirmed.unconfirmed
    assert confirmed.total is not None
    assert confirmed.total.objective.change < 0.0


def test_the_effect_of_a_refused_step_has_the_probability_by_which_it_was_refused(
    pool: MatchingDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = paired_change("objective", np.zeros((1, 4)), np.array([[-1.0, -2.0, -3.0, -1.0]]))
    assert raw.p is not None
    assert raw.p <= 0.05 < CONFIRMED_AT_ONCE * raw.p
    monkeypatch.setattr(searching, "effect_of", lambda *_sides, **_options: Effect(raw, {"offset_mean": raw}))
    once = Resimulation(pool, OPTIONS)
    aim = OptimisationOptions(objective=ObjectiveOptions(seconds=1.0), max_steps=1)
    found = searching.optimise(once, aim, confirming=once, absent=once.sources.keys() - once.needed())
    assert len(found.unconfirmed) == CONFIRMED_AT_ONCE
    for one in found.unconfirmed:
        for change in (one.effect.objective, one.effect.headlines["offset_mean"]):
            assert change.p == pytest.approx(CONFIRMED_AT_ONCE * raw.p)
            assert change.verdict == "unclear"


def test_a_step_that_changes_a_trial_in_anything_is_not_certain(
    pool: MatchingDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = paired_change("objective", np.ones((1, 3)), np.full((1, 3), 0.9))
    monkeypatch.setattr(searching, "effect_of", lambda *_sides, **_options: Effect(saved, {}))
    once = Resimulation(pool, OPTIONS)
    aim = OptimisationOptions(objective=ObjectiveOptions(seconds=0.01), max_steps=1, consider=2)
    step = searching.optimise(once, aim, confirming=once).steps[-1]
    assert (step.sources, step.changed_trials) == (UNWANTED, 0), "the effect alone would not confirm it"
    results = Resimulation.results

    def slightly_changed(self: Resimulation, removed: Collection[str] = NONE) -> tuple[TrialResult, ...]:
        first, *others = results(self, removed)
        metrics = {**first.metrics, "heading_rms_deg": float(len(removed))}
        return replace(first, metrics=metrics), *others

    monkeypatch.setattr(Resimulation, "results", slightly_changed)
    found = searching.optimise(once, aim, confirming=once)
    assert (found.ended, len(found.steps)) == ("not confirmed", 1)


def test_an_optimisation_needs_seven_replicates_to_confirm_equal_changes() -> None:
    needed = next(count for count in range(3, 65) if CONFIRMED_AT_ONCE * probability(np.full(count, -1.0)) <= 0.05)
    described = OptimisationOptions.model_fields["confirmation_replicates"].description
    assert described is not None
    assert f"3 to {needed - 1} are too few to confirm a step" in described
    assert f"the sign test needs {needed}." in described


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
