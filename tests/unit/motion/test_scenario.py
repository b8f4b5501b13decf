"""Trials of an evaluation: the requested paths, in closed form."""

from typing import Any

import numpy as np
import pytest

from marey_motion.errors import MotionError
from marey_motion.evaluation.scenario import Trial, reference, suite_trials
from marey_schemas.options.evaluation import EvaluationOptions

RATE_HZ = 60.0


def circle(speed: float, turn_rate_deg: float, **options: Any) -> Trial:
    return Trial("circle", speed, float(np.radians(turn_rate_deg)), **options)


def test_the_default_suite_is_that_of_the_paper_in_a_stable_order() -> None:
    trials = suite_trials(EvaluationOptions())

    assert len(trials) == 162
    assert [trial.name for trial in trials[:3]] == ["circle v=1 w=-100", "circle v=1 w=-75", "circle v=1 w=-50"]
    assert trials[81].name == "switching v=1 w=-100"
    assert trials[-1].name == "switching v=3 w=100"
    assert len({trial.name for trial in trials}) == 162


def test_the_options_of_a_suite_reach_its_trials() -> None:
    options = EvaluationOptions(
        speeds_m_s=(1.5,),
        turn_rates_deg_s=(0.0, 30.0),
        families=("switching",),
        approach_s=2.0,
        duration_s=10.0,
        switch_speed_m_s=3.5,
        switch_every_s=2.5,
    )

    assert suite_trials(options) == tuple(
        Trial("switching", 1.5, turn_rate, 2.0, 10.0, 3.5, 2.5) for turn_rate in (0.0, float(np.radians(30)))
    )


@pytest.mark.parametrize(("speed", "turn_rate_deg"), [(2.0, 50.0), (1.0, -100.0), (3.0, 25.0)])
def test_a_circle_is_entered_along_its_tangent(speed: float, turn_rate_deg: float) -> None:
    path = reference(circle(speed, turn_rate_deg))

    time = np.arange(1980 + 60) / RATE_HZ
    omega = np.radians(turn_rate_deg)
    tau = np.maximum(time - 3.0, 0.0)
    x = speed / omega * (1.0 - np.cos(omega * tau))
    z = speed * np.minimum(time, 3.0) + speed / omega * np.sin(omega * tau)
    assert path.tick_count == 1980
    np.testing.assert_allclose(path.positions, np.stack((x, z), axis=1), atol=2e-14)
    np.testing.assert_allclose(path.headings, omega * tau, atol=1e-14)
    assert np.all(path.speeds_m_s == speed)
    assert np.all(path.turn_rates_rad_s == np.where(time >= 3.0, omega, 0.0))


def test_a_left_turn_goes_to_the_left_and_a_right_turn_is_its_mirror_image() -> None:
    left, right = reference(circle(2.0, 50.0)), reference(circle(2.0, -50.0))

    assert left.positions[200, 0] > 0.0
    assert np.array_equal(left.positions * (-1.0, 1.0), right.positions)
    assert np.array_equal(left.headings, -right.headings)


def test_a_turn_rate_of_zero_is_the_limit_of_small_ones() -> None:
    straight = reference(circle(3.0, 0.0))

    assert np.all(straight.positions[:, 0] == 0.0)
    np.testing.assert_allclose(straight.positions[:, 1], 3.0 * np.arange(2040) / RATE_HZ, rtol=1e-15)
    for turn_rate_deg in (1e-5, 1e-9, 1e-15):
        nearly = reference(circle(3.0, turn_rate_deg))
        deviation = np.linalg.norm(nearly.positions - straight.positions, axis=1).max()
        assert deviation < 1e-3 * turn_rate_deg / 1e-5, turn_rate_deg


def test_switching_keeps_the_turn_rate_and_chains_tangent_arcs() -> None:
    trial = Trial("switching", 1.5, float(np.radians(50)))
    path = reference(trial)

    time = np.arange(len(path.headings)) / RATE_HZ
    circle_number = np.floor((time - 3.0) / 5.0 + 1e-9)
    fast = (time >= 3.0) & (circle_number % 2 == 1)
    assert np.array_equal(path.speeds_m_s, np.where(fast, 4.0, 1.5))
    np.testing.assert_allclose(path.headings, np.radians(50) * np.maximum(time - 3.0, 0.0), atol=1e-13)
    steps = np.diff(path.positions, axis=0)
    chords = np.linalg.norm(steps, axis=1) * RATE_HZ
    turn = np.radians(50) / RATE_HZ
    expected = path.speeds_m_s[:-1] * np.where(time[:-1] >= 3.0, np.sin(turn / 2) / (turn / 2), 1.0)
    np.testing.assert_allclose(chords, expected, rtol=1e-12)
    directions = np.unwrap(np.arctan2(steps[:, 0], steps[:, 1]))
    np.testing.assert_allclose(directions, 0.5 * (path.headings[1:] + path.headings[:-1]), atol=1e-12)


def test_the_speed_goes_on_switching_in_the_second_looked_ahead() -> None:
    trial = Trial("switching", 1.0, 0.0, approach_s=1.0, duration_s=4.0, switch_every_s=4.0)

    path = reference(trial)

    assert path.tick_count == 300
    assert np.all(path.speeds_m_s[:300] == 1.0)
    assert np.all(path.speeds_m_s[300:] == 4.0)


def test_a_switch_on_a_tick_counts_from_that_tick_on_however_its_time_is_rounded() -> None:
    trial = Trial("switching", 1.0, 0.0, approach_s=0.1, duration_s=4.9, switch_every_s=0.1)

    path = reference(trial)

    after_entry = np.maximum(np.arange(len(path.headings)) // 6 - 1, 0)
    assert np.array_equal(path.speeds_m_s, np.where(after_entry % 2 == 1, 4.0, 1.0))


def test_switches_between_ticks_lose_no_distance() -> None:
    trial = Trial("switching", 1.0, 0.0, approach_s=1.003, duration_s=10.0, switch_every_s=1.007)

    end = reference(trial).positions[-1, 1]

    time = (len(reference(trial).headings) - 1) / RATE_HZ
    pieces = np.clip((time - 1.003 - 1.007 * np.arange(20)) / 1.007, 0.0, 1.0) * 1.007
    np.testing.assert_allclose(end, 1.003 + pieces[0::2].sum() + 4.0 * pieces[1::2].sum(), rtol=1e-13)


def test_a_trial_may_begin_on_its_circle() -> None:
    path = reference(circle(2.0, 90.0, approach_s=0.0, duration_s=4.0))

    assert path.turn_rates_rad_s[0] == np.pi / 2
    np.testing.assert_allclose(path.positions[0], (0.0, 0.0), atol=0)
    np.testing.assert_allclose(path.positions[120], (2 * 2.0 / (np.pi / 2), 0.0), atol=1e-13)


@pytest.mark.parametrize(
    ("trial", "reason"),
    [
        (circle(1.0, 0.0, approach_s=0.0, duration_s=0.0), "circle v=1 w=0.* it has no ticks at 60 Hz"),
        (circle(1.0, 0.0, approach_s=-1.0), "circle v=1 w=0.* takes -1 s .* neither may be negative"),
        (Trial("switching", 1.0, 0.0, switch_every_s=0.0), "switching v=1 w=0.* must be above 0 s"),
    ],
)
def test_a_trial_that_cannot_be_run_is_named_with_the_reason(trial: Trial, reason: str) -> None:
    with pytest.raises(MotionError, match=reason):
        reference(trial)
