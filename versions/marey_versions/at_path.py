"""Changes at a path: the entries at the path and below it that differ between two versions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice

from marey_schemas.datasets.differences import ChangeKind
from marey_versions.compared import ComparedEntry, compare_entries
from marey_versions.records import DatasetEntry, entry_of, key_of
from marey_versions.tree.difference import Changed, difference
from marey_versions.tree.reading import ChunkReader, Tree


def prefixes_of(path: str) -> tuple[str, ...]:
    """Return key prefixes that match exactly the entries at a path and below it, in key order."""
    return (key_of(path, ""), f"{path}/") if path else ("",)


def changes_at(reader: ChunkReader, before: str, after: str, path: str) -> Iterator[Changed]:
    """Return the differences of two trees at a path and below it; all differences for an empty path."""
    return chain.from_iterable(difference(reader, before, after, prefix=prefix) for prefix in prefixes_of(path))


def path_after(reader: ChunkReader, before: str, after: str, key: str, *, most: int) -> str | None:
    """Return the path to which an entry of one tree was moved in another, or None if it was removed.

    `key` is the key of an entry that the tree `before` has and the tree `after` does not have. The entry also counts as
    removed if the trees differ in more than `most` entries.
    """
    changes = list(islice(difference(reader, before, after), most + 1))
    if len(changes) > most:
        return None
    found = (one for one in compare_entries(changes) if one.before is not None and one.before.key == key)
    return next((one.after.path for one in found if one.after is not None), None)


@dataclass(frozen=True)
class ChangeAtPath:
    """Change of the entries at a path and below it by one commit."""

    counts: Mapping[ChangeKind, int]
    """Number of entries by kind of change."""
    moved_from: str | None = None
    """Path of the entry before the commit, if the commit moved a single entry to the path; None otherwise."""
    moved_to: str | None = None
    """Path of the entry after the commit, if the commit moved a single entry away from the path; None otherwise."""


@dataclass
class PathComparer:
    """Comparison of versions at one path, which counts the entries that were read."""

    reader: ChunkReader
    path: str
    most: int
    """Greatest number of entries that one comparison reads. If the versions differ in more entries, an entry that was
    moved to the path or away from it counts as added or removed."""
    compared: int = field(default=0, init=False)
    """Number of differing entries that were read."""

    def change(self, before: str | None, after: str) -> ChangeAtPath | None:
        """Return how the tree `after` differs from the tree `before` at the path, or None if they are equal there.

        `before` is None if there is no version before `after`.
        """
        if before is None:
            added = sum(Tree(self.reader, after).count(prefix) for prefix in prefixes_of(self.path))
            return ChangeAtPath({"added": added}) if added else None
        found = self._compared(before, after)
        if not found:
            return None
        elsewhere: list[str | None] = [None, None]
        if len(found) == 1 and found[0].change == "moved":
            sides = (found[0].before, found[0].after)
            elsewhere = [None if side is None or self._is_here(side) else side.path for side in sides]
        return ChangeAtPath(Counter(one.change for one in found), *elsewhere)

    def _compared(self, before: str, after: str) -> list[ComparedEntry]:
        here = self._read(changes_at(self.reader, before, after, self.path))
        if not all(map(_stays, here)):
            # An entry that appears here or disappears may have been moved, which only all changes of the commit show.
            whole = self._read(difference(self.reader, before, after))
            if len(whole) <= self.most:
                return [one for one in compare_entries(whole) if any(map(self._is_here, _sides(one)))]
        return compare_entries(here[: self.most])

    def _read(self, changes: Iterable[Changed]) -> list[Changed]:
        found = list(islice(changes, self.most + 1))
        self.compared += len(found)
        return found

    def _is_here(self, entry: DatasetEntry) -> bool:
        return entry.path == self.path or entry.path.startswith(f"{self.path}/")


def _stays(one: Changed) -> bool:
    """Return whether an entry was not moved: it is in both versions, and at least one of its parts is unchanged."""
    sides = [one.before, one.after]
    before, after = ({} if side is None else entry_of(one.key, side).parts for side in sides)
    return bool(before.items() & after.items())


def _sides(one: ComparedEntry) -> Sequence[DatasetEntry]:
    return [side for side in (one.before, one.after) if side is not None]
