"""Fixtures of the integration tests."""

from command_line import run
from rest_server import owner, server

__all__ = ["owner", "run", "server"]
