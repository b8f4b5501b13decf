"""Arrays that are sent as the frames in which they differ from a base: what is sent, and what is refused."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.support.tiers import examples

from marey_schemas.encoding import blocks
from marey_schemas.encoding.array_differences import ArrayDifference, detach_differences
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.arrayspec import DTYPES, ArrayError
from marey_schemas.encoding.canonical import array_digest, detach_arrays
from marey_schemas.encoding.codecs import MSGPACK, CodecError, decode_tree, encode_tree

BASE = "sha256:" + "0" * 64
FRAMES = 700
"""Frames of three blocks of the arrays below; the last block is shorter."""
SHAPES: list[tuple[int, ...]] = [(), (0,), (1,), (FRAMES,), (FRAMES, 0), (FRAMES, 7), (FRAMES, 71), (FRAMES, 17, 4)]


def numbers(dtype: str, shape: tuple[int, ...], seed: int = 1) -> NDArray[Any]:
    drawn = np.random.default_rng(seed).normal(scale=3, size=shape)
    return np.asarray(np.abs(drawn) if np.dtype(dtype).kind == "u" else drawn).astype(dtype)


def difference_of(array: NDArray[Any], base: NDArray[Any]) -> ArrayDifference | None:
    ours, theirs = EncodedArray.of(array), EncodedArray.of(base)
    return ArrayDifference.between(ours, theirs, BASE, "/poses", array_digest(array))


def received(tree: Any) -> Any:
    """Return a document as a server decodes it."""
    return decode_tree(encode_tree(tree, MSGPACK, arrays="blocks"), MSGPACK)


def restored(found: ArrayDifference, base: NDArray[Any]) -> NDArray[Any]:
    sent = ArrayDifference.of(received(found.document))
    assert sent is not None
    whole = sent.applied_to(EncodedArray.of(base))
    return whole.decode() if isinstance(whole, EncodedArray) else whole


@settings(max_examples=examples(60), deadline=None)
@given(
    st.sampled_from(DTYPES),
    st.sampled_from(SHAPES),
    st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(1, 40), st.booleans()), max_size=4),
)
def test_the_sum_of_base_and_difference_is_the_array(
    dtype: str, shape: tuple[int, ...], edits: list[tuple[int, int, bool]]
) -> None:
    """This holds for all numbers, including the extremes of the dtype and signed zeros."""
    base = numbers(dtype, shape)
    array, other = base.copy(), numbers(dtype, shape, seed=2)
    for start, length, extreme in edits if shape else ():
        array[start : start + length] = other[start : start + length]
        if extreme and array.size and array.dtype.kind != "b":
            limits = np.finfo(dtype) if array.dtype.kind == "f" else np.iinfo(dtype)
            array[start : start + length] = limits.max
            array[start : start + 1] = -0.0 if array.dtype.kind == "f" else limits.min
    found = difference_of(array, base)
    if found is None:
        return
    whole = restored(found, base)
    assert (whole.dtype, whole.shape, whole.tobytes()) == (array.dtype, array.shape, array.tobytes())
    assert len(encode_tree(found.document, MSGPACK, arrays="blocks")) < len(EncodedArray.of(array).data) + 1000


def test_nine_edited_frames_of_nine_hundred_take_less_than_two_percent() -> None:
    """A block of 256 frames, which a partial array would contain, is more than a quarter of the array."""
    base = np.cumsum(numbers("<f4", (900, 311)), axis=0, dtype=np.float32) / 100
    array = base.copy()
    array[500:509] += 0.01
    found = difference_of(array, base)
    assert found is not None
    assert isinstance(found.frames, np.ndarray)
    assert found.frames.tolist() == list(range(500, 509))
    size = len(encode_tree(found.document, MSGPACK, arrays="blocks"))
    assert size < 0.02 * len(EncodedArray.of(array).data)


def test_tiles_without_edited_frames_are_those_of_the_base() -> None:
    """The receiver neither encodes these tiles again, nor stores other bytes for them."""
    base = numbers("<f4", (FRAMES, 71)).cumsum(axis=0, dtype=np.float32)
    array = base.copy()
    array[300] += 1
    found = difference_of(array, base)
    assert found is not None
    sent = ArrayDifference.of(received(found.document))
    assert sent is not None
    whole = sent.applied_to(EncodedArray.of(base))
    assert isinstance(whole, EncodedArray)
    same = [
        one == other
        for one, other in zip(blocks.split(whole.data), blocks.split(EncodedArray.of(base).data), strict=True)
    ]
    assert same == [True, False, True]


def test_a_difference_that_is_not_smaller_is_not_sent() -> None:
    base = numbers("<f4", (FRAMES, 71))
    assert difference_of(base + 1, base) is None
    assert difference_of(base[:-1], base) is None
    assert difference_of(base.reshape(FRAMES, 71, 1), base) is None
    assert difference_of(base.astype("<f8"), base) is None
    assert difference_of(np.array(1.0), np.array(2.0)) is None


def test_a_document_with_differences_has_the_references_of_the_document_with_arrays() -> None:
    base, array = numbers("<f4", (FRAMES, 71)), numbers("<f4", (FRAMES, 71))
    array[3] += 1
    found = difference_of(array, base)
    assert found is not None
    kept: list[ArrayDifference] = []
    sent = detach_differences({"a": [{"poses": found.document, "rate": 30}]}, kept.append)
    assert sent == detach_arrays({"a": [{"poses": array, "rate": 30}]}, lambda _digest, _array: None)
    assert kept == [found]


def test_a_difference_that_does_not_fit_its_base_is_refused() -> None:
    base, array = numbers("<f4", (FRAMES, 7)), numbers("<f4", (FRAMES, 7))
    array[[3, 600]] += 1
    found = difference_of(array, base)
    assert found is not None
    tree, encoded = received(found.document), EncodedArray.of(base)
    frames, difference = tree["frames"], tree["difference"]
    for changed in (
        {"digest": BASE},
        {"digest": None},
        {"frames": frames[::-1]},
        {"frames": np.array([3, 3], "<u4")},
        {"frames": np.array([3, FRAMES], "<u4")},
        {"frames": np.array([-1, 3], "<i8")},
        {"frames": np.array([3, (1 << 64) - 1], "<u8")},
        {"frames": frames[:1]},
        {"frames": frames.astype("<f4")},
        {"frames": frames.reshape(2, 1)},
        {"frames": [3, 600]},
        {"difference": difference[:1]},
        {"difference": difference[:, :1]},
        {"difference": difference.astype("<i4")},
        {"difference": difference + np.uint32(1)},
        {"difference": np.full_like(difference, 0x7F800000)},  # which makes numbers that are not finite
        {"difference": None},
        {"shape": [FRAMES, 8]},
        {"shape": [FRAMES * 7]},
        {"dtype": "<i4"},
    ):
        sent = ArrayDifference.of({**tree, **changed})
        assert sent is not None
        with pytest.raises(ArrayError):
            sent.applied_to(encoded)
    other = base.copy()
    other[0] += 1
    with pytest.raises(ArrayError, match="does not have the digest that was sent"):
        found.applied_to(EncodedArray.of(other))
    for malformed in ({"shape": "7"}, {"shape": [-1]}, {"dtype": "object"}):
        with pytest.raises(ArrayError):
            ArrayDifference.of({**tree, **malformed})
    assert ArrayDifference.of({**tree, "more": 1}) is None
    assert ArrayDifference.of(base) is None


def test_a_difference_that_would_expand_to_gigabytes_is_refused_before_it_takes_memory() -> None:
    """A few kilobytes of blocks can describe zeros without end."""
    few = np.zeros((4, 7), "<f4")
    found = difference_of(few, few)
    assert found is not None
    many = EncodedArray.of(np.zeros((1 << 20, 7), "<u4"))
    bomb = replace(found, difference=many)
    sent = encode_tree(bomb.document, MSGPACK, arrays="blocks")
    assert len(sent) < (1 << 20) / 10
    tracemalloc.start()
    try:
        with pytest.raises(CodecError, match="larger than"):
            decode_tree(sent, MSGPACK, max_array_bytes=1 << 20)
        with pytest.raises(ArrayError, match="must be an array <u4"):
            bomb.applied_to(EncodedArray.of(few))
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("dtype", ["|u1", "<u4"])
def test_a_difference_with_too_many_frames_is_refused_before_it_takes_memory(dtype: str) -> None:
    """The indices of the frames would take several times the memory of the whole array."""
    base = EncodedArray.of(np.zeros((1 << 20, 1), "|u1"))
    frames = EncodedArray.of(np.zeros(1 << 20, dtype))
    found = ArrayDifference(
        base="sha256:base", pointer="/poses", dtype="|u1", shape=(1 << 20, 1), digest="sha256:whole", frames=frames,
        difference=EncodedArray.of(np.zeros((1 << 20, 1), "|u1")),
    )  # fmt: skip
    tracemalloc.start()
    try:
        with pytest.raises(ArrayError, match="more frames or bytes than the array"):
            found.applied_to(base)
        assert tracemalloc.get_traced_memory()[1] < 1 << 17
    finally:
        tracemalloc.stop()
