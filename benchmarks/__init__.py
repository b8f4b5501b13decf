"""Benchmarks that compare Marey with other libraries: each runs both in turn, in one process, and prints ratios."""
