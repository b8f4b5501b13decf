"""Arrays without the tiles that a receiver has: what is left out, and what is refused."""

from __future__ import annotations

import tracemalloc
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.arrayspec import ArrayError
from marey_schemas.encoding.canonical import array_digest
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_schemas.encoding.partial_arrays import completed, is_partial, partial_array, tile_digests

BASE = "sha256:" + "0" * 64
FRAMES = 2000
"""Frames of eight blocks; the last is shorter."""


def poses(frames: int = FRAMES, *, columns: int = 70) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.random.default_rng(1).normal(size=(frames, columns)).astype("<f4")


def partial_of(array: np.ndarray[Any, Any], base: np.ndarray[Any, Any]) -> dict[str, Any] | None:
    return partial_array(EncodedArray.of(array), BASE, "/poses", tile_digests(EncodedArray.of(base)))


def received(partial: Mapping[str, Any]) -> Any:
    """Return a partial array as a server decodes it."""
    return decode_tree(encode_tree(partial, MSGPACK, arrays="blocks"), MSGPACK)


def expect_error(base: EncodedArray, partial: Mapping[str, Any], **changed: Any) -> None:
    with pytest.raises(ArrayError):
        completed({**partial, **changed}, blocks.split(base.data))


@settings(max_examples=examples(20), deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(1, 40)), max_size=3),
    st.integers(1, FRAMES + 300),
    st.sampled_from([0, 256, 300]),
)
def test_a_partial_array_becomes_the_array_again(edits: list[tuple[int, int]], frames: int, shifted: int) -> None:
    base = poses()
    array = np.concatenate([base[:shifted], poses(FRAMES + 300)])[:frames]
    for start, length in edits:
        array[start : start + length] += 1
    partial = partial_of(array, base)
    if partial is None:
        return
    assert is_partial(partial)
    whole = completed(received(partial), blocks.split(EncodedArray.of(base).data))
    assert array_digest(whole) == array_digest(array)


def test_only_the_tiles_of_edited_frames_are_sent() -> None:
    base, array = poses(), poses()
    array[600:610] += 1
    partial = partial_of(array, base)
    assert partial is not None
    assert partial["tiles"].tolist() == [0, 1, -1, 3, 4, 5, 6, 7]
    assert len(encode_tree(partial, MSGPACK, arrays="blocks")) < 1.1 * len(EncodedArray.of(array).data) / 7


def test_an_array_without_a_common_tile_is_sent_whole() -> None:
    assert partial_of(poses() + 1, poses()) is None
    assert partial_of(poses(0), poses()) is None


def test_a_partial_array_that_does_not_fit_its_base_is_refused() -> None:
    base, array = poses(), poses()
    array[600:610] += 1
    partial = partial_of(array, base)
    assert partial is not None
    encoded = EncodedArray.of(base)
    tiles, sizes = partial["tiles"], partial["sizes"]
    expect_error(encoded, partial, tiles=np.where(tiles == 7, 8, tiles))
    expect_error(encoded, partial, tiles=np.where(tiles == 7, -2, tiles))
    expect_error(encoded, partial, tiles=np.where(tiles == 7, 6, tiles))  # a tile of another size
    expect_error(encoded, partial, tiles=tiles[:-1])
    expect_error(encoded, partial, tiles=np.where(tiles == 7, -1, tiles))
    expect_error(encoded, partial, tiles=tiles.astype("<f4"))
    expect_error(encoded, partial, tiles="0")
    expect_error(encoded, partial, sizes=sizes + 1)
    expect_error(encoded, partial, sizes=np.array([sizes[0] + 1, -1]))
    expect_error(encoded, partial, shape=[FRAMES, 71])
    expect_error(encoded, partial, shape=[1 << 30, 1 << 9])
    expect_error(encoded, partial, dtype="<f8")
    expect_error(encoded, partial, bytes=partial["bytes"].decode()[::-1])


@pytest.mark.parametrize("shape", [[1], [1000 * 16384]])
def test_repeated_tiles_do_not_take_more_memory_than_the_array(shape: list[int]) -> None:
    """A short list of tiles would otherwise become gigabytes, because it can name a large tile many times."""
    base = EncodedArray.of(np.random.default_rng(1).integers(0, 255, size=(256, 1024), dtype=np.uint8))
    partial = {
        "base": BASE, "pointer": "", "dtype": "|u1", "shape": shape, "tiles": np.zeros(1000, "<i4"),
        "sizes": np.empty(0, "<i4"), "bytes": np.empty(0, np.uint8),
    }  # fmt: skip
    tiles = blocks.split(base.data)
    tracemalloc.start()
    try:
        with pytest.raises(ArrayError, match=r"too long|do not match"):
            completed(partial, tiles)
        assert tracemalloc.get_traced_memory()[1] < 8 * len(base.data)
    finally:
        tracemalloc.stop()
