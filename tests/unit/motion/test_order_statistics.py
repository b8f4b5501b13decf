"""Median and low quantile equal those of numpy in every bit."""

from __future__ import annotations

import numpy as np
import pytest

from marey_motion.importing.order_statistics import low_quantile, median

COUNTS = [*range(1, 130), 1000, 4097]


def samples(count: int, dtype: type[np.floating]) -> list[np.ndarray]:
    """Return random values, rounded values that repeat and contain negative zeros, tiny values, and some with a NaN."""
    values = np.random.default_rng(count).normal(size=count)
    missing = values.copy()
    missing[count // 3] = np.nan
    return [one.astype(dtype) for one in (values, np.round(values, 1), np.full(count, -0.0), 1e-30 * values, missing)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_median_has_the_bits_of_numpy(dtype: type[np.floating]) -> None:
    for count in COUNTS:
        for values in samples(count, dtype):
            expected, found = np.median(values), median(values)
            assert (found.dtype, found.tobytes()) == (expected.dtype, expected.tobytes())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_median_of_columns_has_the_bits_of_numpy(dtype: type[np.floating]) -> None:
    for count in COUNTS:
        values = np.stack(samples(count, dtype), axis=1)
        expected, found = np.median(values, axis=0), median(values)
        assert (found.dtype, found.tobytes()) == (expected.dtype, expected.tobytes())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_low_quantile_has_the_bits_of_numpy(dtype: type[np.floating]) -> None:
    for count in COUNTS:
        for values in samples(count, dtype):
            expected, found = np.quantile(values, 0.05), low_quantile(values)
            assert (found.dtype, found.tobytes()) == (expected.dtype, expected.tobytes())
