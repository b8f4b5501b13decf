"""Fields of documents nobody validated: the value in the type that is needed, or an error that names the field."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import FormatError

T = TypeVar("T")


def field_of(document: Any, name: str, kind: type[T] | tuple[type[T], ...], file: str) -> T:
    """`document[name]`, which must be there and of this type."""
    value = document.get(name) if isinstance(document, dict) else None
    if not isinstance(value, kind):
        needed = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
        raise FormatError(f"field {name!r} must be {needed}, not {type(value).__name__}", file=file)
    return value


def text_list(document: Any, name: str, file: str) -> list[str]:
    """A list of texts."""
    values = field_of(document, name, list, file)
    if not all(isinstance(value, str) and value for value in values):
        raise FormatError(f"field {name!r} must be a list of names", file=file)
    return values


def number_list(document: Any, name: str, count: int, file: str, joint: str | None = None) -> NDArray[np.float64]:
    """A list of `count` finite numbers."""
    values = field_of(document, name, list, file)
    numbers = number_array(values, file, name, joint)
    if numbers.shape != (count,):
        raise FormatError(
            f"field {name!r} has shape {numbers.shape}, {count} numbers are needed", file=file, joint=joint
        )
    return numbers


def number_array(values: Any, file: str, name: str, joint: str | None = None) -> NDArray[np.float64]:
    """Nested lists of equal lengths as an array of finite numbers."""
    try:
        array = np.array(values)
        if array.dtype.kind not in "iuf":
            raise ValueError(f"{array.dtype} is no number")
        numbers = array.astype(np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        message = f"field {name!r} must hold numbers in rows of equal length"
        raise FormatError(message, code="bad-number", file=file, joint=joint) from error
    if not np.isfinite(numbers).all():
        raise FormatError(
            f"field {name!r} holds numbers that are not finite", code="bad-number", file=file, joint=joint
        )
    return numbers
