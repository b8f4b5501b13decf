"""Execution of scripts: checkout of a pinned commit, confinement of its processes, and collection of its files."""
