"""Assignment of the resolutions of a merge to the conflicts, or parts of conflicts, that they decide."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection, Container, Iterable, Mapping
from typing import NamedTuple

from marey_schemas.datasets.merges import Side


class Choice(NamedTuple):
    """Decision of a person about one conflict, or about one part of a conflict."""

    key: str
    """Key of the conflict."""
    take: Side
    part: str | None = None
    """Name of the part that is decided; None: all parts of the conflict."""


class Choices:
    """Resolutions that were not used yet. Each decides only one conflict, because its author saw no other conflict."""

    def __init__(self, resolutions: Iterable[Choice], used: set[str]) -> None:
        self._left: defaultdict[str, deque[Choice]] = defaultdict(deque)
        for one in resolutions:
            self._left[one.key].append(one)
        self._used = used

    def take(self, key: str, groups: Mapping[str, Collection[str]], sides: Container[Side]) -> Side | dict[str, Side]:
        """Return the decision about the next conflict with this key, and remove the resolutions on which it is based.

        The decision is a side, or the sides of single parts; parts without a resolution are missing. `groups` contains
        for each part in conflict the parts that must come from the same side, the part itself included. A resolution of
        a part is used only if its side is among `sides`.
        """
        found: dict[str, Side] = {}
        while len(found) < len(groups) and (left := self._left.get(key)):
            one = left[0]
            if one.part is None and not found:
                return self._next(key).take
            if one.part is None or one.part not in groups or one.part in found or one.take not in sides:
                break
            found.update(dict.fromkeys(groups[one.part], self._next(key).take))
        return found

    def _next(self, key: str) -> Choice:
        self._used.add(key)
        return self._left[key].popleft()

    def left(self) -> list[Choice]:
        """Return the resolutions that were not used, sorted by key; those with the same key keep their order."""
        return [one for key in sorted(self._left) for one in self._left[key]]
