"""Differences of versions of datasets in answers."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field

from marey_schemas.base import Answer
from marey_schemas.datasets.commits import Commit, Entry
from marey_schemas.kinds import Kind

ChangeKind = Literal["added", "removed", "moved", "changed"]
"""Kind of change of an entry, or of a part of an entry, between two versions; parts are never moved by themselves."""
CHANGE_KINDS: tuple[ChangeKind, ...] = get_args(ChangeKind)


class ListedCommit(Commit):
    """Commit in a list of commits. If the list is limited to a path, the commit's changes at the path are counted."""

    changes: dict[ChangeKind, int] | None = Field(
        None,
        description="Number of entries that the commit added, removed, moved or changed, compared with its first "
        "parent. Only entries at the path of the list or below it count; null: the list has no path. At most 100,000 "
        "entries are counted. If the commit changes more than 100,000 entries of the dataset, moved entries count as "
        "added or removed.",
    )
    moved_from: str | None = Field(
        None,
        description="If the commit moved a single entry to the path of the list: the path of the entry before "
        "the move; otherwise null.",
    )
    moved_to: str | None = Field(
        None,
        description="If the commit moved a single entry away from the path of the list: the path of the entry "
        "after the move; otherwise null.",
    )


class EntryDifference(Answer):
    """Entry that differs between two versions, with the kind of its change."""

    path: str
    kind: Kind
    change: ChangeKind
    was: str | None = Field(None, description="Path of the entry in the earlier version, if it was moved.")
    parts: dict[str, ChangeKind] = Field(
        default_factory=dict, description="Kind of change of each part that differs, by the name of the part."
    )
    tags_added: tuple[str, ...] = ()
    tags_removed: tuple[str, ...] = ()
    before: Entry | None = None
    after: Entry | None = None


class DatasetDifference(Answer):
    """Difference between two versions of a dataset: the entries that differ, and their numbers."""

    before: Commit
    after: Commit
    counts: dict[ChangeKind, int] = Field(description="Number of differing entries by kind of change.")
    folders: dict[str, dict[ChangeKind, int]] = Field(
        default_factory=dict,
        description="Number of differing entries directly in each folder, by kind of change. A removed entry counts "
        "in the folder that contained it. The limit of the list of entries also limits the number of folders.",
    )
    entries: tuple[EntryDifference, ...]
    complete: bool = Field(description="Whether all differing entries are listed and counted.")
