"""Purges: deletion of deleted items for good, and the holders, which are the objects that still need an item."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.kinds import Kind
from marey_schemas.names import CollectionPath
from marey_schemas.queries.grammar import MOST_CHARACTERS
from marey_schemas.queue.jobs import JobState
from marey_schemas.wording import counted

MOST_PURGED = 500
"""Greatest number of items that one request examines."""
MOST_HOLDERS = 20
"""Greatest number of holders of one item that an answer lists."""


class PurgeRequest(Request):
    """Request to delete deleted items for good; all given conditions must be met.

    One request examines at most `MOST_PURGED` items; `next` in the answer continues the purge.
    """

    item: str | None = Field(
        None, max_length=64, description="Id of one deleted item; absent: the other conditions select the items."
    )
    path: str | None = Field(
        None, max_length=1300, description="Path, made of folder and name, that deleted items had."
    )
    collection: CollectionPath | None = Field(
        None,
        description="Folder whose deleted items are purged, including those in folders below it; empty: the "
        "deleted items of the whole project.",
    )
    kind: Kind | None = Field(None, description="Kind of the items; absent: all kinds.")
    query: str | None = Field(
        None,
        max_length=MOST_CHARACTERS,
        description="Query that the items meet, such as `subject = 02`; absent: any items.",
    )
    older_than_days: int | None = Field(
        None,
        ge=0,
        le=100_000,
        description="Only items that were deleted at least this number of days ago; absent: all.",
    )
    preview: bool = Field(False, description="Report what a purge would do, but change nothing.")
    after: str | None = Field(
        None,
        max_length=64,
        description="Value of `next` in the previous answer, to continue a purge of many "
        "items; absent: the purge begins.",
    )

    @model_validator(mode="after")
    def _names_items(self) -> Self:
        if self.item is None and self.path is None and self.collection is None and self.query is None:
            raise ValueError(
                "give an item, a path, a collection or a query; an empty collection means the whole project"
            )
        return self


class DatasetHolder(Answer):
    """Dataset whose versions contain a revision of an item."""

    type: Literal["dataset"] = "dataset"
    dataset: str = Field(description="Name of the dataset.")
    deleted: bool = Field(False, description="Whether the dataset was deleted; its versions still exist.")
    branches: tuple[str, ...] = Field((), description="Branches whose newest commit contains the revision.")
    tags: tuple[str, ...] = ()
    proposals: tuple[int, ...] = Field((), description="Open proposals to merge a version that contains the revision.")
    commits: int = Field(description="Number of commits that contain a revision of the item.")


class ItemHolder(Answer):
    """Item with a document that refers to the held item, such as a clip that refers to its skeleton."""

    type: Literal["item"] = "item"
    item: str
    kind: Kind
    path: str
    deleted: bool = Field(False, description="Whether this item was deleted, too, so that it can be purged.")


class JobHolder(Answer):
    """Job that prevents the purge of an item: the job has not ended, and reads the item or has created it."""

    type: Literal["job"] = "job"
    job: str
    kind: str
    state: JobState


Holder = Annotated[DatasetHolder | ItemHolder | JobHolder, Field(discriminator="type")]


class PurgedItem(Answer):
    """Item that was purged, or that a purge would delete."""

    item: str
    kind: Kind
    path: str = Field(
        description="Folder and name of the item, in a preview. Empty in the answer to a purge, because this answer "
        "is stored for repetitions of the request, and the name must not be stored."
    )


class HeldItem(Answer):
    """Item that was not purged, because other objects still need it."""

    item: str
    kind: Kind
    path: str
    holders: tuple[Holder, ...] = Field(description=f"Objects that still need the item, at most {MOST_HOLDERS}.")
    others: int = Field(0, description="Number of further objects that need the item and are not listed.")


class PurgeAnswer(Answer):
    """Outcome of a purge: the items that were (or would be) deleted for good, and the items that are still needed."""

    preview: bool
    purged: tuple[PurgedItem, ...] = Field(
        description="Items that were (or would be) deleted for good. They include indexes of motions that contain "
        "poses of the purged clips, even if the indexes were not deleted before."
    )
    refused: tuple[HeldItem, ...]
    freed_bytes: int = Field(
        description="Bytes that the next garbage collection can free: those of the documents, arrays and files to "
        "which nothing else in the project refers. This is an estimate: content that other projects also have is not "
        "freed, and the database rows that refer to the content are not counted."
    )
    next: str | None = Field(
        None, description="Value of `after` in the request for further items; null: no items are left."
    )


class DatasetPurgeRequest(Request):
    """Request to delete a deleted dataset for good, with its versions, branches, tags and proposals."""

    dataset: str = Field(
        min_length=1,
        max_length=64,
        description="Id or name of a deleted dataset. If several deleted datasets have this name, the dataset that "
        "was deleted last is purged.",
    )
    preview: bool = Field(False, description="Report what the purge would do, but change nothing.")


class DatasetPurgeAnswer(Answer):
    """Outcome of the purge of a dataset, or of its preview."""

    preview: bool
    dataset: str = Field(description="Id of the dataset.")
    name: str
    commits: int = Field(description="Number of versions of the dataset.")
    proposals: int = Field(description="Number of proposals of the dataset.")
    holders: tuple[Annotated[ItemHolder | JobHolder, Field(discriminator="type")], ...] = Field(
        description=f"Objects that refer to a version of the dataset and so prevent the purge, at most "
        f"{MOST_HOLDERS}: items that "
        "jobs made from a version, and jobs that have not ended."
    )
    others: int = Field(
        0, description="Number of further objects that refer to a version of the dataset and are not listed."
    )
    freed_bytes: int = Field(
        description="Bytes of the trees of entries, without the chunks that other datasets also have."
    )
    same_name: int = Field(description="Number of other deleted datasets of the project that have the same name.")


def words_of(holder: Holder) -> str:
    """Describe a holder in a few words, such as "the clip raw/walk (clip_…)"."""
    if isinstance(holder, ItemHolder):
        return f"the {'deleted ' if holder.deleted else ''}{holder.kind} {holder.path} ({holder.item})"
    if isinstance(holder, JobHolder):
        return f"the {holder.state} job {holder.job} ({holder.kind})"
    named = [f"{name} {', '.join(map(str, ones))}" for name, ones in _refs_of(holder) if ones]
    details = "; ".join([*named, counted(holder.commits, "commit")])
    return f"the {'deleted ' if holder.deleted else ''}dataset {holder.dataset} ({details})"


def _refs_of(holder: DatasetHolder) -> list[tuple[str, tuple[str, ...] | tuple[int, ...]]]:
    return [("branch", holder.branches), ("tag", holder.tags), ("proposal", holder.proposals)]
