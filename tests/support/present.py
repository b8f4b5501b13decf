"""Check for values whose type allows None, but which a test knows not to be None."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def present(value: T | None) -> T:
    """Return the value; the test fails here if it is None."""
    assert value is not None
    return value
