"""Queries that select items: their fields, and their grammar."""
