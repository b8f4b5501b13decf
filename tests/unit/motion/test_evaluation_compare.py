"""Comparison of two evaluations of the same trials, trial by trial."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import ttest_1samp
from tests.support.compared_evaluations import compare_results
from tests.support.suggestion_cases import OPTIONS, UNWANTED, evaluated, named, wandering_tracks
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.compare import (
    LESS_IS_BETTER,
    MetricChange,
    corrected,
    paired_change,
)
from marey_motion.evaluation.improvement.selection import joined, without_sources
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
            (first, second)
            for one, other in zip(result.trials, after.trials, strict=True)
            if (first := one.metrics[change.metric]) is not None
            and (second := other.metrics[change.metric]) is not None
        ]
        assert change.trials == len(pairs)
        assert change.before == pytest.approx(np.mean([pair[0] for pair in pairs]))
        assert change.change == pytest.approx(np.mean([pair[1] - pair[0] for pair in pairs]), abs=1e-12)
        assert change.verdict in ("same", "unclear")  # with one replicate, nothing is known about chance


def drawn(changes: Floats, metric: str = "offset_mean") -> MetricChange:
    """Return the change of three trials whose mean changes in each replicate are given."""
    before = np.random.default_rng(9).normal(size=(3, len(changes)))
    (found,) = corrected([paired_change(metric, before, before + changes + np.array([[-1.0], [0.0], [1.0]]))])
    return found


def test_the_interval_holds_the_true_change_about_as_often_as_it_says() -> None:
    random = np.random.default_rng(1)
    changes = [drawn(0.3 + random.normal(size=8)) for _ in range(400)]
    held = sum(one.low <= 0.3 <= one.high for one in changes if one.low is not None and one.high is not None)
    assert 365 <= held <= 395


def test_the_interval_is_that_of_student_over_replicates_and_not_over_trials() -> None:
    changes = np.random.default_rng(4).normal(0.3, 0.1, 8)
    found = drawn(changes)
    reach = 2.364624 * changes.std(ddof=1) / np.sqrt(8)
    assert (found.low, found.high) == pytest.approx((changes.mean() - reach, changes.mean() + reach))
    assert (found.trials, found.replicates) == (3, 8)
    assert found.p == pytest.approx(ttest_1samp(changes, 0.0).pvalue)


def test_replicates_in_which_a_metric_is_not_defined_are_left_out() -> None:
    before = np.array([[1.0, np.nan, 2.0, 3.0, 1.0], [np.nan, np.nan, 1.0, 1.0, 1.0]])
    after = before + np.array([0.1, 9.0, 0.2, 0.3, 0.2])
    found = paired_change("offset_mean", before, after)
    assert (found.trials, found.replicates) == (2, 4)
    assert found.change == pytest.approx(0.2)


def test_changes_that_differ_by_rounding_alone_have_an_interval_around_them() -> None:
    counts = np.arange(9.0, 15.0)[None]  # switches in 30 s, five more in every replicate
    found = paired_change("transitions_per_s", counts / 30, (counts + 5) / 30)
    assert (found.low, found.high) == pytest.approx((5 / 30, 5 / 30), rel=1e-12)
    assert paired_change("transitions_per_s", counts, counts).verdict == "same"


@pytest.mark.parametrize(("replicates", "verdict"), [(3, "unclear"), (4, "unclear"), (8, "better")])
def test_equal_changes_of_few_replicates_may_be_chance(replicates: int, verdict: str) -> None:
    found = paired_change("offset_mean", np.ones((1, replicates)), np.zeros((1, replicates)))
    assert found.p == 2.0 ** (1 - replicates)
    assert found.verdict == verdict


def test_a_verdict_needs_more_than_chance_and_a_metric_with_a_direction() -> None:
    noise = 0.1 * np.random.default_rng(3).normal(size=8)
    assert drawn(noise - 0.5).verdict == "better"
    assert drawn(noise + 0.5).verdict == "worse"
    assert drawn(noise - noise.mean()).verdict == "unclear"
    assert drawn(noise + 0.5, "transitions").verdict == "changed"
    assert drawn(0.0 * noise).verdict == "unclear"  # the trials changed, although their means did not
    assert paired_change("offset_mean", np.ones((1, 1)), np.zeros((1, 1))).verdict == "unclear"


def test_differences_of_rounding_are_no_change() -> None:
    before = 0.1 * np.arange(1.0, 9.0)[None]
    found = paired_change("foot_skate", before, before * (1.0 + 2.0**-50))
    assert (found.verdict, found.p, found.change) == ("same", None, 0.0)
    assert paired_change("foot_skate", before, before * (1.0 + 1e-9)).verdict == "worse"


def test_the_verdicts_of_many_metrics_are_rarely_false_together() -> None:
    """The replicates differ by chance alone: uncorrected, more than half of the families would have a false verdict."""
    random = np.random.default_rng(7)
    metrics = LESS_IS_BETTER
    false = 0
    for _ in range(300):
        changes = [paired_change(name, np.zeros((1, 8)), random.normal(size=(1, 8))) for name in metrics]
        false += any(one.verdict != "unclear" for one in corrected(changes))
    assert false <= 300 * 0.05 + 2.5 * np.sqrt(300 * 0.05 * 0.95)
    # Holm's method: the least of two probabilities is doubled, the other one is raised to it at least.
    pair = [
        replace(drawn(np.arange(1.0, 9.0)), metric=name, p=p) for name, p in zip(metrics, (0.03, 0.02), strict=False)
    ]
    assert [one.p for one in corrected(pair)] == pytest.approx([0.04, 0.04])
    assert [one.p for one in corrected([pair[0], replace(pair[1], metric="transitions")])] == [0.03, 0.02]


def test_evaluations_under_other_conditions_are_refused_by_name(
    database: MatchingDatabase, result: EvaluationResult
) -> None:
    fitted_anew = synthetic_database(wandering_tracks()[:5])
    with pytest.raises(MotionError, match="normaliser"):
        compare_results(result, evaluated(fitted_anew))
    other = OPTIONS.replace(controller=OPTIONS.controller.replace(follow="path"))
    with pytest.raises(MotionError, match="options"):
        compare_results(result, evaluated(database, other))
    with pytest.raises(MotionError, match=r"scenarios differ \(duration_s: 6.0 and 5.0; seed: 0 and 3\)"):
        compare_results(result, evaluated(database, OPTIONS.replace(duration_s=5.0, seed=3, coverage_least_s=9.0)))
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
