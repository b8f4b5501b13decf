"""Search for motions of a model that meet constraints."""
