"""Benchmarks that compare Marey with other libraries: both run in turn, in one process, and ratios are printed."""
