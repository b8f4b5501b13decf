"""Commits and entries of datasets in requests and answers."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Answer, Request, Tagged
from marey_schemas.datasets.naming import MAIN, RefName
from marey_schemas.kinds import Kind
from marey_schemas.names import Digest, ItemId, Message, form
from marey_schemas.sizes import MOST_INTEGER

MOST_CHANGES = 10_000
"""Greatest number of explicit changes in one commit."""

TIME_OF_COMMIT = "%Y-%m-%dT%H:%M:%S.%fZ"
"""Format of the time of a commit; the time is in UTC."""

_ENTRY = form(
    r"^[^/\x00-\x1f\x7f]{1,255}(?:/[^/\x00-\x1f\x7f]{1,255})*$",
    "be names joined by single slashes, without a slash at its beginning or end, and not be empty",
)
EntryPath = Annotated[
    str,
    StringConstraints(min_length=1, max_length=1280, pattern=_ENTRY),
]


class PutEntry(Tagged):
    """Change that gives a new or existing entry the content of a revision of an item of the project."""

    tag = "change"
    change: Literal["put"] = "put"
    path: EntryPath
    item: ItemId
    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Number of the revision; null: the newest.")


class RemoveEntry(Tagged):
    """Change that removes an entry."""

    tag = "change"
    change: Literal["remove"] = "remove"
    path: EntryPath
    kind: Kind


class MoveEntry(Tagged):
    """Change that moves an entry to another path."""

    tag = "change"
    change: Literal["move"] = "move"
    path: EntryPath
    kind: Kind
    to: EntryPath


EntryChange = Annotated[PutEntry | RemoveEntry | MoveEntry, Field(discriminator="change")]


class CommitCreate(Request):
    """Request to record a new version of a dataset on a branch."""

    branch: RefName = MAIN
    message: Message = Field(min_length=1)
    changes: tuple[EntryChange, ...] | None = Field(
        None,
        max_length=MOST_CHANGES,
        description="Changes to apply to the newest version of the branch; null: record the content of the dataset's "
        "folder.",
    )
    expected: Digest | None = Field(
        None, description="Digest that the newest commit of the branch must have; null: any."
    )
    write_id: Annotated[str, StringConstraints(min_length=8, max_length=64)] | None = Field(
        None,
        description="Name that the client chooses for this commit, if any; a repeated request with the same name "
        "gets the same commit.",
    )

    @model_validator(mode="after")
    def _has_changes(self) -> CommitCreate:
        if self.changes == ():
            raise ValueError("changes: the list is empty; give at least one change, or omit `changes`")
        return self


class Commit(Answer):
    """Commit: one version of a dataset, with its author, time, message and parents."""

    digest: str
    tree: str = Field(description="Digest of the entries; versions with the same entries have the same digest.")
    parents: tuple[str, ...]
    author: str
    message: str
    at: datetime
    entries: int = Field(description="Number of entries.")
    job: str | None = Field(
        None, description="Job that made this commit of its outputs; null: a user or a program made the commit."
    )


class Entry(Answer):
    """Entry of a version of a dataset: a path, and the content of a revision of an item, with tags."""

    path: str
    kind: Kind
    parts: dict[str, str] = Field(
        description="Content digest of each part. Equal parts have the same digest on every server."
    )
    tags: tuple[str, ...]
    item: str | None = Field(
        description="Item of this project that has a revision with this content; null: no item has one."
    )
    revision: int | None


class Origin(Answer):
    """Commit that last changed one part, the tags or the path of an entry."""

    commit: Commit
    path: str = Field(description="Path of the entry in that commit; a later commit may have moved the entry.")
    certain: bool = Field(
        description="Whether this commit is known to have made the change; false: this commit or an earlier one made "
        "the change."
    )


class EntryOrigins(Answer):
    """Commits that last changed each part, the tags and the path of an entry."""

    path: str
    kind: Kind
    parts: dict[str, Origin] = Field(description="The commit that last changed each part.")
    place: Origin = Field(description="The commit that added the entry, or moved it to its path.")
    tags: Origin = Field(description="The commit that last changed the tags.")
