"""Counterparts of `marey_client.handles` for async programs."""
