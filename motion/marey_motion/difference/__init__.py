"""Differences between two revisions of an item, in terms of motion."""
