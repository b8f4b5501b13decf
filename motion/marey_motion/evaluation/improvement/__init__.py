"""Improvements of a data set: removable clips, clips that fill holes in its coverage, and better feature weights."""
