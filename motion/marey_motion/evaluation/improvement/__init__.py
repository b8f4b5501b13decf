"""Improvements of a dataset: removable clips, clips that fill its holes, and the effect of settings."""
