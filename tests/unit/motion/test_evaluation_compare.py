"""Comparison of two evaluations of the same trials, trial by trial."""

from collections.abc import Iterator
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from tests.support.smaller_databases import without_sources
from tests.support.suggestion_cases import OPTIONS, UNWANTED, evaluated, named, wandering_tracks
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.compare import compare_results, paired_change
from marey_motion.evaluation.improvement.selection import joined
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.matching.building import union_normaliser, with_normaliser
from marey_motion.matching.database import MatchingDatabase


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    return synthetic_database(wandering_tracks())


@pytest.fixture(scope="module")
def result(database: MatchingDatabase) -> EvaluationResult:
    return evaluated(database)


def test_an_evaluation_compared_with_itself_has_not_changed(result: EvaluationResult) -> None:
    found = compare_results(result, result)
    assert found.changed == ()
    assert {change.verdict for change in found.metrics} == {"same"}
    assert all(change.low == change.change == change.high == 0.0 for change in found.metrics)
    assert not found.coverage_change_s.any()
    assert (found.removed, found.added, found.newly_unused) == ((), (), ())


def test_removing_unused_clips_changes_no_trial_although_rows_are_numbered_anew(
    database: MatchingDatabase, result: EvaluationResult
) -> None:
    after = evaluated(without_sources(database, UNWANTED))
    found = compare_results(result, after)
    assert found.changed == ()
    assert found.removed == UNWANTED


def test_only_trials_that_went_another_way_are_told_and_from_where_on(
    database: MatchingDatabase, result: EvaluationResult
) -> None:
    after = evaluated(without_sources(database, ["clip_001"]))
    found = compare_results(result, after)
    changed = {change.trial: change for change in found.changed}
    assert 0 < len(changed) < len(result.trials)
    for one, other, trial in zip(result.records, after.records, result.trials, strict=True):
        change = changed.get(trial.trial.name)
        if change is None:
            assert np.array_equal(one.positions, other.positions)
        else:
            assert np.array_equal(one.positions[: change.first_tick], other.positions[: change.first_tick])
            assert not change.same_motion


@pytest.mark.parametrize("kept", ["positions", "headings", "status", "match_cost", "continuing_cost", "pose_cost"])
def test_a_trial_that_differs_in_anything_at_one_tick_is_told_with_that_tick(
    result: EvaluationResult, kept: str
) -> None:
    values = getattr(result.records[1], kept).copy()
    values[7] = 1 if np.isnan(values[7]).any() else values[7] + 1
    records = (result.records[0], replace(result.records[1], **{kept: values}), *result.records[2:])
    (change,) = compare_results(result, replace(result, records=records)).changed
    assert (change.trial, change.first_tick, change.same_motion) == (result.trials[1].trial.name, 7, False)


def test_a_copy_under_a_lower_uid_is_told_as_the_same_motion() -> None:
    tracks = named(wandering_tracks()[:4])
    database = synthetic_database(tracks)
    copies = [tracks[number]._replace(uid=f"a_{number}") for number in range(4)]
    before, after = evaluated(database), evaluated(joined(database, synthetic_database(copies)))
    found = compare_results(before, after)
    assert len(found.changed) == len(before.trials)
    assert all(change.same_motion and change.first_tick == 0 for change in found.changed)
    assert {change.verdict for change in found.metrics} == {"same"}
    assert set(found.newly_unused) == {track.uid for track in tracks}
    assert found.added == ("a_0", "a_1", "a_2", "a_3")


def test_changes_of_metrics_are_means_over_paired_trials(database: MatchingDatabase, result: EvaluationResult) -> None:
    after = evaluated(without_sources(database, ["clip_003"]))
    for change in compare_results(result, after).metrics:
        pairs = [
            (one.metrics[change.metric], other.metrics[change.metric])
            for one, other in zip(result.trials, after.trials, strict=True)
            if None not in (one.metrics[change.metric], other.metrics[change.metric])
        ]
        assert change.trials == len(pairs)
        assert change.before == pytest.approx(np.mean([pair[0] for pair in pairs]))
        assert change.change == pytest.approx(np.mean([pair[1] - pair[0] for pair in pairs]), abs=1e-12)
        assert change.low <= change.change + 1e-12
        assert change.change - 1e-12 <= change.high


def test_the_interval_holds_the_true_change_about_as_often_as_it_says() -> None:
    random = np.random.default_rng(1)
    held = 0
    for _ in range(60):
        before = random.exponential(size=60)
        after = before + 0.3 + random.normal(size=60)
        change = paired_change("offset_mean", before, after)
        held += change.low <= 0.3 <= change.high
    assert 51 <= held <= 60


def test_the_interval_of_normal_changes_is_two_standard_errors_to_each_side() -> None:
    changes = np.random.default_rng(4).normal(0.3, 1.0, 400)
    found = paired_change("offset_mean", np.zeros(400), changes)
    reach = 1.96 * changes.std() / np.sqrt(400)
    assert (found.low, found.high) == pytest.approx((changes.mean() - reach, changes.mean() + reach), abs=0.05 * reach)


def test_the_interval_of_skewed_changes_reaches_farther_to_the_long_side() -> None:
    changes = np.sort(np.random.default_rng(5).exponential(size=25))
    found = paired_change("offset_mean", np.zeros(25), changes)
    low, high = efron_bounds(changes)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.03 * (high - low))
    assert high - changes.mean() > 1.25 * (changes.mean() - low)


def efron_bounds(changes: Floats) -> Iterator[float]:
    """Yield the bias-corrected and accelerated bounds of the mean as in Efron (1987), from other random resamples."""
    normal, random, count = NormalDist(), np.random.default_rng(6), len(changes)
    means = np.sort(random.choice(changes, (20_000, count)).mean(axis=1))
    bias = normal.inv_cdf(np.mean(means < changes.mean()))
    without = (changes.sum() - changes) / (count - 1)
    apart = without.mean() - without
    acceleration = np.sum(apart**3) / (6.0 * np.sum(apart**2) ** 1.5)
    for tail in (0.025, 0.975):
        shifted = bias + normal.inv_cdf(tail)
        share = normal.cdf(bias + shifted / (1.0 - acceleration * shifted))
        yield means[int(share * len(means))]


def test_the_interval_is_the_same_every_time() -> None:
    random = np.random.default_rng(2)
    before, after = random.normal(size=40), random.normal(size=40)
    assert paired_change("dse_v", before, after) == paired_change("dse_v", before, after)


def test_changes_that_differ_by_rounding_alone_have_an_interval_around_them() -> None:
    counts = np.arange(9, 15)  # switches in 30 s, five more in every trial
    found = paired_change("transitions_per_s", counts / 30, (counts + 5) / 30)
    assert found.low <= found.high
    assert (found.low, found.high) == pytest.approx((5 / 30, 5 / 30), rel=1e-12)
    assert paired_change("transitions_per_s", [2.0, 2.0], [2.0, 2.0]).verdict == "same"


def test_a_verdict_needs_an_interval_without_zero_and_a_metric_with_a_direction() -> None:
    before = np.linspace(1.0, 2.0, 30)
    noise = np.random.default_rng(3).normal(size=30)
    assert paired_change("offset_mean", before, before - 0.5 + 0.1 * noise).verdict == "better"
    assert paired_change("offset_mean", before, before + 0.5 + 0.1 * noise).verdict == "worse"
    assert paired_change("offset_mean", before, before + noise - noise.mean()).verdict == "unclear"
    assert paired_change("transitions", before, before + 2.0 + 0.1 * noise).verdict == "changed"
    assert paired_change("offset_mean", before, before).verdict == "same"
    assert paired_change("offset_mean", [1.0], [0.5]).verdict == "unclear"


def test_evaluations_under_other_conditions_are_refused_by_name(
    database: MatchingDatabase, result: EvaluationResult
) -> None:
    fitted_anew = synthetic_database(wandering_tracks()[:5])
    with pytest.raises(MotionError, match="normaliser"):
        compare_results(result, evaluated(fitted_anew))
    other = OPTIONS.replace(controller=OPTIONS.controller.replace(follow="path"))
    with pytest.raises(MotionError, match="options"):
        compare_results(result, evaluated(database, other))
    with pytest.raises(MotionError, match="scenarios"):
        compare_results(result, evaluated(database, OPTIONS.replace(duration_s=5.0)))
    with pytest.raises(MotionError, match="records"):
        compare_results(result, replace(result, records=()))


def test_one_normaliser_makes_two_databases_comparable() -> None:
    tracks = wandering_tracks()
    before, after = (
        synthetic_database(tracks[:6]),
        synthetic_database([*tracks[2:6], arc_track(1.0, 50.0, 6.0, uid="turn")]),
    )
    for normaliser in (before.normaliser, union_normaliser((before, after))):
        one, other = with_normaliser(before, normaliser), with_normaliser(after, normaliser)
        found = compare_results(evaluated(one), evaluated(other))
        assert found.added == ("turn",)
