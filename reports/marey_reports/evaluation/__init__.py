"""Reports of evaluations, and their figures."""
