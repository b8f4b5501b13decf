"""Fixtures of the integration tests."""

from rest_server import owner, server

__all__ = ["owner", "server"]
