"""Reading of BVH text to a clip of quaternions, against pymotion and a plain loader in numpy.

Marey is timed twice: reading alone (`read_bvh`: numbers, quaternions, every check of the text), which is what the peers
do and what the goals are about; and importing (`read_motion`), which besides finds the body's landmarks, settles unit
and axes, and looks for faults of capture.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymotion.io.bvh import BVH  # type: ignore[import-untyped]

from benchmarks.material import captured_walk, real_folder
from benchmarks.plain_bvh import load_plainly
from benchmarks.timing import Row, Timing, time_in_turn
from marey_motion.formats import read_motion, write_bvh
from marey_motion.formats.bvh import read_bvh

FRAMES, JOINTS = 2752, 31
REAL_FILE = Path("cmu-bvh/01_01.bvh")
GOAL_PYMOTION, GOAL_PLAIN = 20, 5


def run() -> list[Row]:
    """Measure a generated file, and a real one where there is one."""
    with tempfile.TemporaryDirectory() as folder:
        generated = Path(folder, "generated.bvh")
        generated.write_bytes(write_bvh(captured_walk(FRAMES, JOINTS)))
        rows = _rows(generated, "generated")
    real = real_folder()
    if real is not None:
        rows += _rows(real / REAL_FILE, str(REAL_FILE))
    return rows


def _rows(path: Path, name: str) -> list[Row]:
    frames = _check_agreement(path)
    reading, importing, pymotion, plain = time_in_turn(
        lambda: read_bvh(path.read_bytes(), path.name),
        lambda: read_motion(path.read_bytes(), path.name),
        lambda: _load_with_pymotion(path),
        lambda: load_plainly(path),
    )
    size = f"{name}, {path.stat().st_size / 1e6:.1f} MB, {frames} frames"
    return [
        _row("BVH to quaternions", size, reading, "pymotion", pymotion, GOAL_PYMOTION),
        _row("BVH to quaternions", size, reading, "plain numpy", plain, GOAL_PLAIN),
        _row("BVH import with landmarks, units, checks", size, importing, "pymotion", pymotion, None),
    ]


def _row(job: str, size: str, ours: Timing, peer_name: str, peer: Timing, goal: int | None) -> Row:
    ratio = peer.median_s / ours.median_s
    return Row(
        job,
        size,
        ours.shown(1e3, "ms"),
        f"{peer_name} {peer.shown(1e3, 'ms')}",
        ratio,
        "" if goal is None else f"≥ {goal}x",
        None if goal is None else ratio >= goal,
    )


def _load_with_pymotion(path: Path) -> NDArray[np.float64]:
    bvh = BVH()
    bvh.load(str(path))
    rotations: NDArray[np.float64] = bvh.get_data()[0]
    return rotations


def _check_agreement(path: Path) -> int:
    """Check that all three find the same rotations; return the number of frames."""
    ours = read_bvh(path.read_bytes(), path.name).rotations
    assert ours is not None
    for theirs in (_load_with_pymotion(path), load_plainly(path)):
        cosines = np.abs((ours * theirs).sum(axis=-1))
        assert cosines.min() > 1 - 1e-5, f"{path.name}: rotations differ, cosine {cosines.min()}"
    return len(ours)
