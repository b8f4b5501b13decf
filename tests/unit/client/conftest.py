"""Simulated server for tests of the client."""

import pytest
from tests.support.scripted_server import ScriptedServer


@pytest.fixture
def script() -> ScriptedServer:
    """A server whose answers the test prepares."""
    return ScriptedServer()
