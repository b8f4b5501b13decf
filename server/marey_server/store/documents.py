"""Documents: JSON with a known schema, named by the digest of its content; its arrays and files are stored as blobs.

In the database, the JSON contains `{"dtype", "shape", "content"}` in place of an array. The table `document_blob`
records which blob belongs to which place in a document.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from numpy.typing import NDArray
from pydantic import ValidationError
from sqlalchemy import bindparam, insert, select

from marey_schemas.documents.blob_references import is_array_reference, members_of, references_of
from marey_schemas.documents.registry import SCHEMAS
from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import canonical_json, detach_arrays
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.problems import FieldError
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.field_errors import field_errors
from marey_server.store import blobs
from marey_server.store.database.prepared import Prepared, padded
from marey_server.store.tables import blob, document, document_blob, document_item
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import references_in

OPEN_SCHEMA = "marey/document@1"

_NUL = re.compile(rb"(?<!\\)(?:\\\\)*\\u0000")
_POINTER_LENGTH = 512
_ID_LENGTH = 40
EDIT_SCHEMA = PARTS[Kind.EDIT]["edit"].schema

Tree = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PreparedDocument:
    """Checked and encoded document; checking and encoding take longer than storing it, and need no database."""

    digest: str
    schema: str
    body: Tree
    size_bytes: int
    arrays: dict[str, tuple[str, bytes]]
    """Digest and bytes of each array's blob, by JSON Pointer."""
    files: dict[str, str]
    """Digests of the blobs that the document refers to, by JSON Pointer."""


def prepare_document(tree: Any, *, schema: str | None = None) -> PreparedDocument:
    """Check a document against `schema`, by default the schema that the document names, and encode its arrays.

    Raises `InvalidProblem` with one entry for each fault.
    """
    name = _check(tree, schema)
    tree = {**tree, "schema": name}
    encoded: dict[str, bytes] = {}

    def keep(content: str, array: NDArray[Any] | EncodedArray) -> None:
        if content not in encoded:
            encoded[content] = array.data if isinstance(array, EncodedArray) else blocks.encode(array)

    try:
        canonical = canonical_json(detach_arrays(tree, keep))
    except (ValueError, TypeError, RecursionError) as error:
        raise InvalidProblem(f"The body cannot be stored as a document: {error}", code="bad-document") from error
    if _NUL.search(canonical):
        raise InvalidProblem("Text in documents must not contain the character U+0000.", code="bad-text")
    return _of_canonical(name, canonical, lambda _, leaf: encoded[leaf["content"]])


def document_of_bytes(schema: str, canonical: bytes, arrays: Mapping[str, bytes]) -> PreparedDocument:
    """Return a document that another process of this server has checked and encoded.

    `canonical` is its canonical JSON with references in place of arrays; `arrays` maps JSON Pointers to encoded arrays.
    """
    return _of_canonical(schema, canonical, lambda pointer, _: arrays[pointer])


def _of_canonical(schema: str, canonical: bytes, array_of: Callable[[str, Tree], bytes]) -> PreparedDocument:
    body = json.loads(canonical)
    leaves, files = references_of(schema, body)
    encoded = {pointer: array_of(pointer, leaf) for pointer, leaf in leaves.items()}
    _check_pointers([*encoded, *files])
    arrays = {pointer: (blobs.digest_of(data), data) for pointer, data in encoded.items()}
    size_bytes = len(canonical) + sum(map(len, {leaf["content"]: encoded[at] for at, leaf in leaves.items()}.values()))
    return PreparedDocument(blobs.digest_of(canonical), schema, body, size_bytes, arrays, files)


def decoded_tree(content: PreparedDocument) -> Tree:
    """Return the tree that a document was prepared from."""
    tree: Tree = json.loads(canonical_json(content.body))
    for pointer, (_, data) in content.arrays.items():
        holder, key = _place(tree, pointer)
        leaf = holder[key]
        holder[key] = EncodedArray(leaf["dtype"], tuple(leaf["shape"]), data).decode()
    return tree


def prepared(content: Any, *, schema: str | None = None) -> PreparedDocument:
    """Return `content` as a document prepared for `schema`; a prepared document is returned unchanged."""
    if not isinstance(content, PreparedDocument):
        return prepare_document(content, schema=schema)
    if schema not in (None, OPEN_SCHEMA, content.schema):
        raise InvalidProblem(f"This part must have the schema {schema}, not {content.schema}.", code="bad-schema")
    return content


def with_body(content: PreparedDocument, body: Tree) -> PreparedDocument:
    """Return the document with another JSON body and the same arrays and files."""
    return replace(content, digest=digest_of_body(body), body=body)


def digest_of_body(body: Tree) -> str:
    """Return the digest of a document, given as JSON text with references in place of arrays."""
    return blobs.digest_of(canonical_json(body))


def _check(tree: Any, schema: str | None) -> str:
    if not isinstance(tree, Mapping):
        raise InvalidProblem("A document must be an object, not a list or a single value.", code="bad-document")
    named = tree.get("schema", schema)
    if schema is not None and schema != OPEN_SCHEMA and named != schema:
        raise InvalidProblem(f"This part must have the schema {schema}, not {named!r}.", code="bad-schema")
    for pointer, leaf in members_of(tree):
        if is_array_reference(leaf):
            detail = (
                "Send the array itself (dtype, shape, data); a document cannot refer to the content of another one."
            )
            raise InvalidProblem(detail, errors=[FieldError(pointer=pointer, code="array-reference", detail=detail)])
    model = SCHEMAS.get(str(named)) or SCHEMAS[OPEN_SCHEMA]
    try:
        model.model_validate(tree)
    except ValidationError as error:
        errors = field_errors(error, tree)
        raise InvalidProblem(
            f"The document is not a valid {named}: {errors[0].pointer}: {errors[0].detail}", errors=errors
        ) from error
    return str(named or OPEN_SCHEMA)


def _check_pointers(pointers: list[str]) -> None:
    for pointer in pointers:
        if len(pointer) > _POINTER_LENGTH:
            detail = f"The JSON Pointer of an array or file must have at most {_POINTER_LENGTH} characters."
            raise InvalidProblem(
                detail, errors=[FieldError(pointer=pointer[:_POINTER_LENGTH], code="too-deep", detail=detail)]
            )


# -- storing ----------------------------------------------------------------------------------------------------------


def store_document(tx: Transaction, content: Any, *, schema: str | None = None) -> str:
    """Store a document and return its digest. `content` is a tree, or what `prepare_document` has returned for it.

    Storing the same document again adds no rows.

    Raises `ConflictProblem` (`missing-blobs`) if the document names blobs that the caller has not sent and may not
    read.
    """
    ready = prepared(content, schema=schema)
    store_documents(tx, [ready])
    return ready.digest


def store_documents(tx: Transaction, contents: Iterable[PreparedDocument]) -> dict[str, int]:
    """Store documents as `store_document` does, all with the same few statements.

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
    """Return the size of a document without its arrays."""
    return one.size_bytes - sum(map(len, dict(one.arrays.values()).values()))


def _file_bytes(one: PreparedDocument, sizes: Mapping[str, int]) -> int:
    return sum(sizes[digest] for digest in set(one.files.values())) if one.files else 0


def store_variants(tx: Transaction, variants: Sequence[tuple[str, Tree]]) -> None:
    """Store documents that have the arrays and files of existing documents, but other bodies.

    `variants` lists the digest of an existing document and the new body.
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
    held = blobs.hold(tx, {digest for files in naming for digest in files.values()}) if naming else set()
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
    """Load a stored document; its arrays are returned encoded, as numpy arrays, or as references."""
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
    """Load documents by digest, with references in place of their arrays."""
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
    places = [(row, *_place(bodies[row.document_digest], row.pointer)) for row in named]
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


def _place(tree: Any, pointer: str) -> tuple[Any, str | int]:
    """Return the object or list that contains the member named by a JSON Pointer, and the member's key in it."""
    steps = [step.replace("~1", "/").replace("~0", "~") for step in pointer.split("/")[1:]]
    for step in steps[:-1]:
        tree = tree[int(step) if isinstance(tree, list) else step]
    return tree, int(steps[-1]) if isinstance(tree, list) else steps[-1]
