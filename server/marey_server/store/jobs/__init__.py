"""Job queue: submission, claims, fences, results, and propagation of ends, with all SQL for them."""
