"""Scripts of projects: their registration, and the runs with the fields that they logged."""
