"""Submission of jobs: their requests, and the methods of a project that send them."""
