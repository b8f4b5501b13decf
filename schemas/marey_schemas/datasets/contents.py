"""Requests for the content of versions by digest."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.names import Digest

MOST_CONTENTS = 256
"""Greatest number of revisions, and of documents, in one request."""


class PartOfContent(Request):
    """Address of a document: a part of the revisions with a content digest."""

    content: Digest = Field(description="Content digest of the revision.")
    part: Annotated[str, StringConstraints(min_length=1, max_length=64)]


class ContentsRequest(Request):
    """Request for revisions of a project by their content digests, and for documents of them."""

    revisions: tuple[Digest, ...] = Field((), max_length=MOST_CONTENTS)
    documents: tuple[PartOfContent, ...] = Field((), max_length=MOST_CONTENTS)
