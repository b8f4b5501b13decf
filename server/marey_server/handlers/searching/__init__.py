"""Searches in models for motions that meet constraints, and in indexes for motions that resemble an example."""
