"""The cases that a tier runs of tests with many cases."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from tests.support.tiers import CASES, TIERS, cases_of

DATABASES = ("sqlite", "postgres")
LEFT_OUT = "other cases of tests with many"


def items(every: int | None, cases: int, file: str = "faults/test_deaths.py") -> list[Any]:
    """Return items like those of a test that runs each case on both databases, with the mark `every_nth` or without."""
    marks = {} if every is None else {"every_nth": pytest.mark.every_nth(every).mark}
    config = SimpleNamespace(rootpath=Path("project"), stash=pytest.Stash())
    made: list[Any] = [
        SimpleNamespace(
            config=config,
            path=Path("project", "tests") / file,
            nodeid=f"test_deaths.py::test_a_death[{database}-{case}]",
            name=f"test_a_death[{database}-{case}]",
            originalname="test_a_death",
            callspec=SimpleNamespace(params={"database_url": database, "case": case}),
            listchain=list,
            get_closest_marker=marks.get,
        )
        for database in DATABASES
        for case in range(cases)
    ]
    config.stash[CASES] = cases_of(cast(Any, made))
    return made


@pytest.mark.parametrize("tier", ["check", "test"])
def test_every_third_case_runs_on_each_database_and_the_first_always(tier: str) -> None:
    left_out = TIERS[tier].leaves_out[LEFT_OUT]
    kept = [item.callspec.params for item in items(3, 7) if not left_out(item)]
    assert kept == [{"database_url": name, "case": case} for name in DATABASES for case in (0, 3, 6)]
    assert [item.callspec.params["case"] for item in items(5, 2) if not left_out(item)] == [0, 0]


def test_of_fault_cases_every_third_runs_also_without_a_mark() -> None:
    left_out = TIERS["test"].leaves_out[LEFT_OUT]
    assert [item.callspec.params["case"] for item in items(None, 5) if not left_out(item)] == [0, 3, 0, 3]
    assert not any(map(left_out, items(None, 5, "integration/test_rest_jobs.py")))


def test_the_tier_soak_runs_all_cases() -> None:
    assert LEFT_OUT not in TIERS["soak"].leaves_out
