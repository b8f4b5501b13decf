"""Fixtures of the integration tests."""

from typing import Any

import pytest
from tests.support.rest_server import owner, server, worker
from tests.support.webhook_receiver import open_receiver

from marey_server.http.validation import decode_body

__all__ = ["open_receiver", "owner", "server", "worker"]


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """List of the sizes of all request bodies that the server has decoded."""
    sizes: list[int] = []

    def note(data: bytes, media_type: str, **options: Any) -> Any:
        sizes.append(len(data))
        return decode_body(data, media_type, **options)

    monkeypatch.setattr("marey_server.http.resource.decode_body", note)
    return sizes
