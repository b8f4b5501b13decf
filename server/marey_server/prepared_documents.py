"""Documents that are checked, encoded and ready to be stored; preparing them needs no database.

In a prepared document, the JSON contains `{"dtype", "shape", "content"}` in place of an array.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import count, islice
from typing import Any

from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from marey_schemas.documents.blob_references import is_array_reference, members_of, references_of
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.registry import SCHEMAS
from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import canonical_json, detach_arrays
from marey_schemas.encoding.digests import digest_of
from marey_schemas.problems import FieldError
from marey_server.errors import InvalidProblem
from marey_server.field_errors import MAX_ERRORS, field_errors, json_pointer

OPEN_SCHEMA = "marey/document@1"

Tree = dict[str, Any]

_NUL = re.compile(rb"(?<!\\)(?:\\\\)*\\u0000")
_POINTER_LENGTH = 512


@dataclass(frozen=True, slots=True)
class PreparedDocument:
    """Document that was checked and encoded. Both take longer than storing it, and need no database."""

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
    arrays = {pointer: (digest_of(data), data) for pointer, data in encoded.items()}
    size_bytes = len(canonical) + sum(map(len, {leaf["content"]: encoded[at] for at, leaf in leaves.items()}.values()))
    return PreparedDocument(digest_of(canonical), schema, body, size_bytes, arrays, files)


def decoded_tree(content: PreparedDocument) -> Tree:
    """Return the content of a document as dictionaries, lists and values, with decoded arrays."""
    tree: Tree = json.loads(canonical_json(content.body))
    for pointer, (_, data) in content.arrays.items():
        holder, key = place_of(tree, pointer)
        leaf = holder[key]
        holder[key] = EncodedArray(leaf["dtype"], tuple(leaf["shape"]), data).decode()
    return tree


def prepared(content: Any, *, schema: str | None = None) -> PreparedDocument:
    """Return `content` as a document that is prepared for `schema`; a prepared document is returned unchanged.

    Raises `InvalidProblem` if the content is not valid, or the prepared document has another schema.
    """
    if not isinstance(content, PreparedDocument):
        return prepare_document(content, schema=schema)
    if schema not in (None, OPEN_SCHEMA, content.schema):
        raise InvalidProblem(f"This part must have the schema {schema}, not {content.schema}.", code="bad-schema")
    return content


def with_body(content: PreparedDocument, body: Tree) -> PreparedDocument:
    """Return a copy of a prepared document with another JSON body; arrays and files stay the same."""
    return replace(content, digest=digest_of_body(body), body=body)


def digest_of_body(body: Tree) -> str:
    """Return the digest of a document in which references replace the arrays."""
    return digest_of(canonical_json(body))


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
        checked = model.model_validate(tree)
    except ValidationError as error:
        errors = field_errors(error, model, tree)
        raise InvalidProblem(
            f"The document is not a valid {named}: {errors[0].pointer}: {errors[0].detail}", errors=errors
        ) from error
    _require_numbers(str(named), checked, tree)
    if isinstance(checked, MotionDocument):
        _require_rotations(checked)
    return str(named or OPEN_SCHEMA)


def _require_numbers(named: str, checked: BaseModel, tree: Any) -> None:
    """Raise `InvalidProblem` if the document has a text in place of a number.

    The models accept such texts, because queries and settings consist of texts; but the document is stored as sent.
    """
    faults = [
        FieldError(pointer=pointer, code="text-for-number", detail=f"the value must be a number, not the text {text!r}")
        for pointer, text in islice(_texts_for_numbers(checked, tree), MAX_ERRORS)
    ]
    if faults:
        detail = f"The document is not a valid {named}: {faults[0].pointer}: {faults[0].detail}"
        raise InvalidProblem(detail, errors=faults)


def _texts_for_numbers(checked: Any, sent: Any) -> Iterator[tuple[str, str]]:
    """Yield pointer and text for each text in a sent document that its model has read as a number."""
    waiting: list[tuple[tuple[str, ...], Any, Any]] = [((), checked, sent)]
    while waiting:
        steps, whole, raw = waiting.pop()
        for key, value, part in _pairs(whole, raw):
            if isinstance(part, str):
                if isinstance(value, (int, float)):
                    yield json_pointer([*steps, str(key)]), part
            elif isinstance(part, (dict, list, tuple)):
                waiting.append(((*steps, str(key)), value, part))


def _pairs(checked: Any, sent: Any) -> Iterator[tuple[str | int, Any, Any]]:
    """Yield key, checked part and sent part for the parts of an object or a list."""
    if isinstance(sent, Mapping):
        model = isinstance(checked, BaseModel)
        names = _names_of(type(checked)) if model else {}
        parts = vars(checked) if model else checked if isinstance(checked, Mapping) else {}
        for key, part in sent.items():
            name = names.get(key, key)
            if name in parts:
                yield key, parts[name], part
    elif isinstance(checked, (list, tuple)):
        yield from zip(count(), checked, sent, strict=False)


@cache
def _names_of(model: type[BaseModel]) -> dict[str, str]:
    """Return the name of each field with an alias, by the alias."""
    return {field.alias: name for name, field in model.model_fields.items() if field.alias}


def _require_rotations(motion: MotionDocument) -> None:
    """Raise `InvalidProblem` if a quaternion is not a rotation.

    The model of the document does not check this, so that motions which were stored before this check can be read.
    """
    wrong = motion.find_wrong_rotation()
    if wrong is not None:
        frame, joint, length = wrong
        detail = (
            f"Frame {frame}, joint {motion.joints[joint]}: the rotation must be a unit quaternion (w, x, y, z), but "
            f"has the length {length:.6g}. Divide each quaternion by its length."
        )
        place = f"/poses/data/{frame}/{3 + 4 * joint}"
        raise InvalidProblem(detail, errors=[FieldError(pointer=place, code="no-rotation", detail=detail)])


def _check_pointers(pointers: list[str]) -> None:
    for pointer in pointers:
        if len(pointer) > _POINTER_LENGTH:
            detail = (
                f"The document has an array or file whose JSON Pointer has {len(pointer)} characters; at most "
                f"{_POINTER_LENGTH} are allowed. Use shorter names or fewer levels."
            )
            raise InvalidProblem(
                detail, errors=[FieldError(pointer=pointer[:_POINTER_LENGTH], code="too-deep", detail=detail)]
            )


def place_of(tree: Any, pointer: str) -> tuple[Any, str | int]:
    """Return the object or list that contains the member named by a JSON Pointer, and the member's key in it."""
    steps = [step.replace("~1", "/").replace("~0", "~") for step in pointer.split("/")[1:]]
    for step in steps[:-1]:
        tree = tree[int(step) if isinstance(tree, list) else step]
    return tree, int(steps[-1]) if isinstance(tree, list) else steps[-1]
