"""Conversion of BVH files to quaternions, one file and many, compared with pymotion and a simple loader in numpy.

Marey is timed twice. Reading alone (`read_bvh`) parses the numbers, computes quaternions and checks the text, as the
other loaders do; the goals refer to reading alone. Importing (`read_motion`) also finds the landmarks of the body,
determines the unit and the axes, and searches for faults of the capture.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.material import captured_walk, folder_of_takes, real_folder
from benchmarks.plain_bvh import load_plainly
from benchmarks.pymotion_bvh import load_with_pymotion, loaded_with_pymotion
from benchmarks.timing import Row, Timing, time_in_turn
from marey_motion.errors import MotionError
from marey_motion.formats import read_motion, write_bvh
from marey_motion.formats.bvh import read_bvh

FRAMES, JOINTS = 2752, 31
REAL_FILE = Path("cmu-bvh/01_01.bvh")
GOAL_PYMOTION, GOAL_PLAIN, GOAL_MANY = 20, 5, 15


def run() -> list[Row]:
    """Measure a generated file, a real one if there is one, and a folder of small files."""
    with tempfile.TemporaryDirectory() as folder:
        generated = Path(folder, "generated.bvh")
        generated.write_bytes(write_bvh(captured_walk(FRAMES, JOINTS)))
        rows = _rows(generated, "generated")
    real = real_folder()
    if real is not None:
        rows += _rows(real / REAL_FILE, str(REAL_FILE))
    with folder_of_takes() as takes:
        return rows + _many(sorted(takes.rglob("*.bvh")), "real" if real else "generated")


def _rows(path: Path, name: str) -> list[Row]:
    frames = _check_agreement(path)
    reading, importing, pymotion, plain = time_in_turn(
        lambda: read_bvh(path.read_bytes(), path.name),
        lambda: read_motion(path.read_bytes(), path.name),
        lambda: load_with_pymotion(path),
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


def _many(paths: list[Path], origin: str) -> list[Row]:
    """Measure the files that Marey and pymotion both read; a folder of real capture also contains files with faults."""
    frames = loaded_with_pymotion(paths)
    read = [path for path in frames if _is_read(path)]
    reading, importing, pymotion = time_in_turn(
        lambda: [read_bvh(path.read_bytes(), path.name) for path in read],
        lambda: [read_motion(path.read_bytes(), path.name) for path in read],
        lambda: [load_with_pymotion(path) for path in read],
        repeats=3,
    )
    poses = sum(frames[path] for path in read)
    size = f"{len(read)} {origin} files, those of {len(paths)} that both read, {poses:,} frames"
    return [
        _row("many small files read, BVH to quaternions", size, reading, "pymotion", pymotion, GOAL_MANY),
        _row("many small files read, with landmarks, units, checks", size, importing, "pymotion", pymotion, GOAL_MANY),
    ]


def _is_read(path: Path) -> bool:
    try:
        return read_motion(path.read_bytes(), path.name).clip is not None
    except MotionError:
        return False


def _check_agreement(path: Path) -> int:
    """Check that the three loaders find the same rotations in a file; return the file's number of frames."""
    ours = read_bvh(path.read_bytes(), path.name).rotations
    assert ours is not None
    for theirs in (load_with_pymotion(path), load_plainly(path)):
        cosines = np.abs((ours * theirs).sum(axis=-1))
        assert cosines.min() > 1 - 1e-5, f"{path.name}: rotations differ, cosine {cosines.min()}"
    return len(ours)
