"""Verdicts in plain words: a sentence about all trials, sentences about regions, and phrases for errors of trials."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

from marey_motion.evaluation.judgement import REGIONS, Judgement, LimitCheck, Measure, TrialVerdict, judge
from marey_motion.evaluation.relevance import sum_by_source
from marey_motion.evaluation.result import Coverage, EvaluationResult, ReplicateValues
from marey_motion.evaluation.scenario import demand
from marey_reports.drawing.words import duration
from marey_schemas.documents.evaluations import RegionVerdict
from marey_schemas.wording import counted

MOST_PROBLEMS = 3
SIDEWAYS_M_S = 0.3
"""Least speed, in metres per second, at which a window of a clip counts as sideways or backward motion."""


class _Wording(NamedTuple):
    """Wording of an exceeded limit: a clause with a gap for the value, and the value's decimals, unit and factor."""

    words: str
    digits: int
    unit: str
    scale: float = 1.0


_PROBLEMS: dict[Measure, _Wording] = {
    "place": _Wording("it is {} away from its place", 1, " m"),
    "speed": _Wording("its speed is wrong by {}", 1, " m/s"),
    "response": _Wording("it answers a new speed after {}", 1, " s"),
    "speed wobble": _Wording("its speed wavers by {}", 2, " m/s"),
    "turn": _Wording("its turn rate is wrong by {}", 0, " deg/s"),
    "heading": _Wording("its heading is {} off", 0, " degrees"),
    "turn wobble": _Wording("it sways by {}", 0, " deg/s"),
    "skating": _Wording("its feet slide at {} while they should stand", 2, " m/s"),
    "sinking": _Wording("its feet sink {} into the ground", 1, " cm", 100.0),
    "gliding": _Wording("it glides, with only {}", 2, " steps per metre"),
    "pattering": _Wording("it patters, with {}", 1, " steps per metre"),
    "jerking": _Wording("its poses jerk, by {} over all joints from frame to frame", 2, " m"),
    "jumping": _Wording("it jumps between frames {}", 1, " times a second"),
    "treading": _Wording("it treads on the spot {}", 1, " times a second"),
}


def verdict(result: EvaluationResult) -> str:
    """Summarise the result in one sentence: followed trials, worst errors, visible flaws, coverage and unused data."""
    judgement = judge(result)
    if not judgement.trials:
        return "Not judged: the evaluation has no trials."
    parts = [f"the character follows {judgement.followed} of {counted(len(judgement.trials), 'trajectory')}"]
    if result.replicates is not None:
        parts[0] += f" ({_span(result.replicates)})"
    if judgement.followed < len(judgement.trials):
        worst = judgement.ranked[0]
        parts[0] += f", worst at a {demand(worst.outcome.trial)} ({failing(worst)})"
    if judgement.on_path > judgement.followed:
        parts.append(_looking_wrong(judgement))
    if not judgement.looks_measured:
        parts.append("how the motion looks was not measured")
    if result.replicates is not None and (offset := interval_text(result.replicates, "offset_mean", 2)):
        parts.append(f"it is {result.suite['offset_mean']:.2f} m from its path on average ({offset} m)")
    missing = result.coverage.deficit_s
    enough = int(np.count_nonzero(missing <= 0.0))
    parts.append(f"{enough} of {counted(missing.size, 'cell')} of speed and turn rate hold enough data")
    sources = sum_by_source(result.clips, result.usage)
    if unused := sum(1 for source in sources if not source.ticks):
        parts.append(f"{unused} of {counted(len(sources), 'clip')} {'is' if unused == 1 else 'are'} never used")
    return f"{judgement.grade.capitalize()}: {'; '.join(parts)}."


def _span(replicates: ReplicateValues) -> str:
    counts = np.count_nonzero(replicates.followed, axis=0)
    between = f"{counts.min()}" if counts.min() == counts.max() else f"{counts.min()} to {counts.max()}"
    return f"{between} in single replicates"


def interval_text(replicates: ReplicateValues, metric: str, digits: int) -> str:
    """Describe the 95 % interval of a metric of the suite over the replicates; empty if the metric has no interval."""
    found = replicates.interval(metric)
    if found is None or found.low is None or found.high is None:
        return ""
    return f"95 % interval {found.low:.{digits}f} to {found.high:.{digits}f}"


def _looking_wrong(judgement: Judgement) -> str:
    """Describe the problems of trials in which the character keeps to its path, but the motion does not look right."""
    wrong = [each for each in judgement.trials if each.on_path and not each.followed]
    return (
        f"{counted(len(wrong), 'other trajectory')} {'is' if len(wrong) == 1 else 'are'} kept to, but the motion looks "
        f"wrong: {_problems(wrong)}"
    )


def region_verdicts(result: EvaluationResult) -> tuple[RegionVerdict, ...]:
    """Judge each region of the trials, and report backward and sideways motion of the clips that no trial requires."""
    trials = judge(result).trials
    regions = []
    for region in REGIONS:
        own = [each for each in trials if each.region == region]
        if not own:
            continue
        followed = sum(each.followed for each in own)
        wrong = [each for each in own if not each.followed]
        more = f"; {_problems(wrong)}" if wrong else ""
        sentence = f"{region.capitalize()}: {followed} of {counted(len(own), 'trajectory')} followed{more}."
        regions.append(RegionVerdict(region=region, followed=followed, trials=len(own), sentence=sentence))
    asked = {one.region for one in regions}
    unasked = _not_asked_for(result.coverage, 1.0 / result.options.database.rate_hz)
    return (*regions, *(one for one in unasked if one.region not in asked))


def _not_asked_for(coverage: Coverage, window_s: float) -> list[RegionVerdict]:
    forward, strafe = coverage.forward_m_s, coverage.strafe_m_s
    sideways = (np.abs(strafe) >= SIDEWAYS_M_S) & (np.abs(strafe) > np.abs(forward))
    found = []
    for region, mask in (("backwards", (forward <= -SIDEWAYS_M_S) & ~sideways), ("sideways", sideways)):
        seconds = float(np.count_nonzero(mask)) * window_s
        if seconds >= 1.0:
            sentence = (
                f"{region.capitalize()}: not judged; the clips contain {duration(seconds)} of such motion, but no "
                "trial asks for it."
            )
            found.append(RegionVerdict(region=region, followed=0, trials=0, sentence=sentence))
    return found


def _problems(trials: Sequence[TrialVerdict]) -> str:
    """Describe the limits that are exceeded most often, each with the median of the values beyond the limit."""
    beyond: dict[Measure, list[LimitCheck]] = {}
    for trial in trials:
        worst: dict[Measure, LimitCheck] = {}
        for check in trial.exceeded:
            worst.setdefault(check.measure, check)
        for measure, check in worst.items():
            beyond.setdefault(measure, []).append(check)
    most = sorted(beyond.items(), key=lambda item: (-len(item[1]), item[0]))[:MOST_PROBLEMS]
    return ", ".join(f"in {len(checks)} {_typical(measure, checks)}" for measure, checks in most)


def _typical(measure: Measure, checks: Sequence[LimitCheck]) -> str:
    known = [abs(check.value) for check in checks if check.value is not None]
    if len(known) <= len(checks) // 2:
        return _undefined(measure)
    limit = _amount(measure, median(check.limit for check in checks))
    return f"{_PROBLEMS[measure].words.format(_amount(measure, median(known)))} (limit {limit})"


def _amount(measure: Measure, value: float) -> str:
    problem = _PROBLEMS[measure]
    return f"{problem.scale * value:.{problem.digits}f}{problem.unit}"


def _undefined(measure: Measure) -> str:
    return "most changes of the speed stay unanswered" if measure == "response" else "it was not measured"


def failing(trial: TrialVerdict) -> str:
    """Describe the error of a trial that is largest relative to its limit."""
    check, outcome = trial.worst, trial.outcome
    if check.value is None:
        return _undefined(check.measure).removeprefix("it was ")
    if check.measure == "place":
        return f"{check.value:.1f} m off on average"
    if check.measure == "speed":
        return f"{abs(check.value):.1f} m/s too {'fast' if check.value > 0.0 else 'slow'}"
    if check.measure == "turn":
        turn = outcome.trial.turn_rate_rad_s
        much = check.value * turn > 0.0 if turn else True
        return f"{abs(check.value):.0f} deg/s too {'much' if much else 'little'}"
    return _PROBLEMS[check.measure].words.format(_amount(check.measure, abs(check.value)))
