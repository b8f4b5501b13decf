"""Commits: a read transaction prepares the new version, and a short write transaction records it.

The write transaction checks that the newest commit of the branch is still the one that the read transaction has found.
So a version that was computed from an older commit is never recorded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Row, insert, select, update

from marey_schemas.datasets.commits import (
    TIME_OF_COMMIT,
    Commit,
    CommitCreate,
    EntryChange,
    MoveEntry,
    PutEntry,
    RemoveEntry,
)
from marey_schemas.datasets.naming import RefKind
from marey_schemas.wording import counted
from marey_server import faults
from marey_server.errors import ConflictProblem, InvalidProblem, NotFoundProblem
from marey_server.prepared_documents import PreparedDocument
from marey_server.store import projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.datasets.chunks import StoredChunks, store_chunks
from marey_server.store.datasets.contents import Contents, find_contents_of, store_contents
from marey_server.store.datasets.folders import read_folder, tags_of
from marey_server.store.datasets.history import read_commit, tree_of
from marey_server.store.datasets.manifests import FolderManifest, read_manifest, store_manifest
from marey_server.store.datasets.naming import branch_moved, find_dataset, find_ref, is_tag
from marey_server.store.datasets.protection import Mover, require_move
from marey_server.store.datasets.revisions import store_combined
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges, last_purge, require_no_purge_since
from marey_server.store.tables import commit_parent, dataset, dataset_commit, dataset_ref, fast_forward, item, user
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.merging import CombinedEntry
from marey_versions.records import CommitRecord, DatasetEntry, RevisionKey, entry_of, key_of, path_and_kind
from marey_versions.tree.building import build
from marey_versions.tree.chunks import Value
from marey_versions.tree.editing import change
from marey_versions.tree.reading import Tree


@dataclass(frozen=True)
class FolderCommit:
    """State of the dataset's folder from which a commit is made."""

    rev: int
    """`rev` of the dataset when the folder was read."""
    was: str | None
    """Version that was checked out in the folder when it was read, as stored in `dataset.folder_commit`."""
    partial: FolderManifest | None
    """Manifest of the folder after the commit, except that its field `commit` still names the previous commit.

    None if a whole version is checked out in the folder.
    """


@dataclass(frozen=True)
class PreparedCommit:
    """Move of a branch to a new commit, computed but not recorded."""

    dataset_id: str
    branch: str
    head: str | None
    """Newest commit that the branch must still have when the move is recorded."""
    parents: tuple[str, ...]
    message: str
    write_id: str | None
    tree: str = ""
    entries: int = 0
    chunks: Mapping[str, bytes] = field(default_factory=dict)
    contents: Contents = field(default_factory=Contents)
    combined: Sequence[CombinedEntry] = ()
    """Entries that combine changes of both sides of a merge; the project may not have revisions of them yet."""
    documents: Mapping[str, PreparedDocument] = field(default_factory=dict)
    """New documents of the entries in `combined`, which are not stored yet, by content digest."""
    folder: FolderCommit | None = None
    """Folder from which the entries were read; None if the entries were not read from a folder."""
    existing: str | None = None
    """Existing commit to which the branch moves; None if the branch moves to a new commit."""
    recorded: str | None = None
    """Commit that an earlier request with the same `write_id` has recorded, so that nothing is left to do."""
    last_purge: int = 0
    """Time in microseconds of the last purge of the project before the commit was prepared, 0 if there was none."""


def prepare_commit(tx: Transaction, project: str, name: str, request: CommitCreate) -> PreparedCommit:
    """Compute the version that a request describes.

    Raises `NotFoundProblem` for an unknown branch, entry or item, and `ConflictProblem` if the branch is not at the
    expected commit. Raises `InvalidProblem` if the new version would have the same entries as the version before it.
    """
    project_row = projects.require(tx, project)
    found = find_dataset(tx, project_row, name)
    recorded = recorded_as(tx, found.id, request.write_id)
    # A repeated request gets its commit, even if the branch is gone meanwhile.
    head = None if recorded else head_of(tx, found.id, request.branch, request.expected)
    parents = () if head is None else (head,)
    prepared = PreparedCommit(
        found.id, request.branch, head, parents, request.message, request.write_id, recorded=recorded,
        last_purge=last_purge(tx, project_row.id),
    )  # fmt: skip
    if recorded is not None:
        return prepared
    store = StoredChunks(tx)
    before = None if head is None else tree_of(tx, found.id, head)
    folder = None
    if request.changes is None:
        tree, contents, folder = _from_folder(tx, project_row, found, store, head)
    else:
        tree, contents = _from_changes(tx, project_row, store, before, request.changes)
    if tree == before:
        raise InvalidProblem(f"Nothing has changed since the newest commit of {request.branch!r}.", code="no-changes")
    return replace(
        prepared, tree=tree, entries=len(Tree(store, tree)), chunks=store.new, contents=contents, folder=folder
    )


def record_commit(
    tx: Transaction, project: str, name: str, prepared: PreparedCommit, mover: Mover | None = None
) -> Commit:
    """Record a prepared commit, and move the branch to it on behalf of the `mover`, by default the caller.

    Raises `ConflictProblem` if the branch has moved or items were purged since the commit was prepared, and the errors
    of `require_move`.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_dataset(tx, project_row, name)
    if found.id != prepared.dataset_id:
        raise branch_moved(prepared.branch, None)
    if prepared.write_id is not None:  # so that a repeated request waits for the first one, and finds its commit
        tx.lock(f"commit {found.id} {prepared.write_id}")
    recorded = prepared.recorded or recorded_as(tx, found.id, prepared.write_id)
    if recorded is not None:
        return read_commit(tx, project, name, recorded)
    require_no_purge_since(tx, project_row.id, prepared.last_purge)
    mover = mover or Mover(author_of(tx), project_row.role, user_id=tx.principal.user_id)
    store_contents(tx, prepared.contents)
    if prepared.combined:
        author_id, message = mover.user_id, prepared.message
        store_combined(tx, project_row, found.path, prepared.combined, prepared.documents, message, author_id=author_id)
    find_ref(tx, found.id, prepared.branch, lock=True)  # in the order of jobs that commit: revisions, branch, chunks
    store_chunks(tx, prepared.chunks)
    digest = prepared.existing or _insert(tx, prepared, mover.name)
    if prepared.existing is not None and prepared.write_id is not None:
        tx.execute(insert(fast_forward).values(dataset_id=found.id, write_id=prepared.write_id, digest=digest))
    move_branch_to(tx, prepared, digest, mover)
    if prepared.folder is not None:  # after the branch, as in commits of jobs, so that the two never deadlock
        _follow_with_folder(tx, found.id, prepared.folder, digest)
    tx.emit("branch.moved", found.id, project_id=project_row.id, branch=prepared.branch, commit=digest)
    faults.point("dataset_commit.before_commit")
    tx.after_commit(lambda: faults.point("dataset_commit.after_commit"))
    return read_commit(tx, project, name, digest)


def move_branch_to(tx: Transaction, prepared: PreparedCommit, digest: str, mover: Mover) -> None:
    """Move a branch to a commit that follows its newest commit.

    Raises `ConflictProblem` if the branch has moved since the move was prepared, and the errors of `require_move`.
    """
    moved = (
        update(dataset_ref)
        .where(
            dataset_ref.c.dataset_id == prepared.dataset_id,
            dataset_ref.c.name == prepared.branch,
            dataset_ref.c.kind == RefKind.BRANCH.value,
            dataset_ref.c.digest.is_not_distinct_from(prepared.head),
        )
        .values(digest=digest, updated_us=tx.now_us, rev=dataset_ref.c.rev + 1)
    )
    ref = tx.execute(moved.returning(*dataset_ref.c)).first()
    if ref is None:
        current = find_ref(tx, prepared.dataset_id, prepared.branch)
        raise branch_moved(prepared.branch, None if current is None else current.digest)
    require_move(ref, mover)


def recorded_as(tx: Transaction, dataset_id: str, write_id: str | None) -> str | None:
    """Return the commit that an earlier request with this `write_id` recorded, or None if there was no such request.

    If the request was a fast-forward merge, return the commit to which it moved the branch.
    """
    if write_id is None:
        return None
    for table in (dataset_commit, fast_forward):
        statement = select(table.c.digest).where(table.c.dataset_id == dataset_id, table.c.write_id == write_id)
        if (found := tx.execute(statement).scalar()) is not None:
            return str(found)
    return None


def head_of(tx: Transaction, dataset_id: str, branch: str, expected: str | None) -> str | None:
    """Return the digest of the newest commit of a branch, or None if the branch has no commits.

    Raises `NotFoundProblem` for an unknown branch, `InvalidProblem` for a tag, and `ConflictProblem` if the branch is
    not at the expected commit.
    """
    ref = find_ref(tx, dataset_id, branch)
    if ref is None:
        raise NotFoundProblem(f"The dataset has no branch {branch!r}.", code="no-version")
    if ref.kind != RefKind.BRANCH:
        raise is_tag(branch)
    head: str | None = ref.digest
    if expected is not None and expected != head:
        raise branch_moved(branch, head)
    return head


def _insert(tx: Transaction, prepared: PreparedCommit, author: str) -> str:
    at = datetime_of(tx.now_us).strftime(TIME_OF_COMMIT)
    record = CommitRecord(prepared.tree, prepared.parents, author, prepared.message, at)
    insert_commit(tx, prepared.dataset_id, record, entries=prepared.entries, write_id=prepared.write_id)
    return record.digest


def insert_commit(
    tx: Transaction,
    dataset_id: str,
    record: CommitRecord,
    *,
    entries: int,
    write_id: str | None = None,
    job_id: str | None = None,
) -> None:
    """Store a commit whose tree and parents are stored already; `entries` is the number of entries of the tree."""
    above = select(dataset_commit.c.generation).where(
        dataset_commit.c.dataset_id == dataset_id, dataset_commit.c.digest.in_(record.parents)
    )
    first_parent = record.parents[0] if record.parents else None
    row = {
        "dataset_id": dataset_id, "digest": record.digest, "first_parent": first_parent, "tree": record.tree,
        "author": record.author, "message": record.message, "at": record.at, "entries": entries,
        "write_id": write_id, "job_id": job_id,
        "generation": max((number + 1 for number in tx.execute(above).scalars()), default=0),
    }  # fmt: skip
    tx.execute(insert(dataset_commit).values(**row))
    places = [
        {"dataset_id": dataset_id, "digest": record.digest, "position": place, "parent": parent}
        for place, parent in enumerate(record.parents[1:], start=1)
    ]
    if places:
        tx.execute(insert(commit_parent), places)


def author_of(tx: Transaction) -> str:
    """Return the name of the caller as the author of a commit."""
    name = tx.execute(select(user.c.name).where(user.c.id == tx.principal.user_id)).scalar()
    return str(name or tx.principal.actor)


# -- the content of a folder ------------------------------------------------------------------------------------------


def _require_checked_out(found: Row[Any], manifest: FolderManifest | None, parent: str | None) -> None:
    """Raise `ConflictProblem` if the commit checked out in the folder is not the newest commit of the branch."""
    there = None if manifest is None else manifest.commit
    if there != parent:
        raise ConflictProblem(
            f"The version that is checked out in the folder {found.path!r} is not the newest version of this branch. "
            "Check out the branch, or commit to the branch that is checked out.",
            code="folder-elsewhere",
            context={
                "folder_commit": there, "commit": parent,
                "checked_out": None if manifest is None else manifest.shown,
            },
            unnamed="The version that is checked out in the folder is not the newest version of this branch. Check out "
            "the branch, or commit to the branch that is checked out.",
        )  # fmt: skip


def _from_folder(
    tx: Transaction, project_row: ProjectRow, found: Row[Any], store: StoredChunks, head: str | None
) -> tuple[str, Contents, FolderCommit]:
    """Compute the tree of a new version from the items in the dataset's folder; its new chunks are added to `store`.

    If the branch has a newest commit `head`, the new tree is the tree of `head` with the changes of the folder since
    the checkout. Returns the digest of the root of the new tree, the content digests of the items, and the state of the
    folder. Raises `ConflictProblem` if another version is checked out in the folder.
    """
    manifest = read_manifest(tx, found)
    _require_checked_out(found, manifest, head)
    state = read_folder(tx, project_row, found)
    folder = FolderCommit(found.rev, found.folder_commit, None)
    if head is None or manifest is None:
        return build(store, sorted(state.entries.items())), state.contents, folder
    changes, before = state.changes_since(Tree(store, manifest.tree)), tree_of(tx, found.id, head)
    if manifest.partial:
        _require_selected(found, changes, Tree(store, manifest.tree), Tree(store, before))
        folder = replace(folder, partial=replace(manifest, tree=change(store, manifest.tree, changes)))
    return change(store, before, changes), state.contents, folder


def _require_selected(found: Row[Any], changes: Mapping[str, Value | None], selected: Tree, before: Tree) -> None:
    """Raise `ConflictProblem` if the folder has an item at the path of an entry that was not checked out."""
    hidden = sorted(before.get_several(changes).keys() - selected.get_several(changes).keys())
    if hidden:
        path, kind = path_and_kind(hidden[0])
        raise ConflictProblem(
            f"The folder {found.path!r} has a {kind} at {path!r}, where the version has another {kind} that is not "
            f"checked out. Rename the {kind} in the folder, or check out a selection that includes this path.",
            code="not-checked-out",
            context={"count": len(hidden), "path": path, "kind": kind},
            unnamed="The folder has an item at the path of an entry that is not checked out. Rename the item, or "
            "check out a selection that includes this entry.",
        )


def _follow_with_folder(tx: Transaction, dataset_id: str, folder: FolderCommit, digest: str) -> None:
    """Record that a commit is checked out in the folder from which the commit was made.

    If somebody has checked out a version since the folder was read, the folder no longer has the entries of the commit.
    Then nothing is recorded, because the next commit of the folder would otherwise undo this commit.
    """
    unchanged = (
        dataset.c.id == dataset_id,
        dataset.c.rev == folder.rev,  # a checkout of the version that is checked out already increases it, too
        dataset.c.folder_commit.is_not_distinct_from(folder.was),
    )
    now = digest if folder.partial is None else store_manifest(tx, replace(folder.partial, commit=digest))
    tx.execute(update(dataset).where(*unchanged).values(folder_commit=now))


# -- explicit changes -------------------------------------------------------------------------------------------------


def _from_changes(
    tx: Transaction, project_row: ProjectRow, store: StoredChunks, before: str | None, changes: Sequence[EntryChange]
) -> tuple[str, Contents]:
    """Apply changes, in their order, to the tree `before`, or to an empty tree if `before` is None.

    Returns the digest of the root of the resulting tree, and the content digests of the revisions in the changes.
    """
    before = before or build(store, [])
    put = [one for one in changes if isinstance(one, PutEntry)]
    rows = _items_named(tx, project_row, put)
    wanted = {RevisionKey(one.item, one.revision or rows[one.item].head) for one in put}
    contents = find_contents_of(tx, project_row.id, wanted)
    tags = tags_of(tx, [one.item for one in put])
    keys = {key_of(one.path, one.kind) for one in changes if isinstance(one, RemoveEntry | MoveEntry)}
    keys |= {key_of(one.to, one.kind) for one in changes if isinstance(one, MoveEntry)}
    state: dict[str, Value | None] = dict.fromkeys(keys)
    state.update(Tree(store, before).get_several(keys))
    for one in changes:
        if isinstance(one, PutEntry):
            reference = RevisionKey(one.item, one.revision or rows[one.item].head)
            if reference not in contents.parts:
                raise NotFoundProblem(f"The item {one.item!r} has no revision {one.revision}.", code="no-revision")
            entry = DatasetEntry(one.path, rows[one.item].kind, contents.parts[reference], tags.get(one.item, ()))
            state[entry.key] = entry.value
        else:
            _take_away(state, one)
    return change(store, before, state), contents


def _items_named(tx: Transaction, project_row: ProjectRow, put: Sequence[PutEntry]) -> dict[str, Row[Any]]:
    wanted = sorted({one.item for one in put})
    rows: dict[str, Row[Any]] = {}
    for some in in_lists(wanted):
        statement = select(item.c.id, item.c.kind, item.c.head).where(
            item.c.project_id == project_row.id,
            item.c.deleted_us.is_(None),
            item.c.id.in_(some),
        )
        rows.update((row.id, row) for row in tx.execute(statement))
    if missing := [one for one in wanted if one not in rows]:
        raise NotFoundProblem(
            f"The project lacks {counted(len(missing), 'item')} that the changes name; the first is {missing[0]!r}.",
            code="no-item",
        )
    return rows


def _take_away(state: dict[str, Value | None], one: RemoveEntry | MoveEntry) -> None:
    key = key_of(one.path, one.kind)
    value = state.get(key)
    if value is None:
        raise NotFoundProblem(f"The version has no {one.kind.value} at {one.path!r}.", code="no-entry")
    state[key] = None
    if isinstance(one, MoveEntry):
        target = key_of(one.to, one.kind)
        if state.get(target) is not None:
            raise ConflictProblem(
                f"The version already has a {one.kind.value} at {one.to!r}; move it away or remove it first.",
                code="path-taken",
            )
        state[target] = entry_of(key, value).value  # a damaged entry is not copied
