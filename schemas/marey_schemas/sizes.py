"""Units of sizes in bytes, and division of long lists into lists of limited size."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

KIB = 1024
MIB = 1024 * KIB
GIB = 1024 * MIB


def batched(values: Iterable[T], size: int) -> Iterator[list[T]]:
    """Yield the values in lists of `size` values each; the last list may be shorter."""
    rest = iter(values)
    while some := list(itertools.islice(rest, size)):
        yield some
