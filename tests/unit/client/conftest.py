"""In-process server of a client's tests."""

import pytest
from tests.support.scripted_server import ScriptedServer


@pytest.fixture
def script() -> ScriptedServer:
    """A server whose answers the test prepares."""
    return ScriptedServer()
