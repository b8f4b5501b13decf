"""Differences of trees. Chunks that both trees contain are skipped, so the work depends on the changes alone."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

from marey_versions.tree.chunks import Branch, Child, ChunkStore, Leaf, Value
from marey_versions.tree.reading import ChunkReader, after_all_with

COMPARED_TOGETHER = 256
"""Number of chunks of one level and one tree that are compared at once; it limits the memory."""


class Changed(NamedTuple):
    """Key whose values in two trees differ; a value is None if the tree does not have the key."""

    key: str
    before: Value | None
    after: Value | None


def difference(store: ChunkStore | ChunkReader, before: str, after: str, *, prefix: str = "") -> Iterator[Changed]:
    """Return the keys that start with `prefix` and whose values differ in the trees with the given roots, sorted.

    If `store` is a `ChunkReader`, several comparisons can share the chunks that it remembers.
    """
    changes = _difference(
        ChunkReader.of(store), before, after, KeyRange(_before_all_with(prefix), after_all_with(prefix))
    )
    return (one for one in changes if one.key.startswith(prefix))


def _before_all_with(prefix: str) -> str | None:
    """Return a text that sorts shortly before all texts with the prefix; None for an empty prefix."""
    if not prefix:
        return None
    last = ord(prefix[-1])
    return prefix[:-1] + (chr(last - 1) + chr(sys.maxunicode) if last else "")


def _difference(reader: ChunkReader, before: str, after: str, within: KeyRange) -> Iterator[Changed]:
    if before == after:
        return iter(())
    pair = reader.several([before, after])
    sides = [[Child(chunk.last_key, root, chunk.count)] for chunk, root in zip(pair, (before, after), strict=True)]
    levels = [chunk.level for chunk in pair]
    while max(levels) != min(levels):
        higher = levels.index(max(levels))
        sides[higher] = _expanded(reader, sides[higher], levels[higher])
        levels[higher] -= 1
    level = levels[0]
    return _compare(reader, level, sides[0], sides[1], within)


class KeyRange(NamedTuple):
    """Range of keys: greater than `after`, and at most `last`; None stands for no limit."""

    after: str | None
    last: str | None

    def contains(self, key: str) -> bool:
        return (self.after is None or key > self.after) and (self.last is None or key <= self.last)

    def overlaps(self, before: str | None, child: Child) -> bool:
        """Return whether a chunk can have keys in the range; all keys of `child` are greater than `before`."""
        starts_in_time = self.last is None or before is None or before < self.last
        return starts_in_time and (self.after is None or child.last_key > self.after)


def _compare(
    reader: ChunkReader, level: int, before: Sequence[Child], after: Sequence[Child], within: KeyRange
) -> Iterator[Changed]:
    """Compare the chunks of one level in two trees; yield the keys in the range `within` whose values differ."""
    shared = {child.digest for child in before} & {child.digest for child in after}
    before, after = ([child for child in side if child.digest not in shared] for side in (before, after))
    if level == 0:
        yield from _compare_leaves(reader, before, after, within)
        return
    for part in _parts(before, after, within):
        sides = _loaded(reader, before, after, part)
        old, new = (_inside(_expanded(reader, side, level), part) for side in sides)
        yield from _compare(reader, level - 1, old, new, part)


def _parts(before: Sequence[Child], after: Sequence[Child], within: KeyRange) -> Iterator[KeyRange]:
    """Split a range of keys into parts with at most `COMPARED_TOGETHER` chunks of the side that has more chunks."""
    longer = max(before, after, key=len)
    start = within.after
    for place in range(COMPARED_TOGETHER - 1, len(longer) - 1, COMPARED_TOGETHER):
        yield KeyRange(start, longer[place].last_key)
        start = longer[place].last_key
    yield KeyRange(start, within.last)


def _loaded(
    reader: ChunkReader, before: Sequence[Child], after: Sequence[Child], within: KeyRange
) -> tuple[list[Child], list[Child]]:
    """Return the chunks of both trees that can have keys in a range; they were loaded with one request to the store."""
    sides = _inside(before, within), _inside(after, within)
    reader.several([child.digest for side in sides for child in side])
    return sides


def _inside(children: Sequence[Child], within: KeyRange) -> list[Child]:
    found, before = [], None
    for child in children:
        if within.overlaps(before, child):
            found.append(child)
        before = child.last_key
    return found


def _expanded(reader: ChunkReader, children: Sequence[Child], level: int) -> list[Child]:
    """Return the children of those chunks of `level` to which `children` refer."""
    chunks = reader.below(children, level)
    return list(chain.from_iterable(chunk.children for chunk in chunks if isinstance(chunk, Branch)))


def _compare_leaves(
    reader: ChunkReader, before: Sequence[Child], after: Sequence[Child], within: KeyRange
) -> Iterator[Changed]:
    for part in _parts(before, after, within):
        old, new = (_entries(reader, side, part) for side in _loaded(reader, before, after, part))
        for key in sorted(old.keys() | new.keys()):
            if old.get(key) != new.get(key):
                yield Changed(key, old.get(key), new.get(key))


def _entries(reader: ChunkReader, children: Sequence[Child], within: KeyRange) -> dict[str, Value]:
    leaves = reader.below(children, 0)
    return {
        key: value for leaf in leaves if isinstance(leaf, Leaf) for key, value in leaf.entries if within.contains(key)
    }
