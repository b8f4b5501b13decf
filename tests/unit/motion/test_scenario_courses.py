"""Courses with stops, corners, figures of eight and motion sideways: their paths, and what trials on them measure."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.evaluation.judgement import judge_trial
from marey_motion.evaluation.metrics import measure_trial
from marey_motion.evaluation.provenance import provenance_of
from marey_motion.evaluation.result import TrialResult
from marey_motion.evaluation.scenario import Reference, Trial, demand, reference, suite_trials
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.verdict import VerdictLimits

OPTIONS = EvaluationOptions(speeds_m_s=(2.0,), turn_rates_deg_s=(0.0, 90.0), approach_s=1.0, replicates=1)
SQUARE = Trial("corners", 2.0, 0.0, 1.0, 8.0, switch_every_s=2.0, angle_rad=np.pi / 2)
STOPS = Trial("stopping", 1.5, 0.5, 1.0, 8.0, switch_speed_m_s=0.0, switch_every_s=2.0)
EIGHT = Trial("eights", 2.0, np.pi / 2, 1.0, 8.0)
SIDEWAYS = Trial("strafing", 1.0, 0.0, 1.0, 4.0, angle_rad=-np.pi / 2)
COURSES = (SQUARE, STOPS, EIGHT, SIDEWAYS)


def record_of(asked: Reference) -> TrialRecord:
    """Return the record of a character that does exactly what is asked."""
    ticks, nothing = asked.tick_count, np.full(asked.tick_count, np.nan)
    return TrialRecord(
        rate_hz=asked.rate_hz,
        rows=np.zeros(ticks, np.int32),
        positions=asked.positions[:ticks],
        headings=asked.headings[:ticks],
        status=np.full(ticks, Status.KEPT, np.int8),
        match_cost=nothing,
        continuing_cost=nothing,
        pose_cost=nothing,
    )


def measured(trial: Trial, record: TrialRecord | None = None) -> TrialResult:
    asked = reference(trial)
    return measure_trial(trial, asked, record or record_of(asked), OPTIONS)


def at(trial: Trial, seconds: float) -> tuple[float, float, float]:
    """Return x, z and heading of the reference at a time."""
    asked, tick = reference(trial), round(60 * seconds)
    return (*asked.positions[tick].tolist(), float(asked.headings[tick]))


def test_four_corners_of_ninety_degrees_make_a_square() -> None:
    assert at(SQUARE, 2.9)[2] == 0.0, "the first corner comes after the first side"
    assert at(SQUARE, 3.0) == pytest.approx((0.0, 6.0, np.pi / 2))
    assert at(SQUARE, 5.0) == pytest.approx((4.0, 6.0, np.pi))
    assert at(SQUARE, 7.0) == pytest.approx((4.0, 2.0, 1.5 * np.pi))
    assert at(SQUARE, 9.0) == pytest.approx((0.0, 2.0, 2.0 * np.pi), abs=1e-12)


@pytest.mark.parametrize(
    ("trial", "stored"),
    [
        (SQUARE, {"turn_rate_rad_s": 0, "speed_m_s": 2}),
        (Trial("switching", 2.0, 0.0, 1.0, 8.0, 2.5, 2.0), {"turn_rate_rad_s": 0, "speed_m_s": 2}),
    ],
)
def test_stored_trials_with_integers_ask_for_the_same(trial: Trial, stored: dict[str, Any]) -> None:
    found, wanted = reference(replace(trial, **stored)), reference(trial)
    np.testing.assert_array_equal(found.positions, wanted.positions)
    np.testing.assert_array_equal(found.speeds_m_s, wanted.speeds_m_s)
    np.testing.assert_array_equal(found.turn_rates_rad_s, wanted.turn_rates_rad_s)


def test_a_character_that_stops_neither_moves_nor_turns() -> None:
    asked = reference(STOPS)
    stop = slice(3 * 60, 5 * 60)
    assert np.ptp(asked.positions[stop], axis=0).max() < 1e-12
    assert np.ptp(asked.headings[stop]) < 1e-12
    assert set(asked.speeds_m_s.tolist()) == {0.0, 1.5}
    assert asked.headings[-1] == pytest.approx(0.5 * (5.0 - 1.0 / 60.0)), "with the look-ahead"


def test_a_figure_of_eight_returns_to_where_it_began_after_each_circle() -> None:
    start = at(EIGHT, 1.0)
    assert at(EIGHT, 5.0)[:2] == pytest.approx(start[:2], abs=1e-9)
    left, right = (np.array(at(EIGHT, seconds)[:2]) for seconds in (3.0, 7.0))
    assert left - start[:2] == pytest.approx(-(right - start[:2]), abs=1e-9)
    assert np.linalg.norm(left - start[:2]) == pytest.approx(2 * 2.0 / (np.pi / 2))


def test_a_strafing_character_faces_ahead_and_moves_to_its_side() -> None:
    assert at(SIDEWAYS, 3.0) == pytest.approx((-2.0, 1.0, 0.0))
    asked = reference(SIDEWAYS)
    assert asked.directions[-1] == pytest.approx(-np.pi / 2)


@pytest.mark.parametrize("trial", COURSES, ids=lambda trial: trial.family)
def test_a_character_that_does_what_is_asked_has_no_error_and_follows(trial: Trial) -> None:
    found = measured(trial)
    for name in ("offset_mean", "abs_se_v", "abs_se_omega_deg"):
        assert found.metrics[name] == pytest.approx(0.0, abs=2e-3), name
    assert judge_trial(found, VerdictLimits()).followed


def test_a_trial_that_ends_soon_after_a_switch_is_judged_without_the_new_speed() -> None:
    found = measured(replace(STOPS, duration_s=2.3))
    assert found.regimes["switched"]["settled_se_v"] is None
    assert judge_trial(found, VerdictLimits()).followed


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"families": ("corners",), "duration_s": 1.0}, "first corner comes after 5 s.*above 6 s"),
        ({"families": ("corners",), "duration_s": 2.5, "switch_every_s": 2.0}, "above 2.5 s"),
        ({"families": ("eights",), "duration_s": 5.0}, "a full circle at 90 degrees/s ends after 4 s.*above 5 s"),
    ],
)
def test_courses_that_end_before_the_time_after_their_first_change_is_judged_are_refused(
    options: dict[str, Any], why: str
) -> None:
    with pytest.raises(ValidationError, match=why):
        OPTIONS.replace(**options)
    long_enough = OPTIONS.replace(**{**options, "duration_s": options["duration_s"] + 5.1})
    for trial in suite_trials(long_enough):
        assert measured(trial).metrics["settled_heading_rms_deg"] is not None


def late(asked: Reference, ticks: int) -> TrialRecord:
    """Return the record of a character that does everything later, and stands at the origin until then."""
    moments = np.maximum(np.arange(asked.tick_count) - ticks, 0)
    record = record_of(asked)
    return replace(record, positions=asked.positions[moments], headings=asked.headings[moments])


def exceeded(trial: Trial, record: TrialRecord) -> set[str]:
    return {check.measure for check in judge_trial(measured(trial, record), VerdictLimits()).exceeded}


def test_who_does_not_stop_or_cuts_all_corners_or_turns_into_the_direction_of_travel_does_not_follow() -> None:
    ahead = record_of(reference(Trial("circle", 1.5, 0.5, 1.0, 8.0)))
    assert {"speed", "response"} <= exceeded(STOPS, ahead)
    straight = record_of(reference(Trial("circle", 2.0, 0.0, 1.0, 8.0)))
    assert {"place", "heading"} <= exceeded(SQUARE, straight)
    circle = record_of(reference(Trial("circle", 2.0, np.pi / 2, 1.0, 8.0)))
    assert {"heading", "turn"} & exceeded(EIGHT, circle)
    asked = reference(SIDEWAYS)
    turned = replace(record_of(asked), headings=asked.directions[: asked.tick_count])
    assert exceeded(SIDEWAYS, turned) >= {"heading"}


def test_half_a_second_to_turn_a_corner_or_to_stop_is_no_error_of_heading_or_speed() -> None:
    for trial in (SQUARE, STOPS):
        found = judge_trial(measured(trial, late(reference(trial), 30)), VerdictLimits())
        assert {check.measure for check in found.exceeded} <= {"place"}, trial.family
        assert (found.outcome.metrics["offset_mean"] or 0.0) > 0.3
    stopping = measured(STOPS, late(reference(STOPS), 30)).metrics
    assert stopping["response_median_s"] == pytest.approx(0.5, abs=0.02)
    assert (stopping["response_missed"], measured(SQUARE).metrics["response_missed"]) == (0.0, 0.0)


def test_sideways_distance_is_along_the_path_and_not_across() -> None:
    asked = reference(SIDEWAYS)
    record = record_of(asked)
    behind = replace(
        record, positions=record.positions + np.where(asked.speeds_m_s[: asked.tick_count, None] > 0, (0.3, 0.0), 0.0)
    )
    metrics = measured(SIDEWAYS, behind).metrics
    assert metrics["along_track_mean"] == pytest.approx(-0.3)
    assert metrics["cross_track_mean"] == pytest.approx(0.0, abs=1e-9)


def test_each_family_has_its_own_trials_names_and_regions() -> None:
    every = OPTIONS.replace(families=("circle", "switching", "stopping", "corners", "eights", "strafing"))
    names = [trial.name for trial in suite_trials(every)]
    assert names == [
        "circle v=2 w=0", "circle v=2 w=90", "switching v=2 w=0", "switching v=2 w=90", "stopping v=2 w=0",
        "stopping v=2 w=90", "corners v=2 a=-90", "corners v=2 a=90", "corners v=2 a=180", "eights v=2 w=90",
        "strafing v=2 a=-90", "strafing v=2 a=90", "strafing v=2 a=180",
    ]  # fmt: skip
    regions = {judge_trial(measured(trial), every.limits).region for trial in suite_trials(every)}
    assert regions == {
        "straight", "sharp turns", "speed changes", "stops", "corners", "figures of eight", "sideways", "backwards",
    }  # fmt: skip
    assert demand(SQUARE) == "path with corners of 90 degrees to the left at 2 m/s"
    assert demand(SIDEWAYS) == "straight line at 1 m/s, 90 degrees to the right of the facing direction"
    assert demand(replace(SQUARE, angle_rad=np.pi)) == "path with corners of 180 degrees at 2 m/s"
    assert demand(replace(SIDEWAYS, angle_rad=-np.pi)) == "straight line backwards at 1 m/s"
    assert demand(Trial("stopping", 1.5, 0.0)) == "straight line at 1.5 m/s with stops"
    assert demand(EIGHT) == "figure of eight at 90 deg/s and 2 m/s"


@pytest.mark.parametrize(
    ("family", "follow"), [("stopping", "path"), ("corners", "open_loop"), ("strafing", "open_loop")]
)
def test_a_course_that_a_follow_mode_cannot_express_is_refused(family: str, follow: str) -> None:
    with pytest.raises(
        ValidationError, match=f"{family} trials cannot be followed in the mode {follow}; choose time or"
    ):
        EvaluationOptions.model_validate({"families": [family], "controller": {"follow": follow}})


def test_the_scenarios_of_circles_keep_the_digest_that_they_had_before_there_were_angles() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 3.0)])
    circles, corners = (suite_trials(OPTIONS.replace(families=(family,))) for family in ("circle", "corners"))
    assert provenance_of(database, OPTIONS, circles).scenarios == (
        "sha256:2d456fb08989d213acc3fccd2b0c53658ace9df87d6e9c7c53b068e80fdc3c1c"
    )
    assert (
        len({provenance_of(database, OPTIONS, trials).scenarios for trials in (corners, corners[:1], corners[1:])}) == 3
    )
