"""Tiles of the block codec: some frames of some columns of an array, as one losslessly compressed zstd frame.

Compression is based on integer prediction, which is exact. Floats are mapped to integers with the same order. Each
column is replaced by its differences of up to the third order. The largest component of a unit quaternion is predicted
from the other three, up to a few units in the last place. docs/reference/block-format.md describes the layout.
"""

from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Integers = NDArray[Any]  # (channels, frames) unsigned, as wide as the numbers they stand for

RAW, DIFFERENCES, QUATERNIONS = 0, 1, 2
FASTEST = -1  # of zstd's levels: it leaves numbers without repetition as they are
HARDLY_SMALLER = 7 / 8
"""Size of a compressed tile, as a share of its plain bytes, above which the form `RAW` is tried, too.

To try `RAW` for every tile would save only 0.15 % of the size of real motion.
"""
MAX_ORDER = 3
_SQUARE_TOLERANCE = 1e-3  # of the squared norm: what is further from one is not a rotation


class TileError(ValueError):
    """The bytes are not a tile of the expected size."""


def pack(tile: NDArray[Any], lead: int | None) -> bytes:
    """Compress a (frames, columns) little-endian array.

    `lead` is the number of columns before the first quaternion; None if there are no quaternions. A form with
    prediction is tried first. If the result is hardly smaller than the plain bytes, `RAW` is tried, too, and the
    smaller result is returned.
    """
    packed = _compress(_predict(tile, lead))
    if len(packed) <= HARDLY_SMALLER * tile.nbytes:
        return packed
    return min(packed, pack_raw(tile, level=1), key=len)


def pack_raw(tile: NDArray[Any], level: int = FASTEST) -> bytes:
    """Encode a (frames, columns) little-endian array without prediction, by default at about the speed of copying."""
    plain = np.ascontiguousarray(tile).view(np.uint8).reshape(-1)
    return _compress([np.array([RAW], np.uint8), plain], level)


def unpack(data: bytes | memoryview, dtype: np.dtype[Any], frames: int, columns: int) -> NDArray[Any]:
    """Return the (frames, columns) array of a tile.

    Raises `TileError` for bytes that are not a tile of this dtype and size. The function never allocates more memory
    than the tile needs.
    """
    try:
        size = zstandard.frame_content_size(data)
        if not 0 < size <= 2 + 2 * columns + frames * columns * dtype.itemsize:
            raise TileError(
                f"the tile declares {size} bytes, which is not possible for {frames} x {columns} values of {dtype.str}"
            )
        content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise TileError(str(error)) from error
    return _restore(np.frombuffer(content, np.uint8), dtype, frames, columns)


def form_of(data: bytes) -> int:
    """Return the form of a valid tile, `RAW`, `DIFFERENCES` or `QUATERNIONS`, by decompressing only its start."""
    return zstandard.ZstdDecompressor().stream_reader(data).read(1)[0]


def _compress(sections: list[Bytes], level: int = 1) -> bytes:
    """Return one zstd frame in which every section ends a block, so that each section has its own entropy tables."""
    size = sum(section.size for section in sections)
    stream = zstandard.ZstdCompressor(level=level, write_checksum=True).compressobj(size=size)
    parts = []
    for section in sections:
        parts += [stream.compress(section.data), stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*parts, stream.flush()])


def _predict(tile: NDArray[Any], lead: int | None) -> list[Bytes]:
    """Return the sections of the form `QUATERNIONS` if the tile contains unit quaternions, else of `DIFFERENCES`."""
    channels = to_integers(np.ascontiguousarray(tile.T))
    if lead is not None and _holds_rotations(tile, lead):
        return [np.array([QUATERNIONS, lead], np.uint8), *_predict_quaternions(channels, lead)]
    return [np.array([DIFFERENCES], np.uint8), *_difference(channels)]


def _restore(content: Bytes, dtype: np.dtype[Any], frames: int, columns: int) -> NDArray[Any]:
    form, body = content[0], _Sections(content[1:])
    if form == RAW:
        tile = body.take(frames * columns * dtype.itemsize).view(dtype).reshape(frames, columns)
    elif form == DIFFERENCES:
        tile = from_integers(_undo_difference(body, dtype.itemsize, columns, frames), dtype).T
    elif form == QUATERNIONS and dtype == np.dtype("<f4"):
        tile = from_integers(_undo_prediction(body, columns, frames), dtype).T
    else:
        raise TileError(f"the tile has the form {form}, which does not exist for the dtype {dtype.str}")
    body.require_end()
    return tile


class _Sections:
    """Reader of the sections of a tile's content, one after the other."""

    def __init__(self, content: Bytes) -> None:
        self._rest = content

    def take(self, size: int) -> Bytes:
        if size > self._rest.size:
            raise TileError(
                f"the tile ends too early: its next section needs {size} bytes, but {self._rest.size} are left"
            )
        taken, self._rest = self._rest[:size], self._rest[size:]
        return taken

    def require_end(self) -> None:
        if self._rest.size:
            raise TileError(f"the tile has {self._rest.size} bytes after its last section")


# Floats as integers


def to_integers(channels: NDArray[Any]) -> Integers:
    """Return the values as unsigned integers; the integers of floats, read as signed integers, sort like the floats."""
    bits = channels.view(f"<u{channels.dtype.itemsize}")
    return _order(bits) if channels.dtype.kind == "f" else bits


def from_integers(integers: Integers, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the values whose integers `to_integers` returned; `dtype` is the dtype of the values."""
    return (_order(integers) if dtype.kind == "f" else integers).view(dtype)


def _order(bits: Integers) -> Integers:
    """Flip all but the sign bit of negative floats, so that the bits sort like the floats; return the new bits.

    The function is its own inverse.
    """
    width = 8 * bits.itemsize
    signs = bits.view(f"<i{bits.itemsize}") >> (width - 1)
    ordered: Integers = bits ^ (signs.view(bits.dtype) >> 1)
    return ordered


def _fold_sign(integers: Integers) -> Integers:
    """Map 0, -1, 1, -2, ... to 0, 1, 2, 3, ..., so that the high bytes of small differences are zero."""
    signs = integers.view(f"<i{integers.itemsize}") >> (8 * integers.itemsize - 1)
    folded: Integers = (integers << 1) ^ signs.view(integers.dtype)
    return folded


def _unfold_sign(folded: Integers) -> Integers:
    unfolded: Integers = (folded >> 1) ^ (0 - (folded & 1))
    return unfolded


# Differences


def _difference(channels: Integers) -> list[Bytes]:
    """Replace each channel by its differences, of the order (0 to `MAX_ORDER`) that needs the fewest bits.

    Returns the order of each channel (one byte), then the byte planes of the differences, lowest byte first.
    """
    best = _fold_sign(channels)
    cost = _bits_needed(best)
    orders = np.zeros(len(channels), np.uint8)
    step = channels
    for order in range(1, min(MAX_ORDER, channels.shape[1] - 1) + 1):
        step = np.concatenate([step[:, :order], step[:, order:] - step[:, order - 1 : -1]], axis=1)
        folded = _fold_sign(step)
        folded_cost = _bits_needed(folded)
        better = folded_cost < cost
        cost[better], orders[better], best[better] = folded_cost[better], order, folded[better]
    return [orders, *_split_planes(best)]


def _bits_needed(folded: Integers) -> NDArray[np.int64]:
    """Return a measure of the bits that each channel needs, for comparison: larger values mean more bits.

    Each number is converted to float32, and the bits of the float32 are read as an integer. This integer grows almost
    linearly with log2 of the number. The measure is the sum of these integers over the channel.
    """
    logarithms = (folded | 1).astype(np.float32).view(np.int32)
    cost: NDArray[np.int64] = logarithms.sum(axis=1, dtype=np.int64)
    return cost


def _undo_difference(body: _Sections, itemsize: int, channels: int, frames: int) -> Integers:
    orders = body.take(channels)
    integers = _unfold_sign(_join_planes(body, itemsize, channels, frames))
    for order in range(MAX_ORDER, 0, -1):
        rows = np.flatnonzero(orders >= order)
        part = integers[rows, order - 1 :]
        integers[rows, order - 1 :] = np.add.accumulate(part, axis=1, out=part)
    return integers


def _split_planes(integers: Integers) -> list[Bytes]:
    return [(integers >> (8 * byte)).astype(np.uint8).reshape(-1) for byte in range(integers.itemsize)]


def _join_planes(body: _Sections, itemsize: int, channels: int, frames: int) -> Integers:
    integers = np.empty((channels, frames), f"<u{itemsize}")
    in_bytes = integers.view(np.uint8).reshape(channels, frames, itemsize)
    for byte in range(itemsize):
        in_bytes[:, :, byte] = body.take(channels * frames).reshape(channels, frames)
    return integers


# Quaternions


def _holds_rotations(tile: NDArray[np.float32], lead: int) -> bool:
    count = (tile.shape[1] - lead) // 4
    if count < 1:
        return False
    quaternions = tile[:, lead : lead + 4 * count].reshape(len(tile), count, 4)
    squared = np.einsum("fjc,fjc->fj", quaternions, quaternions)
    return bool((np.abs(squared - 1) < _SQUARE_TOLERANCE).all())


def _predict_quaternions(channels: Integers, lead: int) -> list[Bytes]:
    """Return the parts of a tile in which one component of each quaternion is predicted from the other three.

    The parts are the choice of these components, the bytes of the other channels, and the bytes of the prediction
    errors.
    """
    count = (len(channels) - lead) // 4
    values = from_integers(channels, np.dtype("<f4"))
    quaternions = values[lead : lead + 4 * count].reshape(count, 4, -1)
    chosen = np.abs(quaternions).min(axis=2).argmax(axis=1)
    predicted_rows, other_rows = _rows(chosen, len(channels), lead)
    negative = np.signbit(values[predicted_rows]).mean(axis=1) > 0.5
    residuals = channels[predicted_rows] - _prediction(channels[other_rows], lead, count, negative)
    choice = chosen.astype(np.uint8) | (negative.astype(np.uint8) << 2)
    return [choice, *_difference(channels[other_rows]), *_split_planes(_fold_sign(residuals))]


def _undo_prediction(body: _Sections, columns: int, frames: int) -> Integers:
    lead = int(body.take(1)[0])
    count = (columns - lead) // 4
    if count < 1:
        raise TileError(f"the tile declares quaternions after its first {lead} columns, but has only {columns} columns")
    choice = body.take(count)
    if (choice > 7).any():
        raise TileError("the predictor of a quaternion must be a number from 0 to 7 (component + 4 * sign)")
    predicted_rows, other_rows = _rows(choice & 3, columns, lead)
    channels = np.empty((columns, frames), np.uint32)
    channels[other_rows] = others = _undo_difference(body, 4, columns - count, frames)
    residuals = _unfold_sign(_join_planes(body, 4, count, frames))
    channels[predicted_rows] = _prediction(others, lead, count, choice > 3) + residuals
    return channels


def _rows(chosen: NDArray[Any], columns: int, lead: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the channels that are predicted, and the indices of all other channels, each in order."""
    predicted = lead + 4 * np.arange(len(chosen)) + chosen
    return predicted.astype(np.intp), np.delete(np.arange(columns), predicted)


def _prediction(others: Integers, lead: int, count: int, negative: NDArray[np.bool_]) -> Integers:
    """Predict one component of each quaternion from the other three: ±sqrt(1 - a² - b² - c²), as float32 bits.

    a, b and c are the three rows of `others` for this quaternion; the rows start after the first `lead` rows. Returns
    integers (`count`, frames). The root is computed in double precision.

    Products of two float32 are exact in double precision, so a fused multiply-add changes nothing: every machine with
    IEEE 754 arithmetic computes the same bits.
    """
    three = from_integers(others[lead : lead + 3 * count], np.dtype("<f4")).reshape(count, 3, -1)
    with np.errstate(all="ignore"):  # corrupt bytes may hold anything
        squared = np.square(three.astype(np.float64))
        rest = 1.0 - squared[:, 0] - squared[:, 1] - squared[:, 2]
        length = np.sqrt(np.maximum(rest, 0.0)).astype(np.float32)
    return to_integers(np.where(negative[:, None], -length, length))
