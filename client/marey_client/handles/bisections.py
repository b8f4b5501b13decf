"""Search for the first bad version of a dataset between a good version and a bad one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from marey_client.errors import CannotBisect
from marey_schemas.datasets.commits import Commit
from marey_versions.bisection import BadCommitSearch

IsBad = Callable[[Commit], bool | None]
"""Function that tests a version: it returns whether the version is bad, or None if it cannot be tested."""


class VersionReader(Protocol):
    """Methods of `DatasetHandle` that the search for a version needs."""

    def at(self, version: str, /) -> Commit:
        """Return the commit that a version (a branch, a tag or a digest) names."""

    def log(self, version: str, /) -> Iterable[Commit]:
        """List a version and the versions before it, newest first; of a merge, only the first parent is followed."""


@dataclass(frozen=True)
class VersionRange:
    """Versions among which the search looks for the first bad one.

    Parameters
    ----------
    good, bad : the ends of the range
    commits : the versions that can be the first bad one, by digest: `bad` and its ancestors, without `good` and the
        ancestors of `good`
    parents : the parents of each of these versions, by digest; only the first parent if merged versions are left out
    """

    good: Commit
    bad: Commit
    commits: Mapping[str, Commit]
    parents: Mapping[str, tuple[str, ...]]

    @property
    def expected_tests(self) -> int:
        """The expected number of tests between the two ends: log2 of the number of versions, rounded up."""
        return self.search().expected_tests

    @property
    def first(self) -> Commit | None:
        """The version that is tested first after the two ends; None if no test between the ends is needed."""
        chosen = self.search().next()
        return None if chosen is None else self.commits[chosen]

    def search(self) -> BadCommitSearch:
        """Return a new search for the first bad version in this range."""
        return BadCommitSearch(self.parents, self.bad.digest)


@dataclass(frozen=True)
class VersionTest:
    """Tested version, and whether it is bad; None means that it could not be tested."""

    commit: Commit
    bad: bool | None


OnStep = Callable[[VersionTest, int], None]
"""Function called after each test with its result and the number of tests that are still expected."""


@dataclass(frozen=True)
class Bisection:
    """Result of a search for the first bad version.

    Parameters
    ----------
    range : the versions among which the first bad one was searched for
    suspects : the first bad version; or, if some versions could not be tested, all versions that can be the first bad
        one. The last of these suspects was tested and is bad; the other suspects were not tested
    tests : all tests in their order; the first two tests are the tests of `good` and `bad`
    """

    range: VersionRange
    suspects: tuple[Commit, ...]
    tests: tuple[VersionTest, ...]

    @property
    def first_bad(self) -> Commit | None:
        """The first bad version, or None if several versions can be the first bad one."""
        return self.suspects[0] if len(self.suspects) == 1 else None


def read_range(dataset: VersionReader, good: str, bad: str, *, first_parent: bool = False) -> VersionRange:
    """Read the versions after `good` that led to `bad`; with `first_parent`, leave out versions that were merged.

    Raises `CannotBisect` if `good` is not among the versions before `bad`.
    """
    first, last = dataset.at(good), dataset.at(bad)
    if first.digest == last.digest:
        raise CannotBisect(f"{good} and {bad} are the same version; name a good version that is older than the bad one")
    found: dict[str, Commit] = {}
    earlier: set[str] | None = None
    waiting, met = [last.digest], False
    while waiting:
        for one in dataset.log(waiting.pop()):
            met = met or one.digest == first.digest
            if one.digest in found or one.digest == first.digest or (earlier and one.digest in earlier):
                break
            found[one.digest] = one
            waiting += () if first_parent else one.parents[1:]
        if waiting and earlier is None:  # the versions before `good` matter only if there are merges
            earlier = set(_with_ancestors(dataset, first.digest))
    if not met:
        advice = "; without the restriction to first parents, it may be found" if first_parent else ""
        raise CannotBisect(f"the good version, {good}, is not among the versions before the bad one, {bad}{advice}")
    commits = {digest: _plain(one) for digest, one in found.items() if not earlier or digest not in earlier}
    parents = {digest: one.parents[:1] if first_parent else one.parents for digest, one in commits.items()}
    return VersionRange(first, last, commits, parents)


def bisect(among: VersionRange, is_bad: IsBad, on_step: OnStep | None = None) -> Bisection:
    """Test both ends of a range of versions, then versions between them until the first bad one is found.

    Raises `CannotBisect` if the good end is not good, or if the bad end is not bad.
    """
    search, tests = among.search(), []

    def test(commit: Commit) -> VersionTest:
        step = VersionTest(commit, is_bad(commit))
        tests.append(step)
        return step

    for end, bad in ((among.good, False), (among.bad, True)):
        step = test(end)
        _require(step, bad)
        if on_step is not None:
            on_step(step, search.expected_tests + (not bad))
    while (chosen := search.next()) is not None:
        step = test(among.commits[chosen])
        search.record(chosen, step.bad)
        if on_step is not None:
            on_step(step, search.expected_tests)
    return Bisection(among, tuple(among.commits[digest] for digest in search.suspects), tuple(tests))


def _plain(listed: Commit) -> Commit:
    """Return a commit from a list as a `Commit`, without the fields that only lists contain."""
    return Commit.model_validate(listed.model_dump(include=set(Commit.model_fields)))


def _require(step: VersionTest, bad: bool) -> None:
    if step.bad is bad:
        return
    named = f"the version {step.commit.digest}, which was given as the {'bad' if bad else 'good'} one,"
    found = "cannot be tested" if step.bad is None else "is good" if bad else "is bad"
    raise CannotBisect(f"{named} {found}")


def _with_ancestors(dataset: VersionReader, start: str) -> dict[str, Commit]:
    found: dict[str, Commit] = {}
    waiting = [start]
    while waiting:
        for one in dataset.log(waiting.pop()):
            if one.digest in found:
                break
            found[one.digest] = one
            waiting += one.parents[1:]
    return found
