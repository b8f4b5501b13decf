"""Reading of BVH files with pymotion, for comparison."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymotion.io.bvh import BVH


def load_with_pymotion(path: Path) -> NDArray[np.float64]:
    """Return the local quaternions (F, J, 4) of a file, as pymotion reads them."""
    bvh = BVH()
    bvh.load(str(path))
    rotations: NDArray[np.float64] = bvh.get_data()[0]
    return rotations


def loaded_with_pymotion(paths: Iterable[Path]) -> dict[Path, int]:
    """Return the number of frames of each file that pymotion can read; print the names of files that it cannot read."""
    frames = {}
    for path in paths:
        try:
            frames[path] = len(load_with_pymotion(path))
        except Exception as error:  # noqa: BLE001 - a peer's failure is no result of ours
            print(f"pymotion does not read {path.name}: {type(error).__name__}")
    return frames
