"""Functions that read fields of unvalidated documents; if a value is missing or invalid, an error names the field."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import FormatError

T = TypeVar("T")


def field_of(document: Any, name: str, kind: type[T] | tuple[type[T], ...], file: str) -> T:
    """Read a field that must exist and have one of the given types.

    Parameters
    ----------
    document : object    the document
    name : str    name of the field
    kind : type or tuple of types    types to accept
    file : str    name of the file, for messages

    Returns
    -------
    object    the value

    Raises
    ------
    FormatError    if the field is missing or invalid; the error names it
    """
    value = document.get(name) if isinstance(document, dict) else None
    if not isinstance(value, kind):
        needed = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
        raise FormatError(f"field {name!r} must be {needed}, not {type(value).__name__}", file=file)
    return value


def text_list(document: Any, name: str, file: str) -> list[str]:
    """Read a list of texts.

    Parameters
    ----------
    document : object    the document
    name : str    name of the field
    file : str    name of the file, for messages

    Returns
    -------
    list of str    the texts

    Raises
    ------
    FormatError    if the field is missing or invalid; the error names it
    """
    values = field_of(document, name, list, file)
    if not all(isinstance(value, str) and value for value in values):
        raise FormatError(f"field {name!r} must be a list of names", file=file)
    return values


def number_list(document: Any, name: str, count: int, file: str, joint: str | None = None) -> NDArray[np.float64]:
    """Read a list of finite numbers.

    Parameters
    ----------
    document : object    the document
    name : str    name of the field
    count : int    length of the list
    file : str    name of the file, for messages
    joint : str, optional    name of the joint, for messages

    Returns
    -------
    (count,) float64    the numbers

    Raises
    ------
    FormatError    if the field is missing or invalid; the error names it
    """
    values = field_of(document, name, list, file)
    numbers = number_array(values, file, name, joint)
    if numbers.shape != (count,):
        raise FormatError(
            f"field {name!r} has the shape {numbers.shape}, but must be a list of {count} numbers",
            file=file,
            joint=joint,
        )
    return numbers


def number_array(values: Any, file: str, name: str, joint: str | None = None) -> NDArray[np.float64]:
    """Convert nested lists of equal lengths to an array of finite numbers.

    Parameters
    ----------
    values : object    nested lists
    file : str    name of the file, for messages
    name : str    name of the field, for messages
    joint : str, optional    name of the joint, for messages

    Returns
    -------
    (...) float64    the numbers

    Raises
    ------
    FormatError    if a value is not a finite number; the error names the field
    """
    try:
        array = np.array(values)
        if array.dtype.kind not in "iuf":
            raise ValueError(f"the values are of the type {array.dtype}, not numbers")
        numbers = array.astype(np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        message = f"field {name!r} must hold numbers in rows of equal length"
        raise FormatError(message, code="bad-number", file=file, joint=joint) from error
    if not np.isfinite(numbers).all():
        raise FormatError(
            f"field {name!r} contains numbers that are not finite", code="bad-number", file=file, joint=joint
        )
    return numbers
