"""Values that may be None by their type, and that a test knows to be there."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def present(value: T | None) -> T:
    """Return the value; the test fails here if it is None."""
    assert value is not None
    return value
