"""Requests for revisions by their digests, and versions received from an archive or another server."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import AfterValidator, Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.consents import ConsentOverride
from marey_schemas.datasets.commits import TIME_OF_COMMIT, EntryPath
from marey_schemas.datasets.naming import RefName
from marey_schemas.kinds import Kind
from marey_schemas.names import LINE, MOST_TAGS, Digest, Message, PartName, Tag
from marey_schemas.queue.facets import FacetName, FacetValue

MOST_CONTENTS = 256
"""Greatest number of revisions, and of documents, in one request."""
MOST_CHECKED = 500
"""Greatest number of revisions in one request to check whether revisions may be exported."""
MOST_RECEIVED_FACETS = 1000
"""Greatest number of facets (published numbers) of one received revision."""
MOST_RECEIVED_CHANGES = 200_000
"""Greatest number of entries that a commit from an archive or another server may change."""


def _require_time(text: str) -> str:
    """Return the text; raise ValueError unless it is a time in the format that digests of commits require."""
    try:
        is_time = datetime.strptime(text, TIME_OF_COMMIT).strftime(TIME_OF_COMMIT) == text  # noqa: DTZ007
    except ValueError:
        is_time = False
    if not is_time:
        raise ValueError("the time must be written like 2026-11-23T10:00:00.000000Z")
    return text


class PartOfContent(Request):
    """Address of a document: the content digest of a revision, and the name of one of its parts."""

    content: Digest = Field(description="Content digest of the revision.")
    part: PartName


class RequestedDocument(PartOfContent):
    """Address of a document, and optionally a revision with an earlier version of this document that the client has."""

    base: Digest | None = Field(
        None,
        description="Content digest of a revision of the project. Arrays of the document that differ in a few frames "
        "from those in the same part of this revision are returned as array differences. Null: all arrays are "
        "returned whole.",
    )


class ContentsRequest(Request):
    """Request for revisions of a project by their content digests, and for documents of such revisions."""

    revisions: tuple[Digest, ...] = Field((), max_length=MOST_CONTENTS)
    documents: tuple[RequestedDocument, ...] = Field((), max_length=MOST_CONTENTS)
    tiles: tuple[PartOfContent, ...] = Field(
        (),
        max_length=MOST_CONTENTS,
        description="Documents of whose arrays only the digests of the tiles (compressed pieces) are requested.",
    )


class ExportCheck(ConsentOverride):
    """Request to check whether revisions of a dataset may be exported; a large export needs several requests."""

    contents: tuple[Digest, ...] = Field(
        min_length=1, max_length=MOST_CHECKED, description="Content digests of revisions that the export will contain."
    )


class ExportPermission(Answer):
    """Answer to a check of consents: the revisions may be exported."""

    ended: tuple[str, ...] = Field(
        description="Ids of the items whose consent has ended, but whose export the request allows."
    )


class ReceivedRevision(Request):
    """Revision that is sent from an archive or another server: kind, documents and facets."""

    content: Digest = Field(
        description="Content digest of the revision, which the server compares with the digest of the documents."
    )
    kind: Kind
    path: EntryPath | None = Field(
        description="Path of an entry that has the revision; null: no entry has the revision, but another revision "
        "refers to it."
    )
    parts: dict[PartName, Any] = Field(
        min_length=1,
        description='Documents by part, in which references to revisions are `{"content": digest}`. If the project '
        "already has a revision with the same document in this part, the document can be replaced by "
        '`{"content": digest}` with the content digest of that revision. An array can be a partial array, '
        "which lacks tiles that another array of the project has; the page about the block format describes it.",
    )
    facets: dict[FacetName, FacetValue] = Field(
        default_factory=dict,
        max_length=MOST_RECEIVED_FACETS,
        description="Facets: numbers that jobs have published about the revision, by name. They are added to all "
        "revisions with this content, but do not replace facets that the project already has.",
    )


class ReceivedRevisions(Request):
    """Revisions from an archive or another server. The project must already have the revisions that they refer to."""

    revisions: tuple[ReceivedRevision, ...] = Field(min_length=1, max_length=MOST_CONTENTS)


class StoredRevisions(Answer):
    """Number of revisions that a request has added; revisions that the project already had do not count."""

    added: int


class ReceivedChange(Request):
    """Entry that differs between a commit and its first parent."""

    path: EntryPath
    kind: Kind
    parts: dict[PartName, Digest] | None = Field(
        description="Content digest of each part; null: the commit removed the entry."
    )
    tags: tuple[Tag, ...] = Field((), max_length=MOST_TAGS)


class ReceivedCommit(Request):
    """Commit from an archive or another server; it keeps its digest."""

    tree: Digest
    parents: tuple[Digest, ...] = Field(max_length=2)
    author: Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=LINE)]
    message: Message
    at: Annotated[str, AfterValidator(_require_time)] = Field(
        description="Time in UTC, such as 2026-11-23T10:00:00.000000Z."
    )
    changes: tuple[ReceivedChange, ...] = Field(max_length=MOST_RECEIVED_CHANGES)
    begins: RefName | None = Field(
        None, description="Branch that is set to this commit; it must have no commits yet. Null: no branch is changed."
    )
