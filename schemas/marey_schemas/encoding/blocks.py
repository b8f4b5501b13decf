"""Lossless block codec, which stores an array as compressed tiles of frames and columns that can be read separately.

The first axis counts frames; all others together are columns. docs/reference/block-format.md describes the layout.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_schemas.encoding import tiles
from marey_schemas.encoding.arrayspec import ArrayError, ArraySpec, little_endian

MAGIC = b"MRB1"
BLOCK_FRAMES = 256
GROUP_COLUMNS = 1024
NARROW_COLUMNS = 64  # an array with fewer columns gets longer blocks: small tiles compress badly
MAX_TILE_BYTES = 1 << 24
MAX_RESULT_BYTES = 1 << 30
"""Greatest number of bytes that `decode` returns by default; documents allow less for an array."""


class BlockError(ValueError):
    """Block-encoded bytes are corrupt, truncated or do not match their header."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """Division of an array into tiles: an array is cut into blocks of frames, and each block into groups of columns."""

    spec: ArraySpec
    block_frames: int
    group_columns: int

    @property
    def frames(self) -> int:
        return self.spec.shape[0] if self.spec.shape else 1

    @property
    def columns(self) -> int:
        return math.prod(self.spec.shape[1:])

    @property
    def blocks(self) -> int:
        return -(-self.frames // self.block_frames)

    @property
    def groups(self) -> int:
        return -(-self.columns // self.group_columns)

    def of_frames(self, frames: int) -> "_Layout":
        """Return this layout for an array with another number of frames."""
        return replace(self, spec=ArraySpec(self.spec.dtype, (frames, *self.spec.shape[1:])))

    def block(self, index: int) -> slice:
        """Return the range of frames that the block with this number contains."""
        return slice(index * self.block_frames, min((index + 1) * self.block_frames, self.frames))

    def group(self, index: int) -> slice:
        """Return the range of columns that the group with this number contains."""
        return slice(index * self.group_columns, min((index + 1) * self.group_columns, self.columns))

    def lead(self, group: int) -> int | None:
        """Return how many columns of a group of columns come before the first quaternion that begins in it.

        `group` is the number of the group. Returns None if the array cannot contain quaternions: if it is not float32,
        or if its shape is neither that of poses, (F, 3 + 4 J), nor one with a last axis of 4.
        """
        if self.spec.dtype != "<f4":
            return None
        start: int = self.group(group).start
        if len(self.spec.shape) == 2 and self.columns % 4 == 3:
            return (3 - start) % 4
        return -start % 4 if self.spec.shape[-1:] == (4,) else None


def encode(array: NDArray[Any], *, predict: bool = True) -> bytes:
    """Encode an array of any shape and allowed dtype; the same array always gives the same bytes.

    Without `predict`, tiles are hardly compressed. This takes little more time than a copy, and is meant for bytes that
    are read only once. Raises `ArrayError` for a dtype or shape that is not allowed.
    """
    array = little_endian(array)
    layout = _layout_of(ArraySpec.of(array))
    return _assembled(layout, _packed(layout, array, predict=predict))


def is_well_packed(data: bytes) -> bool:
    """Return whether valid bytes may be stored instead of the bytes that `encode` would produce for the same array.

    They may be stored if they have the same layout as the bytes from `encode`, if every tile has a form with
    prediction, and if they are not larger than the plain array.
    """
    layout, starts = _read_head(data)
    return (
        layout == _layout_of(layout.spec)
        and starts[-1] - starts[0] <= layout.spec.nbytes
        and all(tiles.form_of(data[here:there]) != tiles.RAW for here, there in pairwise(starts))
    )


def _layout_of(spec: ArraySpec) -> _Layout:
    longer = NARROW_COLUMNS // max(math.prod(spec.shape[1:]), 1)
    return _Layout(spec, BLOCK_FRAMES * max(longer, 1), GROUP_COLUMNS)


def cut_frames(data: bytes, start: int, stop: int) -> bytes:
    """Return frames `start` to `stop` of an encoded array as another encoded array.

    If `start` is the first frame of a block, whole blocks are copied unchanged. All other frames are decoded and
    encoded again without prediction. Raises `BlockError` if the header, or a tile to decode, is corrupt.
    """
    layout, starts = _read_head(data)
    cut = layout.of_frames(stop - start)
    first, inside = divmod(start, layout.block_frames)
    blocks = 0 if inside else cut.blocks if stop == layout.frames else cut.frames // cut.block_frames
    passed_on = starts[first * layout.groups : (first + blocks) * layout.groups + 1]
    packed = [data[here:there] for here, there in pairwise(passed_on)]
    rest = decode(data, frames=slice(start + blocks * cut.block_frames, stop))
    return _assembled(cut, packed + _packed(cut.of_frames(len(rest)), rest, predict=False))


def split(data: bytes) -> list[bytes]:
    """Return the tiles of an encoded array. Raises `BlockError` if its header is corrupt."""
    _, starts = _read_head(data)
    return [data[here:there] for here, there in pairwise(starts)]


def count_tiles(spec: ArraySpec) -> int:
    """Return the number of tiles of an array in the layout that `encode` uses."""
    layout = _layout_of(spec)
    return layout.blocks * layout.groups


def join(spec: ArraySpec, packed: list[bytes]) -> bytes:
    """Return an encoded array that has the given tiles, in the layout that `encode` uses."""
    return _assembled(_layout_of(spec), packed)


def changed_blocks(data: bytes, former: bytes) -> Iterator[slice]:
    """Yield the frames of each block whose tiles differ between two encoded arrays; equal tiles are not decoded.

    Raises `BlockError` if the arrays do not have the same dtype, shape and layout.
    """
    (layout, starts), (other, others) = _read_head(data), _read_head(former)
    if layout != other:
        raise BlockError("the arrays have different layouts, so they cannot be compared block by block")
    for block in range(layout.blocks):
        first, end = block * layout.groups, (block + 1) * layout.groups
        if data[starts[first] : starts[end]] != former[others[first] : others[end]]:
            yield layout.block(block)


Edit = Callable[[NDArray[Any], NDArray[np.intp], slice], None]
"""Function that changes some frames of a block in place.

It is called with the (frames, columns) array of the block, the indices of the frames in the block, and the place of
these frames in the list of all frames to change.
"""


def with_edited_frames(data: bytes, frames: NDArray[np.intp], edit: Edit) -> bytes:
    """Return an encoded array in which `edit` has changed some frames; tiles of other blocks are copied unchanged.

    `frames` are indices in ascending order. Raises `BlockError` if the header, or a tile to decode, is corrupt.
    """
    layout, starts = _read_head(data)
    packed = [data[here:there] for here, there in pairwise(starts)]
    for block in np.unique(frames // layout.block_frames).tolist():
        within = layout.block(block)
        start, stop = np.searchsorted(frames, [within.start, within.stop]).tolist()
        table = decode(data, frames=within).reshape(within.stop - within.start, layout.columns)
        edit(table, frames[start:stop] - within.start, slice(start, stop))
        packed[block * layout.groups : (block + 1) * layout.groups] = _packed(
            layout.of_frames(len(table)), table, predict=True
        )
    return _assembled(layout, packed)


def _packed(layout: _Layout, array: NDArray[Any], *, predict: bool) -> list[bytes]:
    """Return the tiles of an array, each compressed separately."""
    table = array.reshape(layout.frames, layout.columns)
    parts = (
        (table[layout.block(block), layout.group(group)], layout.lead(group))
        for block in range(layout.blocks)
        for group in range(layout.groups)
    )
    return [tiles.pack(part, lead) if predict else tiles.pack_raw(part) for part, lead in parts]


def _assembled(layout: _Layout, packed: list[bytes]) -> bytes:
    """Return an encoded array as bytes, from its header, the index of its tiles, and the tiles."""
    spec = layout.spec
    head = MAGIC + spec.dtype.encode("ascii")
    head += struct.pack(f"<B{len(spec.shape)}Q", len(spec.shape), *spec.shape)
    head += struct.pack(f"<2I{len(packed)}I", layout.block_frames, layout.group_columns, *map(len, packed))
    return b"".join([head, struct.pack("<I", zlib.crc32(head)), *packed])


def read_spec(data: bytes) -> ArraySpec:
    """Return dtype and shape of an encoded array without decoding it. Raises `BlockError` if its header is corrupt."""
    return _read_head(data)[0].spec


def decode(
    data: bytes,
    *,
    frames: slice | None = None,
    columns: NDArray[np.intp] | None = None,
    max_bytes: int = MAX_RESULT_BYTES,
) -> NDArray[Any]:
    """Decode an array, or some of its frames and columns; only the tiles that contain the wanted values are read.

    `columns` are indices into all axes after the first, flattened: the result is then two-dimensional and equals
    `array.reshape(len(array), -1)[frames][:, columns]`. The result is writable. Raises `BlockError` if the data is
    corrupt, or if the result would have more than `max_bytes`. Raises `IndexError` in the same cases as numpy's
    indexing.
    """
    layout, starts = _read_head(data)
    if not layout.spec.shape and (frames is not None or columns is not None):
        raise IndexError("frames and columns can only be chosen from an array with at least one axis")
    chosen = range(layout.frames)[frames or slice(None)]
    rows = chosen if chosen.step > 0 else chosen[::-1]
    picked = None if columns is None else _column_indices(columns, layout.columns)
    width = layout.columns if picked is None else len(picked)
    dtype = np.dtype(layout.spec.dtype)
    if max(len(rows), 1) * max(width, 1) * dtype.itemsize > max_bytes:
        raise BlockError(
            f"the chosen {len(rows)} frames of {width} columns take more than the {max_bytes} bytes that are allowed"
        )
    table = np.empty((len(rows), width), dtype)
    for block, target_rows, tile_rows in _rows_by_block(layout, rows):
        for group, target_columns, tile_columns in _columns_by_group(layout, picked):
            tile = block * layout.groups + group
            part = _unpack(data[starts[tile] : starts[tile + 1]], layout, block, group)
            table[target_rows, target_columns] = part[tile_rows, tile_columns]
    if dtype.kind == "b" and (table.view(np.uint8) > 1).any():
        raise BlockError("the data of an array of booleans contains a byte that is neither 0 nor 1")
    if chosen.step < 0:
        table = np.ascontiguousarray(table[::-1])
    return table if columns is not None else table.reshape(layout.spec.shape and (len(rows), *layout.spec.shape[1:]))


def _read_head(data: bytes) -> tuple[_Layout, list[int]]:
    """Return the layout of an encoded array, the byte at which each tile starts, and the end of the last tile."""
    if data[: len(MAGIC)] != MAGIC:
        raise BlockError("these bytes are not a block-encoded array")
    try:
        dtype = data[4:7].decode("ascii")
        shape = struct.unpack_from(f"<{data[7]}Q", data, 8)
        table = 16 + 8 * len(shape)
        layout = _Layout(ArraySpec(dtype, shape), *struct.unpack_from("<2I", data, table - 8))
        _require_sane_tiles(layout)
        count = layout.blocks * layout.groups
        end = table + 4 * count
        if end + 4 > len(data):
            raise BlockError(f"the data ends inside the index of its {count} tiles")
        (checksum,) = struct.unpack_from("<I", data, end)
    except (IndexError, struct.error, UnicodeDecodeError, ArrayError) as error:
        raise BlockError(f"the header is malformed: {error}") from error
    if checksum != zlib.crc32(data[:end]):
        raise BlockError("the header is corrupt: its checksum does not match")
    sizes = np.frombuffer(data, "<u4", count, table)
    starts = [end + 4, *(end + 4 + np.cumsum(sizes, dtype=np.int64)).tolist()]
    if starts[-1] != len(data):
        raise BlockError(f"the data has {len(data)} bytes, but its index requires {starts[-1]}")
    return layout, starts


def _require_sane_tiles(layout: _Layout) -> None:
    if layout.block_frames < 1 or layout.group_columns < 1:
        raise BlockError("the header declares tiles without frames or without columns")
    largest = min(layout.block_frames, layout.frames) * min(layout.group_columns, layout.columns)
    largest_bytes = largest * np.dtype(layout.spec.dtype).itemsize
    if largest_bytes > MAX_TILE_BYTES:
        raise BlockError(f"the largest tile has {largest_bytes} bytes; at most {MAX_TILE_BYTES} are allowed")


def _unpack(packed: bytes, layout: _Layout, block: int, group: int) -> NDArray[Any]:
    frames, columns = layout.block(block), layout.group(group)
    try:
        return tiles.unpack(
            packed, np.dtype(layout.spec.dtype), frames.stop - frames.start, columns.stop - columns.start
        )
    except tiles.TileError as error:
        where = f"frames {frames.start} to {frames.stop}, columns {columns.start} to {columns.stop}"
        raise BlockError(f"the tile of {where} is corrupt: {error}") from error


def _rows_by_block(layout: _Layout, rows: range) -> Iterator[tuple[int, slice, slice]]:
    """Yield each block that contains some of `rows`, which are in ascending order.

    A block is yielded as its index, the indices of its rows in the result, and their indices in the block.
    """
    done = 0
    while done < len(rows):
        index = rows[done] // layout.block_frames
        block = layout.block(index)
        here = len(range(rows[done], block.stop, rows.step)) if rows[-1] >= block.stop else len(rows) - done
        first = rows[done] - block.start
        yield index, slice(done, done + here), slice(first, first + (here - 1) * rows.step + 1, rows.step)
        done += here


def _columns_by_group(
    layout: _Layout, picked: NDArray[np.intp] | None
) -> Iterator[tuple[int, slice | NDArray[np.intp], slice | NDArray[np.intp]]]:
    """Yield each group that contains some of the picked columns; None picks all columns.

    A group is yielded as its index, the indices of its columns in the result, and their indices in the group.
    """
    if picked is None:
        for index in range(layout.groups):
            yield index, layout.group(index), slice(None)
        return
    groups = picked // layout.group_columns
    for index in np.unique(groups).tolist():
        targets = np.flatnonzero(groups == index)
        yield index, targets, picked[targets] - index * layout.group_columns


def _column_indices(columns: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return `columns` after replacing each negative index, which counts from the end.

    Raises `IndexError` for an index outside the array, and if `columns` is not a one-dimensional list of integers.
    """
    picked = np.asarray(columns)
    if picked.ndim != 1 or (picked.size and picked.dtype.kind not in "iu"):
        raise IndexError("columns must be a one-dimensional list of integers")
    outside = picked[(picked < -count) | (picked >= count)]
    if outside.size:
        raise IndexError(f"column {outside[0]} is outside an array of {count} columns")
    return np.where(picked < 0, picked + count, picked).astype(np.intp)
