"""References from documents to revisions of items."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Request


class RevisionRef(Request):
    """A pinned revision of an item."""

    item: str
    revision: int = Field(ge=1)


class OutputRef(Request):
    """A reference to another output of the same write; the store replaces it by a reference to the stored item."""

    output: str


class PartDigestRef(Request):
    """The digest of the part `model` of the same item and the same write; the store replaces it by that digest."""

    digest_of: Literal["model"]
