"""Improvements of a dataset: what can go, what fills its holes, and how settings change its evaluation."""
