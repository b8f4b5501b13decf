"""Counterparts of `marey_client.submitting` for async programs."""
