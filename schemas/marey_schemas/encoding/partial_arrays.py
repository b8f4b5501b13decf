"""Arrays that are sent without the tiles that the receiver already has in another array.

In a document, such a *partial array* is an object in place of the array. It names the other array, its *base*, by the
content digest of a revision and a JSON Pointer into the same part of this revision. The other members are `dtype` and
`shape`; `tiles`: for each tile the number of the equal tile of the base, or -1; `sizes`: the sizes in bytes of the
tiles that are sent; and `bytes`: these tiles.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray, array_from_leaf, with_blocks
from marey_schemas.encoding.arrayspec import ArrayError, ArraySpec

_SENT = -1
_MEMBERS = frozenset({"base", "pointer", "dtype", "shape", "tiles", "sizes", "bytes"})
_DIGEST_CHARACTERS = 32
_MOST_OVERHEAD = 64
"""Bytes by which a tile may exceed twice the size of its values. The limit bounds the memory for tiles that repeat."""


def tile_digests(array: EncodedArray) -> list[str]:
    """Return a digest of the bytes of each tile: the first 32 hexadecimal digits of its SHA-256."""
    return [hashlib.sha256(tile).hexdigest()[:_DIGEST_CHARACTERS] for tile in blocks.split(array.data)]


def is_partial(value: Any) -> bool:
    """Return whether a value of a received document is a partial array."""
    return isinstance(value, Mapping) and value.keys() == _MEMBERS


def partial_array(array: EncodedArray, base: str, pointer: str, base_digests: Sequence[str]) -> dict[str, Any] | None:
    """Return an array without the tiles that its base has.

    Returns None if the base has no tile of the array, or if `blocks.encode` would divide the array into other tiles.

    `base` (the content digest of a revision) and `pointer` name the base, and `base_digests` lists the digests of its
    tiles.
    """
    tiles, spec = blocks.split(array.data), ArraySpec(array.dtype, array.shape)
    places = {digest: number for number, digest in enumerate(base_digests)}
    numbers = [places.get(digest, _SENT) for digest in tile_digests(array)]
    if set(numbers) <= {_SENT} or blocks.join(spec, tiles) != array.data:
        return None
    sent = [tile for tile, number in zip(tiles, numbers, strict=True) if number == _SENT]
    return {
        "base": base,
        "pointer": pointer,
        "dtype": array.dtype,
        "shape": list(array.shape),
        "tiles": np.array(numbers, dtype="<i4"),
        "sizes": np.array([len(tile) for tile in sent], dtype="<i4"),
        "bytes": EncodedArray.of(np.frombuffer(b"".join(sent), np.uint8), predict=False),
    }


def completed(partial: Mapping[str, Any], base_tiles: Sequence[bytes]) -> NDArray[Any] | EncodedArray:
    """Return the array that a partial array describes, checked as if it had been sent whole.

    `base_tiles` contains the tiles of the base, as `blocks.split` returns them, so that many partial arrays can share
    them.
    Raises `ArrayError` if the members of the partial array do not match each other or the base.
    """
    spec = ArraySpec.parse(partial["dtype"], partial["shape"])
    count = blocks.count_tiles(spec)
    most_bytes = 2 * spec.nbytes + _MOST_OVERHEAD * count
    tiles, sizes = (_flat(partial, name, count).astype(np.int64) for name in ("tiles", "sizes"))
    sent = _flat(partial, "bytes", most_bytes)
    if any(not _SENT <= number < len(base_tiles) for number in tiles.tolist()) or (sizes < 0).any():
        raise ArrayError("bad-array", "a partial array names a tile that its base does not have")
    if int(sizes.sum()) != len(sent) or len(sizes) != int((tiles == _SENT).sum()):
        raise ArrayError("bad-array", "the bytes of a partial array do not match the sizes of its tiles")
    data, ends = sent.astype(np.uint8).tobytes(), iter(np.cumsum(sizes).tolist())
    joined, start = [], 0
    for number in tiles.tolist():
        if number == _SENT:
            end = next(ends)
            joined.append(data[start:end])
            start = end
        else:
            joined.append(base_tiles[number])
    if len(joined) != count or sum(map(len, joined)) > most_bytes:
        raise ArrayError("bad-array", f"the tiles of a partial array do not match its shape {list(spec.shape)}")
    leaf = {
        "dtype": spec.dtype, "shape": spec.shape, "encoding": "blocks", "data": blocks.join(spec, joined),
    }  # fmt: skip
    return with_blocks(leaf, array_from_leaf(leaf))


def _flat(partial: Mapping[str, Any], name: str, longest: int) -> NDArray[Any]:
    """Return a member of a partial array; its length is checked before any memory is allocated for it."""
    found = partial[name]
    if isinstance(found, EncodedArray | np.ndarray) and math.prod(found.shape) > longest:
        raise ArrayError("bad-array", f"the member {name!r} of a partial array is too long for the array's shape")
    array = found.decode() if isinstance(found, EncodedArray) else found
    if not isinstance(array, np.ndarray) or array.ndim != 1 or array.dtype.kind not in "iu":
        raise ArrayError("bad-array", f"the member {name!r} of a partial array must be a list of integers")
    return array
