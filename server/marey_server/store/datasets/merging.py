"""Merges of versions into branches, and cherry-picks and reverts of single commits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from sqlalchemy import Row

from marey_schemas.datasets.commits import Commit
from marey_schemas.datasets.merges import (
    MOST_CONFLICTING_SEGMENTS,
    MOST_CONFLICTS,
    CombineRequest,
    ConflictingSegment,
    ConflictingSegments,
    EntryConflict,
    MergeAnswer,
    MergeRequest,
    PickRequest,
)
from marey_schemas.kinds import Kind
from marey_schemas.wording import counted
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.store import projects
from marey_server.store.datasets.annotations import AnnotationMerger
from marey_server.store.datasets.chunks import StoredChunks
from marey_server.store.datasets.committing import PreparedCommit, head_of, record_commit, recorded_as
from marey_server.store.datasets.history import CommitReader, read_commit, revisions_with, shown_entry, tree_of
from marey_server.store.datasets.naming import find_dataset, resolve
from marey_server.store.datasets.protection import Mover
from marey_server.store.datasets.revisions import MOST_COMBINED
from marey_server.store.purge_lock import last_purge
from marey_server.store.transaction import Transaction
from marey_versions.ancestry import nearest_common
from marey_versions.annotations import LabelClash, LabelledRange
from marey_versions.choices import Choice
from marey_versions.compared import ComparedEntry, compare_entries
from marey_versions.merging import MergeConflict, MergedEntries, merge_entries
from marey_versions.records import key_of, path_and_kind
from marey_versions.tree.building import build
from marey_versions.tree.difference import difference
from marey_versions.tree.editing import change
from marey_versions.tree.reading import Tree

LARGE_MERGE = "large-merge"
"""Code of the error for a merge that is not computed, because one side has more changes than the caller allows."""


@dataclass(frozen=True)
class PreparedMerge:
    """Merge that was computed, but not recorded; `commit` is the commit to record if there are no conflicts."""

    answer: MergeAnswer
    commit: PreparedCommit


def prepare_merge(
    tx: Transaction, project: str, name: str, request: MergeRequest, *, most: int | None = None
) -> PreparedMerge:
    """Compute the merge of a version into a branch.

    Raises `InvalidProblem` if the branch has all commits of the version, or if a side has more than `most` changes.
    Raises `ConflictProblem` if the branch is not at the expected commit, or if the version and the branch have several
    nearest common commits (merge bases).
    """
    project_row = projects.require(tx, project)
    found = find_dataset(tx, project_row, name)
    if (repeated := _repeated(tx, project, found, request)) is not None:
        return repeated
    theirs = resolve(tx, found.id, request.version)
    started = _start(tx, found, request, theirs, f"Merge {request.version} into {request.into}")
    ours = started.answer.ours
    base = _common(tx, found.id, ours, theirs)
    if base == theirs:
        raise InvalidProblem(
            f"The branch {request.into!r} already has all commits of {request.version!r}.", code="already-merged"
        )
    answer = started.answer.model_copy(update={"base": base})
    commit = replace(started.commit, parents=(ours, theirs), existing=theirs if base == ours else None)
    return _combine(tx, project_row.id, request, PreparedMerge(answer, commit), most)


def prepare_pick(tx: Transaction, project: str, name: str, request: PickRequest, *, undo: bool) -> PreparedMerge:
    """Compute the cherry-pick of a commit onto a branch, or with `undo` the revert of the commit.

    A cherry-pick merges the commit into the branch, with the parent of the commit as the merge base; a revert merges
    the parent, with the commit as the merge base. Raises `InvalidProblem` if the branch would not change, or if the
    commit is a merge and the request does not choose one of its parents.
    """
    project_row = projects.require(tx, project)
    found = find_dataset(tx, project_row, name)
    if (repeated := _repeated(tx, project, found, request)) is not None:
        return repeated
    picked = read_commit(tx, project, name, request.version)
    before = _parent_of(picked, request.parent)
    base, theirs = (picked.digest, before) if undo else (before, picked.digest)
    first_line = picked.message.partition("\n")[0][:100]
    started = _start(tx, found, request, theirs, f"Revert {first_line!r}" if undo else picked.message)
    merge = _combine(
        tx, project_row.id, request, replace(started, answer=started.answer.model_copy(update={"base": base}))
    )
    if not merge.answer.changes and not merge.answer.conflict_count:
        raise InvalidProblem(
            f"The branch {request.into!r} would not change, so there is nothing to commit.", code="no-changes"
        )
    return merge


def _parent_of(picked: Commit, parent: int | None) -> str | None:
    if parent is None and len(picked.parents) > 1:
        raise InvalidProblem(
            "The commit is a merge. Choose the parent with which it is compared: 1 (the branch before the merge) or 2 "
            "(the version that was merged into it).",
            code="is-merge",
        )
    if parent is not None and parent > max(1, len(picked.parents)):
        raise InvalidProblem(
            f"The commit is no merge, so it has no parent {parent}; leave `parent` out.", code="no-parent"
        )
    return picked.parents[(parent or 1) - 1] if picked.parents else None


def _repeated(tx: Transaction, project: str, found: Row[Any], request: CombineRequest) -> PreparedMerge | None:
    """Return the merge that an earlier request with the same `write_id` has recorded; None if there is none.

    The branch and the version of the request may have been deleted since, so neither is looked up.
    """
    recorded = recorded_as(tx, found.id, request.write_id)
    if recorded is None:
        return None
    parents = (*read_commit(tx, project, found.name, recorded).parents, recorded, recorded)
    commit = PreparedCommit(
        found.id, request.into, None, (), request.message, request.write_id, recorded=recorded,
        last_purge=last_purge(tx, found.project_id),
    )  # fmt: skip
    ours, theirs = parents[:2]
    answer = MergeAnswer(commit=None, base=None, ours=ours, theirs=theirs, changes=0, conflicts=(), conflict_count=0)
    return PreparedMerge(answer, commit)


def _start(
    tx: Transaction, found: Row[Any], request: CombineRequest, theirs: str | None, message: str
) -> PreparedMerge:
    """Return a merge of the commit `theirs` into the branch that `request` names; `_combine` then computes its result.

    `message` is the message of the commit if the request contains none. Raises `InvalidProblem` if the branch has no
    commits.
    """
    ours = head_of(tx, found.id, request.into, request.expected)
    if ours is None:
        raise InvalidProblem(f"The branch {request.into!r} has no commits yet; commit to it first.", code="no-commits")
    commit = PreparedCommit(
        found.id, request.into, ours, (ours,), request.message or message, request.write_id,
        last_purge=last_purge(tx, found.project_id),
    )  # fmt: skip
    answer = MergeAnswer(commit=None, base=None, ours=ours, theirs=theirs, changes=0, conflicts=(), conflict_count=0)
    return PreparedMerge(answer, commit)


def _combine(
    tx: Transaction, project_id: str, request: CombineRequest, started: PreparedMerge, most: int | None = None
) -> PreparedMerge:
    """Compute the resulting tree and the conflicts of a merge that `_start` has returned.

    `started.answer` names three commits. The changes from `base` to `theirs` are applied to the tree of `ours`. Raises
    `InvalidProblem` if a side has more than `most` changes, if more than `MOST_COMBINED` entries must be combined, or
    if a resolution of the request resolves no conflict.
    """
    store = StoredChunks(tx)
    answer, commit = started.answer, started.commit
    base, ours, theirs = (
        build(store, []) if one is None else tree_of(tx, commit.dataset_id, one)
        for one in (answer.base, answer.ours, answer.theirs)
    )
    resolutions = [Choice(key_of(one.path, one.kind), one.take, one.part) for one in request.resolutions]
    mine, their = (_changed(store, base, side, most) for side in (ours, theirs))
    annotations = AnnotationMerger(tx, project_id)
    merged = merge_entries(mine, their, resolutions, annotations.merge)
    _require_all_used(merged)
    if len(merged.combined) > MOST_COMBINED:
        raise InvalidProblem(
            f"In {len(merged.combined):,} entries, changes of both sides must be combined, but one merge can combine "
            f"at most {MOST_COMBINED:,}. Merge in several steps: first merge an earlier version.",
            code="too-many-combined",
        )
    tree = change(store, ours, merged.changes)
    held = revisions_with(tx, project_id, _contents(merged.conflicts))
    conflicts = sorted(merged.conflicts, key=lambda one: one.key)
    answer = answer.model_copy(
        update={
            "changes": len(_changed(store, ours, tree)),
            "conflicts": tuple(_shown(one, held) for one in conflicts[:MOST_CONFLICTS]),
            "conflict_count": len(conflicts),
        }
    )
    commit = replace(
        commit, tree=tree, entries=len(Tree(store, tree)), chunks=store.new, combined=merged.combined,
        documents=annotations.documents,
    )  # fmt: skip
    return PreparedMerge(answer, commit)


def _require_all_used(merged: MergedEntries) -> None:
    """Raise `InvalidProblem` if a resolution in the request resolves no conflict.

    One case is allowed: while there are unresolved conflicts, the request may contain a further resolution for an entry
    of which another conflict was resolved.
    """
    unknown = [one for one in merged.unused if one.key not in merged.decided or not merged.conflicts]
    if not unknown:
        return
    (path, kind), part = path_and_kind(unknown[0].key), unknown[0].part
    if part is not None:
        raise InvalidProblem(
            f"The part {part!r} of the {kind} at {path!r} is not in conflict, is decided already, or is not in the "
            f"version {unknown[0].take.value!r}; remove its resolution from the request.",
            code="no-conflict",
        )
    raise InvalidProblem(
        f"The {kind} at {path!r} is not in conflict; remove its resolution from the request.", code="no-conflict"
    )


def record_merge(
    tx: Transaction,
    project: str,
    name: str,
    request: CombineRequest,
    merge: PreparedMerge,
    mover: Mover | None = None,
) -> MergeAnswer:
    """Record the result of a merge, cherry-pick or revert on behalf of `mover`, by default the caller.

    Returns the result. If the request asks for a preview, nothing is recorded.

    Raises `ConflictProblem` if there are conflicts without a resolution, or if the branch has moved.
    """
    if request.preview:
        projects.require(tx, project)
        return merge.answer
    if merge.answer.conflict_count:
        raise ConflictProblem(
            f"{counted(merge.answer.conflict_count, 'entry')} changed on both sides; send a resolution for each.",
            code="merge-conflicts",
            context=merge.answer.model_dump(mode="json"),
            unnamed=True,
        )
    commit = record_commit(tx, project, name, merge.commit, mover)
    return merge.answer.model_copy(update={"commit": commit})


def _changed(store: StoredChunks, base: str, tree: str, most: int | None = None) -> list[ComparedEntry]:
    found = list(islice(difference(store, base, tree), None if most is None else most + 1))
    if most is not None and len(found) > most:
        raise InvalidProblem(
            f"One side of the merge has changed more than {most:,} entries, so this request does not compute the "
            "result; request a preview of the merge.",
            code=LARGE_MERGE,
        )
    return compare_entries(found)


def _contents(conflicts: Iterable[MergeConflict]) -> set[str]:
    return {side.content for one in conflicts for side in (one.base, one.ours, one.theirs) if side is not None}


def _shown(one: MergeConflict, held: Mapping[str, tuple[str, int]]) -> EntryConflict:
    base, ours, theirs = (
        None if side is None else shown_entry(side, held) for side in (one.base, one.ours, one.theirs)
    )
    path, kind = path_and_kind(one.key)
    return EntryConflict(
        path=path, kind=Kind(kind), parts=one.parts, base=base, ours=ours, theirs=theirs,
        reason=_reason(one),
        segments=_shown_segments(one.clash.segments) if one.clash and one.clash.segments else None,
    )  # fmt: skip


def _reason(one: MergeConflict) -> str:
    if one.no_way_back is not None:
        return (
            f"With this resolution, the entry that loses the path would return to {one.no_way_back!r}, but another "
            "entry has this path. Choose the other side, or rename one of the entries before the merge."
        )
    return one.clash.reason if one.clash else ""


def _shown_segments(clash: LabelClash[LabelledRange]) -> ConflictingSegments:
    base, ours, theirs = (
        tuple(ConflictingSegment(**one._asdict()) for one in side[:MOST_CONFLICTING_SEGMENTS])
        for side in (clash.base, clash.ours, clash.theirs)
    )
    return ConflictingSegments(base=base, ours=ours, theirs=theirs)


def _common(tx: Transaction, dataset_id: str, ours: str, theirs: str) -> str | None:
    """Return the merge base of two commits: their nearest common ancestor, or None if there is none.

    Raises `ConflictProblem` if there are several merge bases, none of which is an ancestor of another.
    """
    nearest = nearest_common(CommitReader(tx, dataset_id).read, ours, theirs)
    if len(nearest) > 1:
        raise ConflictProblem(
            "The two versions have several nearest common commits, because each was merged into the other before. "
            "Instead of merging, cherry-pick the commits that the branch lacks.",
            code="several-bases",
            context={"commits": nearest},
            unnamed=True,
        )
    return nearest[0] if nearest else None
