"""Compiled retargeting, in a separate module so that importing other modules does not load numba."""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled, inverse, product, put_rotation

# How a joint of the target gets its rotation.
AT_REST = 0
MAPPED = 1
CARRIED = 2


@compiled
def rotations(local, parents, modes, sources, corrections, rests, target_parents, out):
    """Fill `out` (F, 4·K) with local rotations of the K target joints, continuous in sign from frame to frame.

    `local` (F, 4·J) are the local rotations of the source joints, `parents` (J,) the indices of their parents. The
    other arrays describe the target joints. `modes` (K,) is `AT_REST` for a joint that keeps its rest rotation,
    `MAPPED` for a joint that follows the global rotation of its source joint, and `CARRIED` for a joint that copies
    the local rotation of its source joint. `sources` (K,) are the source joints. Their global rotations are multiplied
    by `corrections` (K, 4) from the right. `rests` (K, 4) are the rest rotations of the target joints, and
    `target_parents` (K,) the indices of their parents.
    """
    joints, targets = parents.shape[0], target_parents.shape[0]
    source = np.empty((joints, 4))
    target = np.empty((targets, 4))
    last = np.zeros((targets, 4))
    for f in range(local.shape[0]):
        for j in range(joints):
            w, x, y, z = local[f, 4 * j], local[f, 4 * j + 1], local[f, 4 * j + 2], local[f, 4 * j + 3]
            p = parents[j]
            if p >= 0:
                w, x, y, z = product(source[p], (w, x, y, z))
            # Products of rounded quaternions shrink or grow along the chain.
            length = np.sqrt(w * w + x * x + y * y + z * z)
            source[j, 0], source[j, 1], source[j, 2], source[j, 3] = w / length, x / length, y / length, z / length
        for k in range(targets):
            p, s = target_parents[k], sources[k]
            if modes[k] == MAPPED:
                w, x, y, z = product(source[s], corrections[k])
                put_rotation(target, k, (w, x, y, z))
                if p >= 0:
                    w, x, y, z = product(inverse(target[p]), (w, x, y, z))
            else:
                if modes[k] == CARRIED:
                    w, x, y, z = local[f, 4 * s], local[f, 4 * s + 1], local[f, 4 * s + 2], local[f, 4 * s + 3]
                else:
                    w, x, y, z = rests[k, 0], rests[k, 1], rests[k, 2], rests[k, 3]
                if p >= 0:
                    put_rotation(target, k, product(target[p], (w, x, y, z)))
                else:
                    put_rotation(target, k, (w, x, y, z))
            if last[k, 0] * w + last[k, 1] * x + last[k, 2] * y + last[k, 3] * z < 0.0:
                w, x, y, z = -w, -x, -y, -z
            put_rotation(last, k, (w, x, y, z))
            out[f, 4 * k], out[f, 4 * k + 1], out[f, 4 * k + 2], out[f, 4 * k + 3] = w, x, y, z
