from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marey_motion.formats.bvh import read_bvh
from marey_schemas.encoding import blocks


def arrays_of(path: Path) -> list[NDArray[np.float32]]:
    """Return the poses and translations of a BVH file in the form in which a clip stores them."""
    source = read_bvh(path.read_bytes(), path.name)
    if source.rotations is None or source.root_positions is None:
        return []
    frames = len(source.rotations)
    poses = np.concatenate([source.root_positions, source.rotations.reshape(frames, -1)], axis=1)
    arrays = [poses.astype(np.float32)]
    if source.translations is not None:
        arrays.append(source.translations.astype(np.float32))
    return arrays


def test_every_real_motion_comes_back_to_the_bit(mocap: Path) -> None:
    checked = 0
    for path in sorted(mocap.rglob("*.bvh")):
        for array in arrays_of(path):
            decoded = blocks.decode(blocks.encode(array))
            assert (decoded.shape, decoded.tobytes()) == (array.shape, array.tobytes()), path
            checked += 1
    assert checked > 200


def test_a_real_motion_takes_less_than_half_of_its_raw_size(mocap: Path) -> None:
    sizes = [
        (len(blocks.encode(arrays_of(path)[0])), arrays_of(path)[0].nbytes) for path in mocap.glob("cmu-bvh/*.bvh")
    ]
    stored, raw = np.sum(sizes, axis=0)
    assert stored < 0.5 * raw
