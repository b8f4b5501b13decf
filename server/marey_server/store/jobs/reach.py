"""Items that an attempt may read: the inputs of its job, and the items to which these inputs and the parameters refer.

A clip names its skeleton, an annotation its clip, an evaluation its clips. Jobs follow such references while they run.
So an attempt may read the items of its project to which the references lead, and no others. Of a deleted item, it may
read only revisions that are inputs of its job. Such inputs may come from an earlier version of a dataset.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator
from typing import Any, NamedTuple

from sqlalchemy import Text, cast, or_, select

from marey_schemas.lru import LruCache
from marey_server.store.ids import ids_in
from marey_server.store.tables import document, document_blob, item, job, job_blob, revision_part
from marey_server.store.transaction import Transaction, in_lists

PinnedPlace = tuple[str, int]
"""Revision of an item: the id of the item, and the number of the revision."""

MOST_DOCUMENTS = 50_000
"""Greatest number of documents that are searched for references of one job."""
_REMEMBERED_BYTES = 32 << 20
_ENTRY_BYTES = 200

_pins: LruCache[str, Pins] = LruCache(
    max_bytes=_REMEMBERED_BYTES, size_of=lambda pins: _ENTRY_BYTES * (1 + len(pins.places) + len(pins.named))
)
_named: LruCache[str, frozenset[str]] = LruCache(
    max_bytes=_REMEMBERED_BYTES, size_of=lambda named: _ENTRY_BYTES * (1 + len(named))
)
"""Results of `_named_items`, by the id of the job.

The results never become outdated, because neither the inputs and parameters of a job nor revisions change.
"""


class Pins(NamedTuple):
    """Inputs and parameters of a job: the revisions of its inputs, and the ids of items that the parameters name."""

    places: frozenset[PinnedPlace]
    named: frozenset[str]


def unreachable_items(tx: Transaction, wanted: Iterable[str]) -> set[str]:
    """Return those of the wanted items that the caller may not read; empty unless the caller is an attempt."""
    if tx.principal.kind != "attempt":
        return set()
    pins = _pins_of(tx)
    beyond = set(wanted) - pins.named - {one for one, _ in pins.places}
    return beyond.difference(_named_items(tx, pins)) if beyond else beyond


def pinned_places(tx: Transaction) -> frozenset[PinnedPlace]:
    """Return the revisions that are inputs of the attempt's job; empty unless the caller is an attempt."""
    return _pins_of(tx).places if tx.principal.kind == "attempt" else frozenset()


def unreachable_places(tx: Transaction, wanted: Iterable[PinnedPlace]) -> set[PinnedPlace]:
    """Return those of the wanted revisions that the caller may not read; empty unless the caller is an attempt."""
    if tx.principal.kind != "attempt":
        return set()
    pins = _pins_of(tx)
    beyond = set(wanted) - pins.places
    if not beyond:
        return beyond
    named = pins.named | _named_items(tx, pins)
    return {(one, number) for one, number in beyond if one not in named}


def reachable_blobs(tx: Transaction, digests: Collection[str]) -> set[str]:
    """Return those of the given blobs that the caller, an attempt, may read.

    These are the blobs that belong to its job, to the tasks of this job, and to the documents that the attempt may
    read.
    """
    principal = tx.principal
    of_job = (
        select(job_blob.c.blob_digest)
        .join(job, job.c.id == job_blob.c.job_id)
        .where(or_(job.c.id == principal.job_id, job.c.parent_id == principal.job_id))
    )
    of_document = (
        select(document_blob.c.blob_digest, item.c.deleted_us, revision_part.c.item_id, revision_part.c.number)
        .join(revision_part, revision_part.c.document_digest == document_blob.c.document_digest)
        .join(item, item.c.id == revision_part.c.item_id)
        .where(item.c.project_id == principal.project_id)
    )
    found: set[str] = set()
    for some in in_lists(digests):
        found.update(tx.execute(of_job.where(job_blob.c.blob_digest.in_(some))).scalars())
        rows = tx.execute(of_document.where(document_blob.c.blob_digest.in_(some))).all()
        refused = unreachable_places(tx, {(row.item_id, row.number) for row in rows}) if rows else set()
        refused |= {(row.item_id, row.number) for row in rows if row.deleted_us is not None} - pinned_places(tx)
        found.update(row.blob_digest for row in rows if (row.item_id, row.number) not in refused)
    return found


# -- the job ----------------------------------------------------------------------------------------------------------


def _pins_of(tx: Transaction) -> Pins:
    job_id = tx.principal.job_id or ""
    pins = _pins.get(job_id)
    if pins is None:
        row = tx.execute(select(job.c.inputs, job.c.params).where(job.c.id == job_id)).one_or_none()
        inputs: dict[str, Any] = {} if row is None else row.inputs
        places = frozenset((pin["item"], pin["revision"]) for many in inputs.values() for pin in many if "item" in pin)
        pins = Pins(places, frozenset(() if row is None else ids_in(json.dumps(row.params))))
        _pins.put(job_id, pins)
    return pins


# -- what documents name ----------------------------------------------------------------------------------------------


def _named_items(tx: Transaction, pins: Pins) -> frozenset[str]:
    """Return the ids of the items to which references lead from the inputs and parameters of the attempt's job.

    References of these items to further items are followed, too.
    """
    job_id = tx.principal.job_id or ""
    found = _named.get(job_id)
    if found is None:
        found = frozenset(_follow(tx, pins))
        _named.put(job_id, found)
    return found


def _follow(tx: Transaction, pins: Pins) -> set[str]:
    known: set[str] = set()
    searched = 0
    ahead = pins.named | {one for one, _ in pins.places}
    pinned = pins.places
    while ahead and searched < MOST_DOCUMENTS:
        found: set[str] = set()
        for row in _texts(tx, sorted(ahead)):
            if (row.item_id, row.number) in pinned or row.item_id in known or row.item_id in pins.named:
                found.update(ids_in(row.text))
                searched += 1
        ahead = frozenset(found - known - ahead)
        known |= found
    return known


def _texts(tx: Transaction, items: Collection[str]) -> Iterator[Any]:
    """Yield the JSON texts of all documents of items, as rows with the item, the revision and the text."""
    statement = (
        select(revision_part.c.item_id, revision_part.c.number, cast(document.c.body, Text).label("text"))
        .join(document, document.c.digest == revision_part.c.document_digest)
        .join(item, item.c.id == revision_part.c.item_id)
        .where(item.c.project_id == tx.principal.project_id)
    )
    for some in in_lists(items):
        yield from tx.execute(statement.where(revision_part.c.item_id.in_(some)))
