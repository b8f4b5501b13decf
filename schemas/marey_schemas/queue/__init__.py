"""Jobs and pipelines: their kinds, their parameters, and the messages between queue and worker."""
