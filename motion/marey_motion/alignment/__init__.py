"""Alignment of motions in time: the correspondence between the frames of one motion and those of another."""
