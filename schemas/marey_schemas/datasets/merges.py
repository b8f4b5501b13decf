"""Merges of versions of datasets in requests and answers."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.datasets.commits import Commit, Entry, EntryPath
from marey_schemas.datasets.naming import MAIN, RefName, Version
from marey_schemas.kinds import Kind
from marey_schemas.names import Digest, Message, PartName

MOST_CONFLICTS = 1000
"""Greatest number of conflicts that an answer lists."""
MOST_RESOLUTIONS = 10_000
"""Greatest number of resolutions in a request."""


MOST_CONFLICTING_SEGMENTS = 100
"""Greatest number of segments that a conflict of an annotation lists for each side."""


class Side(StrEnum):
    """Side that wins a conflict: the branch, the version that is merged into it, or the common base of both."""

    OURS = "ours"
    THEIRS = "theirs"
    BASE = "base"


class Resolution(Request):
    """Decision about a conflict: the side whose version of an entry the merge uses.

    If two different entries would have the same path, `take` selects the entry that gets the path. The other entry
    returns to the path that it has on the branch or in the base. If one side has added that entry, it has no earlier
    path and is dropped. Several conflicts can have the same path and kind. The first resolution decides the first of
    these conflicts, the second resolution the second conflict, and so on.

    If a conflict has several parts, each part can be decided by a separate resolution. In this case, the resolutions of
    one conflict follow each other in the list, and the conflict remains until all its parts are decided.
    """

    path: EntryPath
    kind: Kind
    take: Side
    part: PartName | None = Field(
        None,
        description="Part of the conflict that this resolution decides, such as `motion`, `path` or `tags`; null: "
        "all parts. A part that was computed from another part, such as the sample tree from the model, is "
        "decided together with the other part.",
    )


class CombineRequest(Request):
    """Base of requests that apply changes of other commits to a branch, or undo changes of commits on a branch."""

    into: RefName = Field(MAIN, description="Branch that gets the changes.")
    message: Message = Field("", description="Message of the commit; empty: a sentence that names the versions.")
    resolutions: tuple[Resolution, ...] = Field((), max_length=MOST_RESOLUTIONS)
    preview: bool = Field(False, description="Compute the result without recording it.")
    expected: Digest | None = Field(
        None, description="Digest that the newest commit of the branch must have; null: any."
    )
    write_id: Annotated[str, StringConstraints(min_length=8, max_length=64)] | None = Field(
        None,
        description="Name that the client chooses for this change, if any; a repeated request with the same name "
        "gets the same commit.",
    )


class MergeRequest(CombineRequest):
    """Request to merge a version into a branch."""

    version: Version = Field(description="Version whose changes are merged into the branch.")


class PickRequest(CombineRequest):
    """Request to apply the changes of one commit to a branch (cherry-pick), or to undo them on a branch (revert)."""

    version: Version = Field(description="Commit whose changes are applied or undone.")
    parent: Literal[1, 2] | None = Field(
        None,
        description="Number of the parent with which the commit is compared to find its changes; required if the "
        "commit is a merge. 1: the newest commit of the branch before the merge; 2: the version that was merged.",
    )


class ConflictingSegment(Answer):
    """Segment of an annotation: a label of the frames from `start` up to, but not including, `end`."""

    label: str
    start: int
    end: int


class ConflictingSegments(Answer):
    """Segments of an annotation that exclude each other, at most 100 of each side, in the order of their frames."""

    base: tuple[ConflictingSegment, ...] = Field(
        description="Segments of the base that both sides have removed; empty if both have only added segments."
    )
    ours: tuple[ConflictingSegment, ...]
    theirs: tuple[ConflictingSegment, ...]


class EntryConflict(Answer):
    """Conflict of a merge: an entry that both sides have changed in ways that cannot be combined."""

    path: str
    kind: Kind
    parts: tuple[str, ...] = Field(
        description="Parts that both sides have changed and no resolution decides. `path`: both sides have moved the "
        "entry, or have different entries at the same path. `tags`: the entry would have more than 64 tags. `entry`: "
        "one side has removed the entry."
    )
    base: Entry | None
    ours: Entry | None
    theirs: Entry | None
    reason: str = Field(
        "",
        description="Reason why the changes of an annotation cannot be combined, or why a resolution cannot be "
        "applied; empty for other conflicts.",
    )
    segments: ConflictingSegments | None = Field(
        None,
        description="Segments of an annotation that exclude each other; null if the conflict does not concern "
        "segments.",
    )


class MergeAnswer(Answer):
    """Result of a merge, cherry-pick or revert, or of the preview of one."""

    commit: Commit | None = Field(
        description="New commit of the branch; null for a preview, and if conflicts are unresolved."
    )
    base: str | None = Field(
        description="Digest of the base, the commit with which both sides are compared; null if the sides have no "
        "common commit."
    )
    ours: str = Field(description="Digest of the newest commit of the branch.")
    theirs: str | None = Field(
        description="Digest of the commit whose content is merged into the branch; null: an empty version, because the "
        "first commit of the dataset is undone."
    )
    changes: int = Field(description="Number of entries of the branch that change.")
    conflicts: tuple[EntryConflict, ...] = Field(description="The first conflicts without a resolution, by path.")
    conflict_count: int = Field(description="Number of conflicts without a resolution.")
