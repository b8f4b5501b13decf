"""Commands that edit and annotate clips."""
