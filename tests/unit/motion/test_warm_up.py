"""Kernels are compiled ahead of the first file."""

import os
import subprocess
import sys
from pathlib import Path

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
