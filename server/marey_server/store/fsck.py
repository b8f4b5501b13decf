"""Checks of the store: the digests of blobs, and references between rows.

The checks can run while a server runs, because they use short reads of bounded size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

from sqlalchemy import Column, Row, Select, Table, and_, exists, func, select, text

from marey_schemas.datasets.naming import RefKind
from marey_schemas.datasets.proposal_states import ProposalState
from marey_schemas.documents.blob_references import references_of
from marey_schemas.encoding.arrays import ArrayError, EncodedArray
from marey_schemas.encoding.canonical import array_digest, canonical_json
from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import PARTS, Kind
from marey_server.access.principal import SYSTEM
from marey_server.access.webhook_signatures import is_secret
from marey_server.store.blobs import read_blob
from marey_server.store.database.connections import Database
from marey_server.store.datasets.chunks import StoredChunks, chunk_in
from marey_server.store.datasets.history import revisions_with
from marey_server.store.datasets.manifests import read_manifest
from marey_server.store.documents import items_named_in
from marey_server.store.events import newest_number
from marey_server.store.items.summaries import summarise
from marey_server.store.jobs.inputs import NamingJob
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.object_upkeep.checking import PAGE, StoreDefect, check_blob, check_objects
from marey_server.store.quotas import holdings
from marey_server.store.tables import (
    blob,
    collection,
    commit_parent,
    dataset,
    dataset_commit,
    dataset_ref,
    document,
    document_blob,
    document_item,
    item,
    item_facet,
    item_tag,
    job,
    job_item,
    project,
    proposal,
    revision,
    revision_part,
    tree_chunk,
    upload,
    upload_chunk,
    user,
    webhook,
    webhook_delivery,
)
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord, entry_of
from marey_versions.tree.chunks import Branch, DamagedChunk, Leaf, decode
from marey_versions.tree.reading import Tree

MISCOUNTED = "counter-wrong"
"""Code of defects that `check_store` can repair."""


def check_store(
    database: Database, *, progress: Callable[[str, int], None] | None = None, repair: bool = False
) -> Iterator[StoreDefect]:
    """Yield all defects as they are found.

    From time to time, `progress` is called with the name of a check and the number of rows that it has examined. With
    `repair`, wrong counters of items and bytes are corrected at the end; they are yielded as defects, too.
    """
    yield from database.read(SYSTEM, _check_file)
    passes: tuple[tuple[str, Table, Callable[[Transaction, Row[Any]], list[StoreDefect]]], ...] = (
        ("blobs", blob, check_blob),
        ("documents", document, _check_document),
        ("items", item, _check_item),
        ("collections", collection, _check_collection),
        ("uploads", upload, _check_upload),
        ("tree chunks", tree_chunk, _check_chunk),
        ("datasets", dataset, _check_dataset),
        ("jobs", job, _check_job),
        ("webhooks", webhook, _check_webhook),
        ("projects", project, partial(_check_holding, owner=item.c.project_id)),
        ("users", user, partial(_check_holding, owner=item.c.creator_id)),
    )
    for number, findings in enumerate(check_objects(database), 1):
        yield from findings
        if progress is not None:
            progress("objects", number)
    rows_at_once = 1 if isinstance(database.blobs, ObjectBlobs) else PAGE  # whose bytes are kept until the page ends
    miscounted = False
    for name, table, check in passes:
        behind, count = "", 0
        while page := database.read(SYSTEM, _check_page, table, check, behind, rows_at_once):
            behind, count = page[-1][0], count + len(page)
            for _key, findings in page:
                miscounted = miscounted or any(one.code == MISCOUNTED for one in findings)
                yield from findings
            if progress is not None:
                progress(name, count)
    if miscounted and repair:
        database.write(SYSTEM, holdings.recount)


def _check_page(
    tx: Transaction, table: Table, check: Callable[[Transaction, Row[Any]], list[StoreDefect]], behind: str, limit: int
) -> list[tuple[str, list[StoreDefect]]]:
    key = table.primary_key.columns[0]
    rows = tx.execute(select(table).where(key > behind).order_by(key).limit(limit)).all()
    return [(row._mapping[key], check(tx, row)) for row in rows]


def _check_file(tx: Transaction) -> list[StoreDefect]:
    """Return the faults of an SQLite file: damaged pages, and references to missing rows. On Postgres, return none."""
    if tx.is_postgres:
        return []
    pages = [row[0] for row in tx.execute(text("PRAGMA integrity_check(100)")) if row[0] != "ok"]
    findings = [StoreDefect("broken-database", "database", line) for line in pages]
    dangling = tx.execute(text("PRAGMA foreign_key_check")).mappings()
    return findings + [
        StoreDefect("dangling-reference", place, f"refers to a missing row of {row['parent']}")
        for row in dangling
        for place in [row["table"] if row["rowid"] is None else f"{row['table']}/{row['rowid']}"]
    ]


def _check_document(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    findings = []
    if digest_of(canonical_json(row.body)) != row.digest:
        findings.append(StoreDefect("document-corrupt", row.digest, "the text does not have this digest"))
    arrays, files = references_of(row.schema, row.body)
    file_bytes = select(func.coalesce(func.sum(blob.c.size_bytes), 0)).where(blob.c.digest.in_(set(files.values())))
    if tx.execute(file_bytes).scalar_one() != row.file_bytes:
        detail = "the files to which it refers have another total size than recorded"
        findings.append(StoreDefect("document-reference", row.digest, detail))
    statement = select(document_blob.c.pointer, document_blob.c.blob_digest, blob.c.size_bytes)
    statement = statement.outerjoin(blob, blob.c.digest == document_blob.c.blob_digest)
    held = {
        found.pointer: found for found in tx.execute(statement.where(document_blob.c.document_digest == row.digest))
    }
    for pointer in sorted(held.keys() ^ (arrays.keys() | files.keys())):
        what = "has no blob" if pointer not in held else "is not a reference, but has a blob"
        findings.append(StoreDefect("document-reference", row.digest, f"{pointer} {what}"))
    named_items = select(document_item.c.item_id).where(document_item.c.document_digest == row.digest)
    if set(tx.execute(named_items).scalars()) != items_named_in(row.body):
        detail = "it refers to other items than the table document_item records"
        findings.append(StoreDefect("document-reference", row.digest, detail))
    for pointer, named in files.items():
        if pointer in held and held[pointer].blob_digest != named:
            detail = f"{pointer} names another blob than recorded"
            findings.append(StoreDefect("document-reference", row.digest, detail))
    for pointer, leaf in arrays.items():
        if pointer in held and held[pointer].size_bytes is not None:
            findings += _check_array(tx, row.digest, pointer, leaf, held[pointer])
    return findings


def _check_array(tx: Transaction, digest: str, pointer: str, leaf: dict[str, Any], held: Row[Any]) -> list[StoreDefect]:
    data = read_blob(tx, held.blob_digest, 0, held.size_bytes)
    try:
        content = array_digest(EncodedArray(leaf["dtype"], tuple(leaf["shape"]), data))
    except ArrayError as error:
        return [StoreDefect("array-corrupt", digest, f"{pointer}: {error}")]
    if content != leaf["content"]:
        return [StoreDefect("array-corrupt", digest, f"{pointer}: the array has another digest than the document says")]
    return []


def _check_item(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    kind = Kind(row.kind)
    counts = select(func.count(), func.max(revision.c.number)).where(revision.c.item_id == row.id)
    count, newest = tuple(tx.execute(counts).one())
    if (count, newest) != (row.head, row.head):
        detail = f"it has {count} revisions up to number {newest}, but the newest should have the number {row.head}"
        return [StoreDefect("revisions-lost", row.id, detail)]
    if row.purged_us is not None:
        return _check_purged(tx, row)
    findings = []
    bodies, complete = {}, True
    for found in tx.execute(_head_parts(row)):
        complete = complete and found.body is not None
        bodies[found.part] = found.body
        if found.body is None:
            detail = f"the document {found.document_digest} of the part {found.part} of revision {row.head} is missing"
            findings.append(StoreDefect("document-lost", row.id, detail))
    lacking = [part for part, spec in PARTS[kind].items() if spec.required and part not in bodies]
    findings += [StoreDefect("part-lost", row.id, f"revision {row.head} has no part {part}") for part in lacking]
    if complete and not lacking:
        summary = summarise(kind, bodies)
        if (summary.shown, summary.frames, summary.skeleton_id) != (row.summary, row.frames, row.skeleton_id):
            findings.append(StoreDefect("summary-wrong", row.id, "the summary does not match the newest revision"))
        findings += _check_named_items(tx, row, bodies)
    if (size := tx.execute(select(holdings.BYTES_OF_ITEM).where(item.c.id == row.id)).scalar_one()) != row.stored_bytes:
        detail = f"its revisions take {size} bytes, but {row.stored_bytes} are recorded"
        findings.append(StoreDefect(MISCOUNTED, row.id, detail))
    place = tx.execute(select(collection).where(collection.c.id == row.collection_id)).first()
    if place is None or place.project_id != row.project_id or (row.deleted_us is None) > (place.deleted_us is None):
        findings.append(
            StoreDefect("misplaced-item", row.id, "its collection is deleted, missing, or in another project")
        )
    return findings


def _check_purged(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return a fault if anything is left of the content, the name or the tags of a purged item."""
    left = [
        table.name
        for table in (revision_part, item_tag, item_facet)
        if tx.execute(select(table).where(table.c.item_id == row.id).limit(1)).first() is not None
    ]
    left += [name for name in ("name", "summary", "stored_bytes") if row._mapping[name]]
    return [StoreDefect("purge-incomplete", row.id, f"the item was purged, but has {', '.join(left)}")] if left else []


def _head_parts(row: Row[Any]) -> Select[*tuple[Any, ...]]:
    return (
        select(revision_part.c.part, revision_part.c.document_digest, document.c.body)
        .outerjoin(document, document.c.digest == revision_part.c.document_digest)
        .where(revision_part.c.item_id == row.id, revision_part.c.number == row.head)
    )


def _check_named_items(tx: Transaction, row: Row[Any], bodies: dict[str, dict[str, Any]]) -> list[StoreDefect]:
    named = {"motion": ("motion", "skeleton"), "annotation": ("annotation", "clip")}
    if row.kind not in (Kind.CLIP, Kind.ANNOTATION):
        return []
    part, member = named["motion" if row.kind == Kind.CLIP else "annotation"]
    ref = bodies[part][member]
    there = exists().where(and_(revision.c.item_id == ref["item"], revision.c.number == ref["revision"]))
    if tx.execute(select(there)).scalar():
        return []
    return [StoreDefect("dangling-reference", row.id, f"{member} {ref['item']} has no revision {ref['revision']}")]


def _check_collection(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    if not row.path or row.deleted_us is not None:
        return []
    parent = row.path.rpartition("/")[0]
    above = exists().where(
        collection.c.project_id == row.project_id, collection.c.path == parent, collection.c.deleted_us.is_(None)
    )
    if tx.execute(select(above)).scalar():
        return []
    return [StoreDefect("orphan-collection", row.id, f"{row.path!r} is in {parent!r}, which does not exist")]


def _check_holding(tx: Transaction, row: Row[Any], owner: Column[str]) -> list[StoreDefect]:
    """Return a fault if the stored counts of a project's or user's items and bytes are wrong.

    `owner` is the column of `item` that names the project or user.
    """
    counted, recorded = holdings.count_held(tx, owner, row.id), holdings.read_held(tx, row.id)
    return (
        []
        if counted == recorded
        else [StoreDefect(MISCOUNTED, row.id, f"it has {counted}, but {recorded} are recorded")]
    )


def _check_upload(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    if row.finished_digest is not None or row.dropped:
        return []
    held = select(func.coalesce(func.sum(func.length(upload_chunk.c.data)), 0)).where(
        upload_chunk.c.upload_id == row.id
    )
    size = tx.execute(held).scalar_one()
    return (
        []
        if size == row.offset
        else [StoreDefect("upload-incomplete", row.id, f"only {size} of {row.offset} bytes are stored")]
    )


def _check_chunk(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return the faults of one chunk of a tree of entries: it is damaged, or a chunk below it is missing."""
    try:
        chunk = decode(row.digest, chunk_in(row.data))
    except DamagedChunk as error:
        return [StoreDefect("chunk-corrupt", row.digest, str(error))]
    below = {child.digest for child in chunk.children} if isinstance(chunk, Branch) else set()
    there = set(tx.execute(select(tree_chunk.c.digest).where(tree_chunk.c.digest.in_(sorted(below)))).scalars())
    return [StoreDefect("chunk-lost", row.digest, f"the chunk {one} below it is missing") for one in below - there]


def _check_dataset(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return the faults of the commits, entries and proposals of a dataset."""
    above = select(commit_parent).where(commit_parent.c.dataset_id == row.id).order_by(commit_parent.c.position)
    parents: dict[str, list[str]] = {}
    for found in tx.execute(above):
        parents.setdefault(found.digest, []).append(found.parent)
    commits = select(dataset_commit).where(dataset_commit.c.dataset_id == row.id)
    findings = []
    there, first_parents = set[str](), set[str]()
    for one in tx.execute(commits.execution_options(yield_per=1000)):
        first = () if one.first_parent is None else (one.first_parent,)
        there.add(one.digest)
        first_parents.update(first)
        record = CommitRecord(one.tree, (*first, *parents.get(one.digest, ())), one.author, one.message, one.at)
        if record.digest != one.digest:
            detail = f"the content of the commit {one.digest} has another digest"
            findings.append(StoreDefect("commit-corrupt", row.id, detail))
    lost = sorted(first_parents - there)
    findings += [StoreDefect("commit-lost", row.id, f"the parent {one} of a commit is missing") for one in lost]
    return findings + _check_folder(tx, row) + _check_entries(tx, row) + _check_proposals(tx, row)


def _check_folder(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return a fault if the record of what is checked out in a dataset's folder is missing or damaged."""
    try:
        manifest = read_manifest(tx, row)
        if manifest is not None and manifest.partial:
            len(Tree(StoredChunks(tx), manifest.tree))
    except DamagedChunk as error:
        return [StoreDefect("folder-unknown", row.id, f"what is checked out in the folder is not known: {error}")]
    return []


def _check_entries(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Check the entries of all versions of a dataset.

    Returns a fault for each damaged entry, and one for each content that entries have, but no revision of the project;
    the latter names one of the paths. Damaged chunks are skipped, because `_check_chunk` reports them.
    """
    trees = select(dataset_commit.c.tree).where(dataset_commit.c.dataset_id == row.id)
    waiting = set(tx.execute(trees).scalars())
    seen: set[str] = set()
    lacking: dict[str, str] = {}
    findings: list[StoreDefect] = []
    while waiting:
        batch = {waiting.pop() for _ in range(min(len(waiting), PAGE))}
        seen |= batch
        entries: dict[str, str] = {}
        for digest, data in StoredChunks(tx).load(batch).items():
            with suppress(DamagedChunk):
                chunk = decode(digest, data)
                if isinstance(chunk, Branch):
                    waiting |= {child.digest for child in chunk.children} - seen
                else:
                    entries |= _contents_in(row, digest, chunk, findings)
        found = revisions_with(tx, row.project_id, entries)
        lacking |= {content: path for content, path in entries.items() if content not in found}
    return findings + [
        StoreDefect("entry-lost", row.id, f"no revision has the content {content} of {path!r}")
        for content, path in sorted(lacking.items())
    ]


def _contents_in(row: Row[Any], digest: str, leaf: Leaf, findings: list[StoreDefect]) -> dict[str, str]:
    """Return the paths of the entries in a chunk, by the content digests of the entries.

    For each damaged entry, a fault is added to `findings`.
    """
    found: dict[str, str] = {}
    for key, value in leaf.entries:
        try:
            entry = entry_of(key, value)
        except DamagedChunk as error:
            findings.append(StoreDefect("entry-corrupt", row.id, f"in the chunk {digest}, {error}"))
        else:
            found[entry.content] = entry.path
    return found


def _check_proposals(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return a fault for each proposal whose fields do not fit its state, or that is open and lacks a branch."""
    of_dataset = (dataset_ref.c.dataset_id == row.id, dataset_ref.c.kind == RefKind.BRANCH.value)
    branches = set(tx.execute(select(dataset_ref.c.name).where(*of_dataset)).scalars())
    return [
        StoreDefect(
            "proposal-corrupt",
            row.id,
            f"fields or branches of the proposal {one.number} do not fit its state {one.state}",
        )
        for one in tx.execute(select(proposal).where(proposal.c.dataset_id == row.id))
        if not _is_consistent(one, branches)
    ]


def _is_consistent(one: Row[Any], branches: set[str]) -> bool:
    if one.state == ProposalState.OPEN:
        followed = {one.target} if one.head is not None else {one.target, one.source}
        return followed <= branches and one.ended_us is None and one.merged is None
    return None not in (one.head, one.ended_us) and (one.merged is not None) == (one.state == ProposalState.MERGED)


def _check_job(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return a fault for each item that a job names, but that has no row in the table `job_item` for this job.

    Purges rely on this table.
    """
    naming = NamingJob(row.id, row.inputs, {} if row.parent_id is not None else row.params, row.outputs or ())
    recorded = set(tx.execute(select(job_item.c.item_id).where(job_item.c.job_id == row.id)).scalars())
    return [
        StoreDefect("job-reference", row.id, f"it names the item {one}, but the table job_item has no row for it")
        for one in sorted(naming.items() - recorded)
    ]


def _check_webhook(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return the faults of a webhook that would make it skip events or prevent it from signing messages."""
    retried = (webhook_delivery.c.webhook_id == row.id, webhook_delivery.c.state == "retrying")
    faults = {
        "its position is after the newest event": row.position > newest_number(tx),
        "its secret is damaged": not is_secret(row.secret),
        "the delivery that it repeats is missing": bool(row.attempts)
        and tx.execute(select(webhook_delivery.c.id).where(*retried).limit(1)).first() is None,
    }
    return [StoreDefect("webhook-corrupt", row.id, text) for text, is_so in faults.items() if is_so]
