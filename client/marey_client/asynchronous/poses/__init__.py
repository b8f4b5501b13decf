"""Counterparts of `marey_client.poses` for async programs."""
