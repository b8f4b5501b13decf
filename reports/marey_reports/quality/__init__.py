"""Reports of the quality of motion."""
