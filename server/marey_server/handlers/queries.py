"""Query parameters shared by several resources."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from marey_schemas.base import Request
from marey_server.store.listing import DEFAULT_LIMIT, MAX_LIMIT

MAX_INTEGER = 2**31 - 1


def _split(value: Any) -> Any:
    return tuple(value.split(",")) if isinstance(value, str) else value


CommaSeparated = Annotated[tuple[str, ...], BeforeValidator(_split), Field(max_length=1000)]
"""Several values in one parameter, separated by commas."""


class PageQuery(Request):
    """Which page of a list."""

    limit: int = Field(DEFAULT_LIMIT, ge=1, le=MAX_LIMIT, description="Longest page.")
    cursor: str | None = Field(None, max_length=4096, description="`next_cursor` of the page before.")


class CountedPageQuery(PageQuery):
    """Which page of a list, and whether to count the whole."""

    count: Literal["exact"] | None = Field(None, description="Count the whole list; it costs time on long ones.")
