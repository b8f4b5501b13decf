"""Documents: JSON with a known schema, named by the digest of its content; array leaves and named files are blobs.

In the database an array leaf is stored as `{"dtype", "shape", "content"}`; `document_blob` says which blob holds it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from numpy.typing import NDArray
from pydantic import ValidationError
from sqlalchemy import bindparam, insert, select

from marey_schemas.documents.registry import SCHEMAS
from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import canonical_json, detach_arrays
from marey_schemas.problems import FieldError
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.field_errors import field_errors
from marey_server.store import blobs
from marey_server.store.database.prepared import Prepared, padded
from marey_server.store.tables import blob, document, document_blob
from marey_server.store.transaction import Transaction

OPEN_SCHEMA = "marey/document@1"

_DIGEST = re.compile(r"sha256:[0-9a-f]{64}")
_NUL = re.compile(rb"(?<!\\)(?:\\\\)*\\u0000")
_REFERENCE_KEYS = {"dtype", "shape", "content"}
_FILE_POINTERS = {"marey/clip-info@1": ("/source/file", "/source/companion")}
_POINTER_LENGTH = 512

Tree = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PreparedDocument:
    """Document that is checked and encoded, which takes most of the time of storing it and needs no database."""

    digest: str
    schema: str
    body: Tree
    size_bytes: int
    arrays: dict[str, tuple[str, bytes]]
    """Digest and bytes of each array's blob, by JSON Pointer."""
    files: dict[str, str]
    """Digests of the blobs that the document refers to, by JSON Pointer."""


def prepare_document(tree: Any, *, schema: str | None = None) -> PreparedDocument:
    """Check a document against its schema (`schema`, or else the one it names) and encode its arrays.

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
        raise InvalidProblem(f"This cannot be stored as a document: {error}", code="bad-document") from error
    if _NUL.search(canonical):
        raise InvalidProblem("Text in documents must not contain the character U+0000.", code="bad-text")
    body = json.loads(canonical)
    leaves, files = references_of(name, body)
    arrays = {
        pointer: (blobs.digest_of(encoded[leaf["content"]]), encoded[leaf["content"]])
        for pointer, leaf in leaves.items()
    }
    _check_pointers([*arrays, *files])
    size_bytes = len(canonical) + sum(len(data) for data in encoded.values())
    return PreparedDocument(blobs.digest_of(canonical), name, body, size_bytes, arrays, files)


def prepared(content: Any, *, schema: str | None = None) -> PreparedDocument:
    """Return `content` as a document prepared for `schema`; unchanged if it is one already."""
    if not isinstance(content, PreparedDocument):
        return prepare_document(content, schema=schema)
    if schema not in (None, OPEN_SCHEMA, content.schema):
        raise InvalidProblem(f"This part must have the schema {schema}, not {content.schema}.", code="bad-schema")
    return content


def with_body(content: PreparedDocument, body: Tree) -> PreparedDocument:
    """Return the document with another body and the same arrays and files."""
    canonical = canonical_json(body)
    return replace(content, digest=blobs.digest_of(canonical), body=body)


def _check(tree: Any, schema: str | None) -> str:
    if not isinstance(tree, Mapping):
        raise InvalidProblem("A document must be an object.", code="bad-document")
    named = tree.get("schema", schema)
    if schema is not None and schema != OPEN_SCHEMA and named != schema:
        raise InvalidProblem(f"This part holds {schema}, not {named!r}.", code="bad-schema")
    for pointer, leaf in _members(tree):
        if _is_reference(leaf):
            detail = "Send the array itself (dtype, shape, data); a reference to content is no document's own."
            raise InvalidProblem(detail, errors=[FieldError(pointer=pointer, code="array-reference", detail=detail)])
    model = SCHEMAS.get(str(named)) or SCHEMAS[OPEN_SCHEMA]
    try:
        model.model_validate(tree)
    except ValidationError as error:
        errors = field_errors(error, tree)
        raise InvalidProblem(
            f"This is not a valid {named}: {errors[0].pointer}: {errors[0].detail}", errors=errors
        ) from error
    return str(named or OPEN_SCHEMA)


def _is_reference(value: Any) -> bool:
    return type(value) not in _LEAVES and isinstance(value, Mapping) and value.keys() == _REFERENCE_KEYS


_LEAVES = (str, float, int, bool, type(None))


def _members(value: Any, pointer: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every member of a tree with its JSON Pointer, containers before their members."""
    yield pointer, value
    if type(value) in _LEAVES:  # most members; asking whether they are mappings takes far longer
        return
    if isinstance(value, Mapping):
        for key, member in value.items():
            yield from _members(member, f"{pointer}/{str(key).replace('~', '~0').replace('/', '~1')}")
    elif isinstance(value, list | tuple):
        for index, member in enumerate(value):
            yield from _members(member, f"{pointer}/{index}")


def references_of(schema: str, body: Tree) -> tuple[dict[str, Tree], dict[str, str]]:
    """Return the references of a stored document by JSON Pointer: its array leaves, and digests of blobs it names.

    Blobs are named in the fields that the schema has for them, and in members called `blob`.
    """
    fixed = _FILE_POINTERS.get(schema, ())
    leaves, files = {}, {}
    for pointer, value in _members(body):
        if _is_reference(value):
            leaves[pointer] = value
        elif isinstance(value, str) and (pointer in fixed or pointer.endswith("/blob")) and _DIGEST.fullmatch(value):
            files[pointer] = value
    return leaves, files


def _check_pointers(pointers: list[str]) -> None:
    for pointer in pointers:
        if len(pointer) > _POINTER_LENGTH:
            detail = f"Arrays and files must lie at a JSON Pointer of at most {_POINTER_LENGTH} characters."
            raise InvalidProblem(
                detail, errors=[FieldError(pointer=pointer[:_POINTER_LENGTH], code="too-deep", detail=detail)]
            )


# -- storing ----------------------------------------------------------------------------------------------------------


def store_document(tx: Transaction, content: Any, *, schema: str | None = None) -> str:
    """Store a document, given as a tree or prepared, and return its digest. Storing it again adds no rows.

    Raises `ConflictProblem` (`missing-blobs`) if it names blobs that the caller has not sent and may not read.
    """
    ready = prepared(content, schema=schema)
    if ready.files:
        _require_files(tx, ready.files)
    row = {
        "digest": ready.digest,
        "schema": ready.schema,
        "body": ready.body,
        "size_bytes": ready.size_bytes,
        "created_us": tx.now_us,
    }
    if blobs.insert_new(tx, document, row):
        held = {pointer: digest for pointer, (digest, _data) in ready.arrays.items()}
        for digest, data in sorted(dict(ready.arrays.values()).items()):
            blobs.store_blob(tx, digest, data)
        _refer(tx, ready.digest, held | ready.files)
    return ready.digest


def store_variant(tx: Transaction, digest: str, body: Tree) -> str:
    """Store a document with the arrays and files of another one and the text `body`; return its digest."""
    original = tx.execute(select(document.c.schema, document.c.size_bytes).where(document.c.digest == digest)).one()
    row = {
        "digest": blobs.digest_of(canonical_json(body)),
        "schema": original.schema,
        "body": body,
        "size_bytes": original.size_bytes,
        "created_us": tx.now_us,
    }
    if blobs.insert_new(tx, document, row):
        statement = select(document_blob.c.pointer, document_blob.c.blob_digest)
        held = tx.execute(statement.where(document_blob.c.document_digest == digest)).all()
        _refer(tx, row["digest"], {found.pointer: found.blob_digest for found in held})
    return str(row["digest"])


def _require_files(tx: Transaction, files: Mapping[str, str]) -> None:
    held = blobs.hold(tx, files.values())
    lacking = {pointer: digest for pointer, digest in files.items() if digest not in held}
    if lacking:
        errors = [FieldError(pointer=at, code="missing-blob", detail=digest) for at, digest in lacking.items()]
        raise blobs.missing_blobs(lacking.values(), errors)


def _refer(tx: Transaction, digest: str, held: Mapping[str, str]) -> None:
    if held:
        rows = [
            {"document_digest": digest, "pointer": pointer, "blob_digest": blob_digest}
            for pointer, blob_digest in held.items()
        ]
        tx.execute(insert(document_blob), rows)


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
    if not digests:
        return {}
    bodies = {row.digest: dict(row.body) for row in tx.run(_BODIES, {"digests": padded(digests)})}
    if missing := [digest for digest in digests if digest not in bodies]:
        raise NotFoundProblem(f"There is no document {missing[0]}.")
    return bodies


def _attach_stored(
    tx: Transaction, bodies: Mapping[str, Tree], convert: Callable[[EncodedArray], Any] | None = None
) -> None:
    """Replace the references in documents, given by digest, by their arrays, each passed through `convert`."""
    loaded: dict[str, Any] = {}
    for row in tx.run(_BLOBS_OF_DOCUMENTS, {"digests": padded(bodies)}):
        holder, key = _place(bodies[row.document_digest], row.pointer)
        leaf = holder[key]
        if not _is_reference(leaf):  # the name of a file
            continue
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
