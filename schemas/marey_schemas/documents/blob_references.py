"""References from stored documents to bytes that are stored separately: arrays and files.

In a stored document, an array is replaced by `{"dtype", "shape", "content"}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marey_schemas.encoding.canonical import REFERENCE_KEYS, SCALARS
from marey_schemas.names import is_digest

_FILE_POINTERS = {"marey/clip-info@1": ("/source/file", "/source/companion")}


def is_array_reference(value: Any) -> bool:
    """Return whether a value is a reference that replaces an array."""
    return type(value) not in SCALARS and isinstance(value, Mapping) and value.keys() == REFERENCE_KEYS


def pointer_to(pointer: str, key: object) -> str:
    """Return the JSON Pointer of the member `key` of the object at `pointer`."""
    return f"{pointer}/{str(key).replace('~', '~0').replace('/', '~1')}"


def members_of(tree: Any) -> list[tuple[str, Any]]:
    """List JSON Pointers and values of the nodes of a document; objects and lists precede the values in them.

    Scalars in lists are left out, because they cannot be references: only the value of a named member can be the digest
    of a file.
    """
    found: list[tuple[str, Any]] = []

    def visit(pointer: str, value: Any) -> None:
        found.append((pointer, value))
        if type(value) is dict or isinstance(value, Mapping):  # nearly all are; asking for mappings takes far longer
            for key, member in value.items():
                at = pointer_to(pointer, key)
                if type(member) in SCALARS:
                    found.append((at, member))
                else:
                    visit(at, member)
        elif isinstance(value, (list, tuple)):
            for index, member in enumerate(value):
                if type(member) not in SCALARS:
                    visit(f"{pointer}/{index}", member)

    visit("", tree)
    return found


def references_of(schema: str, body: Any) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Return the references to arrays and the digests of files in a stored document, each as a dictionary by JSON
    Pointer.

    The digest of a file is the value of a member called `blob`, or of a field that `_FILE_POINTERS` lists for the
    schema.
    """
    fixed = _FILE_POINTERS.get(schema, ())
    arrays, files = {}, {}
    for pointer, value in members_of(body):
        if is_array_reference(value):
            arrays[pointer] = value
        elif isinstance(value, str) and (pointer in fixed or pointer.endswith("/blob")) and is_digest(value):
            files[pointer] = value
    return arrays, files
