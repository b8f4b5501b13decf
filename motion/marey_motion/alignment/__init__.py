"""Alignment of motions in time: which frames of one motion correspond to which frames of another."""
