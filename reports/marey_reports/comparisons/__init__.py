"""Charts and pages that compare runs of scripts."""
