"""Bridges: versions of datasets as folders that other programs read, with the identity of the version."""
