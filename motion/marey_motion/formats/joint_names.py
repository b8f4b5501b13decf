"""Unique joint names made from the names in a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

MAX_JOINT_NAME_LENGTH = 255


def unique_names(names: Sequence[str], parents: Sequence[int]) -> tuple[str, ...]:
    """Make repeated names unique by prefixing the parent's name and, if necessary, adding a number.

    The same hierarchy always gets the same names.

    Parameters
    ----------
    names : sequence of str    names of J joints, which may repeat
    parents : sequence of int    index of each joint's parent

    Returns
    -------
    tuple of str    unique names; names that were already unique are unchanged
    """
    counts = Counter(names)
    taken = {name for name, count in counts.items() if count == 1}
    numbers: Counter[str] = Counter()
    result = []
    for joint, name in enumerate(names):
        if counts[name] > 1:
            above = f"{names[parents[joint]]}/{name}" if parents[joint] >= 0 else name
            name = above
            while name in taken:
                numbers[above] += 1
                name = f"{above}#{numbers[above] + 1}"
            taken.add(name)
        result.append(name)
    return tuple(result)
