"""The job queue: submission, claims, fences, results, and what the end of a job causes. All of its SQL."""
