"""Fixtures that every test may use."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import hypothesis
import pytest

from marey_motion.warm_up import discard_outdated_kernels

pytest_plugins = ("tests.support.database_fixtures", "tests.support.store_fixtures", "tests.support.queue_desk")

# A machine that does much else at once takes its time; how fast things are is for benchmarks to tell.
hypothesis.settings.register_profile("marey", deadline=None)
hypothesis.settings.load_profile("marey")

MOCAP_VARIABLE = "MAREY_TEST_MOCAP"
MEMORY = Path("/dev/shm")
ENOUGH_BYTES = 4 << 30
"""Two processes' databases with their logs, and the largest files that tests make, take less than half of this."""


def pytest_configure(config: pytest.Config) -> None:
    """Kernels are compiled anew when any of them has changed, once, before tests are spread over processes."""
    if not hasattr(config, "workerinput"):
        discard_outdated_kernels()
        keep_files_in_memory()
    keep_bytecode()


def keep_files_in_memory() -> None:
    """Put what tests write where there is no disk to wait for, if there is room and nobody chose a place.

    Databases wait for the disk at each of many thousand commits. Processes are killed here, never the machine: what a
    power cut would lose, no test can tell.
    """
    roomy = MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free >= ENOUGH_BYTES
    if roomy and "TMPDIR" not in os.environ:
        os.environ["TMPDIR"] = str(MEMORY)
        tempfile.tempdir = None


def keep_bytecode() -> None:
    """Let the hundreds of processes that tests start find compiled what the first ones have imported."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


def pytest_report_header() -> str:
    folder = os.environ.get(MOCAP_VARIABLE)
    if folder:
        return f"real motion capture: {folder}"
    return f"real motion capture: none ({MOCAP_VARIABLE} is unset; tests that need it are deselected and counted)"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what needs real motion capture where there is none, visibly: pytest counts it as deselected."""
    if os.environ.get(MOCAP_VARIABLE):
        return
    needs_mocap = [item for item in items if "mocap" in getattr(item, "fixturenames", ())]
    if needs_mocap:
        config.hook.pytest_deselected(items=needs_mocap)
        items[:] = [item for item in items if item not in set(needs_mocap)]


@pytest.fixture(scope="session")
def mocap() -> Path:
    """The folder of real motion capture named by MAREY_TEST_MOCAP."""
    folder = Path(os.environ[MOCAP_VARIABLE])
    assert (folder / "MANIFEST.csv").is_file(), f"{MOCAP_VARIABLE}={folder} holds no MANIFEST.csv"
    return folder
