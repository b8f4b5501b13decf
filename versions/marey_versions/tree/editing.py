"""Changes of trees. A change rewrites only the chunks with changed keys, and the chunks above these."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from marey_schemas.sizes import batched
from marey_versions.tree.building import ChunkWriter, Splitter
from marey_versions.tree.chunks import Branch, Child, Chunk, ChunkStore, Leaf, Value
from marey_versions.tree.reading import ChunkReader, leaves_with

CHANGED_TOGETHER = 2_000
"""Number of changes whose chunks are read together, with one request to the store for each level."""

Changes = Mapping[str, Value | None]


def change(store: ChunkStore, root: str, changes: Changes) -> str:
    """Store the tree that results from changes to the tree `root`, and return the digest of its root.

    The value None removes a key; removing a key that the tree does not have has no effect.
    """
    keys = sorted(changes)
    writer = ChunkWriter(store)
    for together in batched(keys, CHANGED_TOGETHER):
        root = _Change(writer, root).apply([(key, changes[key]) for key in together])
    writer.save(root)
    return root


class _Change:
    """Change of the tree with the root digest `root`: rewrites the chunks with changed keys, level by level."""

    def __init__(self, writer: ChunkWriter, root: str) -> None:
        self._writer = writer
        self._root = root

    def apply(self, changes: Sequence[tuple[str, Value | None]]) -> str:
        """Add the chunks of the changed tree, and return the digest of its root."""
        reader = self._writer.reader
        leaves_with(reader, self._root, [key for key, _ in changes])
        top = reader.one(self._root)
        of_level: Sequence[tuple[str, Any]] = changes
        for level in range(top.level + 1):
            of_level = self._rewrite(level, of_level)
        left = [child for _, child in of_level if child is not None] if of_level else [self._child_of(top)]
        root = self._writer.above(left, top.level)
        while isinstance(chunk := reader.one(root), Branch) and len(chunk.children) == 1:
            root = chunk.children[0].digest
        return root

    def _child_of(self, chunk: Chunk) -> Child:
        return Child(chunk.last_key, self._root, chunk.count)

    def _rewrite(self, level: int, changes: Sequence[tuple[str, Any]]) -> list[tuple[str, Child | None]]:
        """Add the new chunks of one level after `changes`, and return the resulting changes of the level above.

        `changes` contains, by key, entries if the level is that of the leaves, and otherwise children of branches. None
        removes a key.
        """
        changed: dict[str, Child | None] = {}
        old = _ChunksOfLevel(self._writer.reader, self._root, level)
        done = 0
        while done < len(changes):
            old.seek(changes[done][0])
            splitter: Splitter[Any] = Splitter(level)
            new: list[Child] = []
            while True:
                reference, chunk, is_last = old.current
                until = len(changes) if is_last else bisect_right(changes, reference.last_key, lo=done, key=_key_of)
                for key, one in _merged(chunk, changes[done:until]):
                    full = splitter.add(key, one)
                    new += [self._add(level, full)] if full else []
                done = until
                changed[reference.last_key] = None
                if is_last or splitter.is_between_chunks:
                    break
                old.advance()
            new += [self._add(level, rest) for rest in splitter.finish()]
            changed.update((child.last_key, child) for child in new)
        return sorted(changed.items(), key=_key_of)

    def _add(self, level: int, members: tuple[Any, ...]) -> Child:
        return self._writer.add(Branch(level, members) if level else Leaf(members))


class _ChunksOfLevel:
    """Cursor over the chunks of one level of a tree; it moves only forward."""

    def __init__(self, reader: ChunkReader, root: str, level: int) -> None:
        self._reader = reader
        self._level = level
        top = reader.one(root)
        self._root = Child(top.last_key, root, top.count)
        self._path: list[tuple[Branch, int]] = []
        """Branches on the way from the root down to the current chunk, each with the index of the child on this way."""

    def seek(self, key: str) -> None:
        """Go to the chunk in which `key` is or would be."""
        self._path = []
        chunk = self._reader.one(self._root.digest)
        while isinstance(chunk, Branch) and chunk.level > self._level:
            place = min(bisect_left(chunk.children, key, key=_key_of_child), len(chunk.children) - 1)
            self._path.append((chunk, place))
            (chunk,) = self._reader.below([chunk.children[place]], chunk.level - 1)

    def advance(self) -> None:
        """Go to the next chunk of the level. The current chunk must not be the last one."""
        while self._path[-1][1] == len(self._path[-1][0].children) - 1:
            self._path.pop()
        branch, place = self._path.pop()
        self._path.append((branch, place + 1))
        chunk = self._reader.below([branch.children[place + 1]], branch.level - 1)[0]
        while isinstance(chunk, Branch) and chunk.level > self._level:
            self._path.append((chunk, 0))
            (chunk,) = self._reader.below([chunk.children[0]], chunk.level - 1)

    @property
    def current(self) -> tuple[Child, Chunk, bool]:
        """The reference to the current chunk, the chunk, and whether it is the last one of its level."""
        reference = self._path[-1][0].children[self._path[-1][1]] if self._path else self._root
        is_last = all(place == len(branch.children) - 1 for branch, place in self._path)
        return reference, self._reader.one(reference.digest), is_last


def _merged(chunk: Chunk, changes: Sequence[tuple[str, Any]]) -> Iterator[tuple[str, Any]]:
    """Return the entries or children of a chunk after changes, each with its key, sorted by key."""
    members: dict[str, Any]
    if isinstance(chunk, Leaf):
        members = {entry[0]: entry for entry in chunk.entries}
        members.update((key, None if value is None else (key, value)) for key, value in changes)
    else:
        members = {child.last_key: child for child in chunk.children}
        members.update(changes)
    return iter(sorted(((key, one) for key, one in members.items() if one is not None), key=_key_of))


def _key_of(changed: tuple[str, Any]) -> str:
    return changed[0]


def _key_of_child(child: Child) -> str:
    return child.last_key
