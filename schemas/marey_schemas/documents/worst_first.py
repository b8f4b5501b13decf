"""Order of rows from the worst to the best, for trials, changed trials and clips.

Reports, the command line, the SDK and stored results all list the worst in this order, so their first rows agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TypeVar

T = TypeVar("T")


def worst_first(
    rows: Iterable[T],
    badness: Callable[[T], float | None],
    name: Callable[[T], str],
    *,
    undefined_is_worst: bool = False,
) -> list[T]:
    """Sort rows from the worst to the best.

    Parameters
    ----------
    rows : the rows, in any order
    badness : number of a row that is greater if the row is worse; None or NaN if it is not defined
    name : name of a row; rows that are equally bad are in the order of their names, and rows with equal names keep
        their order
    undefined_is_worst : whether rows without a badness come before all others, not after them
    """
    missing = math.inf if undefined_is_worst else -math.inf

    def place(row: T) -> tuple[float, str]:
        value = badness(row)
        return (-missing if value is None or math.isnan(value) else -value), name(row)

    return sorted(rows, key=place)


def increase(before: float | None, after: float | None) -> float | None:
    """Return by how much a measure that should be small has grown; None if one of the values is not defined."""
    return None if before is None or after is None else after - before


def middle_of(ranked: list[T]) -> T:
    """Return the median row of rows that are sorted from the worst to the best; of two middle rows, the worse one."""
    return ranked[(len(ranked) - 1) // 2]
