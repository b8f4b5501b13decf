"""Merges of skeletons: duplicates of one rig become one skeleton, to which their clips move."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Answer, Request
from marey_schemas.names import ItemId

SKELETON_MERGE = "skeleton_merge"
"""Name of the input by which a revision that a merge made refers to the revision before it."""
MOST_MOVED = 5_000
"""Greatest number of items that one merge moves to another skeleton."""
MOST_RIGS_COMPARED = 500
"""Greatest number of skeletons that a merge compares with each other, and an import with each new skeleton."""


class SkeletonMergeRequest(Request):
    """Request to merge skeletons of one rig, or to show what would be merged."""

    skeletons: tuple[ItemId, ...] = Field(
        (),
        max_length=MOST_RIGS_COMPARED,
        description="Ids of the skeletons to merge; none: all skeletons of the project.",
    )
    kept: ItemId | None = Field(
        None,
        description="Id of the skeleton that remains. Absent: of each rig the one with a joint map made by hand, or "
        "else the one that most items use.",
    )
    dry_run: bool = Field(False, description="Show what would be merged, and change nothing.")


class NamedSkeleton(Answer):
    """Skeleton, with its path in the project."""

    id: str
    path: str


class MergedSkeleton(NamedSkeleton):
    """Skeleton that was merged into another one and deleted; it can be restored."""

    moved: dict[str, int] = Field(
        default_factory=dict,
        description="Numbers of the items that got a new revision with the kept skeleton, by kind.",
    )


class MergedRig(Answer):
    """Skeletons of one rig: the one that is kept, and those that are merged into it."""

    kept: NamedSkeleton
    merged: tuple[MergedSkeleton, ...]


class SkeletonMergeAnswer(Answer):
    """Result of a merge, or of its preview, by rig."""

    rigs: tuple[MergedRig, ...]
    dry_run: bool
