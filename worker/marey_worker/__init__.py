"""The Marey worker: claims jobs, runs them in child processes, writes results back."""
