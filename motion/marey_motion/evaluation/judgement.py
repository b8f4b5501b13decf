"""Verdict on a set of clips: which trials the character follows within the limits of `VerdictLimits`.

A trial counts as followed if the character keeps the desired place, speed and heading, and looks right: its feet stand
while they are in contact, it steps as often as the clips, and its poses follow each other smoothly. Each measure is
divided by its limit; the result is the *strain*. The share of followed trials gives the grade: from 75 % very good,
from 55 % good, from 30 % usable in part, below that poor. A share much above 75 % can hardly be reached. With clips
generated for every cell of the default grid, 76 % of the trials are followed (95 % of the circles, and 57 % of the
trials with changes of speed). In tight turns, motion matching does not respond to many of these changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from marey_motion.evaluation.result import EvaluationResult, Metrics, TrialResult
from marey_motion.evaluation.scenario import Trial
from marey_schemas.documents.worst_first import worst_first
from marey_schemas.options.verdict import VerdictLimits

GRADES = ((0.75, "very good"), (0.55, "good"), (0.3, "usable in part"), (0.0, "poor"))
TOLERANCE = 1e-12
GENTLE_DEG_S = 50.0
"""Greatest turn rate, in degrees per second, of a gentle turn."""

Measure = Literal[
    "place",
    "speed",
    "response",
    "speed wobble",
    "turn",
    "heading",
    "turn wobble",
    "skating",
    "sinking",
    "gliding",
    "pattering",
    "jerking",
    "jumping",
    "treading",
]
LOOKS: tuple[Measure, ...] = ("skating", "sinking", "gliding", "pattering", "jerking", "jumping", "treading")
"""The measures of how the motion looks; all other measures are about place, speed and heading."""
Region = Literal[
    "straight",
    "gentle turns",
    "sharp turns",
    "speed changes",
    "stops",
    "corners",
    "figures of eight",
    "backwards",
    "sideways",
    "real paths",
]
REGIONS: tuple[Region, ...] = get_args(Region)
_REGION_OF: dict[str, Region] = {
    "switching": "speed changes",
    "stopping": "stops",
    "corners": "corners",
    "eights": "figures of eight",
    "takes": "real paths",
}
BACKWARDS_DEG = 135.0
"""Least angle, in degrees, between heading and direction of travel of a backward motion."""


class LimitCheck(NamedTuple):
    """One measure of a trial and its limit; `metric` is the name of the metric that is compared with the limit.

    `value` is None if the measure is not defined, which counts as infinite strain; the sign of `value` is the sign of
    the error.
    """

    measure: Measure
    metric: str
    value: float | None
    limit: float
    strain: float

    @property
    def exceeded(self) -> bool:
        """True if the measure exceeds its limit."""
        return self.strain > 1.0 + TOLERANCE


@dataclass(frozen=True)
class TrialVerdict:
    """A trial with all its checks, those of the path first."""

    outcome: TrialResult
    checks: tuple[LimitCheck, ...]

    @property
    def worst(self) -> LimitCheck:
        """The check with the largest strain; the first one if several are equal."""
        return max(self.checks, key=lambda each: each.strain)

    @property
    def exceeded(self) -> tuple[LimitCheck, ...]:
        """The checks that exceed their limits, the largest strain first."""
        return tuple(sorted((each for each in self.checks if each.exceeded), key=lambda each: -each.strain))

    @property
    def followed(self) -> bool:
        """True if no limit is exceeded."""
        return not self.exceeded

    @property
    def on_path(self) -> bool:
        """True if no limit of place, speed or heading is exceeded; limits on the looks of the motion are ignored."""
        return all(each.measure in LOOKS for each in self.exceeded)

    @property
    def region(self) -> Region:
        """The group of trials to which the trial belongs, by its family, its turn rate and its angle."""
        trial = self.outcome.trial
        if (region := _REGION_OF.get(trial.family)) is not None:
            return region
        if trial.family == "strafing":
            return "backwards" if abs(float(np.degrees(trial.angle_rad))) >= BACKWARDS_DEG else "sideways"
        turn_deg_s = abs(float(np.degrees(trial.turn_rate_rad_s)))
        return (
            "straight" if turn_deg_s < 1.0 else "gentle turns" if turn_deg_s <= GENTLE_DEG_S + 1e-6 else "sharp turns"
        )


@dataclass(frozen=True)
class Judgement:
    """Grade of a set of clips, and the judged trials on which it is based.

    Parameters
    ----------
    grade : str    one of `GRADES`
    trials : tuple of TrialVerdict    in the order of the suite
    looks_measured : bool    False for results of old versions, which did not measure how the motion looks; their trials
        are judged by place, speed and turn rate only
    """

    grade: str
    trials: tuple[TrialVerdict, ...]
    looks_measured: bool

    @property
    def followed(self) -> int:
        """Number of followed trials."""
        return sum(each.followed for each in self.trials)

    @property
    def on_path(self) -> int:
        """Number of trials in which no limit of place, speed or heading is exceeded; looks are ignored."""
        return sum(each.on_path for each in self.trials)

    @property
    def ranked(self) -> tuple[TrialVerdict, ...]:
        """The trials from the worst to the best."""
        return tuple(rank_trials(self.trials))


def rank_trials(trials: Iterable[TrialVerdict]) -> list[TrialVerdict]:
    """Sort judged trials from the worst to the best: by their largest strain, then by name.

    Parameters
    ----------
    trials : iterable of TrialVerdict    the trials, in any order

    Returns
    -------
    list of TrialVerdict    the same trials, in the order of `marey_schemas.documents.worst_first`
    """
    return worst_first(trials, lambda each: each.worst.strain, lambda each: each.outcome.trial.name)


def judge(result: EvaluationResult) -> Judgement:
    """Grade an evaluation by the share of trials that the character followed.

    Parameters
    ----------
    result : EvaluationResult    the evaluation

    Returns
    -------
    Judgement    grade and judged trials
    """
    trials = tuple(judge_trial(each, result.options.limits) for each in result.trials)
    share = sum(each.followed for each in trials) / len(trials) if trials else 0.0
    grade = next(name for least, name in GRADES if share >= least - TOLERANCE)
    return Judgement(grade, trials, all("foot_skate" in each.metrics for each in result.trials))


def judge_trial(outcome: TrialResult, limits: VerdictLimits) -> TrialVerdict:
    """Compare the measures of a trial with their limits.

    Parameters
    ----------
    outcome : TrialResult    the trial
    limits : VerdictLimits    the limits

    Returns
    -------
    TrialVerdict    the checks. Place and turn rate are always checked; a measure that is not defined for this trial is
        left out
    """
    path = (
        _check("place", outcome.metrics, "offset_mean", limits.lag_s * mean_speed_m_s(outcome.trial)),
        *_speed_checks(outcome, limits),
        *_turn_checks(outcome.metrics, limits, "settled_" if "settled_heading_rms_deg" in outcome.metrics else ""),
    )
    return TrialVerdict(outcome, (*path, *_looks_checks(outcome.metrics, limits)))


def _speed_checks(outcome: TrialResult, limits: VerdictLimits) -> Iterator[LimitCheck]:
    """Check the speed in each regime, apart from the time around speed switches, and the response to the switches."""
    trial, metrics = outcome.trial, outcome.metrics
    regimes = [(mean_speed_m_s(trial), metrics)]
    if "settled_se_v" in metrics and trial.changes_speed and "switched" in outcome.regimes:
        base, switched = outcome.regimes["base"], outcome.regimes["switched"]
        regimes = [(trial.speed_m_s, base), (trial.switch_speed_m_s, switched)]
    fastest = max(wanted for wanted, _ in regimes)
    for wanted, own in regimes:
        if own.get("settled_se_v", 0.0) is None:
            continue  # the trial ends so soon after the switch that no step at this speed is settled
        # The limit at a stop is the share of the speed before the stop.
        limit = limits.speed_share * (wanted or fastest)
        yield _check("speed", own, "settled_se_v" if "settled_se_v" in own else "se_v", limit)
        if "settled_dse_v" in own:
            yield _check("speed wobble", own, "settled_dse_v", limits.speed_wobble_share * fastest)
    yield from _response_checks(metrics, limits)


def _response_checks(metrics: Metrics, limits: VerdictLimits) -> Iterator[LimitCheck]:
    """Check the median response time to speed switches; it is not defined if most switches have no response."""
    if metrics.get("response_median_s") is not None or ("response_median_s" in metrics and metrics["response_missed"]):
        yield _check("response", metrics, "response_median_s", limits.response_s)


def _turn_checks(metrics: Metrics, limits: VerdictLimits, prefix: str = "") -> Iterator[LimitCheck]:
    """Check turn rate and heading; with the prefix `settled_`, apart from the time around changes of the direction."""
    yield _check("turn", metrics, "se_omega_deg", limits.turn_deg_s)
    if "heading_rms_deg" in metrics:
        yield _check("heading", metrics, f"{prefix}heading_rms_deg", limits.heading_deg)
        yield _check("turn wobble", metrics, f"{prefix}dse_omega_deg", limits.turn_wobble_deg_s)


def _looks_checks(metrics: Metrics, limits: VerdictLimits) -> Iterator[LimitCheck]:
    if metrics.get("foot_skate") is not None:
        of_clips = metrics.get("foot_skate_clips") or 0.0
        yield _check("skating", metrics, "foot_skate", max(limits.skate_m_s, limits.skate_ratio * of_clips))
    if metrics.get("foot_depth_p95") is not None:
        yield _check("sinking", metrics, "foot_depth_p95", limits.sinking_m)
    if (contacts := metrics.get("contacts_per_m")) is not None:
        of_clips = metrics.get("contacts_per_m_clips") or 0.0
        least = max(limits.steps_per_m, of_clips / limits.step_ratio)
        yield LimitCheck("gliding", "contacts_per_m", contacts, least, least / contacts if contacts else np.inf)
        if of_clips:
            yield _check("pattering", metrics, "contacts_per_m", max(least, of_clips * limits.step_ratio))
    if (change := metrics.get("pose_cost_clips")) is not None:
        for metric, ratio in (
            ("pose_cost_mean", limits.pose_cost_ratio),
            ("pose_cost_p95", limits.pose_cost_p95_ratio),
        ):
            yield _check("jerking", metrics, metric, ratio * change)
        yield _check("jumping", metrics, "transitions_per_s", limits.transitions_per_s)
        yield _check("treading", metrics, "treading_per_s", limits.treading_per_s)


def exceeded_in_suite(result: EvaluationResult) -> frozenset[str]:
    """Find the metrics whose values for the whole suite exceed the limits for single trials.

    Limits that depend on the desired speed of a trial are not checked.

    Parameters
    ----------
    result : EvaluationResult    the evaluation

    Returns
    -------
    frozenset of str    names of metrics
    """
    suite, limits = result.suite, result.options.limits
    checks = (
        *_turn_checks(suite, limits),
        _check("turn", suite, "abs_se_omega_deg", limits.turn_deg_s),  # errors to the left and to the right cancel out
        *_response_checks(suite, limits),
        *_looks_checks(suite, limits),
    )
    return frozenset(each.metric for each in checks if each.exceeded and each.value is not None)


def _check(measure: Measure, metrics: Metrics, metric: str, limit: float) -> LimitCheck:
    value = metrics.get(metric)
    strain = np.inf if value is None else abs(value) / max(limit, TOLERANCE)
    return LimitCheck(measure, metric, value, limit, strain)


def mean_speed_m_s(trial: Trial) -> float:
    """Compute the mean desired speed of a trial after its approach.

    If the desired speed alternates, the first period after the approach has the base speed.

    Parameters
    ----------
    trial : Trial    the trial

    Returns
    -------
    float    metres per second
    """
    if not trial.changes_speed or trial.duration_s <= 0.0:
        return trial.speed_m_s
    pieces = int(trial.duration_s // trial.switch_every_s)
    rest_s = trial.duration_s - pieces * trial.switch_every_s
    switched_s = (pieces // 2) * trial.switch_every_s + (rest_s if pieces % 2 else 0.0)
    share = switched_s / trial.duration_s
    return (1.0 - share) * trial.speed_m_s + share * trial.switch_speed_m_s
