"""Versions of datasets: trees of entries, their differences and merges. It uses no database, network or clock."""
