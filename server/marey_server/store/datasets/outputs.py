"""Commits of the outputs of jobs, made in the transactions that end the jobs.

The row of the branch is locked before its tree is read, so that commits of several jobs to one branch follow each
other and none is lost. If the branch has moved since the job started, the outputs are merged with the changes of
others. If others have changed the same part of an entry, the outputs are committed to a new branch, which is named
after the job.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, islice

from sqlalchemy import Row, func, select, update

from marey_schemas.datasets.commits import TIME_OF_COMMIT
from marey_schemas.datasets.naming import RefKind
from marey_schemas.queue.commits import MOST_COMMITTED, MOST_LISTED, CommitConflict
from marey_schemas.wording import counted
from marey_server import faults
from marey_server.errors import NotFoundProblem
from marey_server.store.database.clock import datetime_of
from marey_server.store.datasets.annotations import MOST_MERGED_BY_JOB, AnnotationMerger
from marey_server.store.datasets.chunks import StoredChunks, store_chunks
from marey_server.store.datasets.committing import PreparedCommit, insert_commit, move_branch_to
from marey_server.store.datasets.history import tree_of
from marey_server.store.datasets.naming import MOST_REFS, find_ref, is_tag, new_ref
from marey_server.store.datasets.protection import Mover, require_move
from marey_server.store.datasets.revisions import store_combined
from marey_server.store.projects import find_by_id
from marey_server.store.tables import collection, dataset, dataset_commit, dataset_ref, item
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.compared import ComparedEntry
from marey_versions.merging import MergedEntries, merge_entries
from marey_versions.records import CommitRecord, DatasetEntry, RevisionKey, entry_of, path_and_kind
from marey_versions.tree.building import build
from marey_versions.tree.chunks import Value
from marey_versions.tree.editing import change
from marey_versions.tree.reading import ChunkReader, Tree

LONGEST_PATH = 1280
"""Greatest number of characters in the path of an entry."""


@dataclass(frozen=True)
class OutputEntries:
    """Outputs of a job as entries of a dataset, and the branch that receives them."""

    dataset_id: str
    project_id: str
    branch: str
    base: str | None
    """Newest commit of the branch when the inputs of the job were fixed."""
    entries: Mapping[str, DatasetEntry]
    """The entries by key."""
    revisions: Mapping[str, RevisionKey]
    """The revisions from which the entries were made, by key."""
    message: str
    job_id: str
    author_id: str | None
    """Author of the job."""
    replaced: str | None = None
    """Folder whose other entries are removed; None: nothing is removed."""
    kinds: Collection[str] = ()
    """Kinds of the entries that are removed."""


@dataclass(frozen=True)
class CommittedOutputs:
    """Result of committing the outputs of a job."""

    digest: str | None = None
    """Commit with the outputs; None if no commit was made, for example because no entry changed."""
    conflict: CommitConflict | None = None
    """Reason why the outputs are not on the intended branch."""


def lock_branch(tx: Transaction, dataset_id: str, branch: str, mover: Mover) -> Row[tuple[object, ...]]:
    """Lock a branch until the transaction ends, and return its row.

    Raises `NotFoundProblem` if the dataset or the branch was deleted, `InvalidProblem` for a tag, and the errors of
    `require_move`.
    """
    alive = select(dataset.c.id).where(dataset.c.id == dataset_id, dataset.c.deleted_us.is_(None))
    if tx.execute(alive).first() is None:
        raise NotFoundProblem("The dataset was deleted.", code="no-dataset")
    ref = find_ref(tx, dataset_id, branch, lock=True)
    if ref is None:
        raise NotFoundProblem(f"The dataset has no branch {branch!r}.", code="no-version")
    if ref.kind != RefKind.BRANCH:
        raise is_tag(branch)
    require_move(ref, mover)
    return ref


def commit_outputs(tx: Transaction, wanted: OutputEntries, mover: Mover) -> CommittedOutputs:
    """Commit the outputs of a job to its branch on behalf of `mover`. Raises the errors of `lock_branch`."""
    ref = lock_branch(tx, wanted.dataset_id, wanted.branch, mover)
    store = StoredChunks(tx)
    reader = ChunkReader(store)
    base, head = (
        build(store, []) if one is None else tree_of(tx, wanted.dataset_id, one) for one in (wanted.base, ref.digest)
    )
    entries = _with_removals(Tree(reader, base), wanted)
    if (refused := _unfit(entries)) is not None:
        return CommittedOutputs(conflict=refused)
    annotations = AnnotationMerger(tx, wanted.project_id, MOST_MERGED_BY_JOB)
    merged = _merged(reader, base, head, entries, annotations)
    if merged.conflicts:
        tree = change(store, base, _values(entries))
        return _on_own_branch(tx, wanted, mover, store, tree, merged)
    tree = change(store, head, merged.changes)
    if tree == head:
        return CommittedOutputs()
    parents = () if ref.digest is None else (ref.digest,)
    _store_combined(tx, wanted, merged, annotations)
    digest = _record(tx, wanted, mover, store, tree, parents)
    prepared = PreparedCommit(wanted.dataset_id, wanted.branch, ref.digest, parents, wanted.message, None)
    move_branch_to(tx, prepared, digest, mover)
    _follow_in_folder(tx, wanted, ref.digest, digest, merged.changes)
    tx.emit(
        "branch.moved", wanted.dataset_id, project_id=wanted.project_id, branch=wanted.branch, commit=digest,
        job=wanted.job_id,
    )  # fmt: skip
    faults.point("job_commit.after_move")
    return CommittedOutputs(digest)


# -- entries ----------------------------------------------------------------------------------------------------------


def _with_removals(base: Tree, wanted: OutputEntries) -> dict[str, DatasetEntry | None]:
    """Return the outputs of a job as entries by key, and None for each entry that the job removes.

    A job that replaces the content of a folder removes the other entries of its kinds in this folder of `base`. The
    result has at most one entry more than a commit may have.
    """
    entries: dict[str, DatasetEntry | None] = dict(wanted.entries)
    if wanted.replaced is not None and entries:
        inside = (key for key, _ in base.entries(prefix=f"{wanted.replaced}/"))
        others = (key for key in inside if key not in wanted.entries and path_and_kind(key)[1] in wanted.kinds)
        entries.update(dict.fromkeys(islice(others, max(0, MOST_COMMITTED + 1 - len(entries)))))
    return entries


def _values(entries: Mapping[str, DatasetEntry | None]) -> dict[str, Value | None]:
    return {key: None if one is None else one.value for key, one in entries.items()}


def _unfit(entries: Mapping[str, DatasetEntry | None]) -> CommitConflict | None:
    """Return the reason why no commit can have these entries, or None."""
    if len(entries) > MOST_COMMITTED:
        return too_many_changes()
    long = [path_and_kind(key)[0] for key in entries if len(key.partition("\t")[0]) > LONGEST_PATH]
    if long:
        detail = f"{counted(len(long), 'output')} would have a path of more than {LONGEST_PATH} characters."
        return CommitConflict(code="path-too-long", detail=detail, paths=tuple(long[:MOST_LISTED]), count=len(long))
    return None


def too_many_changes() -> CommitConflict:
    """Return the conflict of a job with more outputs than one commit may have."""
    return CommitConflict(
        code="too-many-changes",
        detail=f"The commit of a job changes at most {MOST_COMMITTED:,} entries. The outputs are in the project; "
        "commit them by a request.",
    )


def _merged(
    reader: ChunkReader,
    base: str,
    head: str,
    entries: Mapping[str, DatasetEntry | None],
    annotations: AnnotationMerger,
) -> MergedEntries:
    """Merge the entries of a job, part by part, with the changes of other commits.

    Other commits have changed the tree `base` to the tree `head`. Only changes at the paths of these entries count.
    """
    before = {key: entry_of(key, value) for key, value in Tree(reader, base).get_several(entries).items()}
    if base == head:
        now = before
    else:
        now = {key: entry_of(key, value) for key, value in Tree(reader, head).get_several(entries).items()}
    others = [_compared(before.get(key), now.get(key)) for key in entries if before.get(key) != now.get(key)]
    own = [_compared(before.get(key), one) for key, one in entries.items() if before.get(key) != one]
    return merge_entries(others, own, {}, annotations.merge)


def _compared(before: DatasetEntry | None, after: DatasetEntry | None) -> ComparedEntry:
    return ComparedEntry(before, after)


# -- writing ----------------------------------------------------------------------------------------------------------


def _store_combined(
    tx: Transaction, wanted: OutputEntries, merged: MergedEntries, annotations: AnnotationMerger
) -> None:
    """Store the revisions of those entries in `merged` that have changes of the job and of somebody else."""
    if merged.combined:
        folder = tx.execute(_FOLDER.where(dataset.c.id == wanted.dataset_id)).scalar()
        store_combined(
            tx, find_by_id(tx, wanted.project_id), folder, merged.combined, annotations.documents, wanted.message,
            author_id=wanted.author_id, job_id=wanted.job_id,
        )  # fmt: skip


_FOLDER = select(collection.c.path).join(dataset, dataset.c.collection_id == collection.c.id)


def _record(
    tx: Transaction, wanted: OutputEntries, mover: Mover, store: StoredChunks, tree: str, parents: Sequence[str]
) -> str:
    """Store a commit and its chunks; return the commit's digest.

    The commit may be stored already: identical jobs that end in one transaction, each with a new branch of its own,
    make the same commit.
    """
    at = datetime_of(tx.now_us).strftime(TIME_OF_COMMIT)
    record = CommitRecord(tree, tuple(parents), mover.name, wanted.message, at)
    of_dataset = (dataset_commit.c.dataset_id == wanted.dataset_id, dataset_commit.c.digest == record.digest)
    if tx.execute(select(dataset_commit.c.digest).where(*of_dataset)).first() is None:
        store_chunks(tx, store.new)
        faults.point("job_commit.after_chunks")
        insert_commit(tx, wanted.dataset_id, record, entries=len(Tree(store, tree)), job_id=wanted.job_id)
        faults.point("job_commit.after_commit")
    return record.digest


def _on_own_branch(
    tx: Transaction, wanted: OutputEntries, mover: Mover, store: StoredChunks, tree: str, merged: MergedEntries
) -> CommittedOutputs:
    """Commit `tree`, the tree with the outputs, to a new branch that begins at the commit from which the job started.

    Returns the commit, and the conflicts in `merged` as the reason why it is not on the intended branch. If the dataset
    has too many branches and tags, no commit is made.
    """
    paths = sorted({path_and_kind(one.key)[0] for one in merged.conflicts})
    changed = f"{counted(len(paths), 'path')} of the outputs changed on {wanted.branch!r} while the job ran"
    conflict = CommitConflict(
        code="paths-changed",
        detail=f"{changed}, the first {paths[0]!r}. The outputs are on a new branch, which can be merged.",
        paths=tuple(paths[:MOST_LISTED]),
        count=len(paths),
    )
    of_dataset = dataset_ref.c.dataset_id == wanted.dataset_id
    if tx.execute(select(func.count()).select_from(dataset_ref).where(of_dataset)).scalar_one() >= MOST_REFS:
        detail = (
            f"{changed}, and the outputs were not committed to a new branch, because the dataset already has "
            f"{MOST_REFS:,} branches and tags, which is the limit. Delete some of them, and submit the job again."
        )
        return CommittedOutputs(conflict=conflict.model_copy(update={"code": "too-many-refs", "detail": detail}))
    digest = _record(tx, wanted, mover, store, tree, () if wanted.base is None else (wanted.base,))
    name = _create_branch(tx, wanted, digest)
    tx.emit(
        "branch.created", wanted.dataset_id, project_id=wanted.project_id, name=name, commit=digest, job=wanted.job_id
    )
    return CommittedOutputs(digest, conflict.model_copy(update={"branch": name}))


def _create_branch(tx: Transaction, wanted: OutputEntries, digest: str) -> str:
    """Create a branch named after the id of the job, with a number if that name is taken; return the name."""
    for number in count(1):
        name = wanted.job_id if number == 1 else f"{wanted.job_id}-{number}"
        row = new_ref(tx, wanted.dataset_id, name, RefKind.BRANCH, digest)
        insertion = tx.insert_or_ignore(dataset_ref, row).returning(dataset_ref.c.name)
        if tx.execute(insertion).first() is not None:
            return name
    raise AssertionError("unreachable")


def _follow_in_folder(
    tx: Transaction, wanted: OutputEntries, before: str | None, digest: str, changes: Mapping[str, Value | None]
) -> None:
    """Record the commit `digest` as checked out in the dataset's folder, if the folder contains its changes already.

    This is so if the commit `before` was checked out in the folder, and each entry in `changes` is the newest revision
    of an item at its path in the folder. Otherwise, nothing is recorded, and a user must check out the commit before
    the next commit of the folder.
    """
    followed = (dataset.c.id == wanted.dataset_id, dataset.c.folder_commit.is_not_distinct_from(before))
    folder = tx.execute(_FOLDER.where(*followed)).scalar()
    if folder is None or not _is_in_folder(tx, folder, wanted, changes):
        return
    tx.execute(update(dataset).where(dataset.c.id == wanted.dataset_id).values(folder_commit=digest))


def _is_in_folder(tx: Transaction, folder: str, wanted: OutputEntries, changes: Mapping[str, Value | None]) -> bool:
    expected: dict[str, tuple[str, int]] = {}
    for key, value in changes.items():
        if value is None or value != wanted.entries[key].value:
            return False
        path = "/".join(filter(None, (folder, path_and_kind(key)[0])))
        expected[wanted.revisions[key].item] = (path, wanted.revisions[key].revision)
    if len(expected) != len(changes):
        return False
    ids = sorted(expected)
    for some in in_lists(ids):
        statement = (
            select(item.c.id, item.c.head, item.c.name, collection.c.path)
            .join(collection, collection.c.id == item.c.collection_id)
            .where(item.c.id.in_(some), item.c.deleted_us.is_(None))
        )
        rows = tx.execute(statement).all()
        if len(rows) != len(some):
            return False
        if any(expected[row.id] != ("/".join(filter(None, (row.path, row.name))), row.head) for row in rows):
            return False
    return True
