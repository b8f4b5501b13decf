"""Estimate of the bytes that garbage collection can free after a purge."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from sqlalchemy import Text, cast, exists, func, select

from marey_server.store.tables import blob, document, document_blob, job_blob, revision_part
from marey_server.store.transaction import IN_LIST, Transaction


def freed_by(tx: Transaction, items: Collection[str], jobs: Collection[str]) -> int:
    """Return the sizes of the documents, arrays and files that only revisions of `items`, and `jobs`, refer to.

    Documents that no revision refers to, such as those of a running job, do not count as needing their arrays.
    """
    if not items:
        return 0
    documents = _documents_of(tx, items)
    text_bytes, sizes, needed = 0, dict[str, int](), set[str]()
    lengths = select(func.coalesce(func.sum(func.length(cast(document.c.body, Text))), 0))
    named = select(blob.c.digest, blob.c.size_bytes).join(document_blob, document_blob.c.blob_digest == blob.c.digest)
    for some in _batches(documents):
        text_bytes += tx.execute(lengths.where(document.c.digest.in_(some))).scalar_one()
        for row in tx.execute(named.where(document_blob.c.document_digest.in_(some))):
            sizes[row.digest] = row.size_bytes
    is_part = exists().where(revision_part.c.document_digest == document_blob.c.document_digest)
    referring = select(document_blob.c.blob_digest, document_blob.c.document_digest).where(is_part)
    for some in _batches(sizes.keys()):
        for row in tx.execute(referring.where(document_blob.c.blob_digest.in_(some))):
            if row.document_digest not in documents:
                needed.add(row.blob_digest)
        keeping = select(job_blob.c.blob_digest, job_blob.c.job_id).where(job_blob.c.blob_digest.in_(some))
        needed.update(row.blob_digest for row in tx.execute(keeping) if row.job_id not in jobs)
    return text_bytes + sum(size for digest, size in sizes.items() if digest not in needed)


def _documents_of(tx: Transaction, items: Collection[str]) -> set[str]:
    """Return the digests of the documents that are parts of `items`, and not of any other item."""
    own = select(revision_part.c.document_digest).where(revision_part.c.item_id.in_(items))
    others = exists().where(revision_part.c.document_digest == document.c.digest, revision_part.c.item_id.not_in(items))
    return set(tx.execute(select(document.c.digest).where(document.c.digest.in_(own), ~others)).scalars())


def _batches(digests: Collection[str]) -> Iterator[list[str]]:
    many = sorted(digests)
    return (many[start : start + IN_LIST] for start in range(0, len(many), IN_LIST))
