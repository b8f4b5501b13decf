"""Search for the chunks that some trees do not share with others, compared with a search of all chunks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_versions.tree.building import build
from marey_versions.tree.chunks import Branch, ChunksInMemory, Value, decode
from marey_versions.tree.editing import change
from marey_versions.tree.sharing import unshared_chunks

keys = st.integers(0, 400).map(lambda number: f"take-{number:03d}")
values = st.integers(0, 1).map(lambda number: {"number": number})
trees = st.dictionaries(keys, values, max_size=300)
changes = st.dictionaries(keys, st.none() | values, max_size=5)


class Counting(ChunksInMemory):
    """Store that counts the chunks that are read."""

    reads = 0

    def load(self, digests: Iterable[str]) -> Mapping[str, bytes]:
        """Return the bytes of chunks, and count them."""
        found = super().load(digests)
        self.reads += len(found)
        return found


def below(store: ChunksInMemory, roots: Iterable[str]) -> set[str]:
    """Return the digests of all chunks of trees."""
    found, waiting = set[str](), list(roots)
    while waiting:
        digest = waiting.pop()
        found.add(digest)
        if isinstance(chunk := decode(digest, store[digest]), Branch):
            waiting += [child.digest for child in chunk.children]
    return found


def versions(store: ChunksInMemory, first: dict[str, Value], steps: list[dict[str, Value | None]]) -> list[str]:
    """Store a tree and a later version for each step; return their roots."""
    roots = [build(store, sorted(first.items()))]
    for step in steps:
        roots.append(change(store, roots[-1], step))
    return roots


@settings(max_examples=examples(100), deadline=None)
@given(trees, st.lists(changes, max_size=3), st.lists(trees, max_size=2), st.lists(changes, max_size=3))
def test_unshared_chunks_are_those_that_only_these_trees_have(
    first: dict[str, Value],
    steps: list[dict[str, Value | None]],
    others: list[dict[str, Value]],
    other_steps: list[dict[str, Value | None]],
) -> None:
    store = ChunksInMemory()
    own = versions(store, first, steps)
    kept = [root for other in [first, *others] for root in versions(store, other, other_steps)[1:]]
    assert unshared_chunks(store, own, kept) == below(store, own) - below(store, kept)
    assert unshared_chunks(store, own, []) == below(store, own)
    assert unshared_chunks(store, own, own) == set()


def test_a_search_for_the_chunks_of_a_small_tree_reads_little_of_a_large_one() -> None:
    store = Counting()
    large = {f"take-{number:05d}": {"number": number} for number in range(30_000)}
    root = build(store, sorted(large.items()))
    small = dict(list(large.items())[15_000:15_100])
    own = build(store, sorted(small.items()))
    expected = below(store, [own]) - below(store, [root])
    assert len(expected) < len(below(store, [own]))  # they have chunks in common
    assert unshared_chunks(store, [own], [root]) == expected
    assert store.reads - len(below(store, [own])) <= 6 < len(store) / 200
