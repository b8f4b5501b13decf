"""One sentence that says how good a dataset is."""

from __future__ import annotations

import math

import numpy as np

from marey_motion.evaluation.judgement import judge, strain
from marey_motion.evaluation.relevance import sum_by_source
from marey_motion.evaluation.result import EvaluationResult, TrialResult
from marey_motion.evaluation.scenario import demand
from marey_reports.drawing.words import amount


def verdict(result: EvaluationResult) -> str:
    """How good the dataset is, what goes worst, how much is covered and how much unused, in one sentence."""
    judgement = judge(result)
    if judgement.worst is None:
        return "Not judged: the evaluation has no trials."
    parts = [f"the character follows {judgement.followed} of {amount(judgement.trials, 'trajectory')}"]
    if judgement.followed < judgement.trials:
        parts[0] += f", worst at a {demand(judgement.worst.trial)} ({_failing(judgement.worst)})"
    missing = result.coverage.deficit_s
    enough = int(np.count_nonzero(missing <= 0.0))
    parts.append(f"{enough} of {amount(missing.size, 'cell')} of speed and turn rate hold enough data")
    sources = sum_by_source(result.clips, result.usage)
    unused = sum(1 for source in sources if not source.ticks)
    if unused:
        parts.append(f"{unused} of {amount(len(sources), 'clip')} {'is' if unused == 1 else 'are'} never used")
    return f"{judgement.grade.capitalize()}: {'; '.join(parts)}."


def _failing(outcome: TrialResult) -> str:
    """Which limit a trial breaks most, and by what."""
    kind = max(zip(strain(outcome), ("offset_mean", "se_v", "se_omega_deg"), strict=True))
    value = outcome.metrics.get(kind[1])
    if value is None or math.isinf(kind[0]):
        return "not measured"
    if kind[1] == "offset_mean":
        return f"{value:.1f} m off on average"
    if kind[1] == "se_v":
        return f"{abs(value):.1f} m/s too {'fast' if value > 0.0 else 'slow'}"
    turn = outcome.trial.turn_rate_rad_s
    much = value * turn > 0.0 if turn else True
    return f"{abs(value):.0f} deg/s too {'much' if much else 'little'}"
