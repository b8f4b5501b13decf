"""Compiled functions that compute the rotations of bones whose joints were moved.

They have a module of their own, so that importing the rest of the package does not load numba. Operations and their
order are the same as in `quaternions`, so that results are bit-identical.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled, inverse, product, put_rotation


@compiled
def _length(x, y, z):
    return np.sqrt(x * x + y * y + z * z)


@compiled
def shortest_turns(rigid, moved, starts, ends, shortest_bone, nearly_opposite, turns, halves, opposite):
    """Fill `turns` (B, F, 4) with the shortest rotations of B bones from their directions in `rigid` to `moved`.

    `rigid` and `moved` (F, J, 3) are positions of joints. `halves` (2, B, F) receives the sine and cosine of half of
    each angle. Bones shorter than `shortest_bone` do not turn. `opposite` (B, F) marks bones that turn by nearly 180
    degrees; the caller must compute their rotations and angles.
    """
    for b in range(starts.shape[0]):
        s, e = starts[b], ends[b]
        for f in range(rigid.shape[0]):
            ax = np.float64(rigid[f, e, 0]) - np.float64(rigid[f, s, 0])
            ay = np.float64(rigid[f, e, 1]) - np.float64(rigid[f, s, 1])
            az = np.float64(rigid[f, e, 2]) - np.float64(rigid[f, s, 2])
            bx = np.float64(moved[f, e, 0]) - np.float64(moved[f, s, 0])
            by = np.float64(moved[f, e, 1]) - np.float64(moved[f, s, 1])
            bz = np.float64(moved[f, e, 2]) - np.float64(moved[f, s, 2])
            a, c = _length(ax, ay, az), _length(bx, by, bz)
            w, x, y, z = 1.0, 0.0, 0.0, 0.0
            if a > shortest_bone and c > shortest_bone:
                ax, ay, az, bx, by, bz = ax / a, ay / a, az / a, bx / c, by / c, bz / c
                mx, my, mz = ax + bx, ay + by, az + bz
                w = 0.5 * (mx * mx + my * my + mz * mz)
                x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                length = np.sqrt(w * w + x * x + y * y + z * z)
                opposite[b, f] = length < nearly_opposite
                w, x, y, z = w / length, x / length, y / length, z / length
            turns[b, f, 0], turns[b, f, 1], turns[b, f, 2], turns[b, f, 3] = w, x, y, z
            halves[0, b, f], halves[1, b, f] = _length(x, y, z), abs(w)


@compiled
def turn_joints(world, parents, joints, turns, out):
    """Apply rotations in world axes to B joints, and fill `out` (F, 4·J) with the new local rotations of all J joints.

    `world` (F, J, 4) are the global rotations of all joints before the turns. Rotation b of `turns` (B, F, 4) is
    applied to joint b of `joints` (B,). `parents` (J,) are the indices of the joints' parents.
    """
    turned = np.empty((parents.shape[0], 4))
    for f in range(world.shape[0]):
        for j in range(parents.shape[0]):
            for c in range(4):
                turned[j, c] = world[f, j, c]
        for b in range(joints.shape[0]):
            put_rotation(turned, joints[b], product(turns[b, f], turned[joints[b]]))
        for j in range(parents.shape[0]):
            w, x, y, z = turned[j, 0], turned[j, 1], turned[j, 2], turned[j, 3]
            p = parents[j]
            if p >= 0:
                w, x, y, z = product(inverse(turned[p]), (w, x, y, z))
            out[f, 4 * j], out[f, 4 * j + 1], out[f, 4 * j + 2], out[f, 4 * j + 3] = w, x, y, z
