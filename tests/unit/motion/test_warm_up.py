"""Kernels are compiled ahead of the first file."""

import os
import subprocess
import sys
from pathlib import Path

from marey_motion import warm_up

READ_A_WALK = """
import sys
from marey_motion import generate_gait, read_motion, write_motion

read_motion(write_motion(generate_gait(1.0, 0.0, 0.5), "bvh"), "walk.bvh")
"""


def test_a_first_file_finds_the_kernels_compiled(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "marey_motion.warm_up", "files"], env=environment, check=True)
    before = {file.name for file in tmp_path.rglob("*.nbi")}
    subprocess.run([sys.executable, "-c", READ_A_WALK], env=environment, check=True)
    assert before
    assert {file.name for file in tmp_path.rglob("*.nbi")} == before


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
