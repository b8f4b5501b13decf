"""Splines over canonical time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from marey_motion.errors import MotionError
from marey_motion.modelling.splines import SplineBasis, coefficient_count
from marey_motion.modelling.time_model import equalising_weight, fit_log_slopes

SMALL = st.floats(-2.0, 2.0)


@given(st.tuples(SMALL, SMALL, SMALL, SMALL), st.integers(10, 80))
def test_any_cubic_is_fitted_exactly(coefficients: tuple[float, float, float, float], frames: int) -> None:
    basis = SplineBasis.clamped(frames, coefficient_count(frames))
    values = np.polyval(coefficients, np.linspace(-1.0, 1.0, frames)).astype(np.float64)[:, None]
    np.testing.assert_allclose(basis.at_frames @ basis.fit(values), values, atol=1e-9)


def test_a_spline_begins_and_ends_at_its_outer_coefficients() -> None:
    basis = SplineBasis.clamped(30, 9)
    ends = basis.at_frames[[0, -1]]
    np.testing.assert_allclose(ends, np.eye(9)[[0, -1]], atol=1e-14)
    np.testing.assert_allclose(basis.at_frames.sum(axis=1), 1.0, atol=1e-14)


def test_products_of_basis_functions_are_integrals() -> None:
    basis = SplineBasis.clamped(12, 7)
    for one, other in ((0, 0), (2, 3), (3, 6), (6, 6)):
        expected, _ = quad(
            lambda t, i=one, j=other: basis.matrix([t])[0, i] * basis.matrix([t])[0, j],
            0.0, 11.0, limit=200, points=list(np.unique(basis.knots)[1:-1]),
        )  # fmt: skip
        assert basis.products[one, other] == pytest.approx(expected, abs=1e-10)


def test_a_fifth_of_the_frames_are_coefficients_but_at_least_seven() -> None:
    assert [coefficient_count(frames) for frames in (5, 20, 60, 200)] == [5, 7, 12, 40]


def test_what_is_no_basis_is_refused() -> None:
    for frames, count in ((30, 3), (1, 7)):
        with pytest.raises(MotionError):
            SplineBasis.clamped(frames, count)
    with pytest.raises(MotionError, match="from 0 to 29"):
        SplineBasis.clamped(30, 9).matrix([29.5])
    with pytest.raises(MotionError, match="12 samples"):
        SplineBasis.clamped(30, 9).fit(np.zeros((12, 1)))


# -- time --------------------------------------------------------------------------------------------------------------


@given(st.floats(0.05, 5.0), st.integers(6, 40))
def test_a_motion_of_constant_speed_has_a_constant_function(slope: float, steps: int) -> None:
    basis = SplineBasis.clamped(steps, min(8, steps))
    coefficients = fit_log_slopes(basis, slope * np.arange(steps + 1.0)[None])
    np.testing.assert_allclose(coefficients, np.log(slope), atol=1e-9)


@given(st.lists(st.floats(0.05, 4.0), min_size=12, max_size=50))
def test_a_time_function_lasts_as_long_after_it_was_fitted(slopes: list[float]) -> None:
    times = np.concatenate(([0.0], np.cumsum(slopes)))
    basis = SplineBasis.clamped(len(slopes), 8)
    made = np.exp(basis.at_frames @ fit_log_slopes(basis, times[None])[0]).sum()
    assert made == pytest.approx(times[-1], rel=1e-12)


@pytest.mark.parametrize("wrong", [7.0, 6.0, np.inf, np.nan])
def test_a_time_function_that_stands_still_goes_back_or_is_not_finite_is_refused(wrong: float) -> None:
    times = np.arange(20.0)
    times[8] = wrong
    with pytest.raises(MotionError, match="example 1"):
        fit_log_slopes(SplineBasis.clamped(19, 8), np.stack([np.arange(20.0), times]))


def test_time_weighs_as_much_as_space_unless_one_of_them_does_not_vary() -> None:
    weight = equalising_weight(np.array([3.0, 1.0]), np.array([0.04]))
    assert weight**2 * 0.04 == pytest.approx(4.0)
    assert equalising_weight(np.empty(0), np.array([0.04])) == 1.0
    assert equalising_weight(np.array([3.0]), np.empty(0)) == 1.0
