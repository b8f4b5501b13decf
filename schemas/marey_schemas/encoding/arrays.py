"""Array leaves: numpy arrays in documents, and their form in each media type.

A leaf is `{"dtype": "<f4", "shape": [frames, columns], "data": ...}` with nested lists in JSON and little-endian bytes
in MessagePack and BSON; `"encoding": "blocks"` means that the bytes are those of `blocks.encode`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Annotated, Any

import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrayspec import DTYPES, ArrayError, ArraySpec, little_endian, require_finite

__all__ = [
    "DTYPES",
    "Array",
    "ArrayError",
    "ArrayOf",
    "EncodedArray",
    "array_from_leaf",
    "is_leaf",
    "json_data",
    "nested_lists",
    "with_blocks",
]

LEAF_KEYS = frozenset({"dtype", "shape", "data"})
MAX_ARRAY_BYTES = 1 << 28
_MISREAD_BITS = 0x15AE43FD
"""Bits of 7.038531e-26, the only float32 that changes when a parser reads its shortest text as a double and rounds it.
"""
_ELEMENT_TYPES: dict[str, set[type]] = {"f": {int, float}, "i": {int}, "u": {int}, "b": {bool}}


@dataclass(frozen=True, slots=True)
class EncodedArray:
    """Block-encoded array, which can be stored or sent without being decoded."""

    dtype: str
    shape: tuple[int, ...]
    data: bytes
    decoded: NDArray[Any] | None = field(default=None, compare=False, repr=False)
    """The decoded array, if it was already decoded and checked."""

    @classmethod
    def of(cls, array: NDArray[Any], *, predict: bool = True) -> "EncodedArray":
        """Encode `array` in blocks; without `predict`, the encoding is faster and the result larger."""
        spec = ArraySpec.of(array)
        return cls(spec.dtype, spec.shape, blocks.encode(array, predict=predict))

    def cut_frames(self, start: int, stop: int) -> "EncodedArray":
        """Return the frames [start, stop). Raises `ArrayError` if the bytes are corrupt."""
        try:
            return EncodedArray(self.dtype, (stop - start, *self.shape[1:]), blocks.cut_frames(self.data, start, stop))
        except blocks.BlockError as error:
            raise ArrayError("bad-array", str(error)) from error

    def decode(self, *, max_bytes: int = MAX_ARRAY_BYTES) -> NDArray[Any]:
        """Return the decoded array. Raises `ArrayError` if the bytes are corrupt or do not match dtype and shape."""
        if self.decoded is not None:
            return self.decoded
        claimed = ArraySpec(self.dtype, self.shape)
        claimed.require(max_bytes)
        try:
            held = blocks.read_spec(self.data)
            if held != claimed:
                raise ArrayError("bad-array", f"the array declares {claimed}, but its blocks contain {held}")
            return blocks.decode(self.data)
        except blocks.BlockError as error:
            raise ArrayError("bad-array", str(error)) from error


def is_leaf(value: Mapping[str, Any]) -> bool:
    """Return whether an object of a parsed document is an array leaf."""
    return value.keys() >= LEAF_KEYS


def array_from_leaf(leaf: Mapping[str, Any], *, max_bytes: int = MAX_ARRAY_BYTES) -> NDArray[Any]:
    """Return the array of a leaf in any of its three forms; the array is writable, C-contiguous and finite.

    Raises `ArrayError` if the data does not match dtype and shape, or if the array needs more than `max_bytes`.
    """
    unknown = sorted(leaf.keys() - LEAF_KEYS - {"encoding"})
    if unknown:
        raise ArrayError(
            "bad-array", f"an array has only the keys dtype, shape, data and encoding; remove the key {unknown[0]!r}"
        )
    spec = ArraySpec.parse(leaf["dtype"], leaf["shape"])
    spec.require(max_bytes)
    data = leaf["data"]
    if "encoding" in leaf:
        if leaf["encoding"] != "blocks" or not isinstance(data, bytes):
            raise ArrayError("bad-array", 'the encoding of an array must be "blocks", and its data must be bytes')
        array = EncodedArray(spec.dtype, spec.shape, data).decode(max_bytes=max_bytes)
    elif isinstance(data, bytes):
        array = _from_bytes(data, spec)
    else:
        array = _from_lists(data, spec)
    return require_finite(array)


def with_blocks(leaf: Mapping[str, Any], array: NDArray[Any]) -> NDArray[Any] | EncodedArray:
    """Return the bytes of `leaf` as an `EncodedArray` if they can be stored unchanged, else `array`, its decoded
    form.
    """
    if "encoding" in leaf and blocks.is_well_packed(leaf["data"]):
        return EncodedArray(array.dtype.str, array.shape, leaf["data"], array)
    return array


def _from_bytes(data: bytes, spec: ArraySpec) -> NDArray[Any]:
    dtype = np.dtype(spec.dtype)
    expected = dtype.itemsize * int(np.prod(spec.shape, dtype=np.int64))
    if len(data) != expected:
        raise ArrayError(
            "bad-array",
            f"the data has {len(data)} bytes, but an array of {spec.dtype} with the shape "
            f"{list(spec.shape)} has {expected}",
        )
    raw = np.frombuffer(data, np.uint8)
    if spec.dtype == "|b1" and raw.size and raw.max() > 1:
        raise ArrayError("bad-array", "the data of an array of booleans contains a byte that is neither 0 nor 1")
    return raw.view(dtype).reshape(spec.shape).copy()


def _from_lists(data: object, spec: ArraySpec) -> NDArray[Any]:
    """Convert nested lists to an array. Each level is checked, because numpy would truncate and cast silently."""
    level: list[Any] = [data]
    for axis, size in enumerate(spec.shape):
        for item in level:
            if type(item) is not list or len(item) != size:
                found = f"a list of {len(item)}" if type(item) is list else type(item).__name__
                raise ArrayError(
                    "bad-array",
                    f"the list of elements does not match the shape of the array: on axis {axis}, a list "
                    f"of {size} is needed, not {found}",
                )
        level = list(chain.from_iterable(level))
    wrong = set(map(type, level)) - _ELEMENT_TYPES[np.dtype(spec.dtype).kind]
    if wrong:
        names = ", ".join(sorted(found.__name__ for found in wrong))
        raise ArrayError(
            "bad-array", f"the array has the dtype {spec.dtype}, but contains elements of the type {names}"
        )
    try:
        with np.errstate(over="ignore"):  # what overflows a float32 becomes infinite and is refused as such
            return np.array(level, dtype=spec.dtype).reshape(spec.shape)
    except OverflowError as error:
        raise ArrayError("out-of-range", f"an element of the array is too large for the dtype {spec.dtype}") from error


def json_data(array: NDArray[Any]) -> Any:
    """Return the `data` of a JSON leaf in a form in which `orjson` writes each number as its shortest text.

    A float32 gets at most nine digits (0.1, not 0.10000000149011612) and is read back to the same bits.
    """
    if array.dtype == np.float32 and (array.view(np.uint32) & 0x7FFFFFFF == _MISREAD_BITS).any():
        array = array.astype(np.float64)
    return array if array.ndim else nested_lists(array[np.newaxis])[0]


def nested_lists(array: NDArray[Any]) -> Any:
    """Return `data` of a JSON leaf as nested lists, or as one number if the array has no axes."""
    return orjson.loads(orjson.dumps(json_data(array), option=orjson.OPT_SERIALIZE_NUMPY))


@dataclass(frozen=True, slots=True)
class ArrayOf:
    """Pydantic annotation of an array field: `Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=2)]`.

    Accepts an ndarray or a leaf; an ndarray of another dtype is refused, not cast. Values must be finite.
    `columns` fixes the size of the last axis.
    """

    dtype: str | None = None
    ndim: int | None = None
    columns: int | None = None

    def validate(self, value: object) -> NDArray[Any]:
        """Return the array. Raises `ArrayError`, which says whether dtype, dimensions, columns or values are wrong."""
        if isinstance(value, EncodedArray):
            array = require_finite(value.decode())
        elif isinstance(value, np.ndarray):
            array = require_finite(little_endian(value))
        elif isinstance(value, Mapping) and is_leaf(value):
            array = array_from_leaf(value)
        else:
            raise ArrayError("bad-array", "expected an array: an ndarray, or an object with dtype, shape and data")
        if self.dtype is not None and array.dtype.str != self.dtype:
            raise ArrayError("bad-dtype", f"expected dtype {self.dtype}, not {array.dtype.str}")
        if self.ndim is not None and array.ndim != self.ndim:
            raise ArrayError("bad-shape", f"expected {self.ndim} dimensions, not shape {list(array.shape)}")
        if self.columns is not None and array.shape[-1:] != (self.columns,):
            raise ArrayError("bad-shape", f"expected {self.columns} columns, not shape {list(array.shape)}")
        return array

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self.validate,
            serialization=core_schema.plain_serializer_function_ser_schema(_leaf, when_used="json"),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        dtype: JsonSchemaValue = {"const": self.dtype} if self.dtype else {"type": "string", "enum": list(DTYPES)}
        shape: JsonSchemaValue = {"type": "array", "items": {"type": "integer", "minimum": 0}}
        if self.ndim is not None:
            shape |= {"minItems": self.ndim, "maxItems": self.ndim}
        return {
            "type": "object",
            "title": "Array",
            "description": "An array; data is nested lists in JSON, little-endian bytes in MessagePack and BSON.",
            "properties": {"dtype": dtype, "shape": shape, "data": {"description": "nested lists, or bytes"}},
            "required": ["dtype", "shape", "data"],
            "additionalProperties": False,
        }


def _leaf(array: NDArray[Any]) -> dict[str, Any]:
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": nested_lists(array)}


Array = Annotated[NDArray[Any], ArrayOf()]
