"""Kernels are compiled ahead of the first file."""

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
def test_a_module_that_imports_the_compiler_or_kernels_is_a_source_of_kernels(line, tmp_path, monkeypatch) -> None:
    (tmp_path / "lanes.py").write_text(f"{line}\n")
    (tmp_path / "clips.py").write_text("import numpy\n")
    monkeypatch.setattr(warm_up, "PACKAGE", tmp_path)
    assert [source.name for source in warm_up.kernel_sources()] == ["lanes.py"]


def test_compiled_code_is_discarded_after_any_source_of_kernels_has_changed(tmp_path: Path, monkeypatch) -> None:
    source = tmp_path / "euler.py"
    source.write_text("from numba import njit\n")
    compiled = tmp_path / "__pycache__" / "euler.nbi"
    compiled.parent.mkdir()
    compiled.write_bytes(b"")
    monkeypatch.setattr(warm_up, "PACKAGE", tmp_path)
    os.utime(source, (1_000, 1_000))
    warm_up.discard_outdated_kernels()
    assert compiled.exists()
    os.utime(source)
    os.utime(compiled, (1_000, 1_000))
    warm_up.discard_outdated_kernels()
    assert not compiled.exists()


@pytest.mark.slow
def test_a_first_file_finds_the_kernels_compiled(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "marey_motion.warm_up", "files"], env=environment, check=True)
    before = {file.name for file in tmp_path.rglob("*.nbi")}
    subprocess.run([sys.executable, "-c", READ_A_WALK], env=environment, check=True)
    assert before
    assert {file.name for file in tmp_path.rglob("*.nbi")} == before


@pytest.mark.slow
def test_what_is_compiled_is_not_compiled_again_until_a_kernel_changes(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(warm_up, "STAMP", tmp_path / "kernels-compiled")
    compiled: list[tuple[str, ...]] = []
    monkeypatch.setattr(warm_up, "compile_kernels", lambda stages, processes: compiled.append(tuple(stages)))
    monkeypatch.setattr(warm_up, "discard_outdated_kernels", lambda: None)
    monkeypatch.setattr(sys, "argv", ["warm_up"])
    warm_up.main()
    warm_up.main()
    assert compiled == [tuple(warm_up.STAGES)]
    os.utime(tmp_path / "kernels-compiled", (0, 0))
    warm_up.main()
    assert len(compiled) == 2
