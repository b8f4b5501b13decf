"""Intervals that contain most results of a measurement of an effect if it is repeated with other seeds.

A run is one replicate of a trial. The confidence interval of the mean change over the replicates is not enough, for two
reasons. A repetition varies by chance as well, so the difference of two measurements has twice the variance of one
measurement. And a removed clip changes few runs, each of them by a jump, because motion matching then follows another
sequence of frames. So the changes of most runs are 0. If the measured runs contain fewer jumps than the repetition, the
standard deviation of the changes is too small.

Therefore, the variance is computed from the changes of the runs within each trial, because the runs of different trials
are independent. If some runs did not change, the variance is increased as if one more run had changed. The jump of this
additional run is as large as the observed jumps, but at least as large as the difference of two replicates of one
trial, because a run that continues in another sequence of frames is like another replicate.

If a change affects only a few runs, but these by much more than chance does, the measurement may contain none of the
affected runs. Therefore, `again_percent` is lower if few runs changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.evaluation.compare import MetricChange
from marey_schemas.documents.replicates import LEAST_REPLICATES, student_quantile

PERCENT, PERCENT_OF_FEW = 95, 75
"""Least percentage of repetitions whose change lies in the interval: in general, and if few runs changed.

In simulations with any size of jumps, the percentages were at least 97 and 76 % (docs/decisions/0094).
"""
FEW_RUNS = 8
"""Number of changed runs below which the lower percentage applies."""


@dataclass(frozen=True)
class RepeatedChange(MetricChange):
    """Change of one metric, with an interval that contains most repetitions of the measurement.

    Parameters
    ----------
    again_low, again_high : bounds between which the change lies in `again_percent` or more of 100 repetitions with
        another seed and as many replicates; None if there are too few replicates
    again_percent : `PERCENT`, or `PERCENT_OF_FEW` if fewer than `FEW_RUNS` runs changed and at least one run did not
        change; None without bounds
    """

    again_low: float | None = None
    again_high: float | None = None
    again_percent: int | None = None


def repeated(change: MetricChange, before: Floats, differences: Floats) -> RepeatedChange:
    """Add to a change the interval that contains most changes measured with other seeds.

    Parameters
    ----------
    change : MetricChange    the change, in the unit of its metric
    before : (T, R) float64    addend of each of T trials to the metric of the unchanged suite in each of R replicates
    differences : (T, R) float64    addend of each trial to the change in each replicate, in the same unit

    Returns
    -------
    RepeatedChange    with the interval; without it if there are fewer than `LEAST_REPLICATES` replicates

    Notes
    -----
    Let s_t² be the variance of the differences of trial t, u the share of the runs that did not change, and j² the
    larger of two squares: the mean square of the differences that are not 0, and twice the mean variance of `before`
    within a trial. A measurement has the variance v = (Σ s_t² + u j² / R) / R, in which u j² stands for one more run.
    The difference of two measurements has the variance 2 v. The interval is ± t √(2 v), where t is the 97.5th
    percentile of Student's distribution with R - 1 degrees of freedom.
    """
    low = high = percent = None
    if (count := differences.shape[1]) >= LEAST_REPLICATES:
        changed = differences[differences != 0.0]
        jump = max(
            float(np.mean(changed**2)) if len(changed) else 0.0, 2.0 * float(np.var(before, axis=1, ddof=1).mean())
        )
        unchanged = 1.0 - len(changed) / differences.size
        variance = (float(np.var(differences, axis=1, ddof=1).sum()) + unchanged * jump / count) / count
        half = student_quantile(count - 1) * float(np.sqrt(2.0 * variance))
        low, high = change.change - half, change.change + half
        percent = PERCENT_OF_FEW if len(changed) < min(FEW_RUNS, differences.size) else PERCENT
    return RepeatedChange(**vars(change), again_low=low, again_high=high, again_percent=percent)
