import datetime
import json
import struct
from typing import Any

import bson
import msgpack
import numpy as np
import pytest
from bson import Binary, Code, Decimal128, Int64, ObjectId, Regex
from numpy.typing import NDArray

from marey_schemas.encoding import blocks, codecs
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.codecs import (
    BSON,
    BSON_COPIES,
    JSON,
    MAX_LIST,
    MEDIA_TYPES,
    MSGPACK,
    CodecError,
    decode_tree,
    encode_tree,
)


def refusal(data: bytes, media_type: str, *, keep_blocks: bool = False, **limits: Any) -> CodecError:
    with pytest.raises(CodecError) as caught:
        decode_tree(data, media_type, keep_blocks=keep_blocks, **limits)
    return caught.value


def write(tree: Any, media_type: str) -> bytes:
    """Return a message as another program would encode it."""
    if media_type == JSON:
        return json.dumps(tree).encode()
    return bytes(msgpack.packb(tree)) if media_type == MSGPACK else bytes(bson.encode(tree))


def test_json_has_arrays_as_nested_lists() -> None:
    document = json.loads(encode_tree({"a": np.array([[0.1, 2], [3, 4]], np.float32)}, JSON))
    assert document == {"a": {"dtype": "<f4", "shape": [2, 2], "data": [[0.1, 2.0], [3.0, 4.0]]}}


@pytest.mark.parametrize("media_type", [MSGPACK, BSON])
def test_binary_formats_have_arrays_as_little_endian_bytes(media_type: str) -> None:
    data = encode_tree({"a": np.array([1, 2], ">i2")}, media_type)
    document = msgpack.unpackb(data) if media_type == MSGPACK else bson.decode(data)
    assert document == {"a": {"dtype": "<i2", "shape": [2], "data": b"\1\0\2\0"}}


@pytest.mark.parametrize("media_type", [MSGPACK, BSON])
def test_blocks_travel_as_the_bytes_of_the_block_codec(media_type: str) -> None:
    array = np.arange(900, dtype=np.float32).reshape(300, 3)
    data = encode_tree({"a": array}, media_type, arrays="blocks")
    document = msgpack.unpackb(data) if media_type == MSGPACK else bson.decode(data)
    assert document == {"a": {"dtype": "<f4", "shape": [300, 3], "encoding": "blocks", "data": blocks.encode(array)}}


@pytest.mark.parametrize("media_type", [MSGPACK, BSON])
def test_blocks_may_be_kept_beside_the_array_that_they_hold(media_type: str) -> None:
    sent = {"kept": np.arange(2000), "plain": EncodedArray.of(np.arange(2000), predict=False)}
    tree = decode_tree(encode_tree(sent, media_type, arrays="blocks"), media_type, keep_blocks=True)
    assert tree["kept"] == EncodedArray.of(np.arange(2000))
    np.testing.assert_array_equal(tree["kept"].decode(), np.arange(2000))
    np.testing.assert_array_equal(tree["plain"], np.arange(2000))
    plain = decode_tree(encode_tree({"a": np.arange(2000)}, media_type), media_type, keep_blocks=True)
    np.testing.assert_array_equal(plain["a"], np.arange(2000))


@pytest.mark.parametrize("media_type", [MSGPACK, BSON])
def test_kept_blocks_are_checked_and_counted_as_others(media_type: str) -> None:
    corrupt = bytearray(encode_tree({"a": np.arange(2000)}, media_type, arrays="blocks"))
    corrupt[-10] ^= 1
    assert refusal(bytes(corrupt), media_type, keep_blocks=True).code == "bad-array"
    broken = write({"a": _leaf_of(np.array([1.0, np.nan] * 500))}, media_type)
    assert refusal(broken, media_type, keep_blocks=True).code == "not-finite"
    two = encode_tree({"a": np.arange(2000), "b": np.arange(2000)}, media_type, arrays="blocks")
    assert refusal(two, media_type, keep_blocks=True, max_bytes=20_000).code == "too-large"


def _leaf_of(array: NDArray[Any]) -> dict[str, Any]:
    encoded = EncodedArray.of(array)
    return {"dtype": encoded.dtype, "shape": list(encoded.shape), "encoding": "blocks", "data": encoded.data}


def test_json_cannot_carry_blocks() -> None:
    with pytest.raises(CodecError, match="JSON cannot contain block-encoded arrays"):
        encode_tree({"a": np.zeros(3)}, JSON, arrays="blocks")
    text = '{"a": {"dtype": "<f4", "shape": [1], "encoding": "blocks", "data": "TVJCMQ=="}}'
    assert refusal(text.encode(), JSON).pointer == "/a"


@pytest.mark.parametrize("media_type", ["text/json", "application/msgpack; arrays=blocks", ""])
def test_an_unknown_media_type_is_refused(media_type: str) -> None:
    with pytest.raises(CodecError, match="cannot be encoded as"):
        encode_tree({}, media_type)
    assert refusal(b"{}", media_type).code == "bad-media-type"


@pytest.mark.parametrize("media_type", MEDIA_TYPES)
def test_a_wrong_array_is_refused_where_it_stands(media_type: str) -> None:
    wrong = {"dtype": "<f4", "shape": [2], "data": [1.0] if media_type == JSON else bytes(4)}
    error = refusal(write({"clips": [{"poses": wrong}]}, media_type), media_type)
    assert (error.code, error.pointer) == ("bad-array", "/clips/0/poses")


@pytest.mark.parametrize("media_type", [MSGPACK, BSON])
def test_arrays_together_may_not_exceed_the_limit_however_small_they_travel(media_type: str) -> None:
    tree = {str(number): np.zeros(100_000, np.int8) for number in range(9)}
    data = encode_tree(tree, media_type, arrays="blocks")
    assert len(data) < 10_000
    assert len(decode_tree(data, media_type, max_bytes=900_000)) == 9
    error = refusal(data, media_type, max_bytes=899_999)
    assert (error.code, error.pointer) == ("too-large", "/8")


@pytest.mark.parametrize("media_type", MEDIA_TYPES)
def test_a_claimed_shape_is_refused_before_it_is_allocated(media_type: str) -> None:
    data: Any = [] if media_type == JSON else b""
    error = refusal(write({"a": {"dtype": "<f8", "shape": [1 << 19, 1 << 19], "data": data}}, media_type), media_type)
    assert (error.code, error.pointer) == ("too-large", "/a")


@pytest.mark.parametrize(
    ("text", "code", "pointer"),
    [
        ("", "bad-syntax", ""),
        ("{", "bad-syntax", ""),
        ('{"a": NaN}', "bad-syntax", ""),
        ('{"a": -Infinity}', "bad-syntax", ""),
        ('{"a": [1e999]}', "not-finite", "/a/0"),
        ('{"a": 1, "a": 1}', "bad-syntax", ""),
        ('{"a": 9223372036854775808}', "out-of-range", "/a"),
        ('{"a": ' + "9" * 5000 + "}", "bad-syntax", ""),
        ('{"a": "\\udc00"}', "bad-text", "/a"),
        ('{"a\\u0000b": 1}', "bad-key", ""),
        ("[" * 65 + "]" * 65, "too-deep", "/0" * 64),
        ("[" * 100_000, "too-deep", ""),
        ('{"a": {"b": 1}} x', "bad-syntax", ""),
    ],
)
def test_json_that_other_formats_could_not_carry_is_refused(text: str, code: str, pointer: str) -> None:
    error = refusal(text.encode(), JSON)
    assert (error.code, error.pointer) == (code, pointer)


def test_json_must_be_utf_8() -> None:
    error = refusal('{"a": "é"}'.encode("latin-1"), JSON)
    assert (error.code, str(error)) == ("bad-syntax", "document: the document has text that is not encoded as UTF-8")


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "bad-syntax"),
        (b"\x81\xa1a", "bad-syntax"),
        (b"\x80\x80", "bad-syntax"),
        (b"\xcf" + b"\xff" * 8, "out-of-range"),
        (msgpack.packb({"a": msgpack.ExtType(5, b"x")}), "bad-type"),
        (msgpack.packb({"a": msgpack.Timestamp(1)}), "bad-type"),
        (msgpack.packb({"a": b"bytes"}), "bad-type"),
        (msgpack.packb({b"a": 1}), "bad-key"),
        (msgpack.packb({1: 1}), "bad-syntax"),
        (b"\x82\xa1a\x01\xa1a\x02", "bad-syntax"),
        (b"\x91" * 100_000, "too-deep"),
        (b"\xcb" + struct.pack(">d", float("nan")), "not-finite"),
        (b"\xa1\xff", "bad-syntax"),
    ],
)
def test_messagepack_that_other_formats_could_not_carry_is_refused(data: bytes, code: str) -> None:
    assert refusal(data, MSGPACK).code == code


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b'{"name": "lab"}', "bytes follow the end of the document"),
        (b"\x91\xc1", "the byte 0xc1 cannot begin a value"),
    ],
)
def test_malformed_messagepack_is_explained_without_words_of_the_parser(data: bytes, reason: str) -> None:
    assert str(refusal(data, MSGPACK)) == f"document: the document is not valid application/msgpack: {reason}"


@pytest.mark.parametrize("header", [b"\xdd", b"\xdf"])
def test_messagepack_cannot_claim_its_way_to_memory(header: bytes) -> None:
    claim = header + struct.pack(">I", MAX_LIST) + (b"\xa1a" if header == b"\xdf" else b"")
    assert refusal(claim * 500, MSGPACK).code == "bad-syntax"


@pytest.mark.parametrize(
    "value",
    [
        ObjectId(),
        datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC),
        Decimal128("1.5"),
        Regex("a"),
        Code("x"),
        Code("x", {"a": 1}),
        Binary(b"x", 4),
        b"bytes",
        bson.Timestamp(1, 1),
        bson.MinKey(),
        bson.DBRef("collection", ObjectId()),
    ],
    ids=lambda value: type(value).__name__,
)
def test_bson_that_other_formats_could_not_carry_is_refused(value: Any) -> None:
    error = refusal(bson.encode({"a": [1, value]}), BSON)
    assert error.code == "bad-type"
    assert error.pointer.startswith("/a/1")


def test_bson_integers_of_both_widths_are_plain_integers() -> None:
    tree = decode_tree(bson.encode({"a": Int64(5), "b": 5, "c": 1 << 40}), BSON)
    assert [type(value) for value in tree.values()] == [int, int, int]


@pytest.mark.parametrize("data", [b"", b"\5\0\0\0", b"\5\0\0\x80\0", b"\6\0\0\0\0", bson.encode({}) + b"\0"])
def test_bson_of_another_size_than_it_says_is_refused(data: bytes) -> None:
    assert refusal(data, BSON).code == "bad-syntax"


def test_bson_nested_beyond_the_limit_is_refused() -> None:
    data = bson.encode({})
    for _ in range(3000):
        data = struct.pack("<i", len(data) + 8) + b"\x03a\0" + data + b"\0"
    assert refusal(data, BSON).code == "too-deep"


def test_an_error_reads_as_a_place_and_a_reason() -> None:
    with pytest.raises(CodecError) as caught:
        encode_tree({"a": [1, float("nan")]}, JSON)
    assert str(caught.value) == "/a/1: nan cannot be encoded; only finite numbers can"
    assert codecs.CodecError("bad-syntax", "", "no").args == ("bad-syntax", "", "no")


def test_a_document_of_any_size_may_contain_some_lists_and_a_large_one_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codecs, "FREE_LISTS", 1000)
    fits: list[Any] = [[]] * 999
    long = [[0, 0, 0, 0, 0, 0]] * 1001
    for media_type in (JSON, MSGPACK):
        assert len(decode_tree(encode_tree(fits, media_type), media_type)) == len(fits)
        assert refusal(encode_tree([*fits, []], media_type), media_type).code == "too-large"
        assert len(decode_tree(encode_tree(long, media_type), media_type)) == len(long)


@pytest.mark.parametrize("media_type", [JSON, MSGPACK, BSON])
def test_objects_are_counted_before_they_are_kept(media_type: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = encode_tree({"a": [{}] * 1001}, media_type)
    monkeypatch.setattr(codecs, "FREE_LISTS", 1000)
    monkeypatch.setattr(codecs, "BYTES_PER_LIST", 100)
    monkeypatch.setattr(codecs._Walk, "visit", lambda _walk, _value: pytest.fail("the document was kept"))
    assert refusal(data, media_type).code == "too-large"


@pytest.mark.parametrize("media_type", [JSON, MSGPACK])
def test_members_are_counted_before_they_are_kept(media_type: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = encode_tree({"a": [{"b": 1, "c": 2}] * 100}, media_type)
    monkeypatch.setattr(codecs, "MAX_VALUES", 199)
    monkeypatch.setattr(codecs._Walk, "visit", lambda _walk, _value: pytest.fail("the document was kept"))
    assert refusal(data, media_type).code == "too-large"


def test_bson_with_a_key_that_looks_like_a_reference_has_a_limit_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    tree = {"$ref": "collection", "$id": 1, "a": [{}] * 20}
    assert decode_tree(bson.encode(tree), BSON) == tree
    monkeypatch.setattr(codecs, "FREE_LISTS", 10)
    assert refusal(bson.encode(tree), BSON).code == "too-large"


@pytest.mark.parametrize(
    "text", ["[" * 5000, '\\"[' * 5000, "\\" * 5000 + "[" * 5000, "[" * 4999 + "\\", '"' + "[" * 5000 + '"']
)
@pytest.mark.parametrize("piece_bytes", [7, 8, 1 << 20])
def test_brackets_in_strings_are_no_lists(text: str, piece_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codecs, "FREE_LISTS", 100)
    monkeypatch.setattr(codecs, "BYTES_PER_LIST", 1000)
    monkeypatch.setattr(codecs, "_PIECE_BYTES", piece_bytes)
    tree = {"a": text, text: [1]}
    assert decode_tree(encode_tree(tree, JSON), JSON) == tree
    assert refusal(encode_tree({"a": text, "b": [[]] * 100}, JSON), JSON).code == "too-large"


def test_an_array_of_many_short_rows_is_read_from_json_as_programs_write_it() -> None:
    rows = "[" + ",".join(["[" + ",".join(["[0,0,1]"] * 20) + "]"] * 10_000) + "]"
    leaf = f'{{"dtype": "<f4", "shape": [10000, 20, 3], "data": {rows}}}'
    assert decode_tree(f'{{"a": {leaf}}}'.encode(), JSON)["a"].shape == (10_000, 20, 3)


def test_a_list_may_have_its_greatest_length_inside_an_object() -> None:
    assert len(decode_tree(encode_tree({"a": [0] * MAX_LIST}, JSON), JSON)["a"]) == MAX_LIST


def test_values_are_limited_beyond_the_length_of_each_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codecs, "MAX_VALUES", 2000)
    half = [0] * 1000
    assert refusal(encode_tree([half, half], MSGPACK), MSGPACK).pointer == "/1"
    assert len(decode_tree(encode_tree([half, half[:-2]], MSGPACK), MSGPACK)) == 2


def test_bson_whose_levels_would_be_copied_again_and_again_is_refused() -> None:
    tree: dict[str, Any] = {"$ref": "x" * MAX_LIST}  # objects with this key are read one by one
    for _ in range(BSON_COPIES - 2):
        tree = {"a": tree}
    data = bson.encode(tree)
    assert decode_tree(data, BSON) == tree
    deeper = bson.encode({"a": {"a": {"a": tree}}})
    assert refusal(deeper, BSON).code == "too-deep"
    assert decode_tree(encode_tree({"a": {"a": {"a": tree}}}, MSGPACK), MSGPACK) == {"a": {"a": {"a": tree}}}


def test_arrays_have_a_limit_of_their_own_and_are_announced_before_they_are_decoded() -> None:
    data = encode_tree({"a": np.zeros((1000, 100), np.float32)}, MSGPACK, arrays="blocks")
    sizes: list[int] = []
    assert decode_tree(data, MSGPACK, max_array_bytes=400_000, take_bytes=sizes.append)["a"].shape == (1000, 100)
    with pytest.raises(CodecError, match="/a: "):
        decode_tree(data, MSGPACK, max_array_bytes=399_999, take_bytes=sizes.append)
    assert sizes == [400_000]
