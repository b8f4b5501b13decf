"""Alignment of motions in time: which frame of one motion corresponds to which frame of another."""
