"""Compiled forward kinematics, in a separate module so that importing other modules does not load numba.

The memory layout determines the speed. A block of frames is transposed from one row per pose to one contiguous row of
frames per component. Each step along the joint chain then consists of the same few vector instructions for all frames
of the block. The blocks are small enough for the first two cache levels.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import contracted, product

# Frames per block, and the length of a row of scratch: an odd number of cache lines, because rows a power of two
# apart would all compete for the same few cache sets.
BLOCK = 64
ROW = 80
QUATERNION = 4 * ROW
VECTOR = 3 * ROW


@contracted
def _turn(parent, joint):
    """Replace local rotations of a joint by rotations in the world: joint = parent · joint.

    `parent` (4, frames) contains rotations of the parent in the world. `joint` (4, frames) is overwritten.
    """
    for f in range(BLOCK):
        aw, ax, ay, az = parent[f], parent[ROW + f], parent[2 * ROW + f], parent[3 * ROW + f]
        bw, bx, by, bz = joint[f], joint[ROW + f], joint[2 * ROW + f], joint[3 * ROW + f]
        w, x, y, z = product((aw, ax, ay, az), (bw, bx, by, bz))
        joint[f], joint[ROW + f], joint[2 * ROW + f], joint[3 * ROW + f] = w, x, y, z


@contracted
def _place(rotation, origin, point):
    """Replace offsets of a point by positions in the world: point = origin + rotation · point.

    `rotation` (4, frames) and `origin` (3, frames) are the rotation and position of the point's parent in the world.
    `point` (3, frames) is overwritten.
    """
    for f in range(BLOCK):
        w, x, y, z = rotation[f], rotation[ROW + f], rotation[2 * ROW + f], rotation[3 * ROW + f]
        px, py, pz = point[f], point[ROW + f], point[2 * ROW + f]
        tx = 2 * (y * pz - z * py)
        ty = 2 * (z * px - x * pz)
        tz = 2 * (x * py - y * px)
        point[f] = origin[f] + px + w * tx + y * tz - z * ty
        point[ROW + f] = origin[ROW + f] + py + w * ty + z * tx - x * tz
        point[2 * ROW + f] = origin[2 * ROW + f] + pz + w * tz + x * ty - y * tx


@contracted
def _load(block, first_column, rows, row_count):
    for f in range(block.shape[0]):
        frame = block[f]
        for c in range(row_count):
            rows[c * ROW + f] = frame[first_column + c]


@contracted
def _store(rows, block):
    for f in range(block.shape[0]):
        frame = block[f]
        for c in range(block.shape[1]):
            frame[c] = rows[c * ROW + f]


@contracted
def _load_offsets(offsets, translations, slots, start, count, points):
    for p in range(1, offsets.shape[0]):
        for c in range(3):
            row = points[p * VECTOR + c * ROW : p * VECTOR + c * ROW + ROW]
            if slots[p] < 0:
                row[:BLOCK] = offsets[p, c]
            else:
                for f in range(count):
                    row[f] = translations[start + f, slots[p], c]


@contracted
def positions(poses, offsets, parents, translations, slots, turned, out):
    """Fill `out` (F, 3·P) with global positions of P points: J joints, then end sites.

    The inputs are poses (F, 3 + 4·J), offsets (P, 3), parents (P,) and translations (F, k, 3). `slots` (P,) is the
    index of each point's translation, or -1. `turned` (J,) marks the joints whose global rotation a child needs.
    """
    joints = turned.shape[0]
    rotation = np.zeros(joints * QUATERNION, poses.dtype)
    point = np.zeros(offsets.shape[0] * VECTOR, poses.dtype)
    for start in range(0, poses.shape[0], BLOCK):
        block = poses[start : start + BLOCK]
        _load(block, 0, point, 3)
        _load(block, 3, rotation, 4 * joints)
        _load_offsets(offsets, translations, slots, start, block.shape[0], point)
        for p in range(1, offsets.shape[0]):
            r = parents[p]
            parent = rotation[r * QUATERNION : r * QUATERNION + QUATERNION]
            if p < joints and turned[p]:
                _turn(parent, rotation[p * QUATERNION : p * QUATERNION + QUATERNION])
            _place(parent, point[r * VECTOR : r * VECTOR + VECTOR], point[p * VECTOR : p * VECTOR + VECTOR])
        _store(point, out[start : start + BLOCK])


@contracted
def rotations(local, parents, out):
    """Convert local rotations `local` (F, 4·J) to global rotations `out` (F, 4·J)."""
    rotation = np.zeros(parents.shape[0] * QUATERNION, local.dtype)
    for start in range(0, local.shape[0], BLOCK):
        block = local[start : start + BLOCK]
        _load(block, 0, rotation, 4 * parents.shape[0])
        for p in range(1, parents.shape[0]):
            r = parents[p]
            _turn(
                rotation[r * QUATERNION : r * QUATERNION + QUATERNION],
                rotation[p * QUATERNION : p * QUATERNION + QUATERNION],
            )
        _store(rotation, out[start : start + BLOCK])
