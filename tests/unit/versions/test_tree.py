"""Trees of entries, compared with dictionaries: shape, changes, reading and differences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_versions.tree import difference as differences
from marey_versions.tree.building import LONGEST, MEAN_ENTRIES, Splitter, build
from marey_versions.tree.chunks import Branch, ChunksInMemory, ChunkStore, DamagedChunk, Leaf, Value, decode
from marey_versions.tree.difference import difference
from marey_versions.tree.editing import change
from marey_versions.tree.reading import Tree

Entries = dict[str, Value]

keys = st.text(st.sampled_from("ab/é\U0001f600"), min_size=1, max_size=6)
values = st.integers(0, 3).map(lambda number: {"number": number})
some_entries = st.dictionaries(keys, values, max_size=200)
some_changes = st.dictionaries(keys, st.none() | values, max_size=60)


def numbered(count: int, step: int = 1) -> Entries:
    """Return entries with the keys `take-00000`, `take-00001` and so on."""
    return {f"take-{number:05d}": {"number": number} for number in range(0, count, step)}


def stored(entries: Mapping[str, Value]) -> tuple[ChunksInMemory, str]:
    """Return a store that contains a tree of these entries, and the root of the tree."""
    store = ChunksInMemory()
    return store, build(store, sorted(entries.items()))


def changed(entries: Entries, changes: Mapping[str, Value | None]) -> Entries:
    """Return the entries after changes; None removes an entry."""
    return {key: value for key, value in {**entries, **changes}.items() if value is not None}


@settings(max_examples=examples(60), deadline=None)
@given(some_entries, st.lists(some_changes, max_size=4))
def test_a_tree_has_the_same_root_whatever_the_order_of_the_changes(
    entries: Entries, steps: list[dict[str, Value | None]]
) -> None:
    store, root = stored(entries)
    for changes in steps:
        root = change(store, root, changes)
        entries = changed(entries, changes)
        assert root == build(ChunksInMemory(), sorted(entries.items()))
        assert dict(Tree(store, root).entries()) == entries


@settings(max_examples=examples(60), deadline=None)
@given(some_entries, some_changes, st.integers(1, 5))
def test_a_difference_lists_the_keys_whose_values_differ(
    entries: Entries, changes: dict[str, Value | None], together: int
) -> None:
    store, root = stored(entries)
    after = changed(entries, changes)
    expected = [
        (key, entries.get(key), after.get(key))
        for key in sorted(entries.keys() | after.keys())
        if entries.get(key) != after.get(key)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(differences, "COMPARED_TOGETHER", together)
        other = change(store, root, changes)
        assert [tuple(one) for one in difference(store, root, other)] == expected
        for prefix in ("a", "ab", "b/", "\U0001f600"):
            inside = [one for one in expected if one[0].startswith(prefix)]
            assert [tuple(one) for one in difference(store, root, other, prefix=prefix)] == inside


@settings(max_examples=examples(60), deadline=None)
@given(some_entries, keys, keys)
def test_entries_are_found_by_key_and_prefix_and_counted(entries: Entries, prefix: str, after: str) -> None:
    tree = Tree(*stored(entries))
    inside = {key: value for key, value in entries.items() if key.startswith(prefix)}
    assert dict(tree.entries(prefix=prefix)) == inside
    assert [key for key, _ in tree.entries(after=after)] == sorted(key for key in entries if key > after)
    assert (len(tree), tree.count(prefix)) == (len(entries), len(inside))
    assert tree.get_several([prefix, after]) == {key: entries[key] for key in (prefix, after) if key in entries}


def test_trees_of_several_levels_are_changed_and_compared() -> None:
    entries = numbered(5_000)
    store, root = stored(entries)
    assert isinstance(decode(root, store[root]), Branch)
    changes: dict[str, Value | None] = dict.fromkeys(numbered(5000, 7)) | {"take-02500-b": {"number": -1}}
    other = change(store, root, changes)
    assert other == stored(changed(entries, changes))[1]
    assert [one.key for one in difference(store, root, other)] == sorted(changes)
    assert change(store, other, {key: entries.get(key) for key in changes}) == root


def test_a_tree_without_its_entries_is_the_empty_tree() -> None:
    store, root = stored(numbered(2_000))
    empty = change(store, root, dict.fromkeys(numbered(2_000)))
    assert empty == build(ChunksInMemory(), [])
    assert (len(Tree(store, empty)), list(Tree(store, empty).entries())) == (0, [])


class Counting(ChunksInMemory):
    """Store of chunks that counts requests for chunks, loaded chunks, and stored bytes."""

    loaded = requests = 0
    stored_bytes = 0

    def load(self, digests: Iterable[str]) -> Mapping[str, bytes]:
        found = super().load(digests)
        self.loaded += len(found)
        self.requests += 1
        return found

    def save(self, chunks: Mapping[str, bytes]) -> None:
        self.stored_bytes += sum(map(len, chunks.values()))
        super().save(chunks)


def test_a_difference_loads_the_chunks_of_each_level_of_both_trees_at_once() -> None:
    entries = numbered(5_000)
    store = Counting(stored(entries)[0])
    root = build(ChunksInMemory(), sorted(entries.items()))
    other = change(store, root, {f"take-{number:05d}": {"number": -1} for number in range(0, 5_000, 500)})
    store.requests = 0
    assert len(list(difference(store, root, other))) == 10
    assert store.requests == decode(root, store[root]).level + 1


def test_one_change_reads_and_writes_few_chunks() -> None:
    store = Counting(stored(numbered(30_000))[0])
    root = build(ChunksInMemory(), sorted(numbered(30_000).items()))
    other = change(store, root, {"take-12345": {"number": -1}})
    assert store.loaded < 12
    assert store.stored_bytes < 64_000
    store.loaded = 0
    assert len(list(difference(store, root, other))) == 1
    assert store.loaded < 12
    store.loaded = 0
    assert not list(difference(store, root, other, prefix="take-2"))
    assert store.loaded < 6


def test_no_key_makes_a_chunk_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Splitter, "_is_end", lambda _self, _key: False)
    store, root = stored(numbered(1_000))
    tree = Tree(store, root)
    assert len(tree) == 1_000
    leaves = [chunk for chunk in (decode(*one) for one in store.items()) if isinstance(chunk, Leaf)]
    assert max(leaf.count for leaf in leaves) == LONGEST * MEAN_ENTRIES


def test_a_tree_stays_low_although_every_key_ends_a_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Splitter, "_is_end", lambda _self, _key: True)
    store, root = stored(numbered(1_000))
    assert decode(root, store[root]).level == 9


def test_keys_that_do_not_increase_are_refused() -> None:
    with pytest.raises(ValueError, match="'a' must be greater than the previous key, 'b'"):
        build(ChunksInMemory(), [("b", {}), ("a", {})])


def test_a_missing_chunk_and_a_changed_one_are_named() -> None:
    store, root = stored(numbered(200))
    victim = next(digest for digest in store if digest != root)
    whole = store.pop(victim)
    with pytest.raises(DamagedChunk, match=f"{victim} is missing"):
        list(Tree(store, root).entries())
    store[victim] = whole.replace(b"take-", b"fake-")
    with pytest.raises(DamagedChunk, match=f"{victim} have another digest"):
        list(Tree(store, root).entries())


def test_the_digest_of_a_known_tree_never_changes() -> None:
    store: ChunkStore = ChunksInMemory()
    assert (
        build(store, sorted(numbered(100).items()))
        == "sha256:6a93f0b95edd36631c15aa44fb71177ae9a4f8f4ea5b4cbcb963a586a6ba0a26"
    )
