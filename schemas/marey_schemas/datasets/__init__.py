"""Datasets in requests and answers: branches, tags, commits, entries and differences."""
