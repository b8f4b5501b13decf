"""One sentence that says how good a dataset is, by rules that anybody can check.

A trial counts as followed when the character, on average over it,

* is no farther from the wished place than it goes in half a second at the wished speed,
* is no more than 15 % faster or slower than wished, and
* turns no more than 10 degrees a second faster or slower than wished.

The share of followed trials gives the grade: from 90 % very good, from 70 % good, from 40 % usable in part, below that
poor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion.evaluation.report.words import amount, demand
from marey_motion.evaluation.result import EvaluationResult, TrialResult
from marey_motion.evaluation.scenario import Trial

LONGEST_LAG_S = 0.5
LARGEST_SPEED_SHARE = 0.15
LARGEST_TURN_DEG_S = 10.0
GRADES = ((0.9, "very good"), (0.7, "good"), (0.4, "usable in part"), (0.0, "poor"))


@dataclass(frozen=True)
class Judgement:
    """What the verdict rests on.

    Parameters
    ----------
    grade : one of `GRADES`
    followed, trials : how many trials were followed, of how many
    worst : the trial with the largest mean offset in seconds of travel; None without trials
    """

    grade: str
    followed: int
    trials: int
    worst: TrialResult | None

    @property
    def share(self) -> float:
        """Of the trials that were followed."""
        return self.followed / self.trials if self.trials else 0.0


def judge(result: EvaluationResult) -> Judgement:
    """Apply the rules to every trial."""
    followed = sum(is_followed(each) for each in result.trials)
    share = followed / len(result.trials) if result.trials else 0.0
    grade = next(name for least, name in GRADES if share >= least - 1e-12)
    worst = max(result.trials, key=lag_s, default=None)
    return Judgement(grade, followed, len(result.trials), worst)


def verdict(result: EvaluationResult) -> str:
    """How good the dataset is, in one sentence."""
    judgement = judge(result)
    if judgement.worst is None:
        return "Not judged: the evaluation has no trials."
    coverage = result.coverage
    cells, enough = coverage.deficit_s.size, int(np.count_nonzero(coverage.deficit_s <= 0.0))
    unused = sum(1 for usage in result.usage if usage.ticks == 0)
    parts = [f"the character follows {judgement.followed} of {amount(judgement.trials, 'trajectory')}"]
    if judgement.followed < judgement.trials:
        offset = judgement.worst.metrics.get("offset_mean")
        away = f" ({offset:.1f} m off on average)" if offset is not None else ""
        parts[0] += f", worst at {demand(judgement.worst.trial)}{away}"
    parts.append(f"{enough} of {amount(cells, 'cell')} of speed and turn rate hold enough data")
    if unused:
        parts.append(f"{unused} of {amount(len(result.usage), 'clip')} {'is' if unused == 1 else 'are'} never used")
    return f"{judgement.grade.capitalize()}: {'; '.join(parts)}."


def is_followed(outcome: TrialResult) -> bool:
    """Whether a trial meets the three rules; what is not defined does not."""
    speed = mean_speed_m_s(outcome.trial)
    offset, speed_error, turn_error = (outcome.metrics.get(name) for name in ("offset_mean", "se_v", "se_omega_deg"))
    if offset is None or speed_error is None or turn_error is None:
        return False
    return (
        offset <= LONGEST_LAG_S * speed
        and abs(speed_error) <= LARGEST_SPEED_SHARE * speed
        and abs(turn_error) <= LARGEST_TURN_DEG_S
    )


def lag_s(outcome: TrialResult) -> float:
    """The mean offset in seconds of travel at the wished speed; endless where it is not defined."""
    offset = outcome.metrics.get("offset_mean")
    return float("inf") if offset is None else offset / max(mean_speed_m_s(outcome.trial), 1e-9)


def mean_speed_m_s(trial: Trial) -> float:
    """The wished speed over the circle; a switching trial begins it with its own speed."""
    if trial.family == "circle" or trial.duration_s <= 0.0:
        return trial.speed_m_s
    pieces = int(trial.duration_s // trial.switch_every_s)
    rest_s = trial.duration_s - pieces * trial.switch_every_s
    switched_s = (pieces // 2) * trial.switch_every_s + (rest_s if pieces % 2 else 0.0)
    share = switched_s / trial.duration_s
    return (1.0 - share) * trial.speed_m_s + share * trial.switch_speed_m_s
