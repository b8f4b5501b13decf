"""Datasets with their branches and tags in requests and answers."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated

from pydantic import Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.datasets.protection import Protection
from marey_schemas.names import REF, SLUG, CollectionPath, form

MAIN = "main"
"""Name of the branch that every dataset has from the beginning."""
DatasetName = Annotated[str, StringConstraints(pattern=SLUG)]

RefName = Annotated[str, StringConstraints(pattern=REF)]
"""Name of a branch or a tag; it is part of URLs."""

_VERSION = form(
    r"^[A-Za-z0-9][A-Za-z0-9._:-]{0,127}(?:~[0-9]{1,4})?$",
    "be a branch, a tag or the digest of a commit; ~1 after it means the commit before, ~2 the one before that",
)
Version = Annotated[str, StringConstraints(pattern=_VERSION)]
"""Name of a version: a branch, a tag, or the digest of a commit (the first 8 digits are enough).

With `~n` at the end, the name refers to the version n commits earlier.
"""


class DatasetCreate(Request):
    """Request to create a dataset, whose commits may record a folder of the project."""

    name: DatasetName
    description: str = Field("", max_length=10_000)
    collection: CollectionPath | None = Field(
        None,
        description="Folder of the project whose content the commits of this dataset record; null: each "
        "commit lists its changes.",
    )


class CheckedOut(Answer):
    """Version that was last committed or checked out in the folder of a dataset, and the selection of its entries."""

    commit: str
    query: str | None = Field(description="Query that selected the entries; null: none.")
    paths: tuple[str, ...] = Field(description="Entries and folders that were selected; empty: all.")


class Dataset(Answer):
    """A dataset: a history of versions of named entries."""

    id: str
    name: str
    description: str
    collection: str | None = Field(
        description="Folder whose content the commits record; null: commits list their changes explicitly."
    )
    checked_out: CheckedOut | None = Field(
        None, description="Version in the folder; null if no version was committed or checked out there."
    )
    created_at: datetime
    updated_at: datetime
    rev: int


class RefKind(StrEnum):
    """Kind of a name for a commit: branches move to later commits, tags never move."""

    BRANCH = "branch"
    TAG = "tag"


class RefCreate(Request):
    """Request to create a branch or a tag."""

    name: RefName
    kind: RefKind
    at: Version = Field(MAIN, description="Version to which the new branch or tag points.")


class RefMove(Request):
    """Request to move a branch to another version."""

    at: Version = Field(description="Version to which the branch points from now on.")


class Ref(Answer):
    """Branch or tag of a dataset: a name for a commit."""

    name: str
    kind: RefKind
    commit: str | None = Field(description="Digest of the commit; null for a branch without commits.")
    protection: Protection | None = Field(None, description="Rule of the branch; null if it is not protected.")
    created_at: datetime
    updated_at: datetime
    rev: int
