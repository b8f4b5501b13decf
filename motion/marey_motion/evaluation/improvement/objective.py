"""The objective of an optimisation: one number for a data set, to be minimised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.evaluation.result import TrialResult

HEADLINES = ("offset_mean", "abs_se_v", "abs_se_omega_deg", "pose_cost_mean", "transitions_per_s")
"""Metrics by which changes of a data set are told."""


@dataclass(frozen=True)
class DataSetObjective:
    """mean offset + a · speed error + a' · turn rate error + b · pose cost + c · seconds of data, in metres.

    Parameters
    ----------
    offset : weight of `offset_mean`
    abs_se_v : metres of offset that an error of 1 m/s counts as
    abs_se_omega_deg : metres of offset that an error of 1 degree/s counts as
    pose_cost : metres of offset that a metre of `pose_cost_mean` counts as
    seconds : metres of offset that a second of data counts as; what does not help by more than this goes
    """

    offset: float = 1.0
    abs_se_v: float = 0.5
    abs_se_omega_deg: float = 0.005
    pose_cost: float = 0.5
    seconds: float = 0.0001

    def __post_init__(self) -> None:
        for name, weight in vars(self).items():
            if not (np.isfinite(weight) and weight >= 0.0):
                raise MotionError("a weight is a finite number, 0 or more", where=name)

    def value(self, results: Sequence[TrialResult], seconds: float) -> float:
        """Compute the objective of trials.

        Parameters
        ----------
        results : sequence of TrialResult    the trials
        seconds : float    seconds of data

        Returns
        -------
        float    metres
        """
        means = headline_means(results)
        return (
            self.offset * means["offset_mean"]
            + self.abs_se_v * means["abs_se_v"]
            + self.abs_se_omega_deg * means["abs_se_omega_deg"]
            + self.pose_cost * means["pose_cost_mean"]
            + self.seconds * seconds
        )


def headline_means(results: Sequence[TrialResult]) -> dict[str, float]:
    """Compute the mean of each headline over the trials that define it; 0 where none does.

    Parameters
    ----------
    results : sequence of TrialResult    the trials

    Returns
    -------
    dict of str to float    by metric, in its unit
    """
    means = {}
    for name in HEADLINES:
        values = [value for result in results if (value := result.metrics.get(name)) is not None]
        means[name] = float(np.mean(values)) if values else 0.0
    return means


def headline_changes(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Subtract headlines: after minus before.

    Parameters
    ----------
    before, after : mapping of str to float    by metric

    Returns
    -------
    dict of str to float    by metric, in its unit
    """
    return {name: after[name] - before[name] for name in HEADLINES}
