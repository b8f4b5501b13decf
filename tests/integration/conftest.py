"""Fixtures of the integration tests."""

from tests.support.rest_server import owner, server

__all__ = ["owner", "server"]
