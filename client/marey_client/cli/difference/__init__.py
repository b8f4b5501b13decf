"""Command `diff`: the differences between two revisions."""
