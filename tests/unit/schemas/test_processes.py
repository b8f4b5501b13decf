"""The environment of child processes, and the garbage collector while a process loads modules."""

import gc

import pytest

from marey_schemas.processes.environment import EXTRA_VARIABLE, clean_environment
from marey_schemas.processes.memory import loading_modules

SECRETS = {
    "MAREY_DATABASE_URL": "postgresql://marey:hunter2@db/marey",
    "MAREY_TOKEN": "marey_secret",
    "PGPASSWORD": "hunter2",
    "AWS_SECRET_ACCESS_KEY": "hunter2",
    "HTTPS_PROXY": "http://user:hunter2@proxy",
}
NEEDED = {
    "PATH": "/bin",
    "HOME": "/home/m",
    "LC_ALL": "C.UTF-8",
    "NUMBA_CACHE_DIR": "/cache",
    "MAREY_LOG_LEVEL": "info",
}


def test_a_child_gets_what_it_needs_and_no_secret() -> None:
    assert clean_environment(SECRETS | NEEDED) == NEEDED


def test_an_operator_may_pass_on_further_variables() -> None:
    source = {**NEEDED, "RIG_FOLDER": "/rigs", "OTHER": "1", EXTRA_VARIABLE: "RIG_FOLDER, ABSENT"}
    assert clean_environment(source) == {**NEEDED, "RIG_FOLDER": "/rigs", EXTRA_VARIABLE: source[EXTRA_VARIABLE]}


def test_threads_of_numeric_libraries_are_limited_where_the_environment_does_not() -> None:
    limited = clean_environment({"OMP_NUM_THREADS": "4"}, threads=1)
    assert (limited["OMP_NUM_THREADS"], limited["NUMBA_NUM_THREADS"]) == ("4", "1")


def test_objects_of_loaded_modules_are_not_searched_for_garbage() -> None:
    before = gc.get_freeze_count()
    with loading_modules():
        assert not gc.isenabled()
        module: list[list[int]] = [[] for _ in range(1000)]
    assert gc.isenabled()
    assert gc.get_freeze_count() >= before + len(module)


def test_an_import_that_fails_leaves_the_garbage_collector_on() -> None:
    with pytest.raises(ImportError), loading_modules():
        import marey_no_such_module  # noqa: F401  # pyrefly: ignore[missing-import]  # it is missing
    assert gc.isenabled()
