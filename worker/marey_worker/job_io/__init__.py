"""Inputs and results of jobs: caches, places of results, refusals, and stored reports."""
