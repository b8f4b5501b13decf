"""Lists of the server, which are requested page by page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from marey_client.asynchronous.interruption import note_at_hand
from marey_client.transport import Model, Params, Transport
from marey_schemas.items import Page


def pages(transport: Transport, entry: type[Model], path: str, params: Params | None = None) -> Iterator[Model]:
    """Yield every entry of a list; the next page is requested when it is needed."""
    query: dict[str, Any] = dict(params or {})
    while True:
        page = transport.get(Page, path, query)
        for number, item in enumerate(page.items, start=1):
            note_at_hand(len(page.items) - number)
            yield entry.model_validate(item)
        if page.next_cursor is None:
            return
        query["cursor"] = page.next_cursor
