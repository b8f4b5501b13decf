"""Improvements of a set of clips: clips to remove, clips that fill holes in the coverage, better feature weights."""
