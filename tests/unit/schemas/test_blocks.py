import struct
import zlib
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from tests.support.tiers import examples

from marey_schemas.encoding import blocks, tiles
from marey_schemas.encoding.arrayspec import DTYPES, ArrayError, ArraySpec
from marey_schemas.encoding.blocks import BlockError


def any_bits() -> st.SearchStrategy[NDArray[Any]]:
    """Return a strategy for arrays of every allowed dtype and shape with any bit patterns, such as NaN and -0.0."""

    def of(dtype: str) -> st.SearchStrategy[NDArray[Any]]:
        shapes = hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=9)
        return hnp.arrays(dtype, shapes, elements=hnp.from_dtype(np.dtype(dtype)))

    return st.sampled_from(DTYPES).flatmap(of)


def poses(frames: int, joints: int, seed: int = 0) -> NDArray[np.float32]:
    """Return poses like those of a motion: root translations, then smooth unit quaternions with a little noise."""
    random = np.random.default_rng(seed)
    time_s = np.arange(frames)[:, None, None] / 60
    phase, size = random.uniform(0, 6.28, (2, 1, joints, 4))
    quaternions = np.sin(time_s + phase) * size + random.normal(0, 1e-4, (frames, joints, 4)) + [2, 0, 0, 0]
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    root = np.cumsum(random.normal(0, 1e-3, (frames, 3)), axis=0)
    return np.concatenate([root, quaternions.reshape(frames, -1)], axis=1).astype(np.float32)


def same_bits(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


def with_checksum(head: bytes) -> bytes:
    return head + struct.pack("<I", zlib.crc32(head))


@given(array=any_bits())
@settings(max_examples=examples(300))
def test_every_array_comes_back_to_the_bit(array: NDArray[Any]) -> None:
    assert same_bits(blocks.decode(blocks.encode(array)), array)


def test_bytes_of_the_encoder_may_be_kept() -> None:
    for array in (poses(300, 20), np.arange(5000), np.zeros((0, 7), np.float32)):
        assert blocks.is_well_packed(blocks.encode(array))


def test_bytes_without_prediction_and_those_of_another_layout_may_not_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    array = poses(600, 20)
    assert not blocks.is_well_packed(blocks.encode(array, predict=False))
    assert not blocks.is_well_packed(blocks.cut_frames(blocks.encode(array), 100, 300))
    monkeypatch.setattr(blocks, "BLOCK_FRAMES", 100)
    shorter = blocks.encode(array)
    monkeypatch.undo()
    assert same_bits(blocks.decode(shorter), array)
    assert not blocks.is_well_packed(shorter)


def test_bytes_that_empty_blocks_make_larger_than_the_array_may_not_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    array = poses(60, 20)

    def bloated(sections: list[NDArray[np.uint8]]) -> bytes:
        whole = b"".join(section.tobytes() for section in sections)
        stream = zstandard.ZstdCompressor(level=1, write_checksum=True).compressobj(size=len(whole))
        content = stream.compress(whole) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
        return content + bytes(3) * array.nbytes + stream.flush()

    monkeypatch.setattr(tiles, "_compress", lambda sections, level=1: bloated(sections))
    encoded = blocks.encode(array)
    assert same_bits(blocks.decode(encoded), array)
    assert not blocks.is_well_packed(encoded)


def test_a_million_random_float32_bit_patterns_come_back_to_the_bit() -> None:
    bits = np.random.default_rng(1).integers(0, 1 << 32, 1_000_000, dtype=np.uint32)
    for shape in [(-1,), (4000, 250), (-1, 4), (10_000, 25, 4)]:
        array = bits.view(np.float32).reshape(shape)
        assert same_bits(blocks.decode(blocks.encode(array)), array)


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-45, -1e-45, np.inf, -np.inf, np.nan, 3.4e38, -3.4e38])
def test_special_values_among_poses_come_back_to_the_bit(value: float) -> None:
    array = poses(300, 5)
    array[::7, ::3] = value
    assert same_bits(blocks.decode(blocks.encode(array)), array)


@pytest.mark.parametrize("shape", [(1, 3), (2, 7), (257, 1030), (256, 1027), (513, 2051), (300, 300, 4), (1, 40_000)])
def test_poses_wider_and_narrower_than_one_tile_come_back_to_the_bit(shape: tuple[int, ...]) -> None:
    columns = int(np.prod(shape[1:]))
    array = poses(shape[0], columns // 4 + 1)[:, 3:][:, :columns] if len(shape) == 3 else poses(shape[0], columns // 4)
    array = np.resize(array, shape)
    assert same_bits(blocks.decode(blocks.encode(array)), array)


def test_big_endian_and_strided_arrays_are_stored_as_their_numbers() -> None:
    array = np.arange(2000, dtype=">f8").reshape(100, 20)[::2, ::3]
    decoded = blocks.decode(blocks.encode(array))
    assert decoded.dtype.str == "<f8"
    assert np.array_equal(decoded, array)


def test_the_same_array_always_gives_the_same_bytes() -> None:
    array = poses(600, 20)
    assert blocks.encode(array) == blocks.encode(array.copy())
    assert blocks.encode(array) == blocks.encode(np.asfortranarray(array))


def test_a_decoded_array_is_writable() -> None:
    array = blocks.decode(blocks.encode(np.zeros((5, 2))))
    array[0, 0] = 1
    assert array[0, 0] == 1


def test_a_clip_of_63_joints_takes_less_than_500_bytes_per_pose() -> None:
    array = poses(3000, 63)
    assert len(blocks.encode(array)) <= 500 * len(array)


def test_predicting_a_quaternion_component_makes_poses_smaller() -> None:
    array = poses(1024, 40)
    without_translation = np.ascontiguousarray(array[:, :-1])  # 3 + 4k - 1 columns: no quaternions are seen
    assert len(blocks.encode(array)) < 0.95 * len(blocks.encode(without_translation))


def test_incompressible_arrays_grow_by_less_than_a_percent() -> None:
    array = np.random.default_rng(0).integers(0, 256, (1000, 1000), dtype=np.uint8)
    assert len(blocks.encode(array)) < 1.01 * array.nbytes


def test_the_spec_is_read_without_the_tiles() -> None:
    data = blocks.encode(poses(700, 10))
    broken = data[:-50] + bytes(50)
    assert blocks.read_spec(broken) == ArraySpec("<f4", (700, 43))


@pytest.mark.parametrize(
    "array",
    [poses(1000, 5), poses(600, 400), np.arange(5000.0), np.arange(20_000, dtype=np.int16).reshape(5000, 2, 2)],
    ids=["narrow", "wide", "one axis", "three axes"],
)
@pytest.mark.parametrize(
    ("start", "stop"), [(0, None), (0, 512), (256, None), (256, 600), (7, 300), (512, 513), (3, 3)]
)
def test_frames_cut_out_of_an_encoding_are_those_of_the_array(
    array: NDArray[Any], start: int, stop: int | None
) -> None:
    stop = len(array) if stop is None else stop
    assert same_bits(blocks.decode(blocks.cut_frames(blocks.encode(array), start, stop)), array[start:stop])


def test_blocks_that_are_cut_out_whole_are_passed_on_as_they_are_stored() -> None:
    array = poses(1000, 40)
    data = blocks.encode(array)
    assert blocks.cut_frames(data, 0, 1000) == data
    assert blocks.cut_frames(data, 256, 768) == blocks.encode(array[256:768])
    assert len(blocks.cut_frames(data, 256, 1000)) < len(blocks.cut_frames(data, 257, 1000))


def test_an_array_may_be_encoded_for_speed_instead_of_size() -> None:
    array = poses(1000, 40)
    fast = blocks.encode(array, predict=False)
    assert same_bits(blocks.decode(fast), array)
    assert len(blocks.encode(array)) < len(fast) < 1.01 * array.nbytes


@st.composite
def partial_reads(draw: st.DrawFn) -> tuple[NDArray[Any], slice, NDArray[np.intp] | None]:
    frames = draw(st.integers(1, 900))
    shape = draw(st.sampled_from([(frames, 3), (frames, 79), (frames, 5, 4), (frames,), (frames, 2, 600)]))
    array = np.arange(np.prod(shape), dtype=draw(st.sampled_from(["<f4", "<f8", "<i2"]))).reshape(shape)
    bound = st.none() | st.integers(-frames - 5, frames + 5)
    step = st.none() | st.integers(-300, 300).filter(bool)
    columns = int(np.prod(shape[1:]))
    picked = st.lists(st.integers(-columns, columns - 1), max_size=12).map(lambda picks: np.array(picks, np.intp))
    return array, slice(draw(bound), draw(bound), draw(step)), draw(st.none() | picked)


@given(case=partial_reads())
@settings(max_examples=examples(200))
def test_a_partial_read_equals_slicing_the_whole(case: tuple[NDArray[Any], slice, NDArray[np.intp] | None]) -> None:
    array, frames, columns = case
    expected = array[frames] if columns is None else array.reshape(len(array), -1)[frames][:, columns]
    assert same_bits(
        blocks.decode(blocks.encode(array), frames=frames, columns=columns), np.ascontiguousarray(expected)
    )


def test_a_partial_read_touches_only_its_tiles() -> None:
    array = poses(1000, 400)
    data = bytearray(blocks.encode(array))
    data[-100:] = bytes(100)  # the last columns of the last frames
    assert same_bits(blocks.decode(bytes(data), frames=slice(0, 512)), array[:512])
    first_columns = np.arange(50)
    assert same_bits(blocks.decode(bytes(data), columns=first_columns), np.ascontiguousarray(array[:, :50]))
    with pytest.raises(BlockError, match="frames 768 to 1000, columns 1024 to 1603"):
        blocks.decode(bytes(data))


@pytest.mark.parametrize("columns", [[7], [-8], [[0]], [0.5]])
def test_columns_outside_the_array_are_refused(columns: list[Any]) -> None:
    data = blocks.encode(np.zeros((4, 7)))
    with pytest.raises(IndexError, match="column"):
        blocks.decode(data, columns=np.array(columns))


def test_an_array_without_axes_has_no_parts() -> None:
    data = blocks.encode(np.array(3.0))
    with pytest.raises(IndexError, match="at least one axis"):
        blocks.decode(data, frames=slice(0, 1))


@pytest.mark.parametrize("dtype", ["f2", "c16", "U2", "O", "M8[s]"])
def test_a_dtype_that_may_not_travel_is_refused(dtype: str) -> None:
    with pytest.raises(ArrayError, match="dtype"):
        blocks.encode(np.zeros(3, dtype))


@pytest.fixture(scope="module")
def encoded() -> bytes:
    return blocks.encode(poses(520, 12))


def test_a_changed_byte_never_changes_the_array(encoded: bytes) -> None:
    array, unnoticed = blocks.decode(encoded), 0
    positions = range(0, len(encoded), 41)
    for position in positions:
        changed = bytearray(encoded)
        changed[position] ^= 0x10
        with suppress(BlockError):
            assert same_bits(blocks.decode(bytes(changed)), array)
            unnoticed += 1  # zstd has bits without a meaning
    assert unnoticed < 0.05 * len(positions)


def test_every_truncation_and_extension_is_noticed(encoded: bytes) -> None:
    for length in [*range(60), *range(60, len(encoded), 199)]:
        with pytest.raises(BlockError):
            blocks.decode(encoded[:length])
    with pytest.raises(BlockError, match="index requires"):
        blocks.decode(encoded + b"\0")


@given(data=st.data())
@settings(max_examples=examples(400))
def test_a_forged_header_is_decoded_or_refused_within_its_limit(encoded: bytes, data: st.DataObject) -> None:
    table = 16 + 8 * encoded[7]
    end = table + 4 * 3  # three blocks
    head = bytearray(encoded[:end])
    for _ in range(data.draw(st.integers(1, 4))):
        head[data.draw(st.integers(4, end - 1))] = data.draw(st.integers(0, 255))
    with suppress(BlockError):
        assert blocks.decode(with_checksum(bytes(head)) + encoded[end + 4 :], max_bytes=1 << 22).nbytes <= 1 << 22


@pytest.mark.parametrize(
    ("shape", "block_frames", "group_columns"),
    [
        ((1 << 39, 1), 1, 1),  # an index of half a tera of tiles
        ((1 << 20, 1 << 19), 1 << 31, 1 << 31),  # one tile of 2 TB
        ((4, 4), 0, 1),
        ((4, 4), 1, 0),
        ((1 << 62, 1 << 62), 1, 1),
    ],
)
def test_claims_beyond_reason_are_refused_unallocated(
    shape: tuple[int, ...], block_frames: int, group_columns: int
) -> None:
    head = blocks.MAGIC + b"<f4" + struct.pack("<B2Q2I", 2, *shape, block_frames, group_columns)
    with pytest.raises(BlockError):
        blocks.decode(with_checksum(head) + bytes(64))


def test_an_array_larger_than_allowed_is_refused_but_its_parts_can_be_read() -> None:
    array = np.zeros((100_000, 30), np.float32)
    data = blocks.encode(array)
    assert len(data) < 20_000
    with pytest.raises(BlockError, match="take more than the 1000000 bytes that are allowed"):
        blocks.decode(data, max_bytes=1_000_000)
    assert blocks.decode(data, frames=slice(0, 100), max_bytes=1_000_000).shape == (100, 30)


def test_a_boolean_that_is_neither_0_nor_1_is_refused() -> None:
    data = bytearray(blocks.encode(np.array([0, 1, 2], np.uint8)))
    data[4:7] = b"|b1"
    end = 16 + 8 + 4
    forged = with_checksum(bytes(data[:end])) + bytes(data[end + 4 :])
    with pytest.raises(BlockError, match="boolean"):
        blocks.decode(forged)
