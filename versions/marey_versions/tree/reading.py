"""Reading of trees: single entries, entries in order, folders, and numbers of entries."""

from __future__ import annotations

import sys
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence

from marey_versions.tree.chunks import (
    Branch,
    Child,
    Chunk,
    ChunkStore,
    DamagedChunk,
    Entry,
    Leaf,
    Value,
    decode,
)

LOADED_TOGETHER = 256
"""Greatest number of leaves that an iteration loads with one request to the store."""


class ChunkReader:
    """Reader of chunks from a store; it loads several chunks at a time and remembers them."""

    def __init__(self, store: ChunkStore) -> None:
        self._store = store
        self._known: dict[str, Chunk] = {}

    @classmethod
    def of(cls, store: ChunkStore | ChunkReader) -> ChunkReader:
        """Return the given reader, or a new one for a store."""
        return store if isinstance(store, ChunkReader) else cls(store)

    def one(self, digest: str) -> Chunk:
        """Return a chunk. Raises `DamagedChunk` if it is missing or damaged."""
        return self.several([digest])[0]

    def several(self, digests: Sequence[str]) -> list[Chunk]:
        """Return chunks in the order of the given digests.

        Raises `DamagedChunk` if a chunk is missing or damaged.
        """
        missing = {digest for digest in digests if digest not in self._known}
        if missing:
            loaded = self._store.load(missing)
            for digest in missing:
                if digest not in loaded:
                    raise DamagedChunk(f"the chunk {digest} is missing")
                self._known[digest] = decode(digest, loaded[digest])
        return [self._known[digest] for digest in digests]

    def below(self, children: Sequence[Child], level: int) -> list[Chunk]:
        """Return the chunks of `level` to which `children` refer.

        Raises `DamagedChunk` if a chunk does not have the level, last key and number of entries that its parent states.
        """
        chunks = self.several([child.digest for child in children])
        for child, chunk in zip(children, chunks, strict=True):
            if (chunk.level, chunk.last_key, chunk.count) != (level, child.last_key, child.entries):
                raise DamagedChunk(f"the chunk {child.digest} does not match its description in the chunk above it")
        return chunks

    def know(self, digest: str, chunk: Chunk) -> None:
        """Remember a chunk that is not in the store yet."""
        self._known[digest] = chunk


class Tree:
    """Tree with a given root, open for reading. Trees with the same reader share the chunks that it remembers."""

    def __init__(self, store: ChunkStore | ChunkReader, root: str) -> None:
        self.root = root
        self._reader = ChunkReader.of(store)

    def __len__(self) -> int:
        """Return the number of entries."""
        return self._reader.one(self.root).count

    def get(self, key: str) -> Value | None:
        """Return the value of a key, or None if the tree does not have the key."""
        return self.get_several([key]).get(key)

    def get_several(self, keys: Iterable[str]) -> dict[str, Value]:
        """Return the values of those keys that the tree has."""
        wanted = sorted(set(keys))
        found: dict[str, Value] = {}
        for leaf, inside in leaves_with(self._reader, self.root, wanted):
            of_leaf = dict(leaf.entries)
            found.update((key, of_leaf[key]) for key in inside if key in of_leaf)
        return found

    def entries(self, *, after: str = "", prefix: str = "") -> Iterator[Entry]:
        """Return the entries whose keys start with `prefix` and are greater than `after`, sorted by key."""
        start = max(after, prefix)
        for key, value in self._from(self._reader.one(self.root), start):
            if prefix and not key.startswith(prefix):
                return
            if not after or key > after:
                yield key, value

    def _from(self, chunk: Chunk, start: str) -> Iterator[Entry]:
        """Return the entries below a chunk whose keys are `start` or greater."""
        if isinstance(chunk, Leaf):
            yield from chunk.entries[bisect_left(chunk.entries, start, key=_key_of) :]
            return
        first = bisect_left(chunk.children, start, key=_last_key_of)
        size = 2  # loads little where the caller may need little
        while first < len(chunk.children):
            for below in self._reader.below(chunk.children[first : first + size], chunk.level - 1):
                yield from self._from(below, start)
            first += size
            size = min(2 * size, LOADED_TOGETHER)

    def count(self, prefix: str = "") -> int:
        """Return the number of entries whose keys start with `prefix`."""
        until = after_all_with(prefix)
        return (len(self) if until is None else self._rank(until)) - (self._rank(prefix) if prefix else 0)

    def _rank(self, key: str) -> int:
        """Return the number of entries whose keys are less than `key`."""
        chunk, rank = self._reader.one(self.root), 0
        while isinstance(chunk, Branch):
            place = bisect_left(chunk.children, key, key=_last_key_of)
            rank += sum(child.entries for child in chunk.children[:place])
            if place == len(chunk.children):
                return rank
            (chunk,) = self._reader.below(chunk.children[place : place + 1], chunk.level - 1)
        return rank + bisect_left(chunk.entries, key, key=_key_of)


def leaves_with(reader: ChunkReader, root: str, keys: Sequence[str]) -> list[tuple[Leaf, Sequence[str]]]:
    """Return the leaves that have, or would have, the given sorted keys; each leaf with its share of the keys.

    The chunks of each level are loaded with one request to the store.
    """
    parts: list[tuple[Chunk, Sequence[str]]] = [(reader.one(root), keys)]
    level = parts[0][0].level
    while level > 0:
        wanted = [one for chunk, inside in parts if isinstance(chunk, Branch) for one in _spread(chunk, inside)]
        level -= 1
        chunks = reader.below([child for child, _ in wanted], level)
        parts = [(chunk, inside) for chunk, (_, inside) in zip(chunks, wanted, strict=True)]
    return [(chunk, inside) for chunk, inside in parts if isinstance(chunk, Leaf)]


def _spread(chunk: Branch, keys: Sequence[str]) -> Iterator[tuple[Child, Sequence[str]]]:
    """Yield the children that have, or would have, the given sorted keys, each with its share of the keys.

    The last child also gets all greater keys.
    """
    start = 0
    while start < len(keys):
        place = min(bisect_left(chunk.children, keys[start], key=_last_key_of), len(chunk.children) - 1)
        child = chunk.children[place]
        is_last = place == len(chunk.children) - 1
        until = len(keys) if is_last else bisect_right(keys, child.last_key, lo=start)
        yield child, keys[start:until]
        start = until


def after_all_with(prefix: str) -> str | None:
    """Return the least text that is greater than all texts with the prefix; None if there is none."""
    for place in range(len(prefix) - 1, -1, -1):
        following = ord(prefix[place]) + 1
        if following <= sys.maxunicode:
            return prefix[:place] + chr(0xE000 if following == 0xD800 else following)  # skips the surrogates
    return None


def _key_of(entry: Entry) -> str:
    return entry[0]


def _last_key_of(child: Child) -> str:
    return child.last_key
