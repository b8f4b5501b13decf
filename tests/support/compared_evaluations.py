"""Comparison of exactly two evaluations."""

from marey_motion.evaluation.compare import Comparison, compare_several
from marey_motion.evaluation.result import EvaluationResult


def compare_results(before: EvaluationResult, after: EvaluationResult) -> Comparison:
    """Return the comparison of one evaluation with another."""
    (found,) = compare_several(before, [after])
    return found
