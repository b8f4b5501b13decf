"""Resources of the queue: jobs, pipelines, and the leases of workers."""
