"""Loading BVH to sign-continuous quaternions against pymotion and against a plain numpy loader."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymotion.io.bvh import BVH
from pymotion.rotations import quat_np

from benchmarks.material import noisy_clip, real_folder
from benchmarks.timing import Row, time_in_turn
from marey_motion.formats import ImportOptions, read_motion, write_bvh
from marey_motion.formats.bvh import read_bvh

FRAMES, JOINTS = 3000, 31
GOAL_PYMOTION, GOAL_NUMPY = 20, 5


def run() -> list[Row]:
    """One file from disk: reading alone beside both peers, and the whole import beside pymotion's reading."""
    folder = real_folder()
    with tempfile.TemporaryDirectory() as scratch:
        if folder is None:
            path = Path(scratch) / "generated.bvh"
            path.write_bytes(write_bvh(noisy_clip(FRAMES, JOINTS), rotation_order="zyx"))
        else:
            path = folder / "cmu-bvh" / "01_01.bvh"
        return _rows(path)


def _rows(path: Path) -> list[Row]:
    options = ImportOptions(unit_scale_m=0.01, up_axis="y")
    theirs, _, *_ = _pymotion(path)
    source = read_bvh(path.read_bytes(), path.name)
    assert source.rotations is not None
    for rotations in (theirs, _numpy(path)):
        cosines = np.abs(np.sum(source.rotations * rotations, axis=2))
        assert cosines.min() > 1 - 1e-6, "the loaders disagree about rotations"

    size = f"{path.stat().st_size / 1e6:.1f} MB, {len(source.rotations)} frames x {len(source.parents)} joints"
    rows = []
    for job, ours, peer_name, peer, goal in (
        ("BVH to quaternions", lambda: read_bvh(path.read_bytes(), path.name), "pymotion", _pymotion, GOAL_PYMOTION),
        ("BVH to quaternions", lambda: read_bvh(path.read_bytes(), path.name), "numpy", _numpy, GOAL_NUMPY),
        (
            "BVH import with inference and checks",
            lambda: read_motion(path.read_bytes(), path.name, options=options),
            "pymotion",
            _pymotion,
            None,
        ),
    ):
        mine, other = time_in_turn(ours, lambda peer=peer: peer(path))  # type: ignore[misc]
        ratio = other.median_s / mine.median_s
        rows.append(
            Row(
                job,
                size,
                f"{mine.median_s * 1e3:.1f} ms",
                f"{peer_name} {other.median_s * 1e3:.0f} ms",
                ratio,
                f"≥ {goal}x" if goal else "",
                goal is None or ratio >= goal,
            )
        )
    return rows


def _pymotion(path: Path) -> tuple[NDArray[np.float64], ...]:
    loader = BVH()
    loader.load(str(path))
    return loader.get_data()  # type: ignore[no-any-return]


def _numpy(path: Path) -> NDArray[np.float64]:
    """(F, J, 4) by splitting the text, one array conversion, and the file's one order Z, Y, X for all joints."""
    lines = path.read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    values = np.array([line.split() for line in lines[first:]], np.float64)
    half = np.radians(values[:, 3:].reshape(len(values), -1, 3)) / 2
    cosines, sines, zeros = np.cos(half), np.sin(half), np.zeros(half.shape[:2])

    def turn(place: int, axis: int) -> NDArray[np.float64]:
        parts = [cosines[..., place], zeros, zeros, zeros]
        parts[1 + axis] = sines[..., place]
        return np.stack(parts, axis=-1)

    turns = quat_np.mul(quat_np.mul(turn(0, 2), turn(1, 1)), turn(2, 0))
    return quat_np.unroll(turns, axis=0)  # type: ignore[no-any-return]
