"""The longest wait of tests for anything that is certain to happen."""

PATIENCE_S = 240.0
"""Seconds: long, because machines may be busy, but shorter than the time limit of a test, whose error says less."""
