"""Merges of skeletons: duplicates of one rig become one skeleton, to which their clips and models move."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Answer, Request
from marey_schemas.names import ItemId

SKELETON_MERGE = "skeleton_merge"
"""Role of the input in the lineage of a revision that a merge made: the revision before the merge."""
MOST_MOVED = 5_000
"""Greatest number of items that one merge moves to another skeleton."""
MOST_RIGS_COMPARED = 500
"""Greatest number of skeletons that a merge compares with each other, or that an import compares with a new one."""


class SkeletonMergeRequest(Request):
    """Request to merge skeletons of one rig, or to show what would be merged."""

    skeletons: tuple[ItemId, ...] = Field(
        (),
        max_length=MOST_RIGS_COMPARED,
        description="Ids of the skeletons to merge; none: all skeletons of the project.",
    )
    kept: ItemId | None = Field(
        None,
        description="Id of the skeleton that remains. Absent: for each rig, the skeleton with a joint mapping made "
        "by hand, or else the skeleton that most items use.",
    )
    dry_run: bool = Field(False, description="Show what would be merged, and change nothing.")


class NamedSkeleton(Answer):
    """Skeleton in a merge: its id, and its path in the project."""

    id: str
    path: str


class MergedSkeleton(NamedSkeleton):
    """Skeleton that was merged into another one and deleted; it can be restored."""

    moved: dict[str, int] = Field(
        default_factory=dict,
        description="Number of items that got a new revision with the remaining skeleton, by kind of item.",
    )


class MergedRig(Answer):
    """Skeletons of one rig: the skeleton that remains, and the skeletons that are merged into it."""

    kept: NamedSkeleton
    merged: tuple[MergedSkeleton, ...]


class SkeletonMergeAnswer(Answer):
    """Result of a merge of skeletons, or of its preview: for each rig, the skeletons that become one."""

    rigs: tuple[MergedRig, ...]
    dry_run: bool
