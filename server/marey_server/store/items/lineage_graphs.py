"""Lineage of a revision as a graph, followed through any number of jobs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Literal, NamedTuple

from sqlalchemy import JSON, Column, Row, Select, case, column, func, literal, or_, select
from sqlalchemy.dialects.postgresql import JSONB

from marey_schemas.kinds import Kind
from marey_schemas.lineage import (
    MOST_LINKS,
    MOST_REVISIONS,
    LineageGraph,
    LineageJob,
    LineageLink,
    LineageRequest,
    LineageRevision,
)
from marey_schemas.sizes import batched
from marey_server.store import projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.items.history import find_revision
from marey_server.store.items.reading import find_item
from marey_server.store.tables import collection, item, job, lineage, project, revision
from marey_server.store.transaction import Transaction

Place = tuple[str, int]
"""Id of an item and number of its revision."""


class _Ends(NamedTuple):
    """Columns of `lineage` for one direction of the search.

    A step of the search starts from the revision in `item` and `number`, and reaches the revision in `other_item` and
    `other_number`.
    """

    item: Column[Any]
    number: Column[Any]
    other_item: Column[Any]
    other_number: Column[Any]
    step: Literal[-1, 1]


_TO_INPUTS = _Ends(lineage.c.item_id, lineage.c.number, lineage.c.input_item_id, lineage.c.input_number, -1)
_TO_RESULTS = _Ends(lineage.c.input_item_id, lineage.c.input_number, lineage.c.item_id, lineage.c.number, 1)
_FOLLOWED = {"inputs": (_TO_INPUTS,), "results": (_TO_RESULTS,), "both": (_TO_INPUTS, _TO_RESULTS)}
_AT_ONCE = 500


def read_lineage_graph(
    tx: Transaction, project_name: str, kind: Kind, item_id: str, request: LineageRequest
) -> LineageGraph:
    """Return the graph of the revisions from which a revision was made, and of the revisions made from this revision.

    Revisions that the caller may not read are left out, and so are revisions that are linked only through these. The
    graph holds at most `MOST_REVISIONS` revisions and `MOST_LINKS` links in each direction.
    """
    found = find_item(tx, projects.require(tx, project_name), kind, item_id)
    start = (item_id, request.revision or found.head)
    find_revision(tx, *start)
    walk = _LineageWalk(tx, start)
    for ends in _FOLLOWED[request.direction]:
        walk.follow(ends, request.depth)
    return walk.graph()


class _LineageWalk:
    """Breadth-first search of a lineage, bounded in each direction."""

    def __init__(self, tx: Transaction, start: Place) -> None:
        self._tx = tx
        self._start = start
        self._distances: dict[Place, int] = {start: 0}
        self._links: dict[tuple[Place, Place, str], None] = {}
        self._complete = True

    def follow(self, ends: _Ends, depth: int) -> None:
        """Add the revisions that are at most `depth` jobs away in one direction, the nearest first."""
        most_revisions = len(self._distances) + MOST_REVISIONS
        most_links = len(self._links) + MOST_LINKS
        newest: list[Place] = [self._start]
        for distance in range(1, depth + 1):
            reached: list[Place] = []
            for row in self._linked(newest, ends):
                known, other = (row.item_id, row.number), (row.other_item, row.other_number)
                if other not in self._distances:
                    if len(self._distances) >= most_revisions:
                        self._complete = False
                        continue
                    self._distances[other] = ends.step * distance
                    reached.append(other)
                source, result = (other, known) if ends.step < 0 else (known, other)
                self._links[source, result, row.role] = None
                if len(self._links) >= most_links:
                    self._complete = False
                    return
            newest = reached
            if not newest:
                return

    def _linked(self, places: Collection[Place], ends: _Ends) -> Iterator[Row[Any]]:
        """Yield the links from the given revisions in one direction, if the caller may read the linked revision."""
        statement = (
            select(
                ends.item.label("item_id"), ends.number.label("number"), ends.other_item.label("other_item"),
                ends.other_number.label("other_number"), lineage.c.role,
            )
            .join(item, item.c.id == ends.other_item)
            .join(project, project.c.id == item.c.project_id)
            .where(projects.is_visible(self._tx.principal))
            .limit(MOST_LINKS + 1)  # not ordered: sorting 200,000 clips of one skeleton takes 1.6 s
        )  # fmt: skip
        for some in batched(places, _AT_ONCE):
            # Not pairs: SQLite would scan the table for them.
            both = (ends.item.in_([one for one, _ in some]), ends.number.in_(sorted({number for _, number in some})))
            wanted = set(some)
            rows = self._tx.execute(statement.where(*both)).all()
            if len(rows) > MOST_LINKS:
                self._complete = False
            yield from sorted(row for row in rows if (row.item_id, row.number) in wanted)

    def graph(self) -> LineageGraph:
        """Return the graph: the revisions that were found, the links between them, and the jobs that created them."""
        rows = dict(self._described())
        makers = self._makers({row.job_id for row in rows.values() if row.job_id is not None})
        parents = {name: row.parent_id or name for name, row in makers.items()}
        positions = {place: position for position, place in enumerate(self._distances)}
        return LineageGraph(
            revisions=tuple(
                _shown_revision(rows[place], distance, parents) for place, distance in self._distances.items()
            ),
            links=tuple(
                LineageLink(source=positions[source], result=positions[result], role=role)
                for source, result, role in self._links
            ),
            jobs=tuple(self._jobs(makers, parents)),
            complete=self._complete,
        )

    def _described(self) -> Iterator[tuple[Place, Row[Any]]]:
        statement: Select[*tuple[Any, ...]] = (
            select(
                revision.c.item_id, revision.c.number, revision.c.job_id, revision.c.created_us, item.c.kind,
                item.c.name, item.c.head, item.c.deleted_us, item.c.purged_us, collection.c.path,
            )
            .join(item, item.c.id == revision.c.item_id)
            .join(collection, collection.c.id == item.c.collection_id)
        )  # fmt: skip
        for some in batched(self._distances, _AT_ONCE):
            both = (
                revision.c.item_id.in_([one for one, _ in some]),
                revision.c.number.in_(sorted({number for _, number in some})),
            )
            for row in self._tx.execute(statement.where(*both)):
                if (row.item_id, row.number) in self._distances:
                    yield (row.item_id, row.number), row

    def _makers(self, ids: Collection[str]) -> dict[str, Row[Any]]:
        """Return the rows of the jobs and tasks that have the given ids, as a mapping from id to row."""
        columns = (
            job.c.id, job.c.parent_id, job.c.kind, job.c.seed, job.c.code_version, job.c.finished_us, job.c.committed,
        )  # fmt: skip
        found: dict[str, Row[Any]] = {}
        for some in batched(sorted(ids), _AT_ONCE):
            found |= {row.id: row for row in self._tx.execute(select(*columns).where(job.c.id.in_(some)))}
        return found

    def _jobs(self, makers: Mapping[str, Row[Any]], parents: Mapping[str, str]) -> Iterator[LineageJob]:
        """Yield the jobs of the graph.

        A parent job gets the code versions of its tasks, but only of tasks that created a revision in the graph.
        """
        whole = {**makers, **self._makers(set(parents.values()) - makers.keys())}
        commits = self._commits(set(parents.values()))
        versions: dict[str, set[str]] = defaultdict(set)
        for name, parent in parents.items():
            if whole[name].code_version is not None:
                versions[parent].add(whole[name].code_version)
        for name in sorted(set(parents.values())):
            row = whole[name]
            yield LineageJob(
                id=name, kind=row.kind, seed=row.seed, code_versions=tuple(sorted(versions[name])),
                commits=tuple(sorted(commits[name])), commit=row.committed,
                finished_at=None if row.finished_us is None else datetime_of(row.finished_us),
            )  # fmt: skip

    def _commits(self, ids: Collection[str]) -> dict[str, set[str]]:
        """Return, for each job, the commits of datasets from which the job or its tasks took inputs.

        The database selects the commits, because a job may have 100,000 inputs.
        """
        if self._tx.connection.dialect.name == "postgresql":
            value = column("value", JSONB)
            inputs = func.jsonb_each(job.c.inputs).table_valued(column("key"), value, joins_implicitly=True)
            named = inputs.render_derived()
            listed = case((func.jsonb_typeof(named.c.value) == "array", named.c.value), else_=literal([], JSONB))
            pins = func.jsonb_array_elements(listed).table_valued(value, joins_implicitly=True).render_derived()
        else:
            value = column("value", JSON)
            named = func.json_each(job.c.inputs).table_valued(value, joins_implicitly=True)
            pins = func.json_each(named.c.value).table_valued(value, joins_implicitly=True)
        commit = pins.c.value["commit"].as_string()
        statement = (
            select(func.coalesce(job.c.parent_id, job.c.id).label("whole"), commit.label("commit"))
            .select_from(job, named, pins)
            .distinct()
        )
        found: dict[str, set[str]] = defaultdict(set)
        for some in batched(sorted(ids), _AT_ONCE):
            for row in self._tx.execute(
                statement.where(or_(job.c.id.in_(some), job.c.parent_id.in_(some)), commit.is_not(None))
            ):
                found[row.whole].add(row.commit)
        return found


def _shown_revision(row: Row[Any], distance: int, parents: Mapping[str, str]) -> LineageRevision:
    return LineageRevision(
        item=row.item_id, kind=Kind(row.kind), path=f"{row.path}/{row.name}".lstrip("/"), revision=row.number,
        newest=row.head, deleted=row.deleted_us is not None, purged=row.purged_us is not None, distance=distance,
        job=parents.get(row.job_id), created_at=datetime_of(row.created_us),
    )  # fmt: skip
