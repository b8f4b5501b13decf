"""Units of sizes and times, limits of numbers, durations of logins, and division of long lists into short ones."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

KIB = 1024
MIB = 1024 * KIB
GIB = 1024 * MIB
DAY_S = 86400
MOST_INTEGER = 2**31 - 1
"""Greatest number of a revision or of a frame, the greatest that an INTEGER column of Postgres stores."""
MOST_QUERY_VALUES = 256
"""Greatest number of values in a comma-separated query parameter."""
SEEDS = 2**63
"""Number of different seeds, the integers from 0 on."""
LOGIN_DAYS, LONGEST_LOGIN_DAYS = 7, 90
"""Default number of days, and greatest number of days, for which the token of a login is valid."""
LONGEST_TOKEN_DAYS = 3650
"""Greatest number of days for which a token that no login created is valid, unless it never ends."""


def batched(values: Iterable[T], size: int) -> Iterator[list[T]]:
    """Yield the values in lists of `size` values each; the last list may be shorter."""
    rest = iter(values)
    while some := list(itertools.islice(rest, size)):
        yield some
