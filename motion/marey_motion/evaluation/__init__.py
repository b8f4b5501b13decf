"""Evaluation of locomotion clips: accuracy, relevance and coverage, measured by simulated motion matching.

The method is described by Abichequer Sangalli et al. (2022), "A new framework for the evaluation of locomotive motion
datasets through motion matching techniques". Some formulas of the paper are ambiguous; docs/explanation/evaluation.md
lists them with the interpretation used here.
"""
