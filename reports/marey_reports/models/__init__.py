"""Reports of models, and their figures."""
