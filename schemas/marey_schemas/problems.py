"""Error answers: RFC 9457 `application/problem+json`."""

from typing import Any

from pydantic import Field

from marey_schemas.base import Answer

MEDIA_TYPE = "application/problem+json"


class FieldError(Answer):
    """An invalid value in a request: its place, and what is wrong with it."""

    pointer: str = Field(description="JSON Pointer into the body, or the name of a query parameter or header.")
    code: str
    detail: str


class Problem(Answer):
    """Description of an error, for people (`title`, `detail`) and for programs (`code`)."""

    type: str
    title: str
    status: int
    detail: str
    instance: str = Field(description="The request id; quote it when asking for help.")
    code: str = Field(
        description="Code that stays the same between releases; docs/reference/errors.md lists all codes."
    )
    errors: tuple[FieldError, ...] = ()
    context: dict[str, Any] = Field(
        default_factory=dict, description="Details of the problem, such as the current revision."
    )
