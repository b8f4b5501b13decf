"""How good the clips of an evaluation are: a sentence for people and a few numbers for lists."""

from __future__ import annotations

from marey_motion.evaluation.relevance import sum_by_source
from marey_motion.evaluation.result import EvaluationResult

Headline = dict[str, float | int | None]


def headline_of(result: EvaluationResult) -> Headline:
    """The numbers that lists show; units at the ends of the names, shares from 0 to 1.

    Clips count once, whether their mirrored twins were added or not.
    """
    sources = sum_by_source(result.clips, result.usage)
    rows = sum(clip.frame_count for clip in result.clips)
    return {
        "clips": len(sources),
        "unused_clips": sum(source.ticks == 0 for source in sources),
        "data_s": rows / result.options.database.rate_hz,
        "trials": len(result.trials),
        "offset_mean_m": result.suite["offset_mean"],
        "baseline_offset_mean_m": None if result.baseline is None else result.baseline.suite["offset_mean"],
        "abs_se_v_m_s": result.suite["abs_se_v"],
        "abs_se_omega_deg_s": result.suite["abs_se_omega_deg"],
        "transitions_per_s": result.suite["transitions_per_s"],
        "pose_cost_mean_m": result.suite["pose_cost_mean"],
        "coverage_index": result.coverage.index,
        "symmetry": result.coverage.symmetry,
    }


def verdict_on(result: EvaluationResult, headline: Headline) -> str:
    """What was measured, beside what would be good, in two sentences."""
    offset, best = headline["offset_mean_m"], headline["baseline_offset_mean_m"]
    clips = headline["clips"]
    if offset is None:
        accuracy = f"{_clips(clips)} could not follow the {len(result.trials)} trials"
    else:
        accuracy = f"{_clips(clips)} follow {len(result.trials)} trials {offset:.2f} m off on average"
        if best:
            accuracy += f", {offset / best:.1f} times as far as clips made for every speed and turn ({best:.2f} m)"
    share = 100.0 * result.coverage.index
    unused = headline["unused_clips"]
    left_out = "every clip is used" if not unused else f"{unused} of them {'is' if unused == 1 else 'are'} never used"
    return f"{accuracy}. They cover {share:.0f} % of the speeds and turn rates asked for, and {left_out}."


def _clips(count: float | int | None) -> str:
    return "1 clip" if count == 1 else f"{count} clips"
