"""Search for the version at which a metric crossed a limit; a table of values replaces evaluations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import pytest
from tests.unit.client.test_bisections import ListedVersions

from marey_client.errors import CannotBisect
from marey_client.handles.bisections import read_range
from marey_client.handles.crossings import Crossing, Limit, Measurement, VersionEvaluations, find_crossing
from marey_schemas.datasets.commits import Commit
from marey_schemas.queue.job_params import EvaluateParams

NOTHING = cast(Any, None)


@dataclass
class TabledValues(VersionEvaluations):
    """Values of the metric by version; others cannot be evaluated. `read` contains the evaluated versions."""

    values: Mapping[str, float] = field(default_factory=dict)
    read: list[str] = field(default_factory=list)

    def _evaluated(self, commit: Commit) -> Measurement:
        self.read.append(commit.digest)
        value = self.values.get(commit.digest)
        return Measurement(commit, value, reason="it has no clips" if value is None else "")


def tabled(values: Mapping[str, float], dataset: Any = NOTHING) -> TabledValues:
    return TabledValues(NOTHING, dataset, "offset_mean_m", EvaluateParams(), values=values)


def searched(
    parents: Sequence[Sequence[int]], values: Mapping[str, float], limit: Limit | None = None, good: str = "0"
) -> tuple[Crossing, list[str]]:
    """Search in the versions from `good` to the last version; return the result and the evaluated versions."""
    versions = ListedVersions(parents)
    evaluations = tabled(values, versions)
    return find_crossing(read_range(versions, good, str(len(parents) - 1)), evaluations, limit), evaluations.read


LINE = [[], [0], [1], [2], [3], [4]]


def test_the_limit_half_way_has_the_direction_of_the_change() -> None:
    falling = {"0": 5.0, "1": 5.0, "2": 4.5, "3": 2.0, "4": 1.0, "5": 1.0}
    found, _ = searched(LINE, falling)
    assert (found.limit, found.first_bad and found.first_bad.digest) == (Limit(3.0, above=False), "3")
    rising = {version: -value for version, value in falling.items()}
    found, _ = searched(LINE, rising)
    assert (found.limit, found.first_bad and found.first_bad.digest) == (Limit(-3.0, above=True), "3")


def test_a_value_at_the_limit_is_good() -> None:
    found, _ = searched(LINE, {"0": 0.0, "1": 1.0, "2": 1.0, "3": 1.0, "4": 1.0, "5": 2.0}, Limit(1.0))
    assert found.first_bad is not None
    assert found.first_bad.digest == "5"


def test_no_version_is_evaluated_twice() -> None:
    found, read = searched(LINE, {str(one): float(one) for one in range(6)})
    assert len(read) == len(set(read)) == len(found.measurements) <= 5
    assert found.value(found.search.range.good) == 0.0
    assert [one.parent.commit.digest for one in found.changes] == ["2"]


def test_versions_with_the_same_entries_are_evaluated_once() -> None:
    evaluations = tabled({"1": 0.5})
    first = ListedVersions(LINE).at("1")
    assert evaluations.measure(first).reused is False
    again = evaluations.measure(first.model_copy(update={"digest": "other"}))
    assert (again.value, again.reused, again.commit.digest) == (0.5, True, "other")
    assert evaluations.read == ["1"]


def test_a_parent_that_was_taken_as_good_is_evaluated_and_may_turn_out_bad() -> None:
    merged = [[], [0], [1], [1], [3, 2], [4]]
    found, read = searched(merged, {"0": 0.0, "1": 9.0, "2": 0.0, "3": 0.0, "4": 9.0, "5": 9.0}, Limit(1.0))
    assert found.first_bad is not None
    assert set(merged[int(found.first_bad.digest)]) <= set(map(int, read))
    values = {one.parent.commit.digest: one.parent.value for one in found.changes}
    assert set(values) == set(found.first_bad.parents)


def test_versions_that_cannot_be_evaluated_are_suspects() -> None:
    found, _ = searched(LINE, {"0": 0.0, "1": 0.0, "4": 2.0, "5": 2.0})
    assert found.first_bad is None
    assert [one.digest for one in found.search.suspects] == ["2", "3", "4"]
    assert found.changes == ()
    assert {one.commit.digest: one.reason for one in found.measurements}["2"] == "it has no clips"


@pytest.mark.parametrize(
    ("values", "limit", "reason"),
    [
        ((1.0, 1.0), None, "offset_mean_m is 1 at the good version and 1 at the bad one, so no value is half-way"),
        ((2.0, 3.0), Limit(1.0), "values above 1 are bad, so both versions are bad"),
        ((0.5, 0.7), Limit(1.0), "values above 1 are bad, so both versions are good"),
        ((7.0, 3.0), Limit(5.0), "so the good version is bad and the bad one is good; exchange the versions"),
        ((0.5, 0.7), Limit(0.6, above=False), "values below 0.6 are bad, so the good version is bad and the bad"),
    ],
)
def test_ends_that_do_not_enclose_the_limit_are_refused(
    values: tuple[float, float], limit: Limit | None, reason: str
) -> None:
    with pytest.raises(CannotBisect, match=reason):
        searched(LINE, {"0": values[0], "5": values[1]}, limit)


def test_an_end_that_cannot_be_evaluated_is_refused_with_the_reason() -> None:
    with pytest.raises(CannotBisect, match="the bad version, 5, cannot be evaluated: it has no clips"):
        searched(LINE, {"0": 0.0})


def test_an_unknown_metric_is_refused_with_the_names_of_all() -> None:
    with pytest.raises(CannotBisect, match=r"no metric 'offset'; their metrics are clips, .*offset_mean_m, .*symmetry"):
        TabledValues(NOTHING, NOTHING, "offset", EvaluateParams())
