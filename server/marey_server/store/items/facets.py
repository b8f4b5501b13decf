"""Facets that the results of jobs state about inputs: their check when a result is staged, and their publication.

They are stored with the draft of the result, so they are published, dropped or shared with identical jobs as the result
is. An attempt can state facets only of the inputs of its job, and only those that the kind of the job declares.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import select

from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.job_kinds import find_kind
from marey_server.errors import InvalidProblem
from marey_server.store.tables import item, item_facet
from marey_server.store.transaction import Transaction, in_lists

StoredFacets = list[list[Any]]
"""Facets in a draft: for each item its id, the number of its revision, and the values by name."""


def stored_facets(facets: Sequence[ItemFacets], kind: str, inputs: Iterable[tuple[str, int]]) -> StoredFacets:
    """Return facets as they are stored in a draft; `inputs` are the ids and revisions of the inputs of the job.

    Raises `InvalidProblem` for a revision that is not an input of the job, one that occurs twice, and for a name that
    the kind of the job does not declare.
    """
    if not facets:
        return []
    declared, given = find_kind(kind).facets, set(inputs)
    for one in facets:
        if (one.item, one.revision) not in given:
            raise InvalidProblem(
                f"A result states facets of {one.item} at revision {one.revision}, which is not an input of the job; "
                "or it states them twice.",
                code="no-facet-input",
            )
        given.discard((one.item, one.revision))
        if unknown := sorted(one.values.keys() - declared.keys()):
            name = unknown[0]
            raise InvalidProblem(f"The job kind {kind} does not declare the facet {name!r}.", code="no-facet")
    return [[one.item, one.revision, one.values] for one in facets]


def with_revisions(facets: StoredFacets, revisions: Mapping[tuple[str, int], int]) -> StoredFacets:
    """Return facets of the inputs of one job as those of an identical job; `revisions` has the revision of each."""
    return [[item_id, revisions[item_id, number], values] for item_id, number, values in facets]


def publish_facets(tx: Transaction, job_id: str, project_id: str, facets: Iterable[StoredFacets]) -> None:
    """Record the facets that the results of a job state.

    If another job has published a facet of the same revision, its value is replaced. Items that were purged meanwhile
    are left out.
    """
    values = {(one, number): named for stated in facets for one, number, named in stated}
    items = sorted({one for one, _ in values})
    for some in in_lists(items):
        kept = _lock_items(tx, project_id, some)
        rows = [
            {
                "item_id": one, "number": number, "name": name, "value": value, "job_id": job_id,
                "published_us": tx.now_us,
            }
            for one, number in sorted(values.keys())
            if one in kept
            for name, value in sorted(values[one, number].items())
        ]  # fmt: skip
        if rows:
            added = tx.insert_into(item_facet)
            newer = {name: added.excluded[name] for name in ("value", "job_id", "published_us")}
            key = list(item_facet.primary_key.columns)
            tx.execute(added.on_conflict_do_update(index_elements=key, set_=newer), rows)


def _lock_items(tx: Transaction, project_id: str, items: Sequence[str]) -> set[str]:
    """Return those items of a project that are not purged, and let no purge of them begin before the end of the write.

    They are locked in the order of their ids, as by purges, so that no two writes wait for each other.
    """
    statement = (
        select(item.c.id)
        .where(item.c.id.in_(items), item.c.project_id == project_id, item.c.purged_us.is_(None))
        .order_by(item.c.id)
        .with_for_update(read=True, key_share=True)
    )
    return set(tx.execute(statement).scalars())
