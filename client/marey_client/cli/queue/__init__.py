"""Commands of jobs, pipelines and schedules."""
