"""Compilation of kernels before the first file is read."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from marey_motion import warm_up

READ_A_WALK = """
import sys
from marey_motion import generate_gait, read_motion, write_motion

read_motion(write_motion(generate_gait(1.0, 0.0, 0.5), "bvh"), "walk.bvh")
"""


NAME_MODULES_OF_KERNELS = """
import importlib, pkgutil
import marey_motion
from numba.core.dispatcher import Dispatcher

for found in pkgutil.walk_packages(marey_motion.__path__, "marey_motion."):
    for kernel in vars(importlib.import_module(found.name)).values():
        if isinstance(kernel, Dispatcher):
            print(kernel.py_func.__code__.co_filename)
"""


def test_every_module_with_a_compiled_function_is_a_source_of_kernels() -> None:
    found = subprocess.run([sys.executable, "-c", NAME_MODULES_OF_KERNELS], capture_output=True, text=True, check=True)
    sources = {Path(name) for name in found.stdout.split()}
    assert {"euler.py", "numeric_text.py", "bvh_writer.py", "amc_frames.py"} <= {source.name for source in sources}
    assert sources <= set(warm_up.kernel_sources())


@pytest.mark.parametrize(
    "line",
    [
        "import numba",
        "from numba import njit",
        "from numba.extending import intrinsic",
        "from marey_motion.kernels import product",
    ],
)
def test_a_module_that_imports_the_compiler_or_kernels_is_a_source_of_kernels(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lanes.py").write_text(f"{line}\n")
    (tmp_path / "clips.py").write_text("import numpy\n")
    monkeypatch.setattr(warm_up, "PACKAGE", tmp_path)
    assert [source.name for source in warm_up.kernel_sources()] == ["lanes.py"]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with one compiled kernel and a recorded origin."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(warm_up, "PACKAGE", tmp_path)
    monkeypatch.setattr(warm_up, "STAMP", tmp_path / "__pycache__" / "kernels-compiled")
    (tmp_path / "euler.py").write_text("from numba import njit\n")
    (tmp_path / "__pycache__").mkdir()
    warm_up.discard_outdated_kernels()
    compiled = tmp_path / "__pycache__" / "euler.turn-1.py311.nbi"
    compiled.write_bytes(b"")
    return tmp_path


def compiled_files(package: Path) -> list[str]:
    return [file.name for file in package.rglob("*.nb[ic]")]


def test_compiled_code_of_the_same_sources_is_kept(package: Path) -> None:
    warm_up.discard_outdated_kernels()
    assert compiled_files(package) == ["euler.turn-1.py311.nbi"]


def test_compiled_code_is_discarded_after_a_source_has_changed_whatever_its_time(package: Path) -> None:
    source = package / "euler.py"
    times = source.stat()
    source.write_text("from numba import jit \n")
    os.utime(source, ns=(times.st_atime_ns, times.st_mtime_ns))
    warm_up.discard_outdated_kernels()
    assert compiled_files(package) == []


def test_compiled_code_is_discarded_for_another_compiler(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "version", lambda _: "999")
    warm_up.discard_outdated_kernels()
    assert compiled_files(package) == []


def test_compiled_code_of_other_packages_is_kept(package: Path) -> None:
    (package / "__pycache__" / "foreign.solve-1.py311.nbi").write_bytes(b"")
    (package / "euler.py").write_text("from numba import jit\n")
    warm_up.discard_outdated_kernels()
    assert compiled_files(package) == ["foreign.solve-1.py311.nbi"]


@pytest.mark.soak  # compiles all kernels of one stage
def test_a_first_file_finds_the_kernels_compiled(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "marey_motion.warm_up", "files"], env=environment, check=True)
    before = {file.name for file in tmp_path.rglob("*.nbi")}
    subprocess.run([sys.executable, "-c", READ_A_WALK], env=environment, check=True)
    assert before
    assert {file.name for file in tmp_path.rglob("*.nbi")} == before


def test_what_is_compiled_is_not_compiled_again_until_a_kernel_changes(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled: list[tuple[str, ...]] = []
    monkeypatch.setattr(warm_up, "compile_kernels", lambda stages, processes: compiled.append(tuple(stages)))
    monkeypatch.setattr(sys, "argv", ["warm_up"])
    warm_up.main()
    warm_up.main()
    assert compiled == [tuple(warm_up.STAGES)]
    (package / "euler.py").write_text("from numba import jit\n")
    warm_up.main()
    assert len(compiled) == 2
