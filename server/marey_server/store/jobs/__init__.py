"""Job queue: submission, claims, fences, results, and propagation of job ends; all SQL for jobs is in this package."""
