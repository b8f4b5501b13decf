"""Selection of entries of a version by query and by paths."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from sqlalchemy import Row, Select, and_, select

from marey_schemas.datasets.checkouts import CheckoutRequest
from marey_schemas.kinds import Kind
from marey_schemas.queries.fields import FACET_PREFIX
from marey_schemas.queries.grammar import Query, conditions_of, likenesses_of, operands_of
from marey_schemas.queries.matching import QueriedFacts, matches
from marey_schemas.sizes import batched
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.store import projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.datasets.chunks import StoredChunks
from marey_server.store.datasets.contents import bodies_of
from marey_server.store.datasets.history import tree_of
from marey_server.store.datasets.naming import find_dataset, resolve
from marey_server.store.items.facets import facets_of_contents
from marey_server.store.items.listing import read_query
from marey_server.store.items.querying import clips_like, sql_of
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.items.summaries import Summary, summarise
from marey_server.store.purge_lock import last_purge
from marey_server.store.tables import item, revision
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.at_path import prefixes_of
from marey_versions.records import DatasetEntry, entry_of
from marey_versions.tree.building import build
from marey_versions.tree.chunks import Value
from marey_versions.tree.reading import ChunkReader, Tree

MOST_SEARCHED = 200_000
"""Greatest number of entries that one query is compared with, one by one."""
SEARCHED_AT_ONCE = 1000
MOST_IN_MEMORY = 200_000
"""Greatest number of content digests that are in memory at the same time; they take about 30 MB."""
OF_ENTRIES = frozenset({"name", "path", "folder", "tag"})
"""Fields of queries whose values come from an entry itself, not from its content."""


@dataclass(frozen=True)
class SelectedEntries:
    """Selected entries of a version, as a tree that is not stored yet."""

    dataset_id: str
    commit: str
    tree: str
    """Root of the tree of the selected entries."""
    chunks: Mapping[str, bytes]
    """Chunks of the tree, by digest."""
    last_purge: int
    """Time in microseconds of the last purge of the project before the entries were selected, 0 if there was none."""


def select_entries(tx: Transaction, project: str, name: str, request: CheckoutRequest) -> SelectedEntries | None:
    """Select the entries of a version that a checkout asks for; return None if it asks for the whole version.

    Raises `NotFoundProblem` if the version has no entry at one of the paths, and `BadRequestProblem` for a query that
    is malformed or has a condition `like(...)`. Raises `InvalidProblem` if no entry is selected, or if too many entries
    must be compared with the query.
    """
    if not request.partial:
        return None
    project_row = projects.require(tx, project)
    found = find_dataset(tx, project_row, name)
    last, commit, store = last_purge(tx, project_row.id), resolve(tx, found.id, request.version), StoredChunks(tx)
    entries = _at_paths(Tree(ChunkReader(store), tree_of(tx, found.id, commit)), request.paths)
    if request.query is not None:
        query = read_query(request.query)
        for likeness in likenesses_of(query):
            clips_like(likeness)  # an index has no older revisions, which versions contain
        entries = _matching(tx, project_row.id, found.path or "", query, entries)
    chosen = list(entries)
    if not chosen:
        raise InvalidProblem(
            "The query selects no entry of this version. List the entries with `marey dataset entries`, then change "
            "the query.",
            code="empty-selection",
        )
    tree = build(store, chosen)
    return SelectedEntries(found.id, commit, tree, store.new, last)


def _at_paths(tree: Tree, paths: Sequence[str]) -> Iterator[tuple[str, Value]]:
    """Return the entries of a tree at the given paths and below them, in the order of their keys; without paths, all.

    Raises `NotFoundProblem` if there is no entry at or below one of the paths.
    """
    if not paths:
        return tree.entries()
    wanted = set(paths)
    chosen: dict[str, Value] = {}
    for path in sorted(wanted):
        entries = chain.from_iterable(tree.entries(prefix=prefix) for prefix in prefixes_of(path))
        first = next(entries, None)
        if first is None:
            raise NotFoundProblem(
                f"The version has no entry at {path!r} or below it; `marey dataset entries` lists the entries.",
                code="no-entry",
            )
        if not wanted.intersection(_folders_above(path)):  # otherwise these entries are read with those of the folder
            chosen.update([first, *entries])
    return iter(sorted(chosen.items()))


def _folders_above(path: str) -> list[str]:
    parts = path.split("/")
    return ["/".join(parts[:end]) for end in range(1, len(parts))]


def _matching(
    tx: Transaction, project_id: str, folder: str, query: Query, entries: Iterable[tuple[str, Value]]
) -> Iterator[tuple[str, Value]]:
    """Yield the entries that a query selects.

    Conditions on path and tags are evaluated first, without a database. Then the database selects the contents that may
    meet the other conditions. Only entries with these contents are compared with the whole query.
    """
    operands = list(operands_of(query))
    early = [one for one in operands if {part.field for part in conditions_of(one)} <= OF_ENTRIES]
    found = _early(entries, early, folder)
    if len(early) == len(operands):
        yield from ((entry.key, entry.value) for entry in found)
        return
    of_content = [one for one in operands if _is_of_content(one)]
    if of_content:
        found = _with_possible_content(tx, project_id, of_content, found)
    for some in batched(_limited(found), SEARCHED_AT_ONCE):
        for entry, facts in _facts(tx, project_id, folder, some):
            if matches(query, facts):
                yield entry.key, entry.value


def _is_of_content(query: Query) -> bool:
    """Return whether a query has conditions only on values that follow from the content of an entry.

    Its conditions are then on columns of items: none is on the path or the tags of an entry, and none on facets.
    """
    fields = {part.field for part in conditions_of(query)}
    return fields.isdisjoint(OF_ENTRIES) and not any(field.startswith(FACET_PREFIX) for field in fields)


def _with_possible_content(
    tx: Transaction, project_id: str, queries: Sequence[Query], entries: Iterable[DatasetEntry]
) -> Iterator[DatasetEntry]:
    """Yield the entries whose content may meet all `queries`.

    The database evaluates the queries for the newest revisions of items. It has no summaries of older revisions, so
    these are assumed to meet the queries. The content digests of all these revisions are read once; if there are more
    than `MOST_IN_MEMORY`, the database is queried for `SEARCHED_AT_ONCE` entries at a time instead.
    """
    newest, older = _possible_contents(project_id, queries)
    possible = set(tx.execute(newest.limit(MOST_IN_MEMORY + 1)).scalars())
    possible.update(tx.execute(older.limit(MOST_IN_MEMORY + 1)).scalars())
    if len(possible) <= MOST_IN_MEMORY:
        yield from (entry for entry in entries if entry.content in possible)
        return
    del possible
    for some in batched(entries, SEARCHED_AT_ONCE):
        among = revision.c.content.in_({entry.content for entry in some})
        found = {*tx.execute(newest.where(among)).scalars(), *tx.execute(older.where(among)).scalars()}
        yield from (entry for entry in some if entry.content in found)


def _possible_contents(
    project_id: str, queries: Sequence[Query]
) -> tuple[Select[*tuple[Any, ...]], Select[*tuple[Any, ...]]]:
    """Return two SQL queries, which select digests of contents.

    The first selects those of the newest revisions that meet `queries`, the second those of all older revisions.
    """
    of_project = (
        select(revision.c.content)
        .join(item, item.c.id == revision.c.item_id)
        .where(item.c.project_id == project_id, item.c.purged_us.is_(None), revision.c.content.is_not(None))
    )
    selected = and_(*(sql_of(one, project_id) for one in queries))
    return of_project.where(revision.c.number == item.c.head, selected), of_project.where(
        revision.c.number != item.c.head
    )


def _early(entries: Iterable[tuple[str, Value]], early: Sequence[Query], folder: str) -> Iterator[DatasetEntry]:
    for key, value in entries:
        entry = entry_of(key, value)
        if all(matches(one, _facts_of(entry, folder)) for one in early):
            yield entry


def _limited(entries: Iterable[DatasetEntry]) -> Iterator[DatasetEntry]:
    for number, entry in enumerate(entries):
        if number == MOST_SEARCHED:
            raise InvalidProblem(
                f"The query would have to be compared with more than {MOST_SEARCHED:,} entries. Select folders with "
                "`paths`, or add a condition on `folder`, `path`, `name` or `tag`.",
                code="large-selection",
            )
        yield entry


# -- facts ------------------------------------------------------------------------------------------------------------


def _facts_of(entry: DatasetEntry, folder: str, **more: Any) -> QueriedFacts:
    inside, _, name = "/".join(filter(None, (folder, entry.path))).rpartition("/")
    return QueriedFacts(name=name, folder=inside, tags=entry.tags, **more)


def _facts(
    tx: Transaction, project_id: str, folder: str, entries: Sequence[DatasetEntry]
) -> Iterator[tuple[DatasetEntry, QueriedFacts]]:
    """Yield entries, each with the values that a query can compare.

    The name, the folder and the tags come from the entry. All other values come from a revision that has the content
    of the entry. An entry whose content was purged is left out.
    """
    contents = [entry.content for entry in entries]
    rows = _revisions(tx, project_id, contents)
    summaries = _summaries(tx, rows)
    names = _names(tx, project_id, {one.skeleton_id for one in summaries.values() if one.skeleton_id is not None})
    facets = facets_of_contents(tx, project_id, rows)
    for entry, content in zip(entries, contents, strict=True):
        if (row := rows.get(content)) is None:
            continue
        summary = summaries[content]
        newest = row.head == row.number
        facts = _facts_of(
            entry, folder, revision=row.number, created_at=datetime_of(row.item_created_us),
            updated_at=datetime_of(row.updated_us if newest else row.created_us), summary=summary.shown,
            frames=summary.frames, skeleton=summary.skeleton_id, skeleton_name=names.get(summary.skeleton_id or ""),
            facets=facets.get(content, {}),
        )  # fmt: skip
        yield entry, facts


def _revisions(tx: Transaction, project_id: str, contents: Collection[str]) -> dict[str, Row[Any]]:
    """Return, by content digest, a revision of the project with this content, preferably the newest of its item."""
    found: dict[str, Row[Any]] = {}
    wanted = sorted(set(contents))
    for some in in_lists(wanted):
        statement = (
            select(
                revision.c.content, revision.c.item_id, revision.c.number, revision.c.created_us, item.c.kind,
                item.c.head, item.c.summary, item.c.frames, item.c.skeleton_id, item.c.updated_us,
                item.c.created_us.label("item_created_us"),
            )
            .join(item, item.c.id == revision.c.item_id)
            .where(revision.c.content.in_(some), item.c.project_id == project_id, item.c.purged_us.is_(None))
            .order_by(item.c.head == revision.c.number, item.c.deleted_us.is_(None), item.c.id, revision.c.number)
        )  # fmt: skip
        found.update((row.content, row) for row in tx.execute(statement))
    return found


def _summaries(tx: Transaction, rows: Mapping[str, Row[Any]]) -> dict[str, Summary]:
    """Return the summaries of the revisions in `rows`, by content digest.

    Only the summary of an item's newest revision is stored; the others are computed from the documents.
    """
    older = {content: (row.item_id, row.number) for content, row in rows.items() if row.head != row.number}
    parts = read_part_digests(tx, set(older.values()))
    bodies = bodies_of(tx, {digest for digests in parts.values() for digest in digests.values()}) if older else {}
    made = {
        content: summarise(Kind(rows[content].kind), {part: bodies[one] for part, one in parts[key].items()})
        for content, key in older.items()
    }
    stored = {
        content: Summary(row.summary, row.frames, row.skeleton_id)
        for content, row in rows.items()
        if content not in older
    }
    return stored | made


def _names(tx: Transaction, project_id: str, skeletons: Collection[str]) -> dict[str, str]:
    """Return the names of skeletons by id; deleted skeletons are left out."""
    named = select(item.c.id, item.c.name).where(
        item.c.id.in_(sorted(skeletons)), item.c.project_id == project_id, item.c.deleted_us.is_(None)
    )
    return {row.id: row.name for row in tx.execute(named)}
