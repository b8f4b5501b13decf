"""Tiers of tests: the tests that `--tier` runs, the number of examples of property tests, and groups of tests.

Run the tier `check` while you work, `test` before you merge a change, and `soak` before you call an issue resolved. At
the end of a run, the tests that the tier left out are counted by reason.
"""

from __future__ import annotations

import functools
import gc
import os
import shutil
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from hatch_build import SOURCES as PAGE_SOURCES
from hatch_build import pages_are_current
from tests.support.database_fixtures import BACKENDS
from tests.support.present import present
from tests.support.slow_tests import function_of, slow_tests

MOCAP_VARIABLE = "MAREY_TEST_MOCAP"
"""Environment variable with the path of the folder of real motion capture."""
CLUSTER_VARIABLE = "MAREY_TEST_KUBECONFIG"
"""Environment variable with the kubeconfig of a real cluster, which has a namespace `marey`."""
CLUSTER_IMAGE_VARIABLE = "MAREY_TEST_CLUSTER_IMAGE"
"""Environment variable with the image of the worker that the real cluster pulls, named by its digest."""
CHROMIUM_VARIABLE = "MAREY_TEST_CHROMIUM"
"""Environment variable with the path of Chromium; without it, the program `chromium` is looked for."""
NODE_PACKAGES = PAGE_SOURCES / "node_modules"
SLURM_DAEMONS = ("munged", "slurmctld", "slurmd")
SLURM_PROGRAMS = (*SLURM_DAEMONS, "sbatch")
PROGRAMS = ("kubectl", "zsh", "fish", "curl")
"""Programs that some tests need, which are marked with the name of the program."""
SYSTEM_PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
"""Folders in which daemons are looked for, also by users whose `PATH` does not contain them."""
EXAMPLES, STEPS = 100, 50
"""Number of examples that Hypothesis draws, and of steps that a state machine takes, for an effort of 1."""
SOAK_EFFORT = 4
"""Effort of the tier `soak`, unless `--effort` gives another one."""
EVERY_NTH_FAULT = 3
"""Of the cases of a test in `tests/faults`, all tiers but `soak` run every third, unless the test has `every_nth`."""
LONGEST_STEPS = 2
"""Greatest factor by which a tier increases `STEPS`; running more state machines finds more than longer runs."""


@dataclass(frozen=True)
class Tier:
    """A tier of tests: how many examples its generated tests draw, and which tests it leaves out, by reason."""

    effort: float
    """Factor by which generated tests draw more examples than the number that they name."""
    leaves_out: dict[str, Callable[[pytest.Item], bool]]


def _folder(item: pytest.Item) -> str:
    return _below_tests(item.path, item.config.rootpath)


@functools.cache
def _below_tests(path: Path, root: Path) -> str:
    return path.relative_to(root / "tests").as_posix()


def backend_of(item: pytest.Item) -> str | None:
    """Return the database that a test runs on, or None."""
    callspec = getattr(item, "callspec", None)
    values = callspec.params.values() if callspec else ()
    return next((value for value in values if isinstance(value, str) and value in BACKENDS), None)


def _without_backend(item: pytest.Item) -> str:
    """Return the name of a test, which is the same for each database."""
    return item.nodeid.replace(backend_of(item) or "", "")


def _on_postgres(item: pytest.Item) -> bool:
    return backend_of(item) == "postgres"


def _fault(item: pytest.Item) -> bool:
    return _folder(item).startswith("faults/")


def _whole_way(item: pytest.Item) -> bool:
    there = _folder(item).startswith(("acceptance/test_real_motion", "integration/ways/", "integration/test_demo"))
    return there and not item.get_closest_marker("check")


def _needs_mocap(item: pytest.Item) -> bool:
    return "mocap" in getattr(item, "fixturenames", ())


def _slow(item: pytest.Item) -> bool:
    return function_of(item) in slow_tests() and not item.config.getoption("store_slow")


def _soak_only(item: pytest.Item) -> bool:
    return item.get_closest_marker("soak") is not None


def _needs_slurm(item: pytest.Item) -> bool:
    return item.get_closest_marker("slurm") is not None


def _needs_node(item: pytest.Item) -> bool:
    return item.get_closest_marker("node") is not None


def _needs_chromium(item: pytest.Item) -> bool:
    return item.get_closest_marker("chromium") is not None


def _missing_for_pages() -> str | None:
    """Return why the tests of the browser pages cannot run, or None."""
    if shutil.which("node") is None:
        return "Node is not installed"
    return None if (NODE_PACKAGES / ".package-lock.json").is_file() else "no node_modules"


def _missing_for_chromium() -> str | None:
    """Return why the tests in a browser cannot run, or None."""
    if chromium() is None:
        return "Chromium is not installed (tests/support/install_chromium.sh)"
    return _missing_for_pages() or (None if pages_are_current() else "the pages are not built")


def chromium() -> str | None:
    """Return the path of Chromium: the value of the environment variable, or the program of this name."""
    return os.environ.get(CHROMIUM_VARIABLE) or shutil.which("chromium")


def _needs_program(item: pytest.Item, name: str) -> bool:
    return item.get_closest_marker(name) is not None


def _needs_cluster(item: pytest.Item) -> bool:
    return item.get_closest_marker("cluster") is not None


def _on_one_database(item: pytest.Item) -> bool:
    """Return whether a test is a fault case, a REST test or a test of the server's parts."""
    return _folder(item).startswith(("faults/", "integration/", "unit/server/"))


def _on_other_database(item: pytest.Item) -> bool:
    """Return whether the tier `test` runs this test only on the other database.

    This concerns fault cases, REST tests, workflows and tests of the server's parts. A hash of the name of the test, or
    of the workflow's module, chooses the database, so about half of these tests run on each. Tests with the mark
    `every_database` run on both: those of SQL that differs between databases, of claims, completions and publications,
    and of parts that the hash would test on one database only. Tests that exist for only one database always run.
    """
    backend = backend_of(item)
    if backend is None or item.get_closest_marker("every_database") or not _on_one_database(item):
        return False
    if item.config.stash[ON_DATABASES][_without_backend(item)] < len(BACKENDS):
        return False
    name = _folder(item) if _whole_way(item) else _without_backend(item)
    return BACKENDS[zlib.crc32(name.encode()) % len(BACKENDS)] != backend


def _other_case(item: pytest.Item) -> bool:
    """Return whether only the tier `soak` runs this case of a test with several cases."""
    every = _every_nth(item)
    return every > 1 and item.config.stash[CASES][function_of(item)].index(_without_backend(item)) % every > 0


def _every_nth(item: pytest.Item) -> int:
    """Return n if all tiers but `soak` run every n-th case of a test, by its mark `every_nth` or as a fault case."""
    marker = item.get_closest_marker("every_nth")
    return marker.args[0] if marker else EVERY_NTH_FAULT if _fault(item) else 1


TIERS = {
    "check": Tier(
        0.2,
        {
            "on Postgres": _on_postgres,
            "fault cases": _fault,
            "whole ways": _whole_way,
            "slow": _slow,
            "other cases of tests with many": _other_case,
            "for the tier soak": _soak_only,
        },
    ),
    "test": Tier(
        0.5,
        {
            "other cases of tests with many": _other_case,
            "for the tier soak": _soak_only,
            "on the other database": _on_other_database,
        },
    ),
    "soak": Tier(SOAK_EFFORT, {}),
}


LEFT_OUT = pytest.StashKey[Counter[str]]()
"""Key of the number of tests that the tier left out, by reason."""
ON_DATABASES = pytest.StashKey[Counter[str]]()
"""Key of the number of databases on which a test can run, by its name without the database."""
CASES = pytest.StashKey[dict[str, list[str]]]()
"""Key of the names of the cases of each test of which some tiers run a part, without the database, in their order."""


def examples(count: int, soak: int | None = None) -> int:
    """Return how many examples a property test draws in the running tier; `count` is the number for an effort of 1.

    The tier `soak` multiplies `soak` instead if it is given. A test that is too slow to draw enough examples in the
    tier `test` passes `soak`.
    """
    base = soak if soak is not None and is_soak() else count
    return max(1, base * present(hypothesis.settings.default).max_examples // EXAMPLES)


def steps(count: int) -> int:
    """Return how many steps a state machine takes in the running tier; `count` is the number for an effort of 1."""
    return count * present(hypothesis.settings.default).stateful_step_count // STEPS


def is_soak() -> bool:
    """Return whether this is the tier `soak`, in which tests run their long forms."""
    return present(hypothesis.settings.default).max_examples > EXAMPLES


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--tier", choices=list(TIERS), default="test", help="Tier of tests to run (default: test).")
    parser.addoption(
        "--effort",
        type=int,
        choices=range(2, 1001),
        metavar="TIMES",
        help=f"Factor by which the tier soak draws more examples than tests name (default: {SOAK_EFFORT}).",
    )
    parser.addoption(
        "--fuzz-minutes",
        type=float,
        default=1.0,
        metavar="MINUTES",
        help="In the tier soak, minutes of generated requests for each kind of caller and database (default: 1).",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.stash[LEFT_OUT] = Counter()
    config.option.loadscopereorder = False  # pytest-xdist keeps the order of `_in_order`
    name = config.getoption("tier")
    tier = TIERS[name]
    effort = tier.effort
    if given := config.getoption("effort"):
        if name != "soak":
            raise pytest.UsageError("--effort needs --tier soak")
        effort = given
    # No deadline: how fast things are is for benchmarks to say, and machines do other things at the same time.
    hypothesis.settings.register_profile(
        name,
        deadline=None,
        max_examples=round(effort * EXAMPLES),
        stateful_step_count=round(min(max(effort, 1), LONGEST_STEPS) * STEPS),
    )
    hypothesis.settings.load_profile(name)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect and count the tests to which a reason applies, and mark each other test with its group.

    This hook must run before that of pytest-xdist, which reads the groups.
    """
    reasons = TIERS[config.getoption("tier")].leaves_out
    if MOCAP_VARIABLE not in os.environ:
        reasons = {"need real motion capture": _needs_mocap, **reasons}
    if missing := [name for name in SLURM_PROGRAMS if shutil.which(name, path=SYSTEM_PATH) is None]:
        reasons = {f"need Slurm (tests/support/install_slurm.sh): no {', '.join(missing)}": _needs_slurm, **reasons}
    if lacks := _missing_for_chromium():
        reasons = {f"need Chromium and the pages (make web): {lacks}": _needs_chromium, **reasons}
    if lacks := _missing_for_pages():
        reasons = {f"need Node and its packages (make web): {lacks}": _needs_node, **reasons}
    for name in PROGRAMS:
        if shutil.which(name) is None:
            reasons = {f"need {name}": functools.partial(_needs_program, name=name), **reasons}
    if unset := [name for name in (CLUSTER_VARIABLE, CLUSTER_IMAGE_VARIABLE) if name not in os.environ]:
        reasons = {f"need a Kubernetes cluster ({' and '.join(unset)} not set)": _needs_cluster, **reasons}
    config.stash[ON_DATABASES] = Counter(_without_backend(item) for item in items if backend_of(item))
    config.stash[CASES] = cases_of(items)
    kept, gone = [], []
    for item in items:
        reason = next((reason for reason, applies in reasons.items() if applies(item)), None)
        if reason is None:
            kept.append(item)
            if not item.get_closest_marker("xdist_group"):
                item.add_marker(pytest.mark.xdist_group(_group(item)))
        else:
            gone.append(item)
            config.stash[LEFT_OUT][reason] += 1
    config.hook.pytest_deselected(items=gone)
    items[:] = _in_order(kept)


def cases_of(items: Sequence[pytest.Item]) -> dict[str, list[str]]:
    """Return the names of the cases of each test of which some tiers run a part, by the name of the test."""
    cases: defaultdict[str, dict[str, None]] = defaultdict(dict)
    for item in items:
        if _every_nth(item) > 1:
            cases[function_of(item)][_without_backend(item)] = None
    return {function: list(names) for function, names in cases.items()}


def pytest_collection_finish(session: pytest.Session) -> None:
    """Stop if pytest-xdist has not read the groups: each process would then create all shared data.

    Python's garbage collector ignores the collected tests from now on: they stay until the end, and searching them
    again and again takes a twentieth of the time.
    """
    if session.config.getoption("loadgroup", False) and not all("@" in item.nodeid for item in session.items):
        raise pytest.UsageError("pytest-xdist has not seen the groups of tests, see tests/support/tiers.py")
    gc.collect()
    gc.freeze()


def _group(item: pytest.Item) -> str:
    """Return the name of a test's group. One process runs all tests of a group.

    The tests of a file are a group, and so are all workflows with one kind of database. Some files share data that
    takes long to create; they name their group themselves. Each fault case is a group of its own, because fault cases
    share nothing and mostly wait.
    """
    folder = _folder(item)
    if folder.startswith("integration/ways/"):
        return f"ways on {backend_of(item)}"
    return item.nodeid if _fault(item) else folder


def _in_order(items: Sequence[pytest.Item]) -> list[pytest.Item]:
    """Return the tests in the order in which processes start them: large groups first, with fault cases in between.

    Large groups that start late would run alone at the end, so a workflow and a test in a browser count as many tests.
    Fault cases mostly wait, so they are spread among tests that compute.
    """
    groups: defaultdict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        groups[_group_of(item)].append(item)
    computing = sorted((group for group in groups.values() if not _fault(group[0])), key=_size, reverse=True)
    waiting = sorted((group for group in groups.values() if _fault(group[0])), key=_size, reverse=True)
    total, ended = sum(map(len, computing)), 0
    placed: list[tuple[float, list[pytest.Item]]] = []
    for group in computing:
        placed.append((ended / total, group))
        ended += len(group)
    placed += [(number / len(waiting), group) for number, group in enumerate(waiting)]
    return [item for _, group in sorted(placed, key=lambda pair: pair[0]) for item in group]


def _size(group: Sequence[pytest.Item]) -> int:
    return sum(400 if _needs_chromium(item) else 20 if _whole_way(item) else 1 for item in group)


def _group_of(item: pytest.Item) -> str:
    marker = item.get_closest_marker("xdist_group")
    assert marker is not None
    return str(marker.args[0])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the counts from a worker process of pytest-xdist to the main process, which prints them."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        counts: Counter[str] = session.config.stash[LEFT_OUT]
        output["left_out"] = dict(counts)


def pytest_report_header() -> str:
    """Return a line that names the folder of real motion capture, or says that there is none."""
    folder = os.environ.get(MOCAP_VARIABLE)
    if folder:
        return f"real motion capture: {folder}"
    return f"real motion capture: none ({MOCAP_VARIABLE} is unset; tests that need it are left out and counted)"


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Keep the counts of only one worker process, because each process has collected all tests."""
    config: pytest.Config = node.config
    config.stash[LEFT_OUT] = Counter(getattr(node, "workeroutput", {}).get("left_out", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print how many tests this tier has left out, by reason."""
    left_out = config.stash[LEFT_OUT]
    terminalreporter.write_line(f"tier {config.getoption('tier')} left out {left_out.total()} tests")
    for reason, count in left_out.items():
        terminalreporter.write_line(f"  {count:5} {reason}")


@pytest.fixture(scope="session")
def fuzz_minutes(request: pytest.FixtureRequest) -> float:
    """Return the number of minutes for which each kind of caller sends generated requests."""
    return float(request.config.getoption("fuzz_minutes"))


@pytest.fixture(scope="session")
def mocap() -> Path:
    """The folder of real motion capture named by MAREY_TEST_MOCAP."""
    folder = Path(os.environ[MOCAP_VARIABLE])
    assert (folder / "MANIFEST.csv").is_file(), f"{MOCAP_VARIABLE}={folder} holds no MANIFEST.csv"
    return folder
