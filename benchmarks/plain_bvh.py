"""A simple BVH loader: it parses line by line in Python, and converts Euler angles to quaternions with numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def load_plainly(path: Path) -> Floats:
    """Return the local quaternions (F, J, 4) w, x, y, z of a file whose joints all have the same rotation order."""
    channels: list[int] = []
    order = ""
    frames: list[list[float]] = []
    in_motion = False
    with path.open() as file:
        for line in file:
            if in_motion:
                frames.append([float(word) for word in line.split()])
            elif "CHANNELS" in line:
                words = line.split()
                channels.append(int(words[1]))
                order = "".join(word[0].lower() for word in words[-3:])
            elif "Frame Time" in line:
                in_motion = True
    values = np.array(frames)
    ends = np.cumsum(channels)
    columns = ends[:, None] + np.arange(-3, 0)
    return _continuous(_from_euler(np.radians(values[:, columns]), order))


def _from_euler(angles: Floats, order: str) -> Floats:
    first, second, third = (_about(axis, angles[..., turn]) for turn, axis in enumerate(order))
    return _product(first, _product(second, third))


def _about(axis: str, angle: Floats) -> Floats:
    turned = np.zeros((*angle.shape, 4))
    turned[..., 0] = np.cos(angle / 2)
    turned[..., 1 + "xyz".index(axis)] = np.sin(angle / 2)
    return turned


def _product(a: Floats, b: Floats) -> Floats:
    aw, ax, ay, az = a[..., 0:1], a[..., 1:2], a[..., 2:3], a[..., 3:4]
    bw, bx, by, bz = b[..., 0:1], b[..., 1:2], b[..., 2:3], b[..., 3:4]
    return np.concatenate(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def _continuous(rotations: Floats) -> Floats:
    """Change signs of quaternions so that they do not jump from frame to frame."""
    for frame in range(1, len(rotations)):
        flipped = (rotations[frame - 1] * rotations[frame]).sum(axis=-1) < 0
        rotations[frame][flipped] *= -1
    return rotations
