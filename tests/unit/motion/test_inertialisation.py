"""Decay of offsets by inertialisation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp  # pyrefly: ignore[implicit-reexport]  # scipy collects its names when it runs

from marey_motion.arrays import Floats
from marey_motion.matching.inertialisation import decay_matrix


def test_after_one_half_life_of_the_rate_an_offset_at_rest_is_what_the_closed_form_says() -> None:
    offset, velocity = decay_matrix(0.1, 0.1) @ (1.0, 0.0)

    y = 2 * np.log(2) / 0.1
    np.testing.assert_allclose(offset, 0.25 * (1 + 2 * np.log(2)), rtol=1e-15)
    np.testing.assert_allclose(velocity, -0.25 * y**2 * 0.1, rtol=1e-15)


@pytest.mark.parametrize("start", [(1.0, 0.0), (0.0, 1.0), (-0.3, 4.0)])
def test_an_offset_is_a_critically_damped_spring(start: tuple[float, float]) -> None:
    y = 2 * np.log(2) / 0.1

    def spring(_time: float, state: Floats) -> tuple[float, float]:
        return state[1], -2 * y * state[1] - y * y * state[0]

    times = np.linspace(0, 0.5, 11)
    solution = solve_ivp(spring, (0, 0.5), start, t_eval=times, rtol=1e-11, atol=1e-12)

    closed = np.array([decay_matrix(0.1, time) @ start for time in times])
    np.testing.assert_allclose(closed.T, solution.y, atol=1e-8)


def test_many_short_ticks_decay_like_one_long_one() -> None:
    tick = decay_matrix(0.1, 1 / 60)

    np.testing.assert_allclose(np.linalg.matrix_power(tick, 30), decay_matrix(0.1, 0.5), atol=1e-15)


def test_nothing_has_decayed_at_once_and_everything_in_the_end() -> None:
    assert np.array_equal(decay_matrix(0.1, 0.0), np.eye(2))
    assert np.abs(decay_matrix(0.1, 5.0)).max() < 1e-20


def test_an_offset_at_rest_never_overshoots() -> None:
    offsets = [float((decay_matrix(0.1, time) @ (1.0, 0.0))[0]) for time in np.linspace(0, 2, 200)]

    assert np.all(np.diff(offsets) < 0)
    assert min(offsets) > 0
