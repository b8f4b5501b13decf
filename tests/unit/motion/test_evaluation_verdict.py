"""Verdicts on sets with a known flaw: each fails by its looks, and the verdict names the flaw in plain words."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.support.compared_evaluations import compare_results
from tests.support.judged_sets import FEW, database_of, evaluated_set, frozen, gliding, walks

from marey_motion.clip import Clip
from marey_motion.evaluation.judgement import LOOKS, judge, judge_trial
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.result_documents import result_from_tree, result_to_tree
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.matching.record import Status, TrialRecord
from marey_reports.evaluation.sentences import region_verdicts, verdict
from marey_schemas.options.matching import ControllerOptions
from marey_schemas.options.verdict import VerdictLimits


@pytest.fixture(scope="module")
def good() -> EvaluationResult:
    return evaluated_set(walks())


def told(result: EvaluationResult) -> str:
    return " ".join((verdict(result), *(region.sentence for region in region_verdicts(result))))


def fails_by_looks(result: EvaluationResult) -> int:
    return sum(any(check.measure in LOOKS for check in each.exceeded) for each in judge(result).trials)


def test_generated_walks_for_every_cell_are_followed_and_look_right(good: EvaluationResult) -> None:
    judgement = judge(good)
    assert (judgement.grade, judgement.followed) == ("very good", len(good.trials))
    assert [region.sentence for region in region_verdicts(good)] == [
        "Straight: 2 of 2 trajectories followed.",
        "Gentle turns: 2 of 2 trajectories followed.",
        "Sharp turns: 2 of 2 trajectories followed.",
    ]


def one_stride() -> list[Clip]:
    return [walks()[1].sliced(0, 70)]


@pytest.mark.parametrize(
    ("clips", "words"),
    [
        (lambda: [frozen(clip) for clip in walks()], "it glides, with only 0.00 steps per metre"),
        (lambda: [frozen(walks()[1])], "it glides, with only 0.00 steps per metre"),
        (lambda: [gliding(clip) for clip in walks()], "it glides, with only 0.00 steps per metre"),
        (one_stride, "its feet slide at"),
    ],
    ids=["frozen poses", "one frozen frame", "gliding clips", "one stride"],
)
def test_a_set_that_only_seems_to_follow_fails_by_its_looks_and_the_verdict_says_why(
    clips: Callable[[], list[Clip]], words: str
) -> None:
    result = evaluated_set(clips())
    assert judge(result).followed == 0
    assert fails_by_looks(result) == len(result.trials)
    assert words in told(result)
    assert verdict(result).startswith("Poor: ")


def test_frozen_poses_keep_to_trajectories_and_are_not_followed() -> None:
    result = evaluated_set([frozen(clip) for clip in walks()])
    assert judge(result).on_path >= 4  # what the old verdict counted as followed
    assert "are kept to, but the motion looks wrong" in verdict(result)


def test_poses_chosen_by_their_distance_alone_slide_and_jerk() -> None:
    options = FEW.replace(controller=ControllerOptions(selection="pose_distance", reselect_window_s=0.0))
    stepping = evaluated_set(walks(seconds=2.0), FEW.replace(controller=ControllerOptions(reselect_window_s=0.0)))
    result = evaluated_set(walks(seconds=2.0), options)
    assert fails_by_looks(result) > fails_by_looks(stepping)
    assert fails_by_looks(result) >= len(result.trials) // 2
    assert "its poses jerk" in told(result)
    assert (result.suite["foot_skate"] or 0.0) > 2 * (stepping.suite["foot_skate"] or 0.0)


# The measures, one by one

CIRCLE = suite_trials(FEW)[0]


def played(clips: list[Clip], start: int = 60, ticks: int = 240) -> tuple[LooksMeter, TrialRecord]:
    """Return a record that plays the first clip as it is, from one of its frames on."""
    database = database_of(clips)
    rows = np.arange(start, start + ticks, dtype=np.int32)
    nothing = np.full(ticks, np.nan)
    return LooksMeter(database, ControllerOptions()), TrialRecord(
        database.options.rate_hz, rows, database.root_positions[rows], database.root_headings[rows],
        np.zeros(ticks, dtype=np.int8), nothing, nothing, np.zeros(ticks),
    )  # fmt: skip


def test_a_clip_played_as_it_is_looks_like_itself() -> None:
    meter, record = played(walks()[1:2])
    looks = meter.measure(CIRCLE, record, np.full(239, True))
    assert looks["foot_skate"] == pytest.approx(looks["foot_skate_clips"], abs=1e-3)
    assert looks["contacts_per_m"] == pytest.approx(looks["contacts_per_m_clips"], rel=0.15)
    assert looks["foot_depth_p95"] == pytest.approx(0.0, abs=0.002)
    assert looks["treading_per_s"] == 0.0
    assert looks["foot_skate_ratio"] is None  # the toes of generated walks stand still, so a ratio says nothing


def test_feet_skate_as_fast_as_the_root_is_carried_away() -> None:
    meter, record = played(walks()[1:2])
    drift = np.arange(240)[:, None] / record.rate_hz * np.array([0.3, 0.4])
    looks = meter.measure(CIRCLE, replace(record, positions=record.positions + drift), np.full(239, True))
    assert looks["foot_skate"] == pytest.approx(0.5, abs=0.01)


def test_a_pose_that_is_held_takes_no_steps_and_returning_to_it_is_treading() -> None:
    meter, record = played(walks()[1:2])
    rows = np.tile(np.arange(60, 66, dtype=np.int32), 40)
    status = np.tile(np.array([Status.REPLACING, 0, 0, 0, 0, Status.REPLACED], dtype=np.int8), 40)
    looks = meter.measure(CIRCLE, replace(record, rows=rows, status=status), np.full(239, True))
    assert looks["contacts_per_m"] == 0.0
    assert looks["treading_per_s"] == pytest.approx(39 * 60 / 239)


def test_half_of_the_switches_without_an_answer_are_a_failure_not_a_gap(good: EvaluationResult) -> None:
    trial = replace(good.trials[0].trial, family="switching")
    metrics = dict(good.trials[0].metrics)
    for median_s, missed, failed in ((0.9, 2.0, False), (2.5, 0.0, True), (None, 3.0, True), (None, 0.0, False)):
        outcome = replace(good.trials[0], trial=trial, metrics={**metrics, "response_median_s": median_s,
                                                                "response_missed": missed})  # fmt: skip
        exceeded = {check.measure for check in judge_trial(outcome, VerdictLimits()).exceeded}
        assert ("response" in exceeded) is failed


def test_a_heading_that_drifts_away_fails_though_its_rate_is_within_the_limit(good: EvaluationResult) -> None:
    outcome = replace(good.trials[0], metrics={**good.trials[0].metrics, "se_omega_deg": 9.0, "heading_rms_deg": 150.0})
    assert [check.measure for check in judge_trial(outcome, VerdictLimits()).exceeded] == ["heading"]


def test_each_regime_is_judged_so_that_errors_of_opposite_sign_do_not_cancel(good: EvaluationResult) -> None:
    base = {"settled_se_v": 0.5, "settled_dse_v": 0.1}
    switched = {"settled_se_v": -0.7, "settled_dse_v": 0.1}
    trial = replace(good.trials[0].trial, family="switching")
    outcome = replace(
        good.trials[0],
        trial=trial,
        metrics={**good.trials[0].metrics, "se_v": -0.1, "settled_se_v": -0.1},
        regimes={"base": base, "switched": switched},
    )
    assert [check.value for check in judge_trial(outcome, VerdictLimits()).exceeded] == [0.5, -0.7]


# Limits that are set, and results of old versions


def test_limits_are_options_and_results_with_other_limits_are_not_compared(good: EvaluationResult) -> None:
    strict = FEW.replace(limits=VerdictLimits(skate_m_s=0.001))
    result = evaluated_set(walks(), strict)
    assert judge(result).followed < judge(good).followed
    with pytest.raises(Exception, match="limits of the verdict differ"):
        compare_results(good, result)


def test_a_result_of_an_old_version_is_read_judged_by_its_path_and_not_compared(good: EvaluationResult) -> None:
    tree = result_to_tree(good)
    del tree["options"]["limits"], tree["provenance"]["limits"]
    new = {"foot_skate", "foot_skate_clips", "foot_skate_ratio", "foot_depth_p95", "contacts_per_m", "treading_per_s",
           "contacts_per_m_clips", "pose_cost_clips", "settled_se_v", "settled_dse_v", "heading_rms_deg",
           "response_median_s"}  # fmt: skip
    for one in tree["trials"]:
        one["metrics"] = {name: value for name, value in one["metrics"].items() if name not in new}
        del one["followed"], one["worst_rank"], one["beyond_limits"]
    old = result_from_tree(tree, good.records)

    assert judge(old).followed == len(good.trials)
    assert "how the motion looks was not measured" in verdict(old)
    with pytest.raises(Exception, match="has no limits and must be made again"):
        compare_results(old, good)


def test_the_order_of_the_worst_is_the_same_in_the_document_and_in_the_judgement() -> None:
    result = evaluated_set(one_stride())
    ranks = [one["worst_rank"] for one in result_to_tree(result)["trials"]]
    names = [each.outcome.trial.name for each in judge(result).ranked]
    assert [names[rank] for rank in ranks] == [each.trial.name for each in result.trials]
