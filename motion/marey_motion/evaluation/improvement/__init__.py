"""Improvements of a data set: clips to remove, clips that fill holes in its coverage, and better feature weights."""
