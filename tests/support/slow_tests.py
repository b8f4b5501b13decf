"""List of measured slow test functions, which the tier `check` leaves out.

`make slow-tests` runs the tests of the tier `check`, the slow ones, too, and writes the list `slow_tests.txt`. A test
function is slow if all of its cases together take more than `LONGEST_S`. Each process of a test run measures its own
tests; the main process adds these times.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Generator, Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

LIST = Path(__file__).with_name("slow_tests.txt")
LONGEST_S = 0.4
"""Longest time in seconds of all cases of a function in the tier `check`, on a slow machine that does nothing else."""
CERTAINLY_SLOW_S = 3 * LONGEST_S
"""Seconds above which the tier `check` prints a function that the list lacks; large, because machines may be busy."""

_TAKEN = pytest.StashKey[dict[str, float]]()


@functools.cache
def slow_tests() -> frozenset[str]:
    """Return the names of the slow test functions, as `function_of` returns them."""
    return frozenset(LIST.read_text(encoding="utf-8").split())


def function_of(item: pytest.Item) -> str:
    """Return the file below `tests`, the class if there is one, and the function of a test, without its parameters."""
    file = item.path.relative_to(item.config.rootpath / "tests").as_posix()
    classes = [node.name for node in item.listchain() if isinstance(node, pytest.Class)]
    return "::".join([file, *classes, getattr(item, "originalname", item.name)])


def still_slow(listed: Iterable[str], taken: Mapping[str, float]) -> list[str]:
    """Return the slow functions in order: those with long measured times, and the listed functions that did not run."""
    return sorted({name for name, seconds in taken.items() if seconds > LONGEST_S} | (set(listed) - set(taken)))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--store-slow", action="store_true", help="Run slow tests in each tier, and store the list of slow tests."
    )


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_TAKEN] = {}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measure a test with its fixtures."""
    began = time.monotonic()
    result = yield
    _add(item.config.stash[_TAKEN], function_of(item), time.monotonic() - began)
    return result


def _add(taken: dict[str, float], name: str, seconds: float) -> None:
    taken[name] = taken.get(name, 0.0) + seconds


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the times from a worker process of pytest-xdist to the main process."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        output["taken"] = session.config.stash[_TAKEN]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    config: pytest.Config = node.config
    for name, seconds in getattr(node, "workeroutput", {}).get("taken", {}).items():
        _add(config.stash[_TAKEN], name, seconds)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Write the list if the option is set; in the tier `check`, print slow functions that the list lacks."""
    taken = config.stash[_TAKEN]
    if config.getoption("store_slow"):
        names = still_slow(slow_tests(), taken)
        LIST.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
        terminalreporter.write_line(f"{LIST.name}: {len(names)} of {len(taken)} test functions are slow")
    elif config.getoption("tier") == "check":
        for name, seconds in sorted(taken.items(), key=lambda entry: -entry[1]):
            if seconds > CERTAINLY_SLOW_S:
                terminalreporter.write_line(f"{seconds:6.1f} s, `make slow-tests` may say that it is slow: {name}")
