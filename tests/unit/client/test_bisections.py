"""Search for the first bad version in the range between a good and a bad version, without a server."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_client.errors import CannotBisect
from marey_client.handles.bisections import bisect, read_range
from marey_client.handles.crossings import change_interval
from marey_schemas.datasets.commits import Commit


class ListedVersions:
    """Versions whose names are numbers; parents have lower numbers. `read` contains the versions that were listed."""

    def __init__(self, parents: Sequence[Sequence[int]]) -> None:
        self.parents = parents
        self.read: list[str] = []

    def at(self, version: str) -> Commit:
        parents = tuple(map(str, self.parents[int(version)]))
        now = datetime(2026, 1, 1, tzinfo=UTC)
        return Commit(digest=version, tree=version, parents=parents, author="ada", message="", at=now, entries=1)

    def log(self, version: str) -> Iterator[Commit]:
        following: str | None = version
        while following is not None:
            self.read.append(following)
            one = self.at(following)
            yield one
            following = next(iter(one.parents), None)

    def ancestors(self, version: str, *, first_parent: bool = False) -> set[str]:
        parents = self.at(version).parents[: 1 if first_parent else 2]
        return {version}.union(*(self.ancestors(one, first_parent=first_parent) for one in parents))


some_histories = st.integers(2, 12).flatmap(
    lambda count: st.tuples(
        *(
            st.lists(st.integers(0, place - 1), max_size=2, unique=True) if place else st.just([])
            for place in range(count)
        )
    )
)


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(some_histories, st.booleans(), st.data())
def test_the_range_has_every_version_that_can_be_the_first_bad_one(
    parents: Sequence[Sequence[int]], first_parent: bool, data: st.DataObject
) -> None:
    versions = ListedVersions(parents)
    bad = str(len(parents) - 1)
    good = data.draw(st.sampled_from([str(one) for one in range(len(parents) - 1)]))
    earlier = versions.ancestors(bad, first_parent=first_parent)
    if good not in earlier:
        with pytest.raises(CannotBisect, match="is not among the versions before"):
            read_range(versions, good, bad, first_parent=first_parent)
        return
    found = read_range(versions, good, bad, first_parent=first_parent)
    assert set(found.commits) == earlier - versions.ancestors(good, first_parent=first_parent)
    assert (found.good.digest, found.bad.digest) == (good, bad)


def test_the_history_before_the_good_version_is_not_read_if_there_are_no_merges() -> None:
    versions = ListedVersions([[], *([place] for place in range(200))])
    found = read_range(versions, "190", "200")
    assert len(found.commits) == 10
    assert len(versions.read) == 11


def test_the_tests_are_recorded_in_their_order_with_what_is_left() -> None:
    versions = ListedVersions([[], *([place] for place in range(16))])
    left: list[int] = []
    among = read_range(versions, "0", "16")
    found = bisect(among, lambda one: int(one.digest) >= 5, lambda _, more: left.append(more))
    assert found.first_bad is not None
    assert found.first_bad.digest == "5"
    assert [(one.commit.digest, one.bad) for one in found.tests[:2]] == [("0", False), ("16", True)]
    assert left == [5, 4, 3, 2, 1, 0]
    assert among.expected_tests == 4
    assert among.first == found.tests[2].commit


def test_versions_that_cannot_be_tested_leave_a_range() -> None:
    versions = ListedVersions([[], *([place] for place in range(9))])
    found = bisect(read_range(versions, "0", "9"), lambda one: None if one.digest in "456" else int(one.digest) > 4)
    assert found.first_bad is None
    assert [one.digest for one in found.suspects] == ["4", "5", "6", "7"]


@pytest.mark.parametrize(
    ("bad_from", "reason"), [(0, "given as the good one, is bad"), (99, "given as the bad one, is good")]
)
def test_ends_that_are_not_what_they_are_given_as_are_refused(bad_from: int, reason: str) -> None:
    versions = ListedVersions([[], [0], [1]])
    with pytest.raises(CannotBisect, match=reason):
        bisect(read_range(versions, "0", "2"), lambda one: int(one.digest) >= bad_from)


def test_an_end_that_cannot_be_tested_is_refused() -> None:
    with pytest.raises(CannotBisect, match="given as the good one, cannot be tested"):
        bisect(read_range(ListedVersions([[], [0], [1]]), "0", "2"), lambda _: None)


def test_one_version_is_no_range() -> None:
    with pytest.raises(CannotBisect, match="are the same version"):
        read_range(ListedVersions([[], [0]]), "1", "1")


def replicated(values: Sequence[float | None]) -> dict[str, object]:
    return {"replicates": {"suite": {"offset_mean": list(values)}}}


def test_the_interval_of_a_change_pairs_the_replicates() -> None:
    random = np.random.default_rng(3)
    before = random.normal(1.0, 1.0, 8)
    after = before + random.normal(0.05, 0.01, 8)
    found = change_interval(replicated(before.tolist()), replicated(after.tolist()), "offset_mean")
    half_width = 2.364624 * (after - before).std(ddof=1) / np.sqrt(8)
    assert found == pytest.approx(((after - before).mean() - half_width, (after - before).mean() + half_width))


def test_evaluations_with_too_few_replicates_have_no_interval() -> None:
    assert change_interval(replicated([1.0, None, 2.0]), replicated([1.5, 9.0, 2.5]), "offset_mean") is None
    assert change_interval({}, replicated([1.5, 9.0, 2.5]), "offset_mean") is None
