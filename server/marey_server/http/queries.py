"""Query parameters shared by several resources."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.names import form
from marey_schemas.sizes import MOST_QUERY_VALUES
from marey_server.store.listing import DEFAULT_LIMIT, MAX_LIMIT

T = TypeVar("T")


def _split(value: Any) -> Any:
    return tuple(value.split(",")) if isinstance(value, str) else value


CommaSeparatedOf = Annotated[tuple[T, ...], Field(max_length=MOST_QUERY_VALUES), BeforeValidator(_split)]
"""List of values in one parameter, separated by commas."""

CommaSeparated = CommaSeparatedOf[Annotated[str, StringConstraints(max_length=1024)]]
"""List of texts in one parameter, separated by commas."""


class PageQuery(Request):
    """Query parameters that select one page of a list."""

    limit: int = Field(DEFAULT_LIMIT, ge=1, le=MAX_LIMIT, description="Greatest number of entries in a page.")
    cursor: str | None = Field(
        None,
        max_length=4096,
        pattern=form("^[A-Za-z0-9_-]+$", "be the value of next_cursor"),
        description="Value of `next_cursor` in the previous page.",
    )


class CountedPageQuery(PageQuery):
    """Query parameters that select one page of a list, and optionally ask for the number of all entries."""

    count: Literal["exact"] | None = Field(
        None, description="Return the length of the whole list, which is slow for long lists."
    )
