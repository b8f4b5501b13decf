"""Independent reader of BVH files, for comparison."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymotion.io.bvh import BVH
from pymotion.rotations import quat_np
from tests.support.tiers import is_soak


def positions_by_another_loader(path: Path, *, only_root: bool = False) -> NDArray[np.float64]:
    """Return the joint positions (F, J, 3) of a BVH file, in the unit and the axes of the file.

    With `only_root`, position channels of other joints are ignored, as some programs do.
    """
    loader = BVH()
    loader.load(str(path))
    rotations, positions, parents, offsets, *_ = loader.get_data()
    turned, placed = rotations.copy(), positions.copy()
    if only_root:
        positions[:, 1:] = offsets[1:]
    for joint, parent in enumerate(parents):
        if joint:
            turned[:, joint] = quat_np.mul(turned[:, parent], rotations[:, joint])
            placed[:, joint] = placed[:, parent] + quat_np.mul_vec(turned[:, parent], positions[:, joint])
    return np.asarray(placed)


def files_to_compare(names: list[str]) -> list[str]:
    """Return those files of the collection that tests read with this loader, which is slow.

    The files of each folder `bandai-namco-*` have the same skeleton, so every sixth file is enough, except in the tier
    `soak`.
    """
    alike = [name for name in names if "bandai-namco-" in name]
    left_out = set() if is_soak() else set(alike) - set(alike[::6])
    return [name for name in names if name not in left_out]
