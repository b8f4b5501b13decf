"""Construction of trees from sorted entries, and the rule that says where chunks end.

The rule depends on keys alone, so that a changed value never moves an end. Let k be the key of an entry or child at
level l. The first 4 bytes of the SHA-256 of the text "l k" are read as a big-endian number. The entry or child ends its
chunk if this number is below 2^32 / n. In leaves n is `MEAN_ENTRIES`, in the chunks above the leaves it is
`MEAN_CHILDREN`. There are two exceptions. The first member of a chunk never ends it, so each level has at most about
half as many chunks as the level below. A chunk with `LONGEST` times n members ends in any case, so nobody can make a
chunk arbitrarily large by a choice of keys.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, TypeVar

from marey_versions.tree.chunks import EMPTY, Branch, Child, Chunk, ChunkStore, Entry, Leaf, encode
from marey_versions.tree.reading import ChunkReader

MEAN_ENTRIES = 16
MEAN_CHILDREN = 32
LONGEST = 8

T = TypeVar("T")


def build(store: ChunkStore, entries: Iterable[Entry]) -> str:
    """Store a tree with the given entries, sorted by key, and return the digest of its root.

    Raises `ValueError` if a key is not greater than the previous one.
    """
    writer = ChunkWriter(store)
    children = [writer.add(Leaf(chunk)) for chunk in _split(0, _increasing(entries), _key_of_entry)]
    return writer.finish(children, 0)


class Splitter(Generic[T]):
    """Splitter that divides a sequence of keys with values into the chunks of one level of a tree."""

    def __init__(self, level: int) -> None:
        self._level = level
        mean = MEAN_CHILDREN if level else MEAN_ENTRIES
        self._below = (1 << 32) // mean
        self._most = LONGEST * mean
        self._open: list[T] = []

    @property
    def is_between_chunks(self) -> bool:
        """Whether the last key added ended a chunk, or no key was added yet."""
        return not self._open

    def add(self, key: str, one: T) -> tuple[T, ...] | None:
        """Add a key with its value. If the key ends a chunk, return this chunk, otherwise None."""
        self._open.append(one)
        if len(self._open) == 1 or (len(self._open) < self._most and not self._is_end(key)):
            return None
        return self._take()

    def finish(self) -> Iterator[tuple[T, ...]]:
        """Yield a last chunk with the keys since the last end of a chunk; yield nothing if there are no such keys."""
        if self._open:
            yield self._take()

    def _take(self) -> tuple[T, ...]:
        chunk, self._open = tuple(self._open), []
        return chunk

    def _is_end(self, key: str) -> bool:
        hashed = hashlib.sha256(f"{self._level} {key}".encode())
        return int.from_bytes(hashed.digest()[:4], "big") < self._below


class ChunkWriter:
    """Collector of new chunks; it stores the chunks that belong to the new tree."""

    def __init__(self, store: ChunkStore) -> None:
        self.reader = ChunkReader(store)
        self._store = store
        self._new: dict[str, tuple[Chunk, bytes]] = {}

    def add(self, chunk: Chunk) -> Child:
        digest, data = encode(chunk)
        self._new[digest] = (chunk, data)
        self.reader.know(digest, chunk)
        return Child(chunk.last_key, digest, chunk.count)

    def finish(self, children: Sequence[Child], level: int) -> str:
        """Add the chunks above the chunks of `level`, up to the root; store all, and return the root's digest."""
        root = self.above(children, level)
        self.save(root)
        return root

    def above(self, children: Sequence[Child], level: int) -> str:
        """Add the chunks above the chunks of `level`, given in order, and return the digest of the root."""
        if not children:
            return self.add(EMPTY).digest
        while len(children) > 1:
            level += 1
            children = [self.add(Branch(level, chunk)) for chunk in _split(level, children, _key_of_child)]
        return children[0].digest

    def save(self, root: str) -> None:
        """Store the new chunks of the tree `root`."""
        reached: dict[str, bytes] = {}
        waiting = [root]
        while waiting:
            digest = waiting.pop()
            if digest in self._new and digest not in reached:
                chunk, reached[digest] = self._new[digest]
                if isinstance(chunk, Branch):
                    waiting.extend(child.digest for child in chunk.children)
        self._store.save(reached)
        self._new.clear()


def _split(level: int, members: Iterable[T], key_of: Callable[[T], str]) -> Iterator[tuple[T, ...]]:
    splitter: Splitter[T] = Splitter(level)
    for one in members:
        if full := splitter.add(key_of(one), one):
            yield full
    yield from splitter.finish()


def _increasing(entries: Iterable[Entry]) -> Iterator[Entry]:
    before: str | None = None
    for key, value in entries:
        if before is not None and key <= before:
            raise ValueError(f"the key {key!r} must be greater than the previous key, {before!r}")
        before = key
        yield key, value


def _key_of_entry(entry: Entry) -> str:
    return entry[0]


def _key_of_child(child: Child) -> str:
    return child.last_key
