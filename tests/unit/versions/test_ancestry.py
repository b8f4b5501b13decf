"""Nearest common commits, compared with the set of all common ancestors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_versions.ancestry import nearest_common


class Listed(NamedTuple):
    parents: Sequence[str]
    generation: int
    tree: str = ""


def history(parents: Sequence[Sequence[int]]) -> dict[str, Listed]:
    """Return commits by digest; a digest is the number of the commit, and parents have lower numbers."""
    found: dict[str, Listed] = {}
    for place, before in enumerate(parents):
        names = [str(one) for one in before]
        found[str(place)] = Listed(names, max((found[one].generation + 1 for one in names), default=0))
    return found


def ancestors(commits: dict[str, Listed], digest: str) -> set[str]:
    return {digest}.union(*(ancestors(commits, parent) for parent in commits[digest].parents))


some_histories = st.integers(1, 12).flatmap(
    lambda count: st.tuples(
        *(
            st.lists(st.integers(0, place - 1), max_size=2, unique=True) if place else st.just([])
            for place in range(count)
        )
    )
)


@settings(max_examples=examples(200), deadline=None)
@given(some_histories, st.data())
def test_no_common_ancestor_follows_a_nearest_one(parents: Sequence[Sequence[int]], data: st.DataObject) -> None:
    commits = history(parents)
    ours, theirs = (data.draw(st.sampled_from(sorted(commits))) for _ in range(2))
    shared = ancestors(commits, ours) & ancestors(commits, theirs)
    expected = {one for one in shared if not any(one in ancestors(commits, other) for other in shared - {one})}
    assert nearest_common(commits.__getitem__, ours, theirs) == sorted(expected)


def test_the_history_before_a_common_commit_is_not_read() -> None:
    commits = history([[], *([place] for place in range(1_000)), [1_000], [1_000]])
    read: list[str] = []

    def commit_of(digest: str) -> Listed:
        read.append(digest)
        return commits[digest]

    assert nearest_common(commit_of, "1001", "1002") == ["1000"]
    assert len(read) < 12
