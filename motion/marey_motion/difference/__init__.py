"""Comparison of two revisions of an item: of their motions, skeletons, annotations and models."""
