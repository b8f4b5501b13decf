"""Origins of parts of entries, compared with a recursive definition, and examples of moved entries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_versions import origins
from marey_versions.origins import PATH, TAGS, FoundOrigin, find_origins
from marey_versions.records import key_of
from marey_versions.tree.building import build
from marey_versions.tree.chunks import ChunksInMemory, Value
from marey_versions.tree.reading import ChunkReader

A, B = key_of("a", "clip"), key_of("b", "clip")


class Made(NamedTuple):
    tree: str
    parents: Sequence[str]
    generation: int


class History:
    """Commits whose digests are their numbers."""

    def __init__(self) -> None:
        self.store = ChunksInMemory()
        self.commits: dict[str, Made] = {}
        self.states: dict[str, dict[str, Value]] = {}

    def add(self, state: dict[str, Value], *parents: str) -> str:
        name = str(len(self.commits))
        generation = max((self.commits[one].generation + 1 for one in parents), default=0)
        self.commits[name] = Made(build(self.store, sorted(state.items())), parents, generation)
        self.states[name] = state
        return name

    def origins(self, commit: str, key: str = A, most: int = 100) -> dict[str, FoundOrigin]:
        return find_origins(ChunkReader(self.store), self.commits.__getitem__, commit, key, most=most)


def entry(motion: str, info: str, *tags: str) -> Value:
    return {"parts": {"motion": motion, "info": info}, "tags": sorted(tags)}


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(st.tuples(st.sampled_from("12"), st.sampled_from("12"), st.booleans(), st.data()), max_size=8))
def test_a_part_comes_from_the_first_commit_whose_parents_have_another_one(
    steps: list[tuple[str, str, bool, st.DataObject]],
) -> None:
    history = History()
    # The entry "z" is never changed, and no part of "a" ever equals one of it, so that nothing counts as moved.
    rest = {key_of("z", "clip"): entry("z", "z")}
    last = history.add({A: entry("0", "0"), **rest})
    for motion, info, merges, data in steps:
        others = [data.draw(st.sampled_from(sorted(history.commits)))] if merges else []
        last = history.add({A: entry(motion, info), **rest}, last, *others)

    def expected(commit: str, part: str) -> str:
        value = history.states[commit][A]["parts"][part]
        for parent in history.commits[commit].parents:
            if history.states[parent][A]["parts"][part] == value:
                return expected(parent, part)
        return commit

    found = history.origins(last)
    assert {part: found[part].commit for part in ("motion", "info")} == {
        part: expected(last, part) for part in ("motion", "info")
    }
    assert found[PATH] == FoundOrigin("0", A, certain=True)


def test_a_moved_entry_is_followed_to_its_earlier_path() -> None:
    history = History()
    first = history.add({A: entry("1", "1")})
    second = history.add({A: entry("2", "1")}, first)
    third = history.add({B: entry("2", "1")}, second)
    last = history.add({B: entry("2", "1", "slow")}, third)
    assert history.origins(last, B) == {
        "motion": FoundOrigin(second, A, certain=True),
        "info": FoundOrigin(first, A, certain=True),
        PATH: FoundOrigin(third, B, certain=True),
        TAGS: FoundOrigin(last, B, certain=True),
    }


def test_entries_that_exchanged_their_names_are_followed() -> None:
    history = History()
    first = history.add({A: entry("1", "1"), B: entry("2", "2")})
    swapped = history.add({A: entry("2", "2"), B: entry("1", "1")}, first)
    found = history.origins(swapped)
    assert (found["motion"], found[PATH]) == (
        FoundOrigin(first, B, certain=True),
        FoundOrigin(swapped, A, certain=True),
    )


def test_a_merge_is_the_origin_of_what_differs_from_both_sides() -> None:
    history = History()
    base = history.add({A: entry("1", "1")})
    ours = history.add({A: entry("2", "1")}, base)
    theirs = history.add({A: entry("1", "2")}, base)
    merge = history.add({A: entry("2", "2", "checked")}, ours, theirs)
    found = history.origins(merge)
    assert {name: one.commit for name, one in found.items()} == {
        "motion": ours, "info": theirs, TAGS: merge, PATH: base,
    }  # fmt: skip


def test_a_search_that_has_compared_too_many_entries_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each commit moves the entry.

    So the search compares each commit with its parent, and reads two changed entries.
    """
    history = History()
    keys = [key_of(f"a{place}", "clip") for place in range(6)]
    last = history.add({keys[0]: entry("1", "1")})
    for key in keys[1:]:
        last = history.add({key: entry("1", "1")}, last)
    monkeypatch.setattr(origins, "MOST_CHANGES", 10)
    assert history.origins(last, keys[-1])["motion"] == FoundOrigin("0", keys[0], certain=True)
    monkeypatch.setattr(origins, "MOST_CHANGES", 3)
    assert history.origins(last, keys[-1])["motion"] == FoundOrigin("3", keys[3], certain=False)


def test_a_search_that_ends_early_is_not_certain() -> None:
    history = History()
    last = history.add({A: entry("1", "1")})
    for motion in "234":
        last = history.add({A: entry(motion, "1")}, last)
    found = history.origins(last, most=2)
    assert found["motion"] == FoundOrigin("3", A, certain=True)
    assert found["info"] == FoundOrigin("1", A, certain=False)
