"""Pictures of differences between revisions."""
