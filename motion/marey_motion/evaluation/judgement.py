"""Verdict on a set of clips by simple rules.

A trial counts as followed if the character keeps within three limits, on average over the trial:

* its distance from the desired position is at most the distance that it travels in half a second at the desired speed,
* its speed differs from the desired speed by at most 15 %,
* its turn rate differs from the desired turn rate by at most 10 degrees a second.

The share of followed trials gives the grade: from 90 % very good, from 70 % good, from 40 % usable in part, below that
poor. The best grade can be reached: with clips generated for every cell of the default grid, 95 % of the trials are
followed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from marey_motion.evaluation.result import EvaluationResult, TrialResult
from marey_motion.evaluation.scenario import Trial

LONGEST_LAG_S = 0.5
LARGEST_SPEED_SHARE = 0.15
LARGEST_TURN_DEG_S = 10.0
GRADES = ((0.9, "very good"), (0.7, "good"), (0.4, "usable in part"), (0.0, "poor"))
TOLERANCE = 1e-12


class Strain(NamedTuple):
    """Errors of a trial in position, speed and turn rate, each divided by its limit; infinite for undefined errors."""

    place: float
    speed: float
    turn: float

    @property
    def worst(self) -> float:
        """The largest ratio."""
        return max(self)


@dataclass(frozen=True)
class Judgement:
    """Grade of a set of clips, and the numbers on which the grade is based.

    Parameters
    ----------
    grade : str    one of `GRADES`
    followed, trials : int    number of followed trials, and of all trials
    worst : TrialResult, optional    the trial with the largest ratio of an error to its limit; None if there are no
        trials
    """

    grade: str
    followed: int
    trials: int
    worst: TrialResult | None


def judge(result: EvaluationResult) -> Judgement:
    """Grade an evaluation by the share of trials that the character followed.

    Parameters
    ----------
    result : EvaluationResult    the evaluation

    Returns
    -------
    Judgement    grade and numbers
    """
    followed = sum(is_followed(each) for each in result.trials)
    share = followed / len(result.trials) if result.trials else 0.0
    grade = next(name for least, name in GRADES if share >= least - TOLERANCE)
    worst = max(result.trials, key=lambda each: strain(each).worst, default=None)
    return Judgement(grade, followed, len(result.trials), worst)


def is_followed(outcome: TrialResult) -> bool:
    """Check whether a trial exceeds none of the limits of position, speed and turn rate.

    Parameters
    ----------
    outcome : TrialResult    the trial

    Returns
    -------
    bool    True if no limit is exceeded
    """
    return strain(outcome).worst <= 1.0 + TOLERANCE


def strain(outcome: TrialResult) -> Strain:
    """Compute the ratio of each of a trial's errors to its limit.

    Parameters
    ----------
    outcome : TrialResult    the trial

    Returns
    -------
    Strain    ratios; a value above 1 exceeds its limit
    """
    speed = max(mean_speed_m_s(outcome.trial), TOLERANCE)
    place, bias, turn = (outcome.metrics.get(name) for name in ("offset_mean", "se_v", "se_omega_deg"))
    return Strain(
        float("inf") if place is None else place / (LONGEST_LAG_S * speed),
        float("inf") if bias is None else abs(bias) / (LARGEST_SPEED_SHARE * speed),
        float("inf") if turn is None else abs(turn) / LARGEST_TURN_DEG_S,
    )


def mean_speed_m_s(trial: Trial) -> float:
    """Compute the mean desired speed while a trial follows its circular path.

    If the desired speed alternates, the path begins at the base speed.

    Parameters
    ----------
    trial : Trial    the trial

    Returns
    -------
    float    metres per second
    """
    if trial.family == "circle" or trial.duration_s <= 0.0:
        return trial.speed_m_s
    pieces = int(trial.duration_s // trial.switch_every_s)
    rest_s = trial.duration_s - pieces * trial.switch_every_s
    switched_s = (pieces // 2) * trial.switch_every_s + (rest_s if pieces % 2 else 0.0)
    share = switched_s / trial.duration_s
    return (1.0 - share) * trial.speed_m_s + share * trial.switch_speed_m_s
