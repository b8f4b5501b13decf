"""Versions of datasets: trees of entries, their differences and merges.

This package uses no database, network or clock.
"""
