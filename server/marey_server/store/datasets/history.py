"""Reading of datasets: commits, entries and differences of versions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import chain, islice, pairwise
from typing import Any, NamedTuple

from sqlalchemy import Row, literal, select

from marey_schemas.datasets.commits import Commit, Entry, EntryOrigins, Origin
from marey_schemas.datasets.differences import ChangeKind, DatasetDifference, EntryDifference, ListedCommit
from marey_schemas.items import Page
from marey_schemas.kinds import Kind
from marey_server.errors import BadRequestProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.datasets.chunks import StoredChunks
from marey_server.store.datasets.naming import find_dataset, first_parents, resolve
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import commit_parent, dataset_commit, item, revision
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.at_path import ChangeAtPath, PathComparer, changes_at, path_after, prefixes_of
from marey_versions.compared import ComparedEntry, compare_entries
from marey_versions.origins import PATH, TAGS, find_origins
from marey_versions.records import DatasetEntry, entry_of, key_of, path_and_kind
from marey_versions.tree.chunks import Value
from marey_versions.tree.reading import ChunkReader, Tree

MOST_EXAMINED = 1000
"""Greatest number of commits that one request searches for changes of a path."""
MOST_DIFFERENCES = 100_000
"""Greatest number of differing entries that are counted in one answer."""
MOST_QUOTED = 200
"""Greatest number of characters that an error quotes from the message of a commit."""


def read_commit(tx: Transaction, project: str, name: str, version: str) -> Commit:
    """Return the commit of a version, which is given as a branch, a tag or a digest."""
    row = find_dataset(tx, projects.require(tx, project), name)
    return _commit(tx, row.id, resolve(tx, row.id, version))


def _commit(tx: Transaction, dataset_id: str, digest: str) -> Commit:
    of_dataset = (dataset_commit.c.dataset_id == dataset_id, dataset_commit.c.digest == digest)
    row = tx.execute(select(dataset_commit).where(*of_dataset)).first()
    if row is None:
        raise NotFoundProblem(f"The dataset has no commit {digest!r}.", code="no-version")
    return _shown(row, _parents(tx, dataset_id, [row])[digest])


def tree_of(tx: Transaction, dataset_id: str, digest: str) -> str:
    """Return the digest of the root of a commit's tree."""
    of_dataset = (dataset_commit.c.dataset_id == dataset_id, dataset_commit.c.digest == digest)
    return str(tx.execute(select(dataset_commit.c.tree).where(*of_dataset)).scalar_one())


def _shown(row: Row[Any], parents: Sequence[str]) -> Commit:
    return Commit(
        digest=row.digest, tree=row.tree, parents=tuple(parents), author=row.author, message=row.message,
        at=datetime.fromisoformat(row.at), entries=row.entries, job=row.job_id,
    )  # fmt: skip


def _parents(tx: Transaction, dataset_id: str, commits: Sequence[Row[Any]]) -> dict[str, list[str]]:
    """Return the parents of commits, given as rows, by digest of the commit."""
    found = {row.digest: [] if row.first_parent is None else [row.first_parent] for row in commits}
    statement = (
        select(commit_parent.c.digest, commit_parent.c.parent)
        .where(commit_parent.c.dataset_id == dataset_id, commit_parent.c.digest.in_(found))
        .order_by(commit_parent.c.digest, commit_parent.c.position)
    )
    for row in tx.execute(statement):
        found[row.digest].append(row.parent)
    return found


def list_commits(
    tx: Transaction, project: str, name: str, version: str, *, path: str, cursor: str | None, limit: int
) -> Page:
    """List a commit and the commits before it, newest first; of the parents of a merge, only the first is followed.

    With `path`, list only the commits that changed entries at this path or below it, compared with their first parent.
    Also report these changes. A page ends after `MOST_EXAMINED` commits or `MOST_DIFFERENCES` compared entries. So it
    may have fewer than `limit` commits although more follow.
    """
    row = find_dataset(tx, projects.require(tx, project), name)
    order = listing.parse_order("place", {"place": literal(0)}, unique="place")
    identity = ["commits", row.id, version, path]
    start = resolve(tx, row.id, version) if cursor is None else listing.read_cursor(tx, cursor, order, identity)[0]
    found = _along_first_parents(tx, row.id, start, MOST_EXAMINED if path else limit)
    chosen: list[tuple[Row[Any], ChangeAtPath | None]] = [(one, None) for one in found[:limit]]
    following = found[limit:][:1]
    if path:
        chosen, following = _changing(tx, found, path, limit)
    parents = _parents(tx, row.id, [one for one, _ in chosen])
    return Page(
        items=tuple(_listed(one, parents[one.digest], change) for one, change in chosen),
        next_cursor=listing.make_cursor(tx, order, identity, [following[0].digest]) if following else None,
    )


def _along_first_parents(tx: Transaction, dataset_id: str, start: str, steps: int) -> Sequence[Row[Any]]:
    """Return the rows of a commit and of at most `steps` earlier commits, found by following first parents."""
    earlier = first_parents(dataset_id, start, steps)
    return tx.execute(
        select(dataset_commit)
        .join(earlier, earlier.c.digest == dataset_commit.c.digest)
        .where(dataset_commit.c.dataset_id == dataset_id)
        .order_by(earlier.c.place)
    ).all()


def _listed(row: Row[Any], parents: Sequence[str], change: ChangeAtPath | None) -> ListedCommit:
    made = dict(_shown(row, parents))
    if change is None:
        return ListedCommit(**made)
    return ListedCommit(**made, changes=dict(change.counts), moved_from=change.moved_from, moved_to=change.moved_to)


def _changing(
    tx: Transaction, commits: Sequence[Row[Any]], path: str, limit: int
) -> tuple[list[tuple[Row[Any], ChangeAtPath | None]], Sequence[Row[Any]]]:
    """Return at most `limit` commits that changed a path, each with the change, and where the next page begins.

    In `commits`, each commit is followed by its first parent. The second result contains the commit with which the next
    page begins, or nothing if there is no next page.
    """
    comparer = PathComparer(ChunkReader(StoredChunks(tx)), path, MOST_DIFFERENCES)
    found: list[tuple[Row[Any], ChangeAtPath | None]] = []
    for place, one in enumerate(commits[:MOST_EXAMINED]):
        if len(found) == limit or comparer.compared > MOST_DIFFERENCES:
            return found, [one]
        before = commits[place + 1].tree if place + 1 < len(commits) else None
        change = comparer.change(before, one.tree)
        if change is not None:
            found.append((one, change))
    return found, commits[MOST_EXAMINED:]


def read_origins(tx: Transaction, project: str, name: str, version: str, *, path: str, kind: Kind) -> EntryOrigins:
    """Return the commits that last changed the parts, the path and the tags of an entry.

    Raises `NotFoundProblem` if the version does not have the entry; the error names the commit that removed it.
    """
    row = find_dataset(tx, projects.require(tx, project), name)
    start, key = resolve(tx, row.id, version), key_of(path, kind)
    reader = ChunkReader(StoredChunks(tx))
    if Tree(reader, tree_of(tx, row.id, start)).get(key) is None:
        raise _no_entry(tx, row.id, start, path, kind)
    commits = CommitReader(tx, row.id)
    found = {
        part: Origin(
            commit=_shown(commits.read(one.commit).row, commits.read(one.commit).parents),
            path=path_and_kind(one.key)[0],
            certain=one.certain,
        )
        for part, one in find_origins(reader, commits.read, start, key, most=MOST_EXAMINED).items()
    }
    return EntryOrigins(path=path, kind=kind, place=found.pop(PATH), tags=found.pop(TAGS), parts=found)


def _no_entry(tx: Transaction, dataset_id: str, start: str, path: str, kind: Kind) -> NotFoundProblem:
    """Return the error for an entry that a version does not have; the error names the commit that removed or moved it.

    The search for this commit follows first parents, through at most `MOST_EXAMINED` commits.
    """
    reader, missing = ChunkReader(StoredChunks(tx)), f"The version has no {kind.value} at {path!r}"
    commits = _along_first_parents(tx, dataset_id, start, MOST_EXAMINED)
    for later, earlier in pairwise(commits):
        if Tree(reader, earlier.tree).get(key_of(path, kind)) is None:
            continue
        to = path_after(reader, earlier.tree, later.tree, key_of(path, kind), most=MOST_DIFFERENCES)
        done = "removed" if to is None else f"moved to {to!r}"
        removed_by = _shown(later, _parents(tx, dataset_id, [later])[later.digest])
        return NotFoundProblem(
            f"{missing}; it was {done} by the commit {later.digest} ({_first_line(later.message)!r}).",
            code="no-entry",
            context={"removed_by": removed_by.model_dump(mode="json"), "moved_to": to},
        )
    searched = f", and neither have the {MOST_EXAMINED:,} versions before it" if len(commits) > MOST_EXAMINED else ""
    return NotFoundProblem(f"{missing}{searched}.", code="no-entry")


def _first_line(message: str) -> str:
    """Return the first line of the message of a commit, shortened to `MOST_QUOTED` characters."""
    line = message.strip().partition("\n")[0]
    return line if len(line) <= MOST_QUOTED else f"{line[:MOST_QUOTED]}…"


@dataclass(frozen=True)
class _ReadCommit:
    """Commit read from the database, in the form that the search for origins needs."""

    row: Row[Any]
    parents: Sequence[str]

    @property
    def tree(self) -> str:
        return str(self.row.tree)

    @property
    def generation(self) -> int:
        return int(self.row.generation)


class CommitReader:
    """Reader of commits of a dataset, which reads each commit at most once."""

    def __init__(self, tx: Transaction, dataset_id: str) -> None:
        self._tx = tx
        self._dataset_id = dataset_id
        self._known: dict[str, _ReadCommit] = {}

    def read(self, digest: str) -> _ReadCommit:
        """Return the commit with this digest, which the dataset must have."""
        if digest not in self._known:
            of_dataset = (dataset_commit.c.dataset_id == self._dataset_id, dataset_commit.c.digest == digest)
            row = self._tx.execute(select(dataset_commit).where(*of_dataset)).one()
            self._known[digest] = _ReadCommit(row, _parents(self._tx, self._dataset_id, [row])[digest])
        return self._known[digest]


# -- entries ----------------------------------------------------------------------------------------------------------


def list_entries(
    tx: Transaction, project: str, name: str, version: str, *, path: str, cursor: str | None, limit: int
) -> Page:
    """List the entries of a version in the order of their paths; with `path`, only those at this path and below it.

    All pages of a list are from the commit that the version names when the list begins.
    """
    project_row = projects.require(tx, project)
    row = find_dataset(tx, project_row, name)
    order = listing.parse_order("key", {"key": literal("")}, unique="key")
    identity = ["entries", row.id, version, path]
    if cursor is None:
        digest, after = resolve(tx, row.id, version), ""
    else:  # from the same commit as the page before, even if the branch has moved
        digest, after = listing.read_cursor(tx, cursor, order, identity)
    found = list(islice(_entries_at(tx, tree_of(tx, row.id, digest), path, after=after), limit + 1))
    entries = [entry_of(*one) for one in found[:limit]]
    following = listing.make_cursor(tx, order, identity, [digest, entries[-1].key]) if len(found) > limit else None
    return Page(items=_shown_entries(tx, project_row.id, entries), next_cursor=following)


def _entries_at(tx: Transaction, tree: str, path: str, *, after: str = "") -> Iterator[tuple[str, Value]]:
    stored = Tree(StoredChunks(tx), tree)
    return chain.from_iterable(stored.entries(after=after, prefix=prefix) for prefix in prefixes_of(path))


class EntryRevision(NamedTuple):
    """Entry of a version, and a revision in the project that has the content of the entry."""

    entry: DatasetEntry
    item: str
    number: int


class VersionEntries(NamedTuple):
    """Entries of one kind in a version of a dataset: those that the project has as revisions, and all others."""

    commit: str
    folder: str
    """Path of the dataset's folder, empty if the dataset has no folder."""
    found: tuple[EntryRevision, ...]
    missing: tuple[DatasetEntry, ...]
    """Entries whose content is not in any revision of the project."""


def entries_of_kind(
    tx: Transaction, project_row: ProjectRow, name: str, version: str, kind: Kind, *, path: str, most: int
) -> VersionEntries:
    """Return at most `most` entries of a kind in a version, at a path and below it, in the order of their paths."""
    row = find_dataset(tx, project_row, name)
    commit = resolve(tx, row.id, version)
    entries = (entry_of(*one) for one in _entries_at(tx, tree_of(tx, row.id, commit), path))
    chosen = list(islice((one for one in entries if one.kind == kind.value), most))
    held = revisions_with(tx, project_row.id, {one.content for one in chosen})
    return VersionEntries(
        commit,
        row.path or "",
        tuple(EntryRevision(one, *held[one.content]) for one in chosen if one.content in held),
        tuple(one for one in chosen if one.content not in held),
    )


def _shown_entries(tx: Transaction, project_id: str, entries: Sequence[DatasetEntry]) -> tuple[Entry, ...]:
    held = revisions_with(tx, project_id, {entry.content for entry in entries})
    return tuple(shown_entry(entry, held) for entry in entries)


def shown_entry(entry: DatasetEntry, held: Mapping[str, tuple[str, int]]) -> Entry:
    """Return an entry as a document; `held` maps content digests to revisions of the project (item id and number)."""
    item_id, number = held.get(entry.content, (None, None))
    return Entry(
        path=entry.path, kind=Kind(entry.kind), parts=dict(entry.parts), tags=entry.tags, item=item_id, revision=number
    )


def revisions_with(tx: Transaction, project_id: str, contents: Iterable[str]) -> dict[str, tuple[str, int]]:
    """Find, for each content digest, a revision of the project that has this content.

    The result maps content digests to item ids and revision numbers. Content digests without a revision are left out. A
    revision of a deleted item is used only if all items with the content are deleted.
    """
    wanted = sorted(set(contents))
    found: dict[str, tuple[str, int]] = {}
    for some in in_lists(wanted):
        statement = (
            select(revision.c.content, revision.c.item_id, revision.c.number)
            .join(item, item.c.id == revision.c.item_id)
            .where(revision.c.content.in_(some), item.c.project_id == project_id)
            .order_by(item.c.deleted_us.is_(None), revision.c.item_id, revision.c.number)
        )
        found.update((row.content, (row.item_id, row.number)) for row in tx.execute(statement))
    return found


# -- differences ------------------------------------------------------------------------------------------------------


def compare_versions(
    tx: Transaction, project: str, name: str, before: str, after: str, *, path: str, limit: int
) -> DatasetDifference:
    """Return the entries that differ in two versions; at most `limit` of them are listed.

    With `path`, compare only the entries at this path or below it. An entry that was moved to this path from elsewhere
    then counts as added, and an entry that was moved away counts as removed. Raises `BadRequestProblem` if the versions
    differ in more than `MOST_DIFFERENCES` entries.
    """
    project_row = projects.require(tx, project)
    row = find_dataset(tx, project_row, name)
    old, new = (_commit(tx, row.id, resolve(tx, row.id, version)) for version in (before, after))
    changes = changes_at(ChunkReader(StoredChunks(tx)), old.tree, new.tree, path)
    found = list(islice(changes, MOST_DIFFERENCES + 1))
    if len(found) > MOST_DIFFERENCES:
        raise BadRequestProblem(
            f"The versions differ in more than {MOST_DIFFERENCES:,} entries; compare versions with fewer commits "
            "between them, or select a `path`.",
            code="large-difference",
        )
    compared = compare_entries(found)
    shown = compared[:limit]
    sides = [side for one in shown for side in (one.before, one.after) if side is not None]
    held = revisions_with(tx, project_row.id, {side.content for side in sides})
    return DatasetDifference(
        before=old,
        after=new,
        counts=dict(Counter(one.change for one in compared)),
        folders=dict(islice(_counts_by_folder(compared).items(), limit)),
        entries=tuple(_shown_difference(one, held) for one in shown),
        complete=len(shown) == len(compared),
    )


def _counts_by_folder(compared: Sequence[ComparedEntry]) -> dict[str, dict[ChangeKind, int]]:
    counts: dict[str, Counter[ChangeKind]] = {}
    for one in compared:
        counts.setdefault(one.present.path.rpartition("/")[0], Counter())[one.change] += 1
    return {folder: dict(counts[folder]) for folder in sorted(counts)}


def _shown_difference(one: ComparedEntry, held: dict[str, tuple[str, int]]) -> EntryDifference:
    before, after = (None if side is None else shown_entry(side, held) for side in (one.before, one.after))
    return EntryDifference(
        path=one.present.path, kind=Kind(one.present.kind), change=one.change,
        was=before.path if before is not None and one.change == "moved" else None,
        parts=dict(one.parts),
        tags_added=tuple(sorted(one.tags_of(one.after) - one.tags_of(one.before))),
        tags_removed=tuple(sorted(one.tags_of(one.before) - one.tags_of(one.after))),
        before=before, after=after,
    )  # fmt: skip
