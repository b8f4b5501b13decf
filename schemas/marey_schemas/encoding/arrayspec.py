"""Limits of arrays: the dtypes, shapes and sizes that every codec accepts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

DTYPES = ("<f4", "<f8", "|i1", "<i2", "<i4", "<i8", "|u1", "<u2", "<u4", "<u8", "|b1")
MAX_DIMENSIONS = 8
MAX_ELEMENTS = 1 << 40  # keeps every product of sizes inside 64 bits, whatever a document claims


class ArrayError(ValueError):
    """An array, or its form in a document, exceeds a limit or does not match its declared dtype and shape."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(code, detail)
        self.code = code
        self.detail = detail

    def __str__(self) -> str:
        return self.detail


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """Dtype and shape of an array, checked before memory is allocated.

    `dtype` is one of `DTYPES` (numpy's spelling, little-endian). Raises `ArrayError` if dtype or shape is not allowed.
    """

    dtype: str
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        if self.dtype not in DTYPES:
            raise ArrayError("bad-dtype", f"dtype {self.dtype!r} is not one of {', '.join(DTYPES)}")
        if len(self.shape) > MAX_DIMENSIONS:
            raise ArrayError(
                "bad-shape", f"the array has {len(self.shape)} dimensions; at most {MAX_DIMENSIONS} are allowed"
            )
        if any(size < 0 for size in self.shape):
            raise ArrayError("bad-shape", f"shape {list(self.shape)} has a negative size")
        # Empty sizes count as one: [10**12, 0] holds no numbers, yet would be 10**12 lists in JSON.
        if math.prod(max(size, 1) for size in self.shape) > MAX_ELEMENTS:
            raise ArrayError("too-large", f"shape {list(self.shape)} has more than {MAX_ELEMENTS} elements")

    @classmethod
    def of(cls, array: NDArray[Any]) -> "ArraySpec":
        """Return the spec of `array` after conversion to little-endian."""
        return cls(array.dtype.newbyteorder("<").str, array.shape)

    @classmethod
    def parse(cls, dtype: object, shape: object) -> "ArraySpec":
        """Return the spec of the parsed members `dtype` and `shape` of a leaf."""
        if not isinstance(dtype, str):
            raise ArrayError("bad-dtype", f"dtype must be a string, not {type(dtype).__name__}")
        if not isinstance(shape, Sequence) or isinstance(shape, str | bytes):
            raise ArrayError("bad-shape", f"shape must be a list of integers, not {type(shape).__name__}")
        if not all(isinstance(size, int) and not isinstance(size, bool) for size in shape):
            raise ArrayError("bad-shape", "shape must be a list of integers")
        return cls(dtype, tuple(int(size) for size in shape))

    def __str__(self) -> str:
        return f"{self.dtype} {list(self.shape)}"

    @property
    def nbytes(self) -> int:
        """The size of the array in bytes; an axis of size 0 counts as one of size 1."""
        return int(np.dtype(self.dtype).itemsize * math.prod(max(size, 1) for size in self.shape))

    def require(self, max_bytes: int) -> None:
        """Raise `ArrayError` unless the array fits in `max_bytes`."""
        if self.nbytes > max_bytes:
            raise ArrayError("too-large", f"the array {self} is larger than the {max_bytes} bytes that are allowed")


def little_endian(array: NDArray[Any]) -> NDArray[Any]:
    """Return the same numbers as a C-contiguous little-endian array, copied only where needed.

    Raises `ArrayError` if dtype or shape is not allowed.
    """
    spec = ArraySpec.of(array)
    return np.ascontiguousarray(array, dtype=spec.dtype).reshape(spec.shape)


def require_finite(array: NDArray[Any]) -> NDArray[Any]:
    """Return `array`, or raise `ArrayError` naming its first NaN or infinity."""
    if array.dtype.kind == "f":
        finite = np.isfinite(array)
        if not finite.all():
            index = np.unravel_index(int(np.argmin(finite)), array.shape)
            where = [int(i) for i in index]
            raise ArrayError("not-finite", f"element {where} is {array[index]}; only finite numbers can be encoded")
    return array
