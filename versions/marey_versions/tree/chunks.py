"""Chunks of a tree, their canonical bytes, and the interface of stores of chunks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import orjson

from marey_schemas.encoding.digests import digest_of

Value = dict[str, Any]
Entry = tuple[str, Value]

SCHEMA = "marey/tree-chunk@1"
MOST_CHUNK_BYTES = 8 * 2**20
"""Greatest size of a chunk in bytes; a chunk usually has about 4,000."""
MOST_ENTRIES = 1 << 40
"""Greatest number of entries that a reference to a chunk can state, so that sums of such numbers stay valid lengths."""


class DamagedChunk(Exception):
    """A chunk is missing, or its bytes are not those of a chunk with its digest."""


class Child(NamedTuple):
    """Reference from a chunk to a chunk below."""

    last_key: str
    digest: str
    entries: int
    """Number of entries in the leaves below the child."""


@dataclass(frozen=True, slots=True)
class Leaf:
    """Chunk that contains entries, sorted by key."""

    entries: tuple[Entry, ...]

    @property
    def level(self) -> int:
        """Number of levels below, which is 0."""
        return 0

    @property
    def count(self) -> int:
        """Number of entries."""
        return len(self.entries)

    @property
    def last_key(self) -> str:
        """Greatest key; the empty text for the leaf of an empty tree."""
        return self.entries[-1][0] if self.entries else ""


@dataclass(frozen=True, slots=True)
class Branch:
    """Chunk that refers to chunks of the level below, sorted by key."""

    level: int
    children: tuple[Child, ...]

    @property
    def count(self) -> int:
        """Number of entries in all leaves below."""
        return sum(child.entries for child in self.children)

    @property
    def last_key(self) -> str:
        """Greatest key of the leaves below."""
        return self.children[-1].last_key


Chunk = Leaf | Branch

EMPTY = Leaf(())


class ChunkStore(Protocol):
    """Store of the bytes of chunks by digest."""

    def load(self, digests: Iterable[str]) -> Mapping[str, bytes]:
        """Return the bytes of chunks; chunks that the store does not have are left out."""

    def save(self, chunks: Mapping[str, bytes]) -> None:
        """Store the bytes of chunks by digest. Storing a chunk again has no effect."""


class ChunksInMemory(dict[str, bytes]):
    """Store of chunks in a dictionary."""

    def load(self, digests: Iterable[str]) -> Mapping[str, bytes]:
        """Return the bytes of the chunks that the store has."""
        return {digest: self[digest] for digest in digests if digest in self}

    def save(self, chunks: Mapping[str, bytes]) -> None:
        """Store the bytes of chunks by digest."""
        self.update(chunks)


def encode(chunk: Chunk) -> tuple[str, bytes]:
    """Return the digest and the bytes of a chunk: canonical JSON with sorted members and without spaces."""
    content: dict[str, Any] = {"schema": SCHEMA, "level": chunk.level}
    if isinstance(chunk, Leaf):
        content["entries"] = chunk.entries
    else:
        content["children"] = [tuple(child) for child in chunk.children]
    data = orjson.dumps(content, option=orjson.OPT_SORT_KEYS)
    return digest_of(data), data


def decode(digest: str, data: bytes) -> Chunk:
    """Return the chunk with these bytes. Raises `DamagedChunk` if the bytes are not those of a chunk with `digest`."""
    if digest_of(data) != digest:
        raise DamagedChunk(f"the bytes of the chunk {digest} have another digest")
    return decode_trusted(digest, data)


def decode_trusted(digest: str, data: bytes) -> Chunk:
    """Return the chunk with these bytes, read from a store that checked the digest when it stored them.

    Raises `DamagedChunk` if the bytes are not those of a chunk, for example if a member has another type.
    """
    try:
        content = orjson.loads(data)
        if content["schema"] != SCHEMA:
            raise ValueError(f"the schema is not {SCHEMA}")
        level = content["level"]
        if type(level) is not int or level < 0:
            raise ValueError("the level is not an integer of at least 0")
        return _branch(level, content["children"]) if level else _leaf(content["entries"])
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise DamagedChunk(f"the chunk {digest} cannot be read: {error}") from error


def _leaf(members: Any) -> Leaf:
    entries = []
    before = ""
    for key, value in members:
        if key <= before or type(value) is not dict:  # a key that is no text cannot be compared: a TypeError
            raise ValueError(f"the value of the entry {key!r} is not an object, or the entry is not in order")
        before = key
        entries.append((key, value))
    return Leaf(tuple(entries))


def _branch(level: int, members: Any) -> Branch:
    children = []
    before = ""
    for key, digest, entries in members:
        if key <= before or type(digest) is not str or type(entries) is not int or not 0 < entries <= MOST_ENTRIES:
            raise ValueError(f"the reference to the chunk that ends with {key!r} is not valid, or is not in order")
        before = key
        children.append(Child(key, digest, entries))
    if not children:
        raise ValueError("the list of chunks below is empty")
    return Branch(level, tuple(children))
