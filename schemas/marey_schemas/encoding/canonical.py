"""Digests of arrays and documents that depend on their content, not on their encoding."""

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.arrayspec import ArraySpec, little_endian
from marey_schemas.encoding.digests import digest_of_hash


def array_digest(array: NDArray[Any] | EncodedArray) -> str:
    """Return `sha256:<hex>` of dtype, shape and little-endian bytes, independent of any compression.

    The hashed bytes are the line `<f4 [2,3]` (dtype, space, shape as JSON without spaces) with its line feed, then the
    raw bytes in C order.
    """
    plain = little_endian(array.decode() if isinstance(array, EncodedArray) else array)
    spec = ArraySpec.of(plain)
    head = f"{spec.dtype} [{','.join(map(str, spec.shape))}]\n"
    return _name(head.encode(), plain.reshape(-1).view(np.uint8).data)


SCALARS = (str, float, int, bool, type(None))
"""Types of the values of a document that are no arrays, objects or lists."""
REFERENCE_KEYS = {"dtype", "shape", "content"}
"""Names of the members of a reference that replaces an array."""


def canonical_json(tree: Any) -> bytes:
    """Return the canonical JSON text of a tree without arrays: sorted keys, no spaces, UTF-8.

    JSON has only one type of number. A whole number below 2**63 is written without a point: 1.0 as 1, and -0.0 as 0.
    Any other number is written as the shortest text of its double. Raises `ValueError` for NaN and infinities,
    `TypeError` for a key that is not a string.
    """
    return json.dumps(
        _canonical(tree), sort_keys=True, ensure_ascii=False, separators=(",", ":"), allow_nan=False
    ).encode()


def document_digest(tree: Any) -> str:
    """Return `sha256:<hex>` of the canonical JSON of a tree in which each array is replaced by its reference."""
    return _name(canonical_json(detach_arrays(tree, lambda _digest, _array: None)))


def detach_arrays(tree: Any, keep: Callable[[str, NDArray[Any] | EncodedArray], None]) -> Any:
    """Return the tree with each array replaced by `{"dtype", "shape", "content": array_digest}`.

    `keep(digest, array)` is called once per array, in document order.
    """
    if type(tree) in SCALARS:  # most members; asking whether they are mappings takes far longer
        return tree
    if isinstance(tree, Mapping):
        return {key: detach_arrays(member, keep) for key, member in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [detach_arrays(item, keep) for item in tree]
    if isinstance(tree, np.ndarray | EncodedArray):
        spec = ArraySpec.of(tree) if isinstance(tree, np.ndarray) else ArraySpec(tree.dtype, tree.shape)
        digest = array_digest(tree)
        keep(digest, tree)
        return {"dtype": spec.dtype, "shape": list(spec.shape), "content": digest}
    return tree


def attach_arrays(tree: Any, load: Callable[[str], Any]) -> Any:
    """Return the tree with each reference replaced by `load(digest)`, the inverse of `detach_arrays`."""
    if isinstance(tree, Mapping):
        if tree.keys() == REFERENCE_KEYS:
            return load(tree["content"])
        return {key: attach_arrays(member, load) for key, member in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [attach_arrays(item, load) for item in tree]
    return tree


def _canonical(value: Any) -> Any:
    if type(value) is str or value is None:
        return value
    # Numbers come before containers, because asking whether a number is a mapping takes far longer.
    if isinstance(value, float):
        return int(value) if value.is_integer() and abs(value) < 1 << 63 else value
    if isinstance(value, int):
        return float(value) if not isinstance(value, bool) and abs(value) >= 1 << 63 else value
    if isinstance(value, Mapping):
        return {_text_key(key): _canonical(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_canonical(item) for item in value]
    return value


def _text_key(key: Any) -> str:
    if not isinstance(key, str):
        raise TypeError(f"the object has the key {key!r}, which is not a string")
    return key


def _name(*parts: bytes | memoryview) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest_of_hash(digest)
