"""A second, slow decoder, written from docs/reference/block-format.md, reads what the codec writes."""

import itertools
import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray

from marey_schemas.encoding import blocks


def read_file(data: bytes) -> NDArray[Any]:
    assert data[:4] == b"MRB1"
    dtype = np.dtype(data[4:7].decode())
    axes = data[7]
    shape = struct.unpack_from(f"<{axes}Q", data, 8)
    block_frames, group_columns = struct.unpack_from("<2I", data, 8 + 8 * axes)
    frames, columns = (shape[0] if shape else 1), math.prod(shape[1:])
    corners = list(itertools.product(range(0, frames, block_frames), range(0, columns, group_columns)))
    lengths = struct.unpack_from(f"<{len(corners)}I", data, 16 + 8 * axes)
    position = 16 + 8 * axes + 4 * len(corners)
    assert struct.unpack_from("<I", data, position)[0] == zlib.crc32(data[:position])
    position += 4
    table = np.zeros((frames, columns), dtype)
    for (frame, column), length in zip(corners, lengths, strict=True):
        n, c = min(block_frames, frames - frame), min(group_columns, columns - column)
        tile = read_tile(data[position : position + length], n, c, dtype)
        table[frame : frame + n, column : column + c] = tile
        position += length
    assert position == len(data)
    return table.reshape(shape)


def read_tile(packed: bytes, n: int, c: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    content = zstandard.ZstdDecompressor().decompress(packed)
    stream, w = iter(content[1:]), dtype.itemsize
    if content[0] == 0:
        return np.frombuffer(bytes(stream), dtype).reshape(n, c)
    channels = channel_section(stream, c, n, w) if content[0] == 1 else quaternion_section(stream, c, n)
    if dtype.kind == "f":
        channels = [[flip(u, w) for u in channel] for channel in channels]
    return np.array(channels, f"<u{w}").T.copy().view(dtype)


def take(stream: Iterator[int], count: int) -> list[int]:
    return list(itertools.islice(stream, count))


def flip(u: int, w: int) -> int:
    return u ^ ((1 << 8 * w - 1) - 1) if u >> (8 * w - 1) else u


def byte_planes(stream: Iterator[int], k: int, n: int, w: int) -> list[list[int]]:
    planes = [take(stream, k * n) for _ in range(w)]
    folded = [sum(plane[i] << 8 * byte for byte, plane in enumerate(planes)) for i in range(k * n)]
    unfolded = [((f >> 1) ^ -(f & 1)) % (1 << 8 * w) for f in folded]
    return [unfolded[i * n : (i + 1) * n] for i in range(k)]


def channel_section(stream: Iterator[int], k: int, n: int, w: int) -> list[list[int]]:
    orders = take(stream, k)
    channels = byte_planes(stream, k, n, w)
    for order, x in zip(orders, channels, strict=True):
        for m in range(order, 0, -1):
            for t in range(m, n):
                x[t] = (x[t] + x[t - 1]) % (1 << 8 * w)
    return channels


def quaternion_section(stream: Iterator[int], c: int, n: int) -> list[list[int]]:
    (lead,) = take(stream, 1)
    q = (c - lead) // 4
    choices = take(stream, q)
    others = iter(channel_section(stream, c - q, n, 4))
    residuals = byte_planes(stream, q, n, 4)
    channels = list(itertools.islice(others, lead))
    for choice, residual in zip(choices, residuals, strict=True):
        three = list(itertools.islice(others, 3))
        predicted = [predict(a, b, c, bool(choice & 4)) for a, b, c in zip(*three, strict=True)]
        three.insert(choice & 3, [(p + r) % (1 << 32) for p, r in zip(predicted, residual, strict=True)])
        channels += three
    return channels + list(others)


def predict(ua: int, ub: int, uc: int, negative: bool) -> int:
    a, b, c = (struct.unpack("<f", struct.pack("<I", flip(u, 4)))[0] for u in (ua, ub, uc))
    p = math.sqrt(max(((1 - a * a) - b * b) - c * c, 0))
    return flip(struct.unpack("<I", struct.pack("<f", -p if negative else p))[0], 4)


def smooth(frames: int, columns: int, seed: int = 3) -> NDArray[np.float64]:
    random = np.random.default_rng(seed)
    return np.cumsum(random.normal(0, 0.02, (frames, columns)), axis=0) + random.normal(0, 1, columns)


def turning(frames: int, joints: int) -> NDArray[np.float32]:
    quaternions = smooth(frames, 4 * joints).reshape(frames, joints, 4)
    return (quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize(
    "array",
    [
        np.concatenate([smooth(300, 3).astype(np.float32), turning(300, 6).reshape(300, 24)], axis=1),
        turning(40, 3),
        turning(20, 260),
        smooth(500, 2),
        smooth(30, 40).astype(np.float32) * np.float32(1e-42),
        (smooth(300, 5) * 100).astype(np.int16),
        (smooth(300, 5) * 1e12).astype(np.int64),
        np.arange(1000, dtype=np.uint8),
        np.random.default_rng(0).integers(0, 1 << 32, (50, 60), dtype=np.uint32),
        np.eye(20, dtype=bool),
        np.array(7.5),
        np.zeros((0, 7), np.float32),
        np.zeros((3, 0)),
    ],
    ids=lambda array: f"{array.dtype.str}{array.shape}",
)
def test_the_page_decodes_what_the_codec_writes(array: NDArray[Any]) -> None:
    decoded = read_file(blocks.encode(array))
    assert (decoded.dtype, decoded.shape, decoded.tobytes()) == (array.dtype, array.shape, array.tobytes())
