from typing import Any

import numpy as np
import pytest
from tests.support.evaluation_cases import RATE_HZ, closed_reference, record_of, straight_record
from tests.support.present import present

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.metrics import measure_trial, trial_series
from marey_motion.evaluation.pooling import offset_asymmetry, pooled_metrics
from marey_motion.evaluation.result import TrialResult
from marey_motion.evaluation.scenario import Reference, Trial, reference
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.options.evaluation import EvaluationOptions

OPTIONS = EvaluationOptions()
STRAIGHT = Trial("circle", 1.5, 0.0)
LEFT = Trial("circle", 2.0, np.radians(50.0))
SWITCHING = Trial("switching", 1.0, np.radians(-25.0))


def measured(
    trial: Trial, record: TrialRecord, options: EvaluationOptions = OPTIONS, asked: Reference | None = None
) -> TrialResult:
    return measure_trial(trial, asked or closed_reference(trial), record, options)


def answering(asked: Reference, delay_s: float) -> Floats:
    """Return the speed of each step of a character that follows changes of the wanted speed with a delay."""
    wanted = asked.speeds_m_s[: asked.tick_count - 1]
    late = round(delay_s * RATE_HZ)
    return np.concatenate((np.full(late, wanted[0]), wanted))[: len(wanted)]


# Accuracy


@pytest.mark.parametrize(("speed", "turn_rate"), [(2.0, 50.0), (1.0, -100.0), (3.0, 25.0)])
def test_a_perfect_trial_has_only_the_error_of_chords(speed: float, turn_rate: float) -> None:
    trial = Trial("circle", speed, np.radians(turn_rate))
    metrics = measure_trial(trial, reference(trial), record_of(reference(trial)), OPTIONS).metrics

    assert metrics["offset_max"] == 0.0
    assert metrics["se_v"] == pytest.approx(-speed * (trial.turn_rate_rad_s / RATE_HZ) ** 2 / 24, rel=1e-3)
    assert abs(present(metrics["se_omega_deg"])) < 1e-12
    assert present(metrics["dse_v"]) < 1e-10
    assert present(metrics["dse_omega_deg"]) < 1e-9
    assert abs(present(metrics["se_omega_path_deg"])) < 1e-9


def test_a_speed_that_swings_by_a_over_whole_periods_has_a_spread_of_a_over_root_two() -> None:
    asked = closed_reference(STRAIGHT)
    times = np.arange(1, asked.tick_count) / RATE_HZ
    metrics = measured(STRAIGHT, straight_record(asked, 1.5 + 0.3 * np.sin(2 * np.pi * times))).metrics

    assert metrics["dse_v"] == pytest.approx(0.3 / np.sqrt(2), abs=1e-12)
    assert metrics["se_v"] == pytest.approx(0.0, abs=1e-12)


def test_a_trajectory_shifted_by_thirty_and_forty_centimetres_is_half_a_metre_off() -> None:
    asked = closed_reference(LEFT)
    shifted = record_of(asked, positions=asked.positions[: asked.tick_count] + np.array((0.3, 0.4)))
    metrics = measured(LEFT, shifted).metrics

    for name in ("offset_mean", "offset_rms", "offset_max", "offset_final"):
        assert metrics[name] == pytest.approx(0.5, abs=1e-12)
    samples = 30 * RATE_HZ
    assert metrics["offset_sum"] == pytest.approx(0.5 * samples, abs=1e-9)
    assert metrics["offset_integral"] == pytest.approx(0.5 * 30, abs=1e-9)
    assert abs(present(metrics["se_v"])) < 1e-4


def test_going_too_fast_by_twenty_centimetres_a_second_is_a_static_error_of_that() -> None:
    asked = closed_reference(STRAIGHT)
    fast = measured(STRAIGHT, straight_record(asked, np.full(asked.tick_count - 1, 1.7))).metrics
    slow = measured(STRAIGHT, straight_record(asked, np.full(asked.tick_count - 1, 1.3))).metrics

    assert fast["se_v"] == pytest.approx(0.2, abs=1e-12)
    assert (slow["se_v"], slow["abs_se_v"]) == pytest.approx((-0.2, 0.2), abs=1e-12)
    assert fast["dse_v"] == pytest.approx(0.0, abs=1e-9)


def test_turning_more_to_the_left_than_asked_is_a_positive_error() -> None:
    for turn_rate in (-50.0, 0.0, 50.0):
        trial = Trial("circle", 1.0, np.radians(turn_rate))
        asked = closed_reference(trial)
        more = closed_reference(Trial("circle", 1.0, np.radians(turn_rate + 10.0)))
        metrics = measured(trial, record_of(more), asked=asked).metrics
        assert metrics["se_omega_deg"] == pytest.approx(10.0, abs=1e-9)
        assert metrics["se_omega_path_deg"] == pytest.approx(10.0, abs=1e-9)


def test_left_of_the_path_and_ahead_on_it_are_positive() -> None:
    asked = closed_reference(LEFT)
    heading = asked.headings[: asked.tick_count]
    leftward = np.stack((np.cos(heading), -np.sin(heading)), axis=1)
    ahead = np.stack((np.sin(heading), np.cos(heading)), axis=1)
    moved = record_of(asked, positions=asked.positions[: asked.tick_count] + 0.2 * leftward - 0.1 * ahead)
    metrics = measured(LEFT, moved).metrics

    assert metrics["cross_track_mean"] == pytest.approx(0.2, abs=1e-12)
    assert metrics["along_track_mean"] == pytest.approx(-0.1, abs=1e-12)
    assert metrics["along_track_max"] == pytest.approx(0.1, abs=1e-12)
    assert metrics["offset_rms"] == pytest.approx(np.hypot(0.2, 0.1), abs=1e-12)


def test_side_steps_turn_with_the_path_while_the_character_faces_one_way() -> None:
    asked = closed_reference(LEFT)
    metrics = measured(LEFT, record_of(asked, headings=np.zeros(asked.tick_count))).metrics

    assert metrics["se_omega_deg"] == pytest.approx(-50.0, abs=1e-9)
    assert metrics["se_omega_path_deg"] == pytest.approx(0.0, abs=1e-9)


def test_a_character_that_stands_still_has_no_direction_of_travel() -> None:
    asked = closed_reference(STRAIGHT)
    metrics = measured(STRAIGHT, straight_record(asked, np.zeros(asked.tick_count - 1))).metrics

    assert metrics["se_omega_path_deg"] is None
    assert metrics["dse_omega_path_deg"] is None
    assert metrics["se_v"] == -1.5


def test_the_approach_counts_only_when_asked_for() -> None:
    asked = closed_reference(LEFT)
    apart = np.zeros((asked.tick_count, 2))
    apart[: 180 + 1, 0] = 1.0  # the approach and the tick at which the circle begins
    record = record_of(asked, positions=asked.positions[: asked.tick_count] + apart)
    circle = measured(LEFT, record)
    whole = measured(LEFT, record, EvaluationOptions(window="all"))

    assert circle.metrics["offset_max"] == 0.0
    assert circle.regimes == {}
    assert whole.metrics["offset_mean"] == pytest.approx(180 / 1980)
    assert whole.regimes["approach"]["offset_mean"] == pytest.approx(1.0)
    assert whole.regimes["base"]["offset_mean"] == 0.0


def test_the_approach_does_not_count_as_spread_of_the_turn_rate() -> None:
    metrics = measured(LEFT, record_of(closed_reference(LEFT)), EvaluationOptions(window="all")).metrics

    assert metrics["dse_omega_deg"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["se_omega_deg"] == pytest.approx(0.0, abs=1e-9)


def test_a_trial_without_a_circle_measures_nothing_on_it() -> None:
    trial = Trial("circle", 1.0, 0.5, duration_s=0.0)
    metrics = measured(trial, record_of(closed_reference(trial))).metrics

    assert metrics["se_v"] is None
    assert metrics["offset_final"] is None
    assert metrics["transitions_per_s"] is None
    assert metrics["transitions"] == 0.0


def test_a_record_of_another_trial_is_refused_by_name() -> None:
    with pytest.raises(MotionError, match=r"circle v=2 w=50: the record of the trial has 61 ticks"):
        measure_trial(LEFT, reference(LEFT), record_of(closed_reference(Trial("circle", 1.0, 0.0, 0.0, 1.0))), OPTIONS)


# Regimes and response


def test_each_speed_of_a_switching_trial_is_measured_by_itself() -> None:
    asked = closed_reference(SWITCHING)
    wanted = asked.speeds_m_s[: asked.tick_count - 1]
    times = np.arange(1, asked.tick_count) / RATE_HZ
    swing = np.where(wanted == 4.0, 0.4, 0.1) * np.sin(2 * np.pi * times)
    result = measured(SWITCHING, straight_record(asked, wanted + np.where(wanted == 4.0, -1.5, 0.1) + swing))

    assert list(result.regimes) == ["base", "switched"]
    assert result.regimes["base"]["se_v"] == pytest.approx(0.1, abs=1e-12)
    assert result.regimes["switched"]["se_v"] == pytest.approx(-1.5, abs=1e-12)
    assert result.regimes["switched"]["dse_v"] == pytest.approx(0.4 / np.sqrt(2), abs=1e-12)
    assert result.metrics["se_v"] == pytest.approx(-0.7, abs=1e-12)
    # Spread is about the mean of each speed, not about the mean of both.
    assert result.metrics["dse_v"] == pytest.approx(np.sqrt((0.4**2 + 0.1**2) / 4), abs=1e-12)


@pytest.mark.parametrize("delay_s", [0.0, 0.25, 1.0])
def test_the_response_time_is_how_late_the_speed_comes_right(delay_s: float) -> None:
    asked = closed_reference(SWITCHING)
    result = measured(SWITCHING, straight_record(asked, answering(asked, delay_s)))

    assert result.metrics["response_s"] == pytest.approx(delay_s)
    assert result.metrics["response_missed"] == 0.0
    assert result.regimes["switched"]["response_s"] == pytest.approx(delay_s)
    assert result.regimes["base"]["response_s"] == pytest.approx(delay_s)


def test_a_switch_that_is_never_answered_has_no_response_time() -> None:
    asked = closed_reference(SWITCHING)
    result = measured(SWITCHING, straight_record(asked, np.full(asked.tick_count - 1, 1.0)))

    assert result.regimes["switched"]["response_s"] is None
    assert result.regimes["switched"]["response_missed"] == 3.0
    assert result.regimes["base"]["response_s"] == 0.0
    assert result.metrics["response_missed"] == 3.0


def test_a_speed_that_is_right_for_less_than_half_a_second_has_not_responded() -> None:
    asked = closed_reference(SWITCHING)
    wanted = asked.speeds_m_s[: asked.tick_count - 1]
    speeds = np.full(len(wanted), 1.0)
    first_switch = round(8.0 * RATE_HZ)
    speeds[first_switch + 30 : first_switch + 59] = 4.0  # for 29 steps
    speeds[first_switch + 100 : first_switch + 130] = 3.7  # for 30, within a tenth
    result = measured(SWITCHING, straight_record(asked, speeds))

    assert result.regimes["switched"]["response_s"] == pytest.approx(100 / RATE_HZ)
    assert result.regimes["switched"]["response_missed"] == 2.0


# Switches and costs


def test_only_chosen_jumps_are_transitions() -> None:
    asked = closed_reference(LEFT)
    status = np.full(asked.tick_count, Status.KEPT, dtype=np.int8)
    # The first two were decided during the approach, the third at the first tick of the circle.
    status[[100, 180, 181, 300, 500]] = Status.REPLACING
    status[[99, 179, 299, 499]] = Status.REPLACED
    status[[900, 1000]] = Status.FORCED
    metrics = measured(LEFT, record_of(asked, status=status)).metrics

    assert metrics["transitions"] == 3.0
    assert metrics["transitions_per_s"] == pytest.approx(3.0 / 30.0)
    assert metrics["clip_ends"] == 2.0


def test_costs_are_summed_up_where_they_are_defined() -> None:
    asked = closed_reference(LEFT)
    ticks = asked.tick_count
    match_cost = np.full(ticks, np.nan)
    match_cost[181:281] = np.arange(1.0, 101.0)
    match_cost[7] = 1000.0  # during the approach
    status = np.full(ticks, Status.KEPT, dtype=np.int8)
    status[[400, 600]] = Status.REPLACING
    pose_cost = np.full(ticks, 0.1)
    pose_cost[[399, 599]] = 0.5, 0.7  # towards the rows that are entered
    metrics = measured(LEFT, record_of(asked, match_cost=match_cost, pose_cost=pose_cost, status=status)).metrics

    assert metrics["match_cost_mean"] == 50.5
    assert metrics["match_cost_p95"] == pytest.approx(95.05)
    assert metrics["match_cost_max"] == 100.0
    assert metrics["continuing_cost_mean"] is None
    assert metrics["pose_cost_max"] == 0.7
    assert metrics["switch_pose_cost_mean"] == pytest.approx(0.6)


def test_costs_of_each_speed_are_told_apart() -> None:
    asked = closed_reference(SWITCHING)
    fast = asked.speeds_m_s[: asked.tick_count] == 4.0
    result = measured(SWITCHING, record_of(asked, pose_cost=np.where(fast, 0.9, 0.2)))

    assert result.regimes["base"]["pose_cost_max"] == 0.2
    assert result.regimes["switched"]["pose_cost_mean"] == pytest.approx(0.9)


# The formulas as printed


def test_the_printed_formulas_are_measured_on_request() -> None:
    asked = closed_reference(STRAIGHT)
    record = straight_record(asked, np.full(asked.tick_count - 1, 1.7))
    plain = measured(STRAIGHT, record).metrics
    literal = measured(STRAIGHT, record, EvaluationOptions(literal_formulas=True)).metrics

    assert not any(name.endswith("_literal") for name in plain)
    samples = 1800
    static = 1.7 * samples / (samples - 1) - 1.5
    assert literal["se_v_literal"] == pytest.approx(static, abs=1e-12)
    assert literal["dse_v_literal"] == pytest.approx(np.sqrt(samples * (1.7 - static + 1.5) ** 2 / 9), abs=1e-9)
    assert literal["dse_omega_deg_literal"] == pytest.approx(0.0, abs=1e-9)


# Several trials


def results_of(*values: Any) -> list[TrialResult]:
    return [
        TrialResult(Trial("circle", 1.0, turn_rate), metrics)
        for turn_rate, metrics in zip((-1.0, 1.0), values, strict=False)
    ]


def test_trials_are_pooled_by_what_each_metric_is() -> None:
    pooled = pooled_metrics(
        results_of(
            {"se_v": 1.0, "dse_v": 3.0, "offset_max": 2.0, "offset_rms": 3.0, "transitions": 5.0, "response_s": None},
            {"se_v": -2.0, "dse_v": 4.0, "offset_max": 7.0, "offset_rms": 4.0, "transitions": 6.0, "response_s": 0.5},
        )
    )

    assert pooled["se_v"] == -0.5
    assert pooled["dse_v"] == 3.5
    assert pooled["dse_v_pooled"] == pytest.approx(np.sqrt(12.5))
    assert pooled["offset_max"] == 7.0
    assert pooled["offset_rms"] == pytest.approx(np.sqrt(12.5))
    assert pooled["transitions"] == 11.0
    assert pooled["response_s"] == 0.5


def test_regimes_are_pooled_under_their_names() -> None:
    trials = [
        TrialResult(SWITCHING, {"se_v": 0.0}, {"base": {"se_v": base}, "switched": {"se_v": None}})
        for base in (1.0, 2.0)
    ]
    pooled = pooled_metrics(trials)

    assert pooled["base.se_v"] == 1.5
    assert pooled["switched.se_v"] is None


def test_asymmetry_is_the_difference_between_left_and_right_turns() -> None:
    assert offset_asymmetry(results_of({"offset_mean": 0.5}, {"offset_mean": 0.2})) == pytest.approx(0.3)
    assert offset_asymmetry(results_of({"offset_mean": 0.5})) is None
    straight = TrialResult(STRAIGHT, {"offset_mean": 0.1}, {})
    assert offset_asymmetry((straight,)) is None
    pair = results_of({"offset_mean": 0.5}, {"offset_mean": 0.2})
    assert offset_asymmetry((*pair, straight)) == pytest.approx(0.3)


def test_a_series_has_a_value_per_step_and_says_what_was_asked() -> None:
    asked = closed_reference(SWITCHING)
    series = trial_series(SWITCHING, asked, record_of(asked))

    assert len(series.times_s) == asked.tick_count - 1
    switches = series.times_s[np.flatnonzero(np.diff(series.wanted_speeds_m_s))]
    assert switches == pytest.approx([8.0, 13.0, 18.0, 23.0, 28.0])
    assert np.flatnonzero(np.diff(series.regimes)).size == 6
