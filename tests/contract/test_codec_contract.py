"""Rules that the codec of every media type must follow."""

import datetime
import math
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum
from functools import reduce
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tests.support.tiers import examples

from marey_schemas.encoding import codecs
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.arrayspec import DTYPES
from marey_schemas.encoding.codecs import ArrayForm, CodecError, decode_tree, encode_tree


def finite_arrays() -> st.SearchStrategy[np.ndarray[Any, Any]]:
    def of(dtype: str) -> st.SearchStrategy[np.ndarray[Any, Any]]:
        numbers: dict[str, Any] = {"allow_nan": False, "allow_infinity": False} if dtype[1] == "f" else {}
        shapes = hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=6)
        return hnp.arrays(dtype, shapes, elements=hnp.from_dtype(np.dtype(dtype), **numbers))

    return st.sampled_from(DTYPES).flatmap(of)


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
keys = texts.filter(lambda key: "\0" not in key)
scalars = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False)
)
values = st.recursive(
    scalars | texts | finite_arrays(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4),
    max_leaves=12,
)
objects = st.dictionaries(keys, values, max_size=5)


def same(a: object, b: object) -> bool:
    """Return whether two values are equal in their types and in every bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float):
        return type(b) is float and a == b and math.copysign(1, a) == math.copysign(1, b)
    return type(a) is type(b) and a == b


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True)
class Codec:
    media_type: str
    arrays: ArrayForm = "plain"

    def encode(self, tree: object) -> bytes:
        return encode_tree(tree, self.media_type, arrays=self.arrays)

    def decode(self, data: bytes, **limits: Any) -> Any:
        return decode_tree(data, self.media_type, keep_blocks=False, **limits)

    def refusal(self, tree: object) -> CodecError:
        with pytest.raises(CodecError) as caught:
            self.encode(tree)
        return caught.value

    def __str__(self) -> str:
        return f"{self.media_type.removeprefix('application/')}-{self.arrays}"


CODECS = [
    Codec(codecs.JSON),
    Codec(codecs.MSGPACK),
    Codec(codecs.BSON),
    Codec(codecs.MSGPACK, "blocks"),
    Codec(codecs.BSON, "blocks"),
]


@given(tree=objects)
@settings(max_examples=examples(80, soak=200))
def test_what_every_codec_writes_reads_back_equal_to_the_bit_and_is_always_the_same(tree: object) -> None:
    for codec in CODECS:
        data = codec.encode(tree)
        assert same(codec.decode(data), tree), codec
        assert codec.encode(tree) == data, codec


@given(data=st.binary(max_size=200))
@settings(max_examples=examples(200, soak=500))
def test_every_codec_reads_or_refuses_rubbish_and_never_crashes(data: bytes) -> None:
    for codec in CODECS:
        with suppress(CodecError):
            codec.decode(data)


@given(tree=objects, changes=st.lists(st.tuples(st.integers(0), st.integers(0, 255)), min_size=1, max_size=4))
@settings(max_examples=examples(300))
def test_every_codec_reads_or_refuses_changed_bytes_and_never_crashes(
    tree: object, changes: list[tuple[int, int]]
) -> None:
    for codec in CODECS:
        written = codec.encode(tree)
        for position, value in changes:
            data = bytearray(written)
            data[position % len(data)] = value
            with suppress(CodecError):
                codec.decode(bytes(data))


@given(tree=objects, cut=st.integers(0))
@settings(max_examples=examples(100))
def test_every_codec_refuses_truncated_bytes(tree: object, cut: int) -> None:
    for codec in CODECS:
        data = codec.encode(tree)
        with pytest.raises(CodecError):
            codec.decode(data[: cut % len(data)])


@pytest.mark.parametrize("codec", CODECS, ids=str)
class TestEveryCodec:
    def test_a_document_may_be_an_array(self, codec: Codec) -> None:
        assert same(codec.decode(codec.encode(np.eye(3, dtype=np.float32))), np.eye(3, dtype=np.float32))

    def test_an_encoded_array_travels_like_the_array_it_holds(self, codec: Codec) -> None:
        array = np.arange(600, dtype=np.int32).reshape(300, 2)
        assert codec.encode({"a": EncodedArray.of(array)}) == codec.encode({"a": array})

    def test_arrays_of_other_byte_orders_and_strides_travel_as_their_numbers(self, codec: Codec) -> None:
        array = np.arange(12, dtype=">f4").reshape(3, 4)[:, ::2]
        decoded = codec.decode(codec.encode({"a": array}))["a"]
        assert decoded.dtype.str == "<f4"
        assert decoded.tolist() == array.tolist()

    def test_decoded_arrays_are_writable(self, codec: Codec) -> None:
        array = codec.decode(codec.encode({"a": np.zeros((4, 2))}))["a"]
        array[0, 0] = 1
        assert array[0, 0] == 1

    def test_numpy_scalars_enumerations_and_tuples_travel_as_plain_values(self, codec: Codec) -> None:
        tree = {"n": np.float32(0.5), "i": np.int16(3), "b": np.bool_(True), "e": Colour.RED, "t": (1, 2)}
        assert same(codec.decode(codec.encode(tree)), {"n": 0.5, "i": 3, "b": True, "e": "red", "t": [1, 2]})

    def test_keys_that_look_like_references_are_ordinary_keys(self, codec: Codec) -> None:
        tree = {"schema": {"$ref": "#/a", "$id": "b", "$db": 1}, "_id": 1, "a.b": 2, "$where": 3, "": 4}
        assert same(codec.decode(codec.encode(tree)), tree)

    @pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
    def test_a_number_that_is_not_finite_is_refused_where_it_stands(self, codec: Codec, number: float) -> None:
        error = codec.refusal({"a/b": [0.0, {"~": number}]})
        assert (error.code, error.pointer) == ("not-finite", "/a~1b/1/~0")

    @pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
    def test_an_array_with_a_number_that_is_not_finite_is_refused_with_its_index(
        self, codec: Codec, number: float
    ) -> None:
        array = np.zeros((3, 2), np.float32)
        array[2, 1] = number
        error = codec.refusal({"poses": array})
        assert (error.code, error.pointer) == ("not-finite", "/poses")
        assert "[2, 1]" in error.detail

    @pytest.mark.parametrize("number", [2**63, -(2**63) - 1, 10**400])
    def test_an_integer_beyond_64_bits_is_refused(self, codec: Codec, number: int) -> None:
        error = codec.refusal({"n": [number]})
        assert (error.code, error.pointer) == ("out-of-range", "/n/0")

    @pytest.mark.parametrize("key", [1, None, b"a", ("a",)])
    def test_a_key_that_is_not_a_string_is_refused(self, codec: Codec, key: object) -> None:
        error = codec.refusal({"in": {key: 1}})
        assert (error.code, error.pointer) == ("bad-key", "/in")

    def test_a_key_with_nul_is_refused(self, codec: Codec) -> None:
        assert codec.refusal({"a\0b": 1}).code == "bad-key"

    @pytest.mark.parametrize("text", ["\ud800", "a\udfffb"])
    def test_half_a_surrogate_pair_is_refused(self, codec: Codec, text: str) -> None:
        assert codec.refusal({"t": text}).code == "bad-text"
        assert codec.refusal({text: "t"}).code == "bad-text"

    @pytest.mark.parametrize(
        "value",
        [
            b"bytes",
            datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC),
            Decimal(1),
            {1, 2},
            object(),
            1j,
            np.longdouble(1),
            np.complex64(1),
            np.datetime64(1, "ns"),
            np.timedelta64(1, "ns"),
            np.bytes_(b"bytes"),
        ],
        ids=lambda value: type(value).__name__,
    )
    def test_a_value_that_some_format_could_not_carry_is_refused(self, codec: Codec, value: object) -> None:
        error = codec.refusal({"a": [value]})
        assert (error.code, error.pointer) == ("bad-type", "/a/0")

    @pytest.mark.parametrize("dtype", ["f2", "c8", "S3", "U3", "M8[s]", "O"])
    def test_an_array_of_another_dtype_is_refused(self, codec: Codec, dtype: str) -> None:
        error = codec.refusal({"a": np.zeros(2, dtype)})
        assert (error.code, error.pointer) == ("bad-dtype", "/a")

    def test_an_object_with_the_members_of_an_array_is_refused(self, codec: Codec) -> None:
        error = codec.refusal({"a": {"dtype": "<f4", "shape": [1], "data": [1.0]}})
        assert (error.code, error.pointer) == ("reserved-keys", "/a")

    def test_nesting_is_allowed_to_its_limit_and_refused_beyond(
        self, codec: Codec, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        tree: Any = reduce(lambda inner, _: {"a": inner}, range(codecs.MAX_DEPTH), cast(Any, 1))
        assert same(codec.decode(codec.encode(tree)), tree)
        assert codec.refusal({"a": tree}).code == "too-deep"
        data = codec.encode(tree)
        monkeypatch.setattr(codecs, "MAX_DEPTH", codecs.MAX_DEPTH - 1)
        with pytest.raises(CodecError) as caught:
            codec.decode(data)
        assert caught.value.code == "too-deep"

    def test_more_bytes_than_allowed_are_refused_unread(self, codec: Codec) -> None:
        data = codec.encode({"a": "x" * 100})
        with pytest.raises(CodecError) as caught:
            codec.decode(data, max_bytes=len(data) - 1)
        assert caught.value.code == "too-large"
        assert codec.decode(data, max_bytes=len(data))

    def test_a_long_list_must_be_an_array(self, codec: Codec) -> None:
        error = codec.refusal({"a": [0] * (codecs.MAX_LIST + 1)})
        assert (error.code, error.pointer) == ("too-large", "/a")


@given(tree=objects)
@settings(max_examples=examples(60, soak=150))
def test_all_media_types_decode_to_the_same_tree(tree: object) -> None:
    decoded = [decode_tree(encode_tree(tree, media_type), media_type) for media_type in codecs.MEDIA_TYPES]
    assert same(decoded[0], decoded[1])
    assert same(decoded[1], decoded[2])


@given(tree=values.filter(lambda tree: not isinstance(tree, dict)))
@settings(max_examples=examples(30, soak=60))
def test_lists_and_scalars_are_documents_in_json_and_messagepack(tree: object) -> None:
    for media_type in (codecs.JSON, codecs.MSGPACK):
        assert same(decode_tree(encode_tree(tree, media_type), media_type), tree)


@pytest.mark.parametrize("tree", [[1, 2], "text", 1, None])
def test_a_bson_document_must_be_an_object(tree: object) -> None:
    with pytest.raises(CodecError, match="must be an object"):
        encode_tree(tree, codecs.BSON)
