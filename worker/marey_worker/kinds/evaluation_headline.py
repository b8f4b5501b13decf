"""The few numbers of an evaluation that lists show."""

from __future__ import annotations

from marey_motion.evaluation.judgement import judge
from marey_motion.evaluation.relevance import recorded_rows, sum_by_source
from marey_motion.evaluation.result import EvaluationResult

Headline = dict[str, float | int | None]


def headline_of(result: EvaluationResult) -> Headline:
    """The numbers that lists show; units at the ends of the names, shares from 0 to 1.

    Clips count once, whether their mirrored twins were added or not.
    """
    sources = sum_by_source(result.clips, result.usage)
    rows = recorded_rows(result.clips, result.usage)
    return {
        "clips": len(sources),
        "unused_clips": sum(source.ticks == 0 for source in sources),
        "data_s": rows / result.options.database.rate_hz,
        "trials": len(result.trials),
        "followed_trials": judge(result).followed,
        "offset_mean_m": result.suite["offset_mean"],
        "baseline_offset_mean_m": None if result.baseline is None else result.baseline.suite["offset_mean"],
        "abs_se_v_m_s": result.suite["abs_se_v"],
        "abs_se_omega_deg_s": result.suite["abs_se_omega_deg"],
        "transitions_per_s": result.suite["transitions_per_s"],
        "pose_cost_mean_m": result.suite["pose_cost_mean"],
        "coverage_index": result.coverage.index,
        "symmetry": result.coverage.symmetry,
    }
