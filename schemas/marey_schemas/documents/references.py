"""References from documents to revisions of items."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Request


class RevisionRef(Request):
    """Reference to one revision of an item."""

    item: str
    revision: int = Field(ge=1)


class OutputRef(Request):
    """Reference to another output of the same request. The store replaces it by a reference to the stored item."""

    output: str


class PartDigestRef(Request):
    """Placeholder for the digest of the part `model` that the same request stores for the same item.

    The store replaces the placeholder by the digest.
    """

    digest_of: Literal["model"]
