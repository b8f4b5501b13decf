"""Documents: JSON with a known schema, named by the digest of its content; its arrays and files are stored as blobs.

In the database, the JSON contains `{"dtype", "shape", "content"}` in place of an array. The table `document_blob`
records which blob belongs to which place in a document.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, Literal

from sqlalchemy import bindparam, insert, select

from marey_schemas.documents.blob_references import is_array_reference
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.problems import FieldError
from marey_server.errors import NotFoundProblem
from marey_server.prepared_documents import PreparedDocument, Tree, digest_of_body, place_of, prepared
from marey_server.store import blobs
from marey_server.store.database.prepared import Prepared, padded
from marey_server.store.tables import blob, document, document_blob, document_item
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import references_in

_ID_LENGTH = 40
EDIT_SCHEMA = PARTS[Kind.EDIT]["edit"].schema


def store_document(tx: Transaction, content: Any, *, schema: str | None = None) -> str:
    """Store a document and return its digest. `content` is a tree, or the result of `prepare_document` for a tree.

    The document is checked against `schema`, by default the schema that the document names. Storing the same document
    again adds no rows.

    Raises `InvalidProblem` if the document is not valid, and `ConflictProblem` (`missing-blobs`) if the document names
    blobs that the caller has not sent and may not read.
    """
    ready = prepared(content, schema=schema)
    store_documents(tx, [ready])
    return ready.digest


def store_documents(tx: Transaction, contents: Iterable[PreparedDocument]) -> dict[str, int]:
    """Store many documents, as `store_document` stores one, with few SQL statements in total.

    Returns, by digest, the number of bytes that each new document uses of a quota.
    """
    by_digest = {one.digest: one for one in contents}
    file_sizes = _require_files(tx, by_digest.values())
    rows = [
        {
            "digest": one.digest,
            "schema": one.schema,
            "body": one.body,
            "size_bytes": one.size_bytes,
            "file_bytes": _file_bytes(one, file_sizes),
            "created_us": tx.now_us,
        }
        for one in by_digest.values()
    ]
    new = blobs.insert_new(tx, document, rows)
    added = [one for one in by_digest.values() if one.digest in new]
    arrays = {digest: data for one in added for digest, data in one.arrays.values()}
    new_arrays = blobs.store_blobs(tx, arrays)
    tx.new_document_bytes += sum(map(_text_bytes, added)) + sum(len(arrays[digest]) for digest in new_arrays)
    _refer(
        tx,
        [
            (one.digest, pointer, digest)
            for one in added
            for pointer, digest in [*((at, digest) for at, (digest, _data) in one.arrays.items()), *one.files.items()]
        ],
    )
    _refer_to_items(tx, {one.digest: one.body for one in added})
    return {one.digest: one.size_bytes + _file_bytes(one, file_sizes) for one in added}


def _text_bytes(one: PreparedDocument) -> int:
    """Return the size, in bytes, of a document without its arrays."""
    return one.size_bytes - sum(map(len, dict(one.arrays.values()).values()))


def _file_bytes(one: PreparedDocument, sizes: Mapping[str, int]) -> int:
    return sum(sizes[digest] for digest in set(one.files.values())) if one.files else 0


def store_variants(tx: Transaction, variants: Sequence[tuple[str, Tree]]) -> None:
    """Store documents that have the same arrays and files as existing documents, but other bodies.

    `variants` contains, for each new document, the digest of the existing document and the new body.
    """
    if not variants:
        return
    digests = [digest_of_body(body) for _, body in variants]
    of_originals = sorted({original for original, _ in variants})
    columns = (document.c.digest, document.c.schema, document.c.size_bytes, document.c.file_bytes)
    originals = {row.digest: row for row in tx.execute(select(*columns).where(document.c.digest.in_(of_originals)))}
    rows = [
        {
            "digest": digest,
            "schema": originals[original].schema,
            "body": body,
            "size_bytes": originals[original].size_bytes,
            "file_bytes": originals[original].file_bytes,
            "created_us": tx.now_us,
        }
        for digest, (original, body) in zip(digests, variants, strict=True)
    ]
    new = blobs.insert_new(tx, document, rows)
    added = {digest: original for digest, (original, _) in zip(digests, variants, strict=True) if digest in new}
    held: dict[str, list[tuple[str, str]]] = {}
    for row in tx.execute(select(document_blob).where(document_blob.c.document_digest.in_(sorted(added.values())))):
        held.setdefault(row.document_digest, []).append((row.pointer, row.blob_digest))
    _refer(tx, [(digest, *place) for digest, original in added.items() for place in held.get(original, ())])
    _refer_to_items(tx, {digest: body for digest, (_, body) in zip(digests, variants, strict=True) if digest in added})


def _require_files(tx: Transaction, contents: Iterable[PreparedDocument]) -> dict[str, int]:
    """Check that the caller may use the files to which documents refer; return the sizes of the files in bytes."""
    naming = [one.files for one in contents if one.files]
    held = blobs.lock_usable(tx, {digest for files in naming for digest in files.values()}) if naming else set()
    for files in naming:
        lacking = {pointer: digest for pointer, digest in files.items() if digest not in held}
        if lacking:
            errors = [FieldError(pointer=at, code="missing-blob", detail=digest) for at, digest in lacking.items()]
            raise blobs.missing_blobs(lacking.values(), errors)
    return blobs.sizes_of(tx, held)


def _refer(tx: Transaction, references: Iterable[tuple[str, str, str]]) -> None:
    """Record which documents refer to which blobs.

    Each reference consists of the digest of the document, a JSON Pointer into it, and the digest of the blob.
    """
    columns = ("document_digest", "pointer", "blob_digest")
    rows = [dict(zip(columns, one, strict=True)) for one in references]
    if rows:
        tx.execute(insert(document_blob), rows)


def items_named_in(body: Tree) -> set[str]:
    """Return the ids of the items that a document names in its references, or as sources in the commands of an edit.

    The fields of some documents are not checked, so texts that are too long for an id are ignored.
    """
    named = {reference.item for reference in references_in(body)}
    if body.get("schema") == EDIT_SCHEMA:
        named |= {one["source"] for one in body["commands"] if "source" in one}
    return {one for one in named if len(one) <= _ID_LENGTH}


def _refer_to_items(tx: Transaction, bodies: Mapping[str, Tree]) -> None:
    """Record which items documents refer to, so that no purge deletes these items. `bodies` are the new documents."""
    rows = [
        {"document_digest": digest, "item_id": item}
        for digest, body in bodies.items()
        for item in sorted(items_named_in(body))
    ]
    if rows:
        tx.execute(insert(document_item), rows)


_STORED_BYTES = Prepared(
    select(document.c.digest, (document.c.size_bytes + document.c.file_bytes).label("stored_bytes")).where(
        document.c.digest.in_(bindparam("digests", expanding=True))
    )
)


def stored_bytes_of(tx: Transaction, digests: Iterable[str]) -> dict[str, int]:
    """Return, by digest, how many bytes a document uses of a quota: the bytes of its text, its arrays and its files."""
    wanted = sorted(set(digests))
    return {
        row.digest: row.stored_bytes
        for some in in_lists(wanted)
        for row in tx.run(_STORED_BYTES, {"digests": padded(some)})
    }


# -- reading ----------------------------------------------------------------------------------------------------------


_BODIES = Prepared(
    select(document.c.digest, document.c.body).where(document.c.digest.in_(bindparam("digests", expanding=True)))
)
_BLOBS_OF_DOCUMENTS = Prepared(
    select(document_blob.c.document_digest, document_blob.c.pointer, document_blob.c.blob_digest, blob.c.size_bytes)
    .join(blob, blob.c.digest == document_blob.c.blob_digest)
    .where(document_blob.c.document_digest.in_(bindparam("digests", expanding=True)))
)


def load_document(tx: Transaction, digest: str, *, arrays: Literal["encoded", "decoded", "none"] = "encoded") -> Tree:
    """Load a stored document; `arrays` says whether its arrays are encoded, decoded (numpy) or references ("none").

    Raises `NotFoundProblem` if the document is missing.
    """
    return load_documents(tx, [digest], arrays=arrays)[digest]


def load_documents(
    tx: Transaction, digests: Collection[str], *, arrays: Literal["encoded", "decoded", "none"] = "encoded"
) -> dict[str, Tree]:
    """Load stored documents by digest, as `load_document` does. Raises `NotFoundProblem` if one is missing."""
    bodies = load_bodies(tx, digests)  # freshly read, so that they may be changed
    if bodies and arrays != "none":
        _attach_stored(tx, bodies, (lambda stored: stored.decode()) if arrays == "decoded" else None)
    return bodies


def load_body(tx: Transaction, digest: str) -> Tree:
    """Load a document with references in place of its arrays."""
    return load_bodies(tx, [digest])[digest]


def load_bodies(tx: Transaction, digests: Collection[str]) -> dict[str, Tree]:
    """Load documents by digest, with references in place of arrays. Raises `NotFoundProblem` if one is missing."""
    wanted = list(digests)
    bodies = {
        row.digest: dict(row.body) for some in in_lists(wanted) for row in tx.run(_BODIES, {"digests": padded(some)})
    }
    if missing := [digest for digest in digests if digest not in bodies]:
        raise NotFoundProblem(f"There is no document {missing[0]}.")
    return bodies


def _attach_stored(
    tx: Transaction, bodies: Mapping[str, Tree], convert: Callable[[EncodedArray], Any] | None = None
) -> None:
    """Replace references to arrays in documents by the stored arrays, each converted by `convert`.

    `bodies` maps the digests of documents to their trees.
    """
    loaded: dict[str, Any] = {}
    named = tx.run(_BLOBS_OF_DOCUMENTS, {"digests": padded(bodies)})
    places = [(row, *place_of(bodies[row.document_digest], row.pointer)) for row in named]
    arrays = [
        (row, holder, key) for row, holder, key in places if is_array_reference(holder[key])
    ]  # not names of files
    tx.blobs.expect(tx.connection, [row.blob_digest for row, _, _ in arrays])
    for row, holder, key in arrays:
        leaf = holder[key]
        if leaf["content"] not in loaded:
            data = blobs.read_blob(tx, row.blob_digest, 0, row.size_bytes)
            stored = EncodedArray(leaf["dtype"], tuple(leaf["shape"]), data)
            loaded[leaf["content"]] = convert(stored) if convert else stored
        holder[key] = loaded[leaf["content"]]
