"""Search for the chunks that some trees do not share with others, without reading the others whole."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Sequence

from marey_schemas.sizes import batched
from marey_versions.tree.chunks import Branch, Child, Chunk, ChunkStore, decode_trusted
from marey_versions.tree.reading import LOADED_TOGETHER


def unshared_chunks(store: ChunkStore, roots: Collection[str], others: Collection[str]) -> set[str]:
    """Return the digests of the chunks of the trees `roots` that none of the trees `others` has.

    Every chunk of `roots` is read. Of `others`, only the roots are read, and the branches below which one of these
    chunks could be: the last key of a chunk is in the range of keys of each branch above it. Leaves of `others` are
    not read, because the branches above them contain their digests. Missing chunks are left out.
    """
    own: dict[str, tuple[str, ...]] = {}
    last_keys: set[str] = set()
    waiting = set(roots)
    while waiting:
        own.update(dict.fromkeys(waiting, ()))
        below: set[str] = set()
        for digest, chunk in _load(store, waiting):
            if isinstance(chunk, Branch):
                own[digest] = tuple(child.digest for child in chunk.children)
                below.update(own[digest])
            else:
                last_keys.add(chunk.last_key)
        waiting = below - own.keys()
    return own.keys() - _shared(store, own, sorted(last_keys), others)


def _shared(
    store: ChunkStore, own: dict[str, tuple[str, ...]], last_keys: Sequence[str], others: Collection[str]
) -> set[str]:
    """Return those digests of `own` that occur in the trees `others`.

    `own` maps the digest of each chunk to the digests of the chunks below it, and `last_keys` are the last keys of the
    leaves, sorted.
    """
    shared: set[str] = set()
    read: set[str] = set()
    waiting = set(others)
    while waiting:
        _add_with_below(shared, own, waiting & own.keys())
        waiting -= own.keys()
        read |= waiting
        further: set[str] = set()
        for _, chunk in _load(store, waiting):
            if isinstance(chunk, Branch):
                further.update(child.digest for child in _overlapping(chunk, last_keys, own))
        waiting = further - read
    return shared


def _overlapping(branch: Branch, last_keys: Sequence[str], own: Collection[str]) -> Iterator[Child]:
    """Yield the children of a branch that are in `own`, or that have branches below which a chunk of `own` may be."""
    start = 0
    for child in branch.children:
        until = bisect_right(last_keys, child.last_key, lo=start)
        if until > start and (branch.level > 1 or child.digest in own):
            yield child
        start = until


def _add_with_below(found: set[str], own: dict[str, tuple[str, ...]], digests: Iterable[str]) -> None:
    """Add chunks of `own`, and all chunks below them, to `found`."""
    waiting = set(digests) - found
    while waiting:
        found |= waiting
        waiting = {child for digest in waiting for child in own[digest]} - found


def _load(store: ChunkStore, digests: Collection[str]) -> Iterator[tuple[str, Chunk]]:
    for some in batched(sorted(digests), LOADED_TOGETHER):
        for digest, data in store.load(some).items():
            yield digest, decode_trusted(digest, data)
