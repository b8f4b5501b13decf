"""The check that pytest-xdist runs the tests of a group in one process."""

from types import SimpleNamespace
from typing import Any

import pytest
from tests.support.tiers import pytest_collection_finish


def session(*node_ids: str, grouped: bool) -> Any:
    config = SimpleNamespace(getoption=lambda _name, _default: grouped)
    return SimpleNamespace(config=config, items=[SimpleNamespace(nodeid=one) for one in node_ids])


def test_a_run_in_groups_stops_if_a_test_has_no_group() -> None:
    pytest_collection_finish(session("a.py::one@a.py", "a.py::two@a.py", grouped=True))
    with pytest.raises(pytest.UsageError, match="groups of tests"):
        pytest_collection_finish(session("a.py::one@a.py", "a.py::two", grouped=True))


def test_a_run_in_one_process_has_no_groups() -> None:
    pytest_collection_finish(session("a.py::one", grouped=False))
