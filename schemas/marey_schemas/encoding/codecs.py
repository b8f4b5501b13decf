"""Encoding of documents as JSON, MessagePack and BSON, which represent the same trees with the same limits.

A tree consists of objects (str keys), lists, str, int (64 bit), finite float, bool, None, and arrays. A BSON document
is an object, so a tree that is a list or a scalar is refused in BSON.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Literal, NoReturn

import bson
import bson.errors
import msgpack
import numpy as np
import orjson
from bson.codec_options import CodecOptions
from bson.raw_bson import RawBSONDocument
from numpy.typing import NDArray

from marey_schemas.encoding.arrays import LEAF_KEYS, EncodedArray, array_from_leaf, json_data, with_blocks
from marey_schemas.encoding.arrayspec import DTYPES, ArrayError, ArraySpec, little_endian, require_finite

JSON, MSGPACK, BSON = MEDIA_TYPES = ("application/json", "application/msgpack", "application/bson")
MAX_BYTES = 1 << 28
"""Greatest size in bytes of a document that is decoded, and of its arrays together, if a caller sets no other limit."""
MAX_DEPTH = 64
MAX_LIST = 1 << 20
MAX_VALUES = 1 << 21
"""Greatest number of values in a document that is decoded; the elements of arrays do not count."""
FREE_LISTS = 1 << 17
"""Number of objects and lists that every document may contain; documents above a certain size may contain more."""
BYTES_PER_LIST = 6
"""Least number of bytes per object or list in a document with more than `FREE_LISTS` objects and lists.

Each object or list takes 70 bytes of memory.
"""
BSON_COPIES = 8
"""Greatest number of bytes copied per byte of a BSON document. The reader copies a nested object once per level."""

ArrayForm = Literal["plain", "blocks"]


class CodecError(ValueError):
    """A document cannot be encoded or decoded.

    `code` names the error for programs; `pointer` (RFC 6901) is the place of the error in the document.
    """

    def __init__(self, code: str, pointer: str, detail: str) -> None:
        super().__init__(code, pointer, detail)
        self.code = code
        self.pointer = pointer
        self.detail = detail

    def __str__(self) -> str:
        return f"{self.pointer or 'document'}: {self.detail}"


def encode_tree(tree: Any, media_type: str, *, arrays: ArrayForm = "plain") -> bytes:
    """Encode a tree whose leaves may be numpy arrays or `EncodedArray`.

    `arrays="blocks"` (not in JSON) writes every array in the block encoding; an `EncodedArray` is then copied as it is.
    Raises `CodecError` if the media type or a value is not allowed, or if the tree exceeds a limit.
    """
    _require_media_type(media_type)
    if media_type == JSON and arrays == "blocks":
        raise CodecError(
            "bad-media-type",
            "",
            "JSON cannot contain block-encoded arrays; use application/msgpack or application/bson",
        )

    def leaf(value: NDArray[Any] | EncodedArray) -> dict[str, Any]:
        return _leaf_as_json(value) if media_type == JSON else _leaf_as_bytes(value, arrays)

    plain = _Walk(on_array=leaf).visit(tree)
    if media_type == JSON:
        return orjson.dumps(plain, option=orjson.OPT_SERIALIZE_NUMPY)
    if media_type == MSGPACK:
        packed: bytes = msgpack.packb(plain)
        return packed
    return _write_bson(plain)


def _write_bson(plain: Any) -> bytes:
    if not isinstance(plain, dict):
        raise CodecError("bad-type", "", "a BSON document must be an object; use JSON or MessagePack for lists")
    try:
        return bson.encode(plain)
    except (bson.errors.BSONError, OverflowError) as error:
        raise CodecError("too-large", "", f"BSON is limited to 2 GiB; use JSON: {error}") from error


def decode_tree(
    data: bytes,
    media_type: str,
    *,
    max_bytes: int = MAX_BYTES,
    max_array_bytes: int | None = None,
    keep_blocks: bool = False,
    take_bytes: Callable[[int], None] | None = None,
) -> Any:
    """Decode a tree; array leaves become writable numpy arrays.

    With `keep_blocks`, arrays in the block encoding become `EncodedArray` if their bytes can be stored unchanged; they
    are decoded nevertheless, as a check. `max_bytes` limits the size of the input. `max_array_bytes` limits the total
    size of all arrays; its default and its upper bound are `max_bytes`. `take_bytes` is called with the size of each
    array before the array is decoded, and may raise an error of its own. The number of values is limited, too. Raises
    `CodecError` if the document is not valid or exceeds a limit, or if the media type is not supported.
    """
    _require_media_type(media_type)
    if len(data) > max_bytes:
        raise CodecError("too-large", "", f"the document has {len(data)} bytes; at most {max_bytes} are accepted")
    walk = _Walk(
        array_bytes=max_bytes if max_array_bytes is None else min(max_bytes, max_array_bytes),
        keep_blocks=keep_blocks,
        take_bytes=take_bytes,
        max_values=MAX_VALUES,
        max_copied=BSON_COPIES * max(len(data), MAX_LIST),
    )
    try:
        return walk.visit(_PARSERS[media_type](data))
    except CodecError:
        raise
    except (RecursionError, msgpack.StackError) as error:
        raise CodecError("too-deep", "", f"the document is nested deeper than {MAX_DEPTH} levels") from error
    except UnicodeDecodeError as error:
        raise CodecError("bad-syntax", walk.pointer, "the document has text that is not encoded as UTF-8") from error
    except (ValueError, bson.errors.BSONError, msgpack.UnpackException) as error:
        raise CodecError("bad-syntax", walk.pointer, f"the document is not valid {media_type}: {error}") from error


def _require_media_type(media_type: str) -> None:
    if media_type not in MEDIA_TYPES:
        raise CodecError(
            "bad-media-type", "", f"documents cannot be encoded as {media_type!r}; use one of {', '.join(MEDIA_TYPES)}"
        )


def _leaf_as_json(value: NDArray[Any] | EncodedArray) -> dict[str, Any]:
    array = _finite_array(value)
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": json_data(array)}


def _leaf_as_bytes(value: NDArray[Any] | EncodedArray, arrays: ArrayForm) -> dict[str, Any]:
    if arrays == "blocks":
        encoded = value if isinstance(value, EncodedArray) else EncodedArray.of(require_finite(value))
        return {"dtype": encoded.dtype, "shape": list(encoded.shape), "encoding": "blocks", "data": encoded.data}
    array = _finite_array(value)
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}


def _finite_array(value: NDArray[Any] | EncodedArray) -> NDArray[Any]:
    return require_finite(value.decode() if isinstance(value, EncodedArray) else little_endian(value))


class _Count:
    """Counter of objects, lists and members of objects, which refuses a document with too many while it is parsed."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._lists_left = _most_lists(data)
        self._members_left = MAX_VALUES
        self.refusal: CodecError | None = None

    def add(self, members: int = 0) -> None:
        """Count an object or a list. Raises `CodecError` if there are too many."""
        self._lists_left -= 1
        self._members_left -= members
        if self._lists_left < 0 or self._members_left < 0:
            self.refusal = _too_many_lists(self._data) if self._lists_left < 0 else _too_many_values("")
            raise self.refusal

    def on_list(self, items: list[Any]) -> list[Any]:
        """Count a list that was parsed, and return it."""
        self.add()
        return items

    def on_object(self, pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
        """Count an object that was parsed, and return it. Raises `ValueError` for a repeated key."""
        self.add(len(pairs))
        members = dict(pairs)
        if len(members) != len(pairs):
            repeated = Counter(key for key, _ in pairs).most_common(1)[0][0]
            raise ValueError(f"the key {repeated!r} is repeated in one object")
        return members


def _parse_json(data: bytes) -> Any:
    if data.count(b"[") + data.count(b"{") > _most_lists(data) < _count_brackets(data):
        raise _too_many_lists(data)
    return json.loads(data.decode("utf-8"), object_pairs_hook=_Count(data).on_object, parse_constant=_refuse_constant)


def _count_brackets(data: bytes) -> int:
    """Return the number of objects and lists in JSON, which is the number of opening brackets outside of strings."""
    count, start, inside = 0, 0, False
    while start < len(data):
        piece = data[start : start + _PIECE_BYTES]
        escaping = len(piece) - len(piece.rstrip(b"\\"))
        piece += data[start + len(piece) : start + len(piece) + escaping % 2]  # an escape stays in one piece
        start += len(piece)
        plain = piece.replace(b"\\\\", b"  ").replace(b'\\"', b"  ")
        signs = np.frombuffer(plain, np.uint8)
        in_string = np.logical_xor.accumulate(signs == ord('"')) ^ inside
        count += int(np.count_nonzero(((signs | 32) == ord("{")) & ~in_string))
        inside = bool(in_string[-1])
    return count


def _parse_msgpack(data: bytes) -> Any:
    count = _Count(data)
    # The parser allocates what a header claims before it reads on, so claims are limited.
    try:
        return msgpack.unpackb(
            data,
            object_pairs_hook=count.on_object,
            list_hook=count.on_list,
            max_array_len=MAX_LIST,
            max_map_len=MAX_LIST,
        )
    except msgpack.ExtraData as error:  # the texts of these two errors name functions of the parser, or are empty
        raise ValueError("bytes follow the end of the document") from error
    except msgpack.FormatError as error:
        raise ValueError("the byte 0xc1 cannot begin a value") from error


def _most_lists(data: bytes) -> int:
    return max(FREE_LISTS, len(data) // BYTES_PER_LIST)


def _too_many_lists(data: bytes) -> CodecError:
    most = _most_lists(data)
    return CodecError("too-large", "", f"the document of {len(data)} bytes has more than {most} objects and lists")


def _too_many_values(pointer: str) -> CodecError:
    return CodecError("too-large", pointer, f"the document has more than {MAX_VALUES} values; send numbers as arrays")


def _parse_bson(data: bytes) -> Any:
    if int.from_bytes(data[:4], "little", signed=True) != len(data):
        raise ValueError(f"the document has {len(data)} bytes, but the header of the BSON declares another size")
    if _REFERENCE_KEY in data:  # which would become a database reference, unless each object is read when it is used
        if data.count(_BSON_OBJECT) > FREE_LISTS:
            raise CodecError(
                "too-large",
                "",
                f"a BSON document with a key $ref may contain at most {FREE_LISTS} objects; use MessagePack",
            )
        return RawBSONDocument(data)
    count = _Count(data)

    class Counted(dict[str, Any]):
        """BSON object that is counted before its members are read."""

        def __init__(self) -> None:
            count.add()

    try:
        return bson.decode(data, CodecOptions(document_class=Counted))
    except bson.errors.InvalidBSON as error:
        if "recursion" in str(error):  # the decoder replaces other errors by its own, and keeps no cause
            raise RecursionError from error
        raise count.refusal or error from None


_PARSERS: dict[str, Callable[[bytes], Any]] = {JSON: _parse_json, MSGPACK: _parse_msgpack, BSON: _parse_bson}
_PIECE_BYTES = 1 << 20
_REFERENCE_KEY = b"$ref\0"
_BSON_OBJECT = b"\x03"


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"JSON does not allow {name}; all numbers must be finite")


# Values of one format only, though Python takes them for a str or a tuple.
_FOREIGN = (bson.Code, msgpack.ExtType)


class _Walk:
    """Traversal of a tree that checks every value and converts every array.

    For encoding, `on_array` converts arrays to array leaves, the objects that represent arrays in documents (see
    `arrays`). For decoding, `on_array` is None, and array leaves are converted to arrays.
    """

    def __init__(
        self,
        *,
        on_array: Callable[[Any], dict[str, Any]] | None = None,
        array_bytes: int = 0,
        keep_blocks: bool = False,
        take_bytes: Callable[[int], None] | None = None,
        max_values: int | None = None,
        max_copied: int = 0,
    ) -> None:
        self._on_array = on_array
        self._array_bytes = array_bytes
        self._keep_blocks = keep_blocks
        self._take_bytes = take_bytes
        self._values_left = math.inf if max_values is None else max_values
        self._copies_left = max_copied
        self._path: list[str | int] = []

    @property
    def pointer(self) -> str:
        """The JSON Pointer of the current value."""
        return "".join("/" + str(step).replace("~", "~0").replace("/", "~1") for step in self._path)

    def visit(self, value: Any) -> Any:
        """Return the converted value. Raises `CodecError` if the value is not allowed, or exceeds a limit."""
        if isinstance(value, _FOREIGN):
            raise self._error("bad-type", f"a value of type {type(value).__name__} cannot be encoded")
        if isinstance(value, str):
            return self._text(value)
        if value is None or isinstance(value, bool):
            return value
        if isinstance(value, int):
            return self._integer(value)
        if isinstance(value, float):
            return self._float(value)
        if isinstance(value, Mapping):
            return self._object(value)
        if isinstance(value, (list, tuple)):
            return self._list(value)
        if isinstance(value, np.ndarray | EncodedArray) and self._on_array is not None:
            return self._array(self._on_array, value)
        if isinstance(value, np.generic) and value.dtype.newbyteorder("<").str in DTYPES and self._on_array is not None:
            return self.visit(value.item())
        raise self._error("bad-type", f"a value of type {type(value).__name__} cannot be encoded")

    def _object(self, value: Mapping[Any, Any]) -> Any:
        if isinstance(value, RawBSONDocument):
            self._copies_left -= len(value.raw)
            if self._copies_left < 0:
                raise self._error(
                    "too-deep",
                    "the nested objects of the BSON document have too many bytes together, since each level is "
                    "copied; use MessagePack",
                )
        self._enter(len(value))
        keys = [self._key(key) for key in value]
        if LEAF_KEYS.issubset(keys):
            if self._on_array is not None:
                raise self._error(
                    "reserved-keys",
                    "an object with the keys dtype, shape and data would be read as an array; pass an ndarray instead",
                )
            return self._array(self._take_leaf, value)
        members = {}
        for key, member in zip(keys, value.values(), strict=True):
            self._path.append(key)
            members[key] = self.visit(member)
            self._path.pop()
        return members

    def _list(self, value: list[Any] | tuple[Any, ...]) -> list[Any]:
        if len(value) > MAX_LIST:
            raise self._error(
                "too-large",
                f"the list has {len(value)} elements; send more than {MAX_LIST} numbers as an array "
                "(an object with dtype, shape and data)",
            )
        self._enter(len(value))
        items = []
        for index, item in enumerate(value):
            self._path.append(index)
            items.append(self.visit(item))
            self._path.pop()
        return items

    def _array(self, convert: Callable[[Any], Any], value: Any) -> Any:
        try:
            return convert(value)
        except ArrayError as error:
            raise self._error(error.code, error.detail) from error

    def _take_leaf(self, leaf: Mapping[str, Any]) -> NDArray[Any] | EncodedArray:
        if self._take_bytes is not None:
            spec = ArraySpec.parse(leaf["dtype"], leaf["shape"])
            spec.require(self._array_bytes)
            self._take_bytes(spec.nbytes)
        array = array_from_leaf(leaf, max_bytes=self._array_bytes)
        self._array_bytes -= array.nbytes
        return with_blocks(leaf, array) if self._keep_blocks else array

    def _key(self, key: object) -> str:
        if not isinstance(key, str):
            raise self._error("bad-key", f"the object has the key {key!r}, which is not a string")
        if "\0" in key:
            raise self._error("bad-key", f"the key {key!r} contains the character U+0000")
        return self._text(key)

    def _text(self, text: str) -> str:
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise self._error("bad-text", "a string contains half of a surrogate pair") from error
        return str.__str__(text)

    def _integer(self, number: int) -> int:
        if not -(1 << 63) <= number < 1 << 63:
            raise self._error("out-of-range", "an integer does not fit in 64 bits")
        return int(number)

    def _float(self, number: float) -> float:
        if not math.isfinite(number):
            raise self._error("not-finite", f"{number} cannot be encoded; only finite numbers can")
        return float(number)

    def _enter(self, values: int) -> None:
        if len(self._path) >= MAX_DEPTH:
            raise self._error("too-deep", f"the document is nested deeper than {MAX_DEPTH} levels")
        self._values_left -= values
        if self._values_left < 0:
            raise _too_many_values(self.pointer)

    def _error(self, code: str, detail: str) -> CodecError:
        return CodecError(code, self.pointer, detail)
