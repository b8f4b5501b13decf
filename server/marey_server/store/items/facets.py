"""Facets (named numbers that jobs publish about revisions of their inputs): checks, staging, publication and copies.

An attempt stages facets together with its results. Like results, facets are published when the attempt succeeds,
deleted if it fails, and shared with identical jobs. An attempt can state facets only of the inputs of its job, and of
the clips of evaluations among these inputs. The kind of the job must declare the names of the facets.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import and_, select

from marey_schemas.kinds import Kind
from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.job_kinds import find_kind
from marey_server.errors import InvalidProblem
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import document, item, item_facet, revision, revision_part
from marey_server.store.transaction import Transaction, in_lists

StoredFacets = list[list[Any]]
"""Facets as they are staged: for each revision, a list of the id of the item, the number, and the values by name."""


def stored_facets(tx: Transaction, job_row: Any, facets: Sequence[ItemFacets]) -> StoredFacets:
    """Check the facets that an attempt states, and return them in the form in which they are staged.

    `job_row` has the columns `inputs`, `kind` and `project_id` of the job. Each facet must concern an input of the job,
    or a clip of an evaluation among the inputs. Raises `InvalidProblem` for any other revision, for a revision that
    occurs twice, and for a name that the kind of the job does not declare.
    """
    declared, given = find_kind(job_row.kind).facets, _measured(tx, job_row)
    stated: set[tuple[str, int]] = set()
    for one in facets:
        if (one.item, one.revision) in stated:
            raise InvalidProblem(
                f"The job states facets of {one.item} at revision {one.revision} twice; state them once.",
                code="no-facet-input",
            )
        if (one.item, one.revision) not in given:
            raise InvalidProblem(
                f"The job states facets of {one.item} at revision {one.revision}, which is neither an input of the job "
                "nor a clip of an evaluation among its inputs.",
                code="no-facet-input",
            )
        stated.add((one.item, one.revision))
        if unknown := sorted(one.values.keys() - declared.keys()):
            name = unknown[0]
            raise InvalidProblem(f"The job kind {job_row.kind} does not declare the facet {name!r}.", code="no-facet")
    return [[one.item, one.revision, one.values] for one in facets]


def _measured(tx: Transaction, job_row: Any) -> set[tuple[str, int]]:
    """Return the inputs of a job, and the clips of evaluations among these inputs, as pairs of item and revision."""
    pins = [pin for many in job_row.inputs.values() for pin in many]
    found = {(pin["item"], pin["revision"]) for pin in pins}
    evaluations = sorted({pin["item"] for pin in pins if pin["kind"] == Kind.EVALUATION})
    bodies = (
        select(revision_part.c.item_id, revision_part.c.number, document.c.body)
        .join(document, document.c.digest == revision_part.c.document_digest)
        .where(revision_part.c.part == "evaluation")
    )
    named: set[tuple[str, int]] = set()
    for page in in_lists(evaluations):
        some = revision_part.c.item_id.in_(page)
        for row in tx.execute(bodies.where(some)):
            if (row.item_id, row.number) in found:
                named.update(_pairs(row.body.get("clip_set")))
    return found | _existing(tx, job_row.project_id, named)


def _pairs(clip_set: Any) -> Iterator[tuple[str, int]]:
    """Yield the clips in the member `clip_set` of an evaluation, as pairs of item id and revision number.

    The schema of evaluations does not describe this member, so whatever has another form is skipped.
    """
    clips = clip_set.get("clips") if isinstance(clip_set, Mapping) else None
    for clip in clips if isinstance(clips, list) else ():
        named = (clip.get("item"), clip.get("revision")) if isinstance(clip, Mapping) else (None, None)
        if isinstance(named[0], str) and isinstance(named[1], int):
            yield named[0], named[1]


def _existing(tx: Transaction, project_id: str, named: Collection[tuple[str, int]]) -> set[tuple[str, int]]:
    """Return those of the named revisions that exist in a project."""
    items, found = sorted({one for one, _ in named}), set[tuple[str, int]]()
    for some in in_lists(items):
        statement = (
            select(revision.c.item_id, revision.c.number)
            .join(item, item.c.id == revision.c.item_id)
            .where(revision.c.item_id.in_(some), item.c.project_id == project_id)
        )
        found.update((row.item_id, row.number) for row in tx.execute(statement))
    return found & set(named)


def with_revisions(facets: StoredFacets, revisions: Mapping[tuple[str, int], int]) -> StoredFacets:
    """Return facets that an identical job has staged, rewritten as facets of this job.

    The two jobs may have read different revisions of an item. `revisions` maps each input of the other job (item id and
    revision number) to the revision number that this job read. Facets of items that are no inputs of the job, such as
    clips of an evaluation, are unchanged.
    """
    return [[item_id, revisions.get((item_id, number), number), values] for item_id, number, values in facets]


def publish_facets(tx: Transaction, project_id: str, facets: StoredFacets) -> None:
    """Record the facets that a job states.

    If another job has published a facet of this name for the same revision, its value is replaced. Items that were
    purged since the job stated their facets are left out.
    """
    hold_off_purges(tx, project_id)
    stated: dict[str, list[tuple[int, dict[str, float]]]] = {}
    for one, number, values in sorted(facets, key=lambda fact: (fact[0], fact[1])):
        stated.setdefault(one, []).append((number, values))
    for some in in_lists(stated):
        rows = [
            {"item_id": one, "number": number, "name": name, "value": value}
            for one in _not_purged(tx, project_id, some)
            for number, values in stated[one]
            for name, value in sorted(values.items())
        ]
        if rows:
            added = tx.insert_into(item_facet)
            key = list(item_facet.primary_key.columns)
            tx.execute(added.on_conflict_do_update(index_elements=key, set_={"value": added.excluded.value}), rows)


def facets_of_contents(tx: Transaction, project_id: str, contents: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return the facets of revisions of a project by content digest; contents without facets are left out.

    Revisions with the same content share their facets. If they have different values, the newest revision decides.
    """
    found: dict[str, dict[str, float]] = {}
    wanted = sorted(set(contents))
    for some in in_lists(wanted):
        statement = (
            select(revision.c.content, item_facet.c.name, item_facet.c.value)
            .join(item, item.c.id == revision.c.item_id)
            .join(
                item_facet, and_(item_facet.c.item_id == revision.c.item_id, item_facet.c.number == revision.c.number)
            )
            .where(revision.c.content.in_(some), item.c.project_id == project_id)
            .order_by(revision.c.created_us, revision.c.item_id, revision.c.number)
        )
        for row in tx.execute(statement):
            found.setdefault(row.content, {})[row.name] = row.value
    return found


def fill_facets(tx: Transaction, project_id: str, values: Mapping[str, Mapping[str, float]]) -> None:
    """Add facets to all revisions of a project that have certain contents; existing facets keep their values.

    `values` maps content digests to the values by name. This function is for revisions that come from archives or other
    servers. Facets that a job of this server states are recorded by `publish_facets`.
    """
    contents = sorted(content for content, named in values.items() if named)
    for some in in_lists(contents):
        with_content = (
            select(revision.c.content, revision.c.item_id, revision.c.number)
            .join(item, item.c.id == revision.c.item_id)
            .where(revision.c.content.in_(some), item.c.project_id == project_id, item.c.purged_us.is_(None))
            .order_by(revision.c.item_id, revision.c.number)
        )
        add_facets(tx, [(row.item_id, row.number, values[row.content]) for row in tx.execute(with_content)])


def repeat_facets(tx: Transaction, item_id: str, number: int, again: int) -> None:
    """Copy the facets of revision `number` of an item to the later revision `again`, which has the same content."""
    of_revision = (item_facet.c.item_id == item_id, item_facet.c.number == number)
    rows = tx.execute(select(item_facet.c.name, item_facet.c.value).where(*of_revision))
    add_facets(tx, [(item_id, again, {row.name: row.value for row in rows})])


def add_facets(tx: Transaction, stated: Iterable[tuple[str, int, Mapping[str, float]]]) -> None:
    """Add facets to revisions, each given by item id, number and values by name; existing facets keep their values."""
    rows = [
        {"item_id": one, "number": number, "name": name, "value": value}
        for one, number, values in stated
        for name, value in sorted(values.items())
    ]
    if rows:
        tx.execute(tx.insert_into(item_facet).on_conflict_do_nothing(), rows)


def _not_purged(tx: Transaction, project_id: str, items: Sequence[str]) -> Sequence[str]:
    """Return those items of a project that are not purged, sorted by id.

    The facets of one job are written in this order, but a transaction can publish the facets of several jobs, one job
    after the other. So two transactions can deadlock; `Database.write` then repeats one of them.
    """
    statement = select(item.c.id).where(
        item.c.id.in_(items), item.c.project_id == project_id, item.c.purged_us.is_(None)
    )
    return tx.execute(statement.order_by(item.c.id)).scalars().all()
