"""Fair claims: which projects get the workers, and how many jobs of a project may run at once."""
