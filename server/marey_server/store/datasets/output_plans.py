"""Plans for committing the outputs of jobs. A plan merges the outputs with the commits of others, and writes nothing.

A plan is computed in the transaction that records it, or, for many outputs, in an earlier read transaction. If others
have moved the branch since then, `follow` adds their changes to the plan, unless they concern the same entries.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice

from sqlalchemy import select

from marey_schemas.queue.commits import MOST_LISTED, CommitConflict
from marey_schemas.wording import counted
from marey_server.prepared_documents import PreparedDocument
from marey_server.store.datasets.annotations import MOST_MERGED_BY_JOB, AnnotationMerger
from marey_server.store.datasets.chunks import StoredChunks
from marey_server.store.datasets.history import tree_of
from marey_server.store.datasets.revisions import MOST_COMBINED
from marey_server.store.tables import collection, dataset, item
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.compared import ComparedEntry
from marey_versions.merging import MergedEntries, merge_entries
from marey_versions.records import DatasetEntry, RevisionKey, entry_of, path_and_kind
from marey_versions.tree.building import build
from marey_versions.tree.chunks import Value
from marey_versions.tree.difference import difference
from marey_versions.tree.editing import change
from marey_versions.tree.reading import ChunkReader, Tree

LONGEST_PATH = 1280
"""Greatest number of characters in the path of an entry."""
MOST_FOLLOWED = 1_000
"""Greatest number of changes of others that are added to a plan while the branch is locked."""


@dataclass(frozen=True)
class OutputEntries:
    """Outputs of a job as entries of a dataset, and the branch that receives them."""

    dataset_id: str
    project_id: str
    branch: str
    base: str | None
    """Commit from which the job started: the newest commit of the branch when the job's input revisions were fixed."""
    entries: Mapping[str, DatasetEntry]
    """The entries by key."""
    revisions: Mapping[str, RevisionKey]
    """The revisions from which the entries were made, by key."""
    message: str
    job_id: str
    author_id: str | None
    """Id of the user who is the author of the job; None for a job of the server itself."""
    replaced: str | None = None
    """Folder whose other entries of `kinds` the commit removes, except outputs of the job; None removes nothing."""
    kinds: Collection[str] = ()
    """Kinds of the entries that are removed from the folder `replaced`."""


@dataclass(frozen=True)
class PlannedCommit:
    """Commit of the outputs of a job, computed but not recorded."""

    head: str | None
    """Newest commit of the branch when the plan was computed."""
    refused: CommitConflict | None = None
    """Reason why the outputs cannot be committed; if there is one, the fields below are empty."""
    head_tree: str = ""
    """Tree of the commit `head`."""
    tree: str = ""
    """Tree of the new commit: that of `head` with the outputs.

    If there are conflicts, the outputs go to a new branch, and this is the tree of `OutputEntries.base` with the
    outputs.
    """
    count: int = 0
    """Number of entries of `tree`."""
    chunks: Mapping[str, bytes] = field(default_factory=dict)
    """Chunks of `tree` that may not be stored yet, by digest."""
    merged: MergedEntries = field(default_factory=MergedEntries)
    documents: Mapping[str, PreparedDocument] = field(default_factory=dict)
    """Documents of annotations that were merged, by content digest."""
    keys: Collection[str] = ()
    """Keys of all entries that the job makes or removes."""
    in_folder: bool = False
    """Whether the dataset's folder contains the changes already."""


def plan_outputs(tx: Transaction, wanted: OutputEntries, head: str | None, most: int) -> PlannedCommit:
    """Compute the commit of the outputs of a job to a branch whose newest commit is `head`.

    The commit is refused in three cases: it would add, change and remove more than `most` entries in total; a path is
    too long; or more than `MOST_COMBINED` entries combine a change of the job with a change of others.
    """
    store = StoredChunks(tx)
    reader = ChunkReader(store)
    base, head_tree = (
        build(store, []) if one is None else tree_of(tx, wanted.dataset_id, one) for one in (wanted.base, head)
    )
    entries = _with_removals(Tree(reader, base), wanted, most)
    if (refused := _unfit(entries, most)) is not None:
        return PlannedCommit(head, refused)
    annotations = AnnotationMerger(tx, wanted.project_id, MOST_MERGED_BY_JOB)
    merged = _merged(reader, base, head_tree, entries, annotations)
    if len(merged.combined) > MOST_COMBINED:
        return PlannedCommit(head, too_many_changes(MOST_COMBINED, " that others have changed meanwhile"))
    tree = change(store, base, _values(entries)) if merged.conflicts else change(store, head_tree, merged.changes)
    in_folder = not merged.conflicts and _is_in_folder(tx, wanted, head, merged.changes)
    return PlannedCommit(
        head, None, head_tree, tree, len(Tree(store, tree)), store.new, merged, annotations.documents, entries.keys(),
        in_folder,
    )  # fmt: skip


def follow(tx: Transaction, wanted: OutputEntries, planned: PlannedCommit, head: str | None) -> PlannedCommit | None:
    """Return a plan for the commit `head`, to which others have moved the branch since the plan was computed.

    The new plan keeps all chunks of `planned`, even those that are stored already: a purge of a deleted dataset may
    have deleted them again. A plan with conflicts is returned unchanged. Returns None if the plan must be computed
    again, because it was refused, or because others have changed the same entries as the job or more than
    `MOST_FOLLOWED` entries.
    """
    if planned.head == head or planned.merged.conflicts:  # the commit to a branch of its own stays as it is
        return planned
    if planned.refused is not None or head is None:
        return None
    store = StoredChunks(tx)
    store.save(planned.chunks)
    head_tree = tree_of(tx, wanted.dataset_id, head)
    others: dict[str, Value | None] = {}
    for one in difference(store, planned.head_tree, head_tree):
        if one.key in planned.keys or len(others) == MOST_FOLLOWED:
            return None
        others[one.key] = one.after
    tree = change(store, planned.tree, others)
    return replace(planned, head=head, head_tree=head_tree, tree=tree, count=len(Tree(store, tree)), chunks=store.new)


# -- entries ----------------------------------------------------------------------------------------------------------


def _with_removals(base: Tree, wanted: OutputEntries, most: int) -> dict[str, DatasetEntry | None]:
    """Return the outputs of a job as entries by key, and None for each entry that the job removes.

    A job that replaces the content of a folder removes the other entries of its kinds in this folder of `base`.
    Removals are added only until the result has `most` + 1 entries, because a commit of more than `most` entries is
    refused.
    """
    entries: dict[str, DatasetEntry | None] = dict(wanted.entries)
    if wanted.replaced is not None and entries:
        inside = (key for key, _ in base.entries(prefix=f"{wanted.replaced}/"))
        others = (key for key in inside if key not in wanted.entries and path_and_kind(key)[1] in wanted.kinds)
        entries.update(dict.fromkeys(islice(others, max(0, most + 1 - len(entries)))))
    return entries


def _values(entries: Mapping[str, DatasetEntry | None]) -> dict[str, Value | None]:
    return {key: None if one is None else one.value for key, one in entries.items()}


def _unfit(entries: Mapping[str, DatasetEntry | None], most: int) -> CommitConflict | None:
    """Return the reason why a commit cannot contain these entries, or None if it can.

    It cannot if there are more than `most` entries, or if a path is too long.
    """
    if len(entries) > most:
        return too_many_changes(most)
    long = [path_and_kind(key)[0] for key in entries if len(key.partition("\t")[0]) > LONGEST_PATH]
    if long:
        detail = f"{counted(len(long), 'output')} would have a path of more than {LONGEST_PATH} characters."
        return CommitConflict(code="path-too-long", detail=detail, paths=tuple(long[:MOST_LISTED]), count=len(long))
    return None


def too_many_changes(most: int, condition: str = "") -> CommitConflict:
    """Return the conflict for a job that would commit more than `most` changes.

    The text `condition`, such as " that others have changed", says in the message which entries the limit counts.
    """
    return CommitConflict(
        code="too-many-changes",
        detail=f"The commit of a job can change at most {most:,} entries{condition}. The outputs are in the project; "
        "`marey dataset commit` records those in the folder of the dataset.",
    )


def _merged(
    reader: ChunkReader,
    base: str,
    head: str,
    entries: Mapping[str, DatasetEntry | None],
    annotations: AnnotationMerger,
) -> MergedEntries:
    """Merge the outputs of a job, part by part, with the changes that other commits made to the same entries.

    The job started from the tree `base`; other commits have changed `base` to the tree `head`. `entries` are the
    outputs of the job by key, and None for removed entries.
    """
    before = {key: entry_of(key, value) for key, value in Tree(reader, base).get_several(entries).items()}
    if base == head:
        now = before
    else:
        now = {key: entry_of(key, value) for key, value in Tree(reader, head).get_several(entries).items()}
    others = [_compared(before.get(key), now.get(key)) for key in entries if before.get(key) != now.get(key)]
    own = [_compared(before.get(key), one) for key, one in entries.items() if before.get(key) != one]
    return merge_entries(others, own, (), annotations.merge)


def _compared(before: DatasetEntry | None, after: DatasetEntry | None) -> ComparedEntry:
    return ComparedEntry(before, after)


# -- the folder -------------------------------------------------------------------------------------------------------


def _is_in_folder(
    tx: Transaction, wanted: OutputEntries, head: str | None, changes: Mapping[str, Value | None]
) -> bool:
    """Return whether the dataset's folder already has all changes of a new commit, which then counts as checked out.

    For this, two conditions must be met. The parent `head` of the new commit is checked out in the folder. Each entry
    in `changes` is the newest revision of an item at its path in the folder. A removed entry makes the result false.
    """
    followed = (dataset.c.id == wanted.dataset_id, dataset.c.folder_commit.is_not_distinct_from(head))
    folder = tx.execute(FOLDER.where(*followed)).scalar()
    if folder is None:
        return False
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


FOLDER = select(collection.c.path).join(dataset, dataset.c.collection_id == collection.c.id)
"""Query for the path of the folder of a dataset."""
