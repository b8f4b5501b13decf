"""Search for the first bad commit, compared with tests of all commits of random histories."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from math import ceil, log2

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_versions.bisection import BadCommitSearch

History = Mapping[str, Sequence[str]]


def history(parents: Sequence[Sequence[int]]) -> dict[str, list[str]]:
    """Return the parents of each commit; a digest is the number of the commit."""
    return {str(place): [str(one) for one in before] for place, before in enumerate(parents)}


def ancestors(commits: History, digest: str) -> set[str]:
    return {digest}.union(*(ancestors(commits, parent) for parent in commits.get(digest, ())))


def search(commits: History, bad: str, is_bad: Callable[[str], bool | None]) -> tuple[BadCommitSearch, list[str]]:
    """Run a search to its end, and return it with the commits that it tested."""
    found = BadCommitSearch(commits, bad)
    tested = []
    while (commit := found.next()) is not None:
        tested.append(commit)
        found.record(commit, is_bad(commit))
    return found, tested


def most_tests(commits: int) -> int:
    """Return how many tests are enough for n commits if a test leaves at most 2 n / 3 + 1/2 commits.

    Such a test always exists: start at the newest commit, and go to the parent with more ancestors until a commit has
    at most 2 n / 3 ancestors (itself included). The child of this commit has more than 2 n / 3 ancestors, so the
    commit itself has more than n / 3 - 1/2. A test of the commit leaves either its ancestors or all other commits.
    """
    return 0 if commits == 1 else 1 + most_tests((4 * commits + 3) // 6)


some_histories = st.integers(1, 14).flatmap(
    lambda count: st.tuples(
        *(
            st.lists(st.integers(max(0, place - 5), place - 1), min_size=1, max_size=2, unique=True)
            if place
            else st.just([])
            for place in range(count)
        )
    )
).map(history)  # fmt: skip


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(some_histories, st.data())
def test_the_commit_that_brought_the_fault_is_found_in_few_tests(commits: History, data: st.DataObject) -> None:
    newest = str(len(commits) - 1)
    reachable = ancestors(commits, newest)
    culprit = data.draw(st.sampled_from(sorted(reachable)))
    found, tested = search(commits, newest, lambda one: culprit in ancestors(commits, one))
    assert found.suspects == (culprit,)
    assert len(tested) == len(set(tested)) <= most_tests(len(reachable))


@settings(max_examples=examples(60, soak=200), deadline=None)
@given(some_histories, st.data())
def test_the_answer_is_bad_and_all_commits_before_it_are_good(commits: History, data: st.DataObject) -> None:
    newest = str(len(commits) - 1)
    culprits = data.draw(st.sets(st.sampled_from(sorted(commits)), max_size=4)) | {newest}
    bad = {one for one in commits if ancestors(commits, one) & culprits}
    (answer,) = search(commits, newest, bad.__contains__)[0].suspects
    assert answer in bad
    assert not bad & set(commits[answer])


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(some_histories, st.data())
def test_with_commits_that_cannot_be_tested_the_fault_is_among_the_suspects(
    commits: History, data: st.DataObject
) -> None:
    newest = str(len(commits) - 1)
    reachable = sorted(ancestors(commits, newest))
    culprit = data.draw(st.sampled_from(reachable))
    skipped = data.draw(st.sets(st.sampled_from(reachable)))
    found, tested = search(
        commits, newest, lambda one: None if one in skipped else culprit in ancestors(commits, one)
    )  # fmt: skip
    *others, last = found.suspects
    assert len(tested) == len(set(tested)) < len(reachable)
    assert set(found.suspects) == consistent_culprits(commits, newest, tested, skipped, culprit)
    assert set(others) <= skipped & set(tested)
    assert culprit in ancestors(commits, last)


def consistent_culprits(
    commits: History, newest: str, tested: Collection[str], skipped: Collection[str], culprit: str
) -> set[str]:
    """Return every commit that explains the results of all tests if it is the only fault."""

    def results(fault: str) -> list[bool]:
        return [fault in ancestors(commits, one) for one in tested if one not in skipped]

    return {one for one in ancestors(commits, newest) if results(one) == results(culprit)}


def test_the_oracle_of_suspects_refuses_a_search_that_forgets_the_ancestors_of_good_commits() -> None:
    commits = history([[], [0], [1], [2], [3]])

    class Forgetful(BadCommitSearch):
        def record(self, commit: str, bad: bool | None) -> None:
            if bad:
                super().record(commit, bad)
            else:
                self._left &= ~(1 << self._places[commit])

    found = Forgetful(commits, "4")
    tested = []
    while (commit := found.next()) is not None:
        tested.append(commit)
        found.record(commit, int(commit) >= 4)
    assert set(found.suspects) == consistent_culprits(commits, "4", tested, (), "4")
    assert len(tested) > most_tests(5)


@pytest.mark.parametrize("count", [1, 2, 3, 17, 100, 1000])
def test_without_merges_no_search_needs_more_tests_than_expected(count: int) -> None:
    commits = history([[], *([place] for place in range(count - 1))])
    expected = BadCommitSearch(commits, str(count - 1)).expected_tests
    assert expected == ceil(log2(count))
    for culprit in range(0, count, max(1, count // 40)):
        found, tested = search(commits, str(count - 1), list(map(str, range(culprit, count))).__contains__)
        assert found.suspects == (str(culprit),)
        assert len(tested) <= expected


def test_a_long_range_of_commits_that_cannot_be_tested_is_left_in_few_steps() -> None:
    commits = history([[], *([place] for place in range(999))])
    _, tested = search(commits, "999", lambda one: None if 400 <= int(one) < 600 else int(one) >= 700)
    assert len(tested) < 20


def test_commits_whose_parents_are_known_to_be_good_are_searched_without_them() -> None:
    found, tested = search({"b": ["a"], "c": ["b"], "side": ["older"], "d": ["c", "side"]}, "d", lambda one: one == "c")
    assert found.suspects == ("c",)
    assert "a" not in tested
    assert "older" not in tested


def test_a_history_of_thousands_of_commits_is_searched_in_little_time() -> None:
    found, tested = search(
        history([[], *([place] for place in range(9_999))]), "9999", lambda one: int(one) >= 1234
    )  # fmt: skip
    assert found.suspects == ("1234",)
    assert len(tested) <= 14
