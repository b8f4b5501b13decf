"""Savitzky-Golay filters are those of scipy, without its costly import."""

import numpy as np
import pytest
from scipy.signal import savgol_coeffs, savgol_filter

from marey_motion.savitzky_golay import filter_weights, filtered


@pytest.mark.parametrize("frames", [0, 1, 70])
@pytest.mark.parametrize(("window", "order"), [(3, 1), (5, 3), (31, 3), (61, 1), (61, 4)])
def test_filtered_values_are_those_of_scipy_to_the_last_bit(window: int, order: int, frames: int) -> None:
    columns = np.random.default_rng(window).normal(size=(window + frames, 2)).cumsum(axis=0)
    for values in (columns, columns[:, 0]):
        assert np.array_equal(filtered(values, window, order), savgol_filter(values, window, order, axis=0))


@pytest.mark.parametrize(("window", "order"), [(1, 0), (3, 0), (5, 4), (31, 2), (101, 3)])
def test_weights_are_those_of_scipy_to_the_last_bit(window: int, order: int) -> None:
    assert np.array_equal(filter_weights(window, order), savgol_coeffs(window, order))


def test_a_polynomial_of_the_order_stays_as_it_is() -> None:
    time = np.linspace(-1.0, 1.0, 40)
    values = np.stack((time**3 - time, 2.0 - time**2), axis=1)
    assert filtered(values, 9, 3) == pytest.approx(values, abs=1e-12)
