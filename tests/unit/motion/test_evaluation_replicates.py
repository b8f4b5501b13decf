"""Replicates of trials: their draws, their independence of threads and tasks, their intervals, and their documents."""

from dataclasses import replace

import numpy as np
import pytest
from tests.support.suggestion_cases import OPTIONS, simulated, wandering_tracks
from tests.support.synthetic_databases import synthetic_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.replicates import MeasuredReplicates, run_of, run_replicates
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.result_documents import result_from_tree, result_to_tree
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.evaluation.suite import assemble
from marey_motion.matching.database import MatchingDatabase
from marey_reports.evaluation.chapters import baseline_chapter
from marey_reports.evaluation.sentences import verdict
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree

SEVERAL = OPTIONS.replace(replicates=4, duration_s=3.0)
TRIALS = suite_trials(SEVERAL)


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    return synthetic_database(wandering_tracks())


@pytest.fixture(scope="module")
def result(database: MatchingDatabase) -> EvaluationResult:
    replicates = run_replicates(database, SEVERAL, TRIALS, threads=2)
    return assemble(database, SEVERAL, TRIALS, simulated(database, SEVERAL), replicates=replicates)


def test_the_first_replicate_is_the_trial_itself(database: MatchingDatabase, result: EvaluationResult) -> None:
    single = SEVERAL.replace(replicates=1)
    assert run_replicates(database, single, TRIALS) is None
    alone = assemble(database, single, TRIALS, simulated(database, single))
    assert alone.replicates is None
    assert result.replicates is not None
    for number, trial in enumerate(alone.trials):
        own = dict(zip(result.replicates.names, result.replicates.values[number, 0].tolist(), strict=True))
        assert {name: own[name] for name, value in trial.metrics.items() if value is not None} == {
            name: value for name, value in trial.metrics.items() if value is not None
        }
    for one, other in zip(alone.records, result.records, strict=True):
        assert np.array_equal(one.positions, other.positions)
    # What identifies the conditions of an evaluation without replicates has not changed since there are replicates.
    known = "sha256:c76b26d41fd0ff9f2d7bd83f5f5dc08276e1412ba4ebffeeefac35ffa4672a5f"
    assert alone.provenance.scenarios == known != result.provenance.scenarios
    assert assemble(database, single.replace(seed=1), TRIALS, simulated(database, single)).provenance.scenarios == known


def test_replicates_depend_on_seed_trial_and_number_alone(database: MatchingDatabase, result: EvaluationResult) -> None:
    drawn = {run_of(trial, number, SEVERAL) for trial in TRIALS for number in range(1, 40)}
    starts = np.array([run.start_ticks for run in drawn])
    longer = np.array([(run.driven.approach_s - run.trial.approach_s) * 60 for run in drawn])
    for ticks in (starts, longer):
        assert ticks.min() >= 0
        assert ticks.max() <= 60
        assert abs(ticks.mean() - 30) < 4
    assert abs(np.corrcoef(starts, longer)[0, 1]) < 0.2
    assert run_of(TRIALS[0], 1, SEVERAL) != run_of(TRIALS[0], 1, SEVERAL.replace(seed=1))
    # Two tasks, with the trials in another order, on one thread.
    shares = [run_replicates(database, SEVERAL, share, threads=1) for share in (TRIALS[1::2], TRIALS[::2])]
    trees = [decode_tree(encode_tree(share.as_tree(), MSGPACK), MSGPACK) for share in shares if share is not None]
    joined = MeasuredReplicates.from_trees(trees, TRIALS)
    again = assemble(database, SEVERAL, TRIALS, result.records, replicates=joined)
    assert encode_tree(result_to_tree(again), MSGPACK) == encode_tree(result_to_tree(result), MSGPACK)


def test_metrics_are_means_with_intervals_that_every_page_tells(result: EvaluationResult) -> None:
    values = result.replicates
    assert values is not None
    offsets = values.of_trials("offset_mean")
    assert offsets.shape == (len(TRIALS), 4)
    assert offsets.std(axis=1).max() > 0
    assert [trial.metrics["offset_mean"] for trial in result.trials] == pytest.approx(offsets.mean(axis=1))
    assert result.suite["offset_mean"] == pytest.approx(offsets.mean())
    interval = values.interval("offset_mean")
    assert interval is not None
    assert interval.low is not None
    half = 3.182446 * offsets.mean(axis=0).std(ddof=1) / 2.0
    assert interval.mean - interval.low == pytest.approx(half, rel=1e-6)
    assert sum(usage.ticks for usage in result.usage) > 4 * sum(len(record.rows) for record in result.records)
    assert "in single replicates" in verdict(result)
    assert f"95 % interval {interval.low:.2f} to {interval.high:.2f} m" in verdict(result)
    assert "Each trial ran 4 times" in str(baseline_chapter(result).content)


def test_a_document_holds_its_replicates_and_old_documents_have_one(result: EvaluationResult) -> None:
    tree = decode_tree(encode_tree(result_to_tree(result), MSGPACK), MSGPACK)
    back = result_from_tree(tree)
    assert back.replicates is not None
    assert result.replicates is not None
    assert np.array_equal(back.replicates.values, result.replicates.values, equal_nan=True)
    assert back.replicates.interval("offset_mean") == result.replicates.interval("offset_mean")
    del tree["replicates"], tree["options"]["replicates"], tree["options"]["seed"]
    old = result_from_tree(tree)
    assert (old.replicates, old.options.replicates) == (None, 1)


def test_a_result_without_its_replicates_is_refused(database: MatchingDatabase, result: EvaluationResult) -> None:
    replicates = run_replicates(database, SEVERAL, TRIALS[1:])
    for given in (None, replicates):
        with pytest.raises(MotionError, match="3 further replicates"):
            assemble(database, SEVERAL, TRIALS, result.records, replicates=given)


def test_replicates_with_undefined_metrics_count_as_far_as_they_are_defined(result: EvaluationResult) -> None:
    assert result.replicates is not None
    some = replace(result.replicates, suite={"response_s": np.array([np.nan, 1.0, 2.0, np.nan])})
    assert some.interval("response_s") == (2, 1.5, None, None)
    assert some.interval("missing") is None
