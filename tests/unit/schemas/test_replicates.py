"""Means of replicates with Student's intervals, compared with scipy and with closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import t, ttest_1samp

from marey_schemas.documents.replicates import mean_interval, student_quantile


def test_the_quantile_is_that_of_student() -> None:
    assert student_quantile(1) == pytest.approx(math.tan(0.475 * math.pi), rel=1e-12)
    for degrees in (*range(1, 30), 99, 100, 999):
        assert student_quantile(degrees) == pytest.approx(t.ppf(0.975, degrees), rel=1e-10)


def test_the_interval_is_that_of_the_t_test_at_any_scale() -> None:
    rng = np.random.default_rng(4)
    for count in (3, 4, 10):
        for scale in (1e-300, 1.0, 1e150):
            values = scale * rng.normal(2.0, 1.0, count)
            found = mean_interval(values.tolist())
            known = ttest_1samp(values / scale, 0.0).confidence_interval(0.95)
            assert found.n == count
            assert found.mean == pytest.approx(values.mean(), rel=1e-12)
            assert np.array([found.low, found.high]) / scale == pytest.approx([known.low, known.high], rel=1e-9)


def test_few_equal_and_huge_values_have_no_interval_that_is_not_finite() -> None:
    assert mean_interval([3.0]) == (1, 3.0, None, None)
    assert mean_interval([1.0, 2.0]) == (2, 1.5, None, None)
    assert mean_interval([0.0] * 3) == (3, 0.0, 0.0, 0.0)
    assert mean_interval([0.1] * 5).mean == pytest.approx(0.1)
    huge = mean_interval([1.7e308, -1.7e308, 1.7e308])
    assert huge.mean == pytest.approx(1.7e308 / 3)
    assert (huge.low, huge.high) == (None, None)
