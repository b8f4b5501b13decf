"""Erasure of items: their content, names and tags, and the traces of these in jobs and events.

One row of each item remains, with its id, its kind, and the times of its creation, deletion and purge. One row of each
revision remains, with its number, its time and the job that made it. Rows of `lineage` refer to the rows that remain.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any

from sqlalchemy import Row, Text, cast, delete, exists, func, select, update

from marey_schemas.kinds import Kind
from marey_server.store import collections, events
from marey_server.store.projects import ProjectRow
from marey_server.store.purging.job_records import forget_in_jobs
from marey_server.store.studies.participants import forget_studies
from marey_server.store.tables import (
    blob,
    collection,
    dataset,
    document,
    document_blob,
    folder_role,
    item,
    item_facet,
    item_tag,
    job,
    job_blob,
    revision,
    revision_part,
    schedule,
)
from marey_server.store.transaction import Transaction, in_lists


def erase(tx: Transaction, project_row: ProjectRow, rows: Sequence[Row[Any]], jobs: Sequence[str], at_us: int) -> None:
    """Erase deleted items, and record an event for each; `jobs` are the jobs that name one of them."""
    ids = [row.id for row in rows]
    forget_in_jobs(tx, frozenset(ids), jobs)
    forget_studies(tx, ids)
    events.forget_names(tx, ids, "name", "collection")
    events.forget_clips(tx, project_row.id, frozenset(ids))
    tx.execute(update(schedule).where(schedule.c.project_id == project_row.id).values(problem=None))
    tx.execute(delete(revision_part).where(revision_part.c.item_id.in_(ids)))
    tx.execute(delete(item_tag).where(item_tag.c.item_id.in_(ids)))
    tx.execute(delete(item_facet).where(item_facet.c.item_id.in_(ids)))
    bare = {"author_id": None, "message": "", "content": None}
    tx.execute(update(revision).where(revision.c.item_id.in_(ids)).values(**bare))
    empty = {
        "name": "", "name_folded": "", "summary": {}, "frames": 0, "skeleton_id": None, "creator_id": None,
        "stored_bytes": 0, "collection_id": collections.ensure(tx, project_row, ""),
    }  # fmt: skip
    changed = {"purged_us": at_us, "updated_us": tx.now_us, "rev": item.c.rev + 1}
    tx.execute(update(item).where(item.c.id.in_(ids)).values(**empty, **changed))
    _drop_empty_folders(tx, project_row.id, {row.path for row in rows})
    for row in rows:
        tx.audit("item.purged", row.id, about=row.id, project_id=project_row.id, item_kind=Kind(row.kind).value)


def _drop_empty_folders(tx: Transaction, project_id: str, paths: Collection[str]) -> None:
    """Erase those deleted folders at and above `paths` that contain no items any more, and their names in events.

    The folder of a dataset remains.
    """
    deleted = (collection.c.project_id == project_id, collection.c.deleted_us.is_not(None))
    used = exists().where(dataset.c.collection_id == collection.c.id)
    found: dict[str, str] = {}  # before the items, because others may delete folders with items at these paths
    for some in in_lists(sorted(set(_with_ancestors(paths)))):
        there = select(collection.c.id, collection.c.path).where(*deleted, ~used, collection.c.path.in_(some))
        found.update((row.id, row.path) for row in tx.execute(there))
    with_items = select(collection.c.path).where(*deleted, exists().where(item.c.collection_id == collection.c.id))
    holding = sorted(tx.execute(with_items).scalars())
    for empty in in_lists(sorted(one for one, path in found.items() if not _is_within(holding, path))):
        tx.execute(delete(folder_role).where(folder_role.c.collection_id.in_(empty)))
        tx.execute(delete(collection).where(collection.c.id.in_(empty)))
        events.forget_names(tx, empty, "path", "was")


def _with_ancestors(paths: Iterable[str]) -> Iterator[str]:
    """Yield each path that is not empty, and the paths of the folders above it."""
    for path in paths:
        while path:
            yield path
            path = path.rpartition("/")[0]


def _is_within(ordered: Sequence[str], folder: str) -> bool:
    """Return whether one of the sorted paths is `folder` or below it."""
    below = f"{folder}/"
    place, first_below = bisect_left(ordered, folder), bisect_left(ordered, below)
    same = place < len(ordered) and ordered[place] == folder
    return same or (first_below < len(ordered) and ordered[first_below].startswith(below))


# -- freed bytes ------------------------------------------------------------------------------------------------------


def freed_by(tx: Transaction, project_id: str, items: Collection[str], jobs: Collection[str]) -> int:
    """Return how many bytes a purge of `items` frees: those of documents, arrays and files that nothing else needs.

    Only references from the same project count: from revisions of other items, and from jobs that are not in `jobs`.
    The content of other projects does not count, because the caller may not know about it.
    """
    if not items:
        return 0
    documents = _documents_of(tx, project_id, items)
    text_bytes, sizes, needed = 0, dict[str, int](), set[str]()
    lengths = select(func.coalesce(func.sum(func.length(cast(document.c.body, Text))), 0))
    named = select(blob.c.digest, blob.c.size_bytes).join(document_blob, document_blob.c.blob_digest == blob.c.digest)
    for some in in_lists(sorted(documents)):
        text_bytes += tx.execute(lengths.where(document.c.digest.in_(some))).scalar_one()
        for row in tx.execute(named.where(document_blob.c.document_digest.in_(some))):
            sizes[row.digest] = row.size_bytes
    is_part = exists().where(
        revision_part.c.document_digest == document_blob.c.document_digest,
        item.c.id == revision_part.c.item_id,
        item.c.project_id == project_id,
    )
    referring = select(document_blob.c.blob_digest, document_blob.c.document_digest).where(is_part)
    for some in in_lists(sorted(sizes)):
        for row in tx.execute(referring.where(document_blob.c.blob_digest.in_(some))):
            if row.document_digest not in documents:
                needed.add(row.blob_digest)
        keeping = (
            select(job_blob.c.blob_digest, job_blob.c.job_id)
            .join(job, job.c.id == job_blob.c.job_id)
            .where(job_blob.c.blob_digest.in_(some), job.c.project_id == project_id)
        )
        needed.update(row.blob_digest for row in tx.execute(keeping) if row.job_id not in jobs)
    return text_bytes + sum(size for digest, size in sizes.items() if digest not in needed)


def _documents_of(tx: Transaction, project_id: str, items: Collection[str]) -> set[str]:
    """Return the digests of the documents that are parts of `items`, and of no other item of the project."""
    own = select(revision_part.c.document_digest).where(revision_part.c.item_id.in_(items))
    others = exists().where(
        revision_part.c.document_digest == document.c.digest,
        item.c.id == revision_part.c.item_id,
        item.c.project_id == project_id,
        item.c.id.not_in(items),
    )
    return set(tx.execute(select(document.c.digest).where(document.c.digest.in_(own), ~others)).scalars())
