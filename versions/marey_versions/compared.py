"""Differences of entries: what was added, removed, moved or changed, and in which parts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from marey_schemas.datasets.differences import ChangeKind
from marey_versions.records import DatasetEntry, entry_of
from marey_versions.tree.difference import Changed


@dataclass(frozen=True)
class ComparedEntry:
    """Entry that differs between two versions; `before` or `after` is None if that version does not have the entry."""

    before: DatasetEntry | None
    after: DatasetEntry | None

    @property
    def present(self) -> DatasetEntry:
        """The entry after the change; if the entry was removed, the entry before the change."""
        present = self.after or self.before
        assert present is not None
        return present

    @property
    def change(self) -> ChangeKind:
        """The kind of change. A moved entry may have been changed, too."""
        if self.before is None:
            return "added"
        if self.after is None:
            return "removed"
        return "moved" if self.before.path != self.after.path else "changed"

    @cached_property
    def parts(self) -> Mapping[str, ChangeKind]:
        """The kind of change of each part that differs."""
        before, after = (side.parts if side is not None else {} for side in (self.before, self.after))
        return {
            part: _of_sides(part in before, part in after)
            for part in sorted(before.keys() | after.keys())
            if before.get(part) != after.get(part)
        }

    @staticmethod
    def tags_of(side: DatasetEntry | None) -> set[str]:
        """Return the tags of one side; empty if that version does not have the entry."""
        return set(side.tags) if side is not None else set()


def _of_sides(before: bool, after: bool) -> ChangeKind:
    if before and after:
        return "changed"
    return "removed" if before else "added"


def compare_entries(changes: Iterable[Changed]) -> list[ComparedEntry]:
    """Return the entries that differ between two versions, sorted by path; moved entries are recognised.

    An entry consists of parts, such as `motion` and `info`. A removed and an added entry of the same kind count as one
    moved entry if all their parts are equal. Of the entries that remain, a removed and an added entry of the same kind
    count as moved if one part is equal. If there are several possible pairs, the order of the paths decides.

    An entry whose parts have all changed usually counts as changed. There is an exception: its old parts are now those
    of another differing entry, or its new parts were those of another entry before. Then the entry is divided into a
    removed and an added entry, which are paired as above. So two entries that exchanged their names count as moved.
    """
    compared = [
        ComparedEntry(*(None if value is None else entry_of(one.key, value) for value in (one.before, one.after)))
        for one in changes
    ]
    compared = _rejoined(_paired(list(_split(compared)), _whole))
    for part in _part_names(compared):
        compared = _paired(compared, _of_part(part))
    return sorted(compared, key=lambda one: one.present.key)


def _split(compared: Iterable[ComparedEntry]) -> Iterator[ComparedEntry]:
    """Split each entry whose parts have all changed into a removed and an added entry; yield others unchanged."""
    for one in compared:
        if one.before and one.after and one.parts.keys() == one.before.parts.keys() | one.after.parts.keys():
            yield ComparedEntry(one.before, None)
            yield ComparedEntry(None, one.after)
        else:
            yield one


def _rejoined(compared: Sequence[ComparedEntry]) -> list[ComparedEntry]:
    """Replace each pair of a removed and an added entry with the same path and kind by one changed entry."""
    added = {one.after.key: one.after for one in compared if one.before is None and one.after is not None}
    removed = {one.before.key for one in compared if one.after is None and one.before is not None}
    joined: list[ComparedEntry] = []
    for one in compared:
        if one.after is None and one.before is not None:
            joined.append(ComparedEntry(one.before, added.get(one.before.key)))
        elif one.before is not None or one.present.key not in removed:
            joined.append(one)
    return joined


def _part_names(compared: Iterable[ComparedEntry]) -> list[str]:
    return sorted({part for one in compared for part in one.present.parts}, key=lambda part: (part == "info", part))


def _whole(entry: DatasetEntry) -> Hashable:
    return entry.content


def _of_part(part: str) -> Callable[[DatasetEntry], Hashable]:
    return lambda entry: entry.parts.get(part)


def _paired(compared: list[ComparedEntry], alike: Callable[[DatasetEntry], Hashable]) -> list[ComparedEntry]:
    """Pair each removed entry with an added entry of the same kind for which `alike` returns the same value."""
    removed: dict[tuple[str, Hashable], deque[ComparedEntry]] = {}
    for one in compared:
        if one.after is None and one.before is not None and alike(one.before) is not None:
            removed.setdefault((one.before.kind, alike(one.before)), deque()).append(one)
    gone: set[int] = set()
    paired: list[ComparedEntry] = []
    for one in compared:
        fits = removed.get((one.after.kind, alike(one.after))) if one.before is None and one.after else None
        if fits:
            partner = fits.popleft()
            gone.add(id(partner))
            paired.append(ComparedEntry(partner.before, one.after))
        else:
            paired.append(one)
    return [one for one in paired if id(one) not in gone]
