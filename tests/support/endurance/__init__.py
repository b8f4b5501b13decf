"""Long trials of a whole installation: two servers and six workers with Postgres and S3, under faults or under load."""
