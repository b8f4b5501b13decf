from contextlib import suppress

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.support.tiers import examples

from marey_schemas.encoding import tiles
from marey_schemas.encoding.tiles import DIFFERENCES, QUATERNIONS, RAW, TileError

FLOAT = np.dtype("<f4")


def rotations(frames: int, joints: int) -> NDArray[np.float32]:
    random = np.random.default_rng(0)
    quaternions = np.cumsum(random.normal(0, 0.01, (frames, joints, 4)), axis=0) + random.normal(0, 1, (joints, 4))
    return (quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)).reshape(frames, -1).astype(np.float32)


def content_of(packed: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(packed)


def forged(content: bytes) -> bytes:
    return zstandard.ZstdCompressor(write_checksum=True).compress(content)


def test_unit_quaternions_are_predicted() -> None:
    assert content_of(tiles.pack(rotations(64, 5), 0))[0] == QUATERNIONS


def test_columns_before_and_after_the_quaternions_are_kept() -> None:
    tile = np.concatenate([np.ones((64, 2)), rotations(64, 5), np.full((64, 3), 7.5)], axis=1).astype(np.float32)
    packed = tiles.pack(tile, 2)
    assert content_of(packed)[0] == QUATERNIONS
    assert tiles.unpack(packed, FLOAT, 64, 25).tobytes() == tile.tobytes()


@pytest.mark.parametrize("value", [0.0, 2.0, np.nan, np.inf])
def test_columns_that_are_no_unit_quaternions_are_only_differenced(value: float) -> None:
    tile = rotations(64, 5)
    tile[10] = value
    packed = tiles.pack(tile, 0)
    assert content_of(packed)[0] == DIFFERENCES
    assert tiles.unpack(packed, FLOAT, 64, 20).tobytes() == tile.tobytes()


def test_quaternions_whose_every_component_changes_sign_come_back_to_the_bit() -> None:
    angle = np.linspace(0, 40, 256)[:, None] * [1.0, 1.7, 2.3, 3.1] + [0.0, 1.0, 2.0, 3.0]
    tile = np.sin(angle)
    tile = (tile / np.linalg.norm(tile, axis=1, keepdims=True)).astype(np.float32)
    assert tiles.unpack(tiles.pack(tile, 0), FLOAT, 256, 4).tobytes() == tile.tobytes()


def test_what_does_not_get_smaller_is_stored_raw() -> None:
    tile = np.random.default_rng(0).integers(0, 1 << 32, (100, 100), dtype=np.uint32).view(np.float32)
    packed = tiles.pack(tile, 0)
    assert content_of(packed)[0] == RAW
    assert tiles.unpack(packed, FLOAT, 100, 100).tobytes() == tile.tobytes()


@given(data=st.data())
@settings(max_examples=examples(300))
def test_quaternions_with_any_low_bits_come_back_to_the_bit(data: st.DataObject) -> None:
    """The encoder does not verify tiles by decoding, so its prediction must be exact for all values that it accepts."""
    frames, joints, lead = data.draw(st.integers(1, 40)), data.draw(st.integers(1, 6)), data.draw(st.integers(0, 3))
    random = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    turned = random.normal(0, 10.0 ** random.uniform(-30, 1, (joints, 4)), (frames, joints, 4))
    turned[np.abs(turned).max(axis=-1) < 1e-20] = [1, 0, 0, -0.0]
    units = (turned / np.linalg.norm(turned, axis=-1, keepdims=True)).reshape(frames, -1).astype(np.float32)
    noisy = (units.view(np.uint32) ^ random.integers(0, 16, units.shape, dtype=np.uint32)).view(np.float32)
    before = random.integers(0, 1 << 32, (frames, lead), dtype=np.uint32).view(np.float32)
    tile = np.concatenate([before, noisy], axis=1)
    assert tiles._predict(tile, lead)[0][0] == QUATERNIONS
    assert tiles.unpack(tiles.pack(tile, lead), FLOAT, *tile.shape).tobytes() == tile.tobytes()


@pytest.mark.parametrize("dtype", ["<i4", "|i1", "<u8", "<f8"])
def test_straight_lines_cost_next_to_nothing(dtype: str) -> None:
    tile = np.arange(100)[:, None] * np.arange(1, 2) + np.zeros((1, 30))
    packed = tiles.pack(tile.astype(dtype), None)
    assert len(packed) < tile.astype(dtype).nbytes / 10


def test_a_tile_that_claims_another_size_is_refused_unread() -> None:
    with pytest.raises(TileError, match="the tile declares"):
        tiles.unpack(forged(bytes(1 << 24)), FLOAT, 4, 4)


def test_a_tile_that_does_not_say_its_size_is_refused() -> None:
    stream = zstandard.ZstdCompressor().compressobj()
    with pytest.raises(TileError):
        tiles.unpack(stream.compress(bytes(1 << 24)) + stream.flush(), FLOAT, 4, 4)


def test_bytes_behind_the_tile_are_refused() -> None:
    with pytest.raises(TileError):
        tiles.unpack(tiles.pack(rotations(64, 5), 0) + b"more", FLOAT, 64, 20)


@given(
    form=st.integers(0, 3),
    content=st.binary(max_size=120),
    dtype=st.sampled_from(["<f4", "<f8", "|b1", "<u2"]),
    frames=st.integers(1, 5),
    columns=st.integers(1, 9),
)
@settings(max_examples=examples(600))
def test_forged_content_is_decoded_or_refused(form: int, content: bytes, dtype: str, frames: int, columns: int) -> None:
    with suppress(TileError):
        tile = tiles.unpack(forged(bytes([form]) + content), np.dtype(dtype), frames, columns)
        assert tile.shape == (frames, columns)


@given(data=st.data())
@settings(max_examples=examples(300))
def test_forged_predictions_are_decoded_or_refused(data: st.DataObject) -> None:
    content = bytearray(content_of(tiles.pack(rotations(6, 3), 0)))
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    with suppress(TileError):
        assert tiles.unpack(forged(bytes(content)), FLOAT, 6, 12).shape == (6, 12)


@pytest.mark.parametrize("content", [b"", bytes([9]), bytes([RAW]), bytes([QUATERNIONS]), bytes([QUATERNIONS, 200])])
def test_content_that_ends_early_is_refused(content: bytes) -> None:
    with pytest.raises(TileError):
        tiles.unpack(forged(content), FLOAT, 4, 4)
