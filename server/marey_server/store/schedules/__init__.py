"""Schedules: their times, their management by members of a project, and the submission of their jobs."""
