"""The block codec: arrays as compressed tiles of frames and columns, exact to the bit."""

import struct
import zlib
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from marey_schemas.arrayspec import ArrayError, ArraySpec, little_endian

MAGIC = b"MAB0"


class BlockError(ValueError):
    """Block-encoded bytes are corrupt, truncated or not what they claim to be."""


def encode(array: NDArray[Any]) -> bytes:
    """Encode an array of any shape and travelling dtype, exactly."""
    array = little_endian(array)
    spec = ArraySpec.of(array)
    head = MAGIC + spec.dtype.encode() + struct.pack(f"<B{array.ndim}Q", array.ndim, *array.shape)
    body = zstandard.ZstdCompressor(level=1, write_checksum=True).compress(array.tobytes())
    return head + struct.pack("<I", zlib.crc32(head)) + body


def read_spec(data: bytes) -> ArraySpec:
    """Dtype and shape of an encoded array, without decoding it. Raises `BlockError`."""
    return _read_head(data)[0]


def _read_head(data: bytes) -> tuple[ArraySpec, int]:
    try:
        if data[:4] != MAGIC:
            raise BlockError("these bytes are not a block-encoded array")
        ndim = data[7]
        end = 8 + 8 * ndim
        if struct.unpack_from("<I", data, end)[0] != zlib.crc32(data[:end]):
            raise BlockError("the header is corrupt")
        return ArraySpec(data[4:7].decode("ascii"), struct.unpack_from(f"<{ndim}Q", data, 8)), end + 4
    except (IndexError, struct.error, UnicodeDecodeError, ArrayError) as error:
        raise BlockError(f"the header is malformed: {error}") from error


def decode(data: bytes, *, frames: slice | None = None, columns: NDArray[np.intp] | None = None) -> NDArray[Any]:
    """Decode an array, or some frames (first axis) and columns (other axes, flattened) of it.

    With `columns` the result is two-dimensional: `array.reshape(len(array), -1)[frames][:, columns]`.
    """
    spec, start = _read_head(data)
    expected = int(np.dtype(spec.dtype).itemsize * np.prod(spec.shape, dtype=np.int64))
    try:
        if zstandard.frame_content_size(data[start:]) != expected:
            raise BlockError("the data does not have the size the header says")
        raw = zstandard.ZstdDecompressor().decompress(data[start:], max_output_size=expected)
    except zstandard.ZstdError as error:
        raise BlockError(f"the data is corrupt: {error}") from error
    array = np.frombuffer(bytearray(raw), spec.dtype).reshape(spec.shape)
    if frames is not None:
        array = array[frames]
    return array if columns is None else array.reshape(len(array), -1)[:, columns]
