"""Evaluation of locomotion clips: accuracy, relevance and coverage, measured by simulated motion matching.

After Abichequer Sangalli et al. (2022), "A new framework for the evaluation of locomotive motion datasets through
motion matching techniques", for which docs/explanation/evaluation.md lists the ambiguous formulas and their
interpretation.
"""
