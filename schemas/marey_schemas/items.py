"""Collections, items, revisions and lineage in requests and answers."""

from datetime import datetime
from typing import Any

from pydantic import Field

from marey_schemas.access import Role
from marey_schemas.base import Answer, Request
from marey_schemas.kinds import Kind
from marey_schemas.names import MOST_TAGS, Digest, ItemName, Message, ReceivingPath, Tag
from marey_schemas.sizes import MOST_INTEGER

LOOP_TAG = "loop"
"""Tag of clips that are played as loops."""


class CollectionCreate(Request):
    """Request to create a folder; missing parents are created, too."""

    path: ReceivingPath = Field(min_length=1)


class CollectionChange(Request):
    """Request to move or rename a folder with its contents."""

    path: ReceivingPath = Field(min_length=1)


class Collection(Answer):
    """Folder (collection) of a project, which contains items and folders."""

    id: str
    path: str
    role: Role | None = Field(
        None,
        description="The caller's role in the folder, which results from the role in the project and the roles in "
        "folders; null for a guest of a public project.",
    )
    created_at: datetime
    updated_at: datetime
    deleted_at: datetime | None = None
    rev: int


class ItemCreate(Request):
    """Request to create an item with its first revision; each part is a document."""

    name: ItemName
    collection: ReceivingPath = ""
    tags: tuple[Tag, ...] = Field((), max_length=MOST_TAGS)
    parts: dict[str, Any] = Field(min_length=1)
    message: Message = ""


class ItemChange(Request):
    """Request to rename, move or tag an item; absent fields are unchanged."""

    name: ItemName | None = None
    collection: ReceivingPath | None = None
    tags: tuple[Tag, ...] | None = Field(None, max_length=MOST_TAGS)


class ItemRevert(Request):
    """Request to give an item the content of an earlier revision."""

    revision: int = Field(ge=1, le=MOST_INTEGER)
    message: Message = Field(
        "", description="Message of the new revision; empty: a sentence that names the earlier revision."
    )


class HidingCondition(Answer):
    """Condition of a query, with the numbers of items that this condition excludes."""

    condition: str
    hides: int = Field(description="Number of items that do not meet this condition.")
    alone: int = Field(description="Number of items that meet all other conditions, but not this one.")


class QueryExplanation(Answer):
    """Number of items that a query selects, and the numbers of items that its conditions exclude."""

    items: int = Field(description="Number of items to which the query was applied.")
    selected: int
    conditions: tuple[HidingCondition, ...] = Field(description="Conditions that every selected item meets.")


class PartSummary(Answer):
    """Part of an item, without its content: schema, digest and size of the document."""

    document: str
    schema_: str = Field(alias="schema")
    size_bytes: int


class PartPlace(Request):
    """Address of a document to read: an item, a revision, and the name of a part."""

    kind: Kind
    item: str = Field(max_length=64)
    revision: int = Field(ge=1, le=MOST_INTEGER)
    part: str = Field(max_length=64)


class PartsRequest(Request):
    """Request to read several documents, each a part of a revision of an item."""

    parts: tuple[PartPlace, ...] = Field(min_length=1, max_length=256)


class Item(Answer):
    """Item: a named object of one kind in a project, such as a clip, at its newest revision."""

    id: str
    kind: Kind
    name: str
    collection: str
    tags: tuple[str, ...] = ()
    revision: int
    parts: dict[str, PartSummary] = Field(default_factory=dict)
    summary: dict[str, Any] = Field(
        default_factory=dict,
        description="Values that lists show and filter by; for clips: frames, frame_rate_hz, duration_s, "
        "skeleton, warnings.",
    )
    facets: dict[str, float] = Field(
        default_factory=dict, description="Numbers that jobs published about the newest revision, by name."
    )
    created_at: datetime
    updated_at: datetime
    deleted_at: datetime | None = None
    rev: int = Field(
        description="Number that increases with every change of name, place, tags and revision; it is part of the ETag."
    )

    @property
    def path(self) -> str:
        """The collection and the name, joined by `/`."""
        return f"{self.collection}/{self.name}".lstrip("/")


class Revision(Answer):
    """Revision: one immutable state of an item, with its author, time and message."""

    item: str
    revision: int
    author: str | None
    message: str
    job: str | None
    created_at: datetime
    parts: dict[str, PartSummary]


class LineageEdge(Answer):
    """One step of an item's lineage: an input of a revision, or a result computed from the revision."""

    item: str
    kind: Kind
    name: str = Field(description="Name of the item; empty if it was purged.")
    purged: bool = Field(
        False, description="Whether the item was purged (deleted for good); only its place in the lineage is left."
    )
    revision: int
    job: str | None
    role: str = Field(description="Name of the job input for which the revision was used.")


class Lineage(Answer):
    """Lineage of a revision: its inputs and its results."""

    item: str
    revision: int
    job_kind: str | None = None
    params: dict[str, Any] | None = None
    seed: int | None = None
    code_version: str | None = None
    environment: dict[str, str] = Field(default_factory=dict)
    inputs: tuple[LineageEdge, ...] = ()
    outputs: tuple[LineageEdge, ...] = ()


class Staleness(Answer):
    """State of an item's inputs: whether any of them has a newer revision."""

    item: str
    revision: int
    stale: bool
    because: tuple[LineageEdge, ...] = Field(
        (), description="Inputs that now have newer revisions than those from which the item was made."
    )


class Page(Answer):
    """One page of a list, with the cursor of the next page."""

    items: tuple[Any, ...]
    next_cursor: str | None = None
    count: int | None = None


class BlobsQuery(Request):
    """Request that asks which of the given blobs are missing.

    A blob is missing if the server does not have it, or if the caller may not read it.
    """

    digests: tuple[str, ...] = Field(max_length=10_000)


class BlobsMissing(Answer):
    """Digests of the requested blobs that are missing, so that they must be sent."""

    missing: tuple[str, ...]


class UploadCreate(Request):
    """Request to begin an upload of bytes in pieces."""

    length: int = Field(ge=1, le=16 * 2**30, description="Number of bytes of the whole upload.")
    digest: Digest | None = Field(None, description="Digest that the complete upload must have; null: any.")


class Upload(Answer):
    """Resumable upload of bytes: the bytes received so far, and the digest at the end."""

    id: str
    length: int
    offset: int = Field(description="Number of bytes received, which is where the next piece starts.")
    digest: str | None = Field(None, description="Digest of the blob; null until the upload is complete.")


class Event(Answer):
    """Event in a project; events are ordered by the time at which their database transaction was committed."""

    seq: int
    at: datetime
    project: str | None
    kind: str
    subject: str
    actor: str | None
    body: dict[str, Any] = Field(default_factory=dict)


class EventFeed(Page):
    """One page of events in their order, and whether further events exist.

    `next_cursor` and `count` are always null. To read the next page, send the number of the last event as `after`.
    """

    items: tuple[Event, ...]
    more: bool = Field(
        description="Whether further events existed when this page was read; to read them, send the number of the "
        "last event of this page as `after`."
    )
