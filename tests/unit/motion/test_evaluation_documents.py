from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from tests.support.evaluation_cases import arc, clips_of, record_of, root_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.result_documents import (
    records_from_tree,
    records_to_tree,
    result_from_tree,
    result_to_tree,
)
from marey_motion.evaluation.scenario import Trial, reference, suite_trials
from marey_motion.evaluation.suite import assemble
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.encoding.codecs import MEDIA_TYPES, decode_tree, encode_tree
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.matching import ControllerOptions, DatabaseOptions

OPTIONS = EvaluationOptions(
    speeds_m_s=(1.0, 2.0),
    turn_rates_deg_s=(-50.0, 0.0, 50.0),
    duration_s=12.0,
    replicates=1,
    literal_formulas=True,
    database=DatabaseOptions(mirroring="add", extra_joints=("head",)),
    controller=ControllerOptions(root_clamp_m=0.5),
)
TRIALS = suite_trials(OPTIONS)


def searched_record(trial: Trial, number: int) -> TrialRecord:
    """Return a random record that follows the trial's reference path, with a search every six ticks and a few jumps."""
    asked = reference(trial)
    ticks = asked.tick_count
    generator = np.random.default_rng(number)
    match_cost = np.full(ticks, np.nan)
    match_cost[::6] = generator.uniform(size=len(match_cost[::6]))
    continuing_cost = np.where(generator.uniform(size=ticks) < 0.9, match_cost - 0.3, np.nan)
    rows = np.arange(ticks, dtype=np.int32) % 500
    status = np.where(np.diff(rows, prepend=-1) == 1, Status.KEPT, Status.REPLACING).astype(np.int8)
    pose_cost = generator.uniform(size=ticks)
    return record_of(
        asked,
        rows=rows,
        status=status,
        match_cost=match_cost,
        continuing_cost=continuing_cost,
        pose_cost=pose_cost,
    )


@pytest.fixture(scope="module")
def result() -> EvaluationResult:
    database = root_database(arc(1.0, 50.0, 5.0), arc(2.0, -50.0, 4.0), arc(1.0, 0.0, 0.5), options=OPTIONS.database)
    tagged = replace(database.clips[0], tags=("walk",)), replace(database.clips[1], mirrored_from="a")
    database = replace(database, clips=(*tagged, database.clips[2]))
    records = [searched_record(trial, number) for number, trial in enumerate(TRIALS)]
    baseline = replace(assemble(database, OPTIONS, TRIALS, records), records=(), notes=("a note",))
    return assemble(database, OPTIONS, TRIALS, records, baseline=baseline)


def same(left: Any, right: Any) -> bool:
    """Return whether two results are equal in every bit and in the type of every array."""
    if is_dataclass(left):
        return type(left) is type(right) and all(
            same(getattr(left, field.name), getattr(right, field.name)) for field in fields(left)
        )
    if isinstance(left, np.ndarray):
        return left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, (tuple, list)):
        return type(left) is type(right) and len(left) == len(right) and all(map(same, left, right))
    return type(left) is type(right) and left == right


def test_an_evaluation_comes_back_from_its_tree_as_it_was(result: EvaluationResult) -> None:
    assert same(result_from_tree(result_to_tree(result), result.records), result)


def test_records_come_back_from_their_tree_as_they_were(result: EvaluationResult) -> None:
    known = records_from_tree(records_to_tree(TRIALS, result.records))

    assert list(known) == [trial.name for trial in TRIALS]
    assert same(tuple(known.values()), result.records)


@pytest.mark.parametrize("media_type", MEDIA_TYPES)
def test_both_documents_travel_in_every_format(result: EvaluationResult, media_type: str) -> None:
    evaluation = decode_tree(encode_tree(result_to_tree(result), media_type), media_type)
    records = decode_tree(encode_tree(records_to_tree(TRIALS, result.records), media_type), media_type)
    back = result_from_tree(evaluation, tuple(records_from_tree(records).values()))

    assert same(back.coverage, result.coverage)
    assert same(back.records, result.records)
    assert back.trials == result.trials
    assert back.options == result.options
    assert result_to_tree(back).keys() == result_to_tree(result).keys()


def test_blocks_keep_every_bit(result: EvaluationResult) -> None:
    media_type = "application/msgpack"
    tree = records_to_tree(TRIALS, result.records)
    back = records_from_tree(decode_tree(encode_tree(tree, media_type, arrays="blocks"), media_type))

    assert same(tuple(back.values()), result.records)


def test_records_of_shares_of_the_trials_join_to_those_of_all(result: EvaluationResult) -> None:
    shares = [records_from_tree(records_to_tree(TRIALS[share::3], result.records[share::3])) for share in (2, 0, 1)]
    known = shares[0] | shares[1] | shares[2]

    assert same(tuple(known[trial.name] for trial in TRIALS), result.records)


def test_records_without_any_search_come_back(result: EvaluationResult) -> None:
    quiet = record_of(reference(TRIALS[0]))
    (back,) = records_from_tree(records_to_tree(TRIALS[:1], [quiet])).values()

    assert same(back, quiet)


def test_the_same_result_gives_the_same_bytes(result: EvaluationResult) -> None:
    first, second = (
        encode_tree(tree, "application/msgpack", arrays="blocks")
        for tree in (result_to_tree(result), result_to_tree(result_from_tree(result_to_tree(result))))
    )
    assert first == second


def test_a_document_of_another_schema_is_refused(result: EvaluationResult) -> None:
    with pytest.raises(MotionError, match="marey/evaluation-records@1 is needed, not marey/evaluation@1"):
        records_from_tree(result_to_tree(result))
    with pytest.raises(MotionError, match="not None"):
        result_from_tree({})


def test_records_of_several_rates_are_refused(result: EvaluationResult) -> None:
    slower = replace(result.records[1], rate_hz=30.0)
    with pytest.raises(MotionError, match="rates"):
        records_to_tree(TRIALS[:2], [result.records[0], slower])


def test_clips_of_an_evaluation_tell_where_their_frames_are(result: EvaluationResult) -> None:
    assert [usage.popularity.shape for usage in result.usage] == [(301,), (241,), (31,)]
    assert clips_of(301, 241, 31)[1].start == result.clips[1].start
