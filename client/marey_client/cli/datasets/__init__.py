"""Commands of the groups `dataset`, `proposal` and `archive`."""
