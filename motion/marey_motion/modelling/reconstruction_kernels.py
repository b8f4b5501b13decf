"""Compiled comparison of the joint positions of poses, with the derivative of the error with respect to a pose."""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled, inverse, product, put_rotation, rotate_vector


@compiled
def _load_rotations(pose, rotations, lengths):
    """Fill `rotations` (J, 4) with the unit quaternions of a pose, and `lengths` (J,) with the original lengths."""
    for joint in range(len(rotations)):
        column = 3 + 4 * joint
        w, x, y, z = pose[column], pose[column + 1], pose[column + 2], pose[column + 3]
        length = np.sqrt(w * w + x * x + y * y + z * z)
        lengths[joint] = length
        rotations[joint, 0] = w / length
        rotations[joint, 1] = x / length
        rotations[joint, 2] = y / length
        rotations[joint, 3] = z / length


@compiled
def _place_joints(pose, local, parents, offsets, world, positions):
    """Fill rotations `world` (J, 4) and positions (J, 3) in the world, from a pose and its local rotations `local`."""
    world[0] = local[0]
    positions[0] = pose[:3]
    for joint in range(1, len(parents)):
        parent = parents[joint]
        aw, ax, ay, az = world[parent]
        put_rotation(world, joint, product(world[parent], local[joint]))
        ox, oy, oz = offsets[joint]
        tx = 2.0 * (ay * oz - az * oy)
        ty = 2.0 * (az * ox - ax * oz)
        tz = 2.0 * (ax * oy - ay * ox)
        positions[joint, 0] = positions[parent, 0] + ox + aw * tx + ay * tz - az * ty
        positions[joint, 1] = positions[parent, 1] + oy + aw * ty + az * tx - ax * tz
        positions[joint, 2] = positions[parent, 2] + oz + aw * tz + ax * ty - ay * tx


@compiled
def mean_distances(poses, parents, offsets, targets, out):
    """Fill `out` (B,) with the mean distance, in metres, of the joints of B motions from `targets` (T, J, 3).

    `poses` (B, T, 3 + 4·J) are the motions; their quaternions need not have unit length. `parents` (J,) and `offsets`
    (J, 3) describe the skeleton.
    """
    joints = len(parents)
    local, world = np.empty((joints, 4)), np.empty((joints, 4))
    lengths, positions = np.empty(joints), np.empty((joints, 3))
    for motion in range(poses.shape[0]):
        total = 0.0
        for frame in range(poses.shape[1]):
            _load_rotations(poses[motion, frame], local, lengths)
            _place_joints(poses[motion, frame], local, parents, offsets, world, positions)
            for joint in range(joints):
                x = positions[joint, 0] - targets[frame, joint, 0]
                y = positions[joint, 1] - targets[frame, joint, 1]
                z = positions[joint, 2] - targets[frame, joint, 2]
                total += np.sqrt(x * x + y * y + z * z)
        out[motion] = total / (poses.shape[1] * joints)


@compiled
def squared_error_gradient(poses, parents, offsets, targets, gradient):
    """Return the sum of squared distances of joints from `targets` (F, J, 3), and fill `gradient` (F, 3 + 4·J).

    The gradient is the derivative of the sum with respect to `poses` (F, 3 + 4·J). Quaternions need not have unit
    length: the sum is computed for the rotations that they represent. From the leaves to the root, the gradients of all
    joints below a joint are added up to a force and a torque on this joint.
    """
    joints = len(parents)
    local, world = np.empty((joints, 4)), np.empty((joints, 4))
    lengths, positions = np.empty(joints), np.empty((joints, 3))
    forces, torques = np.empty((joints, 3)), np.empty((joints, 3))
    total = 0.0
    for frame in range(len(poses)):
        _load_rotations(poses[frame], local, lengths)
        _place_joints(poses[frame], local, parents, offsets, world, positions)
        for joint in range(joints):
            for axis in range(3):
                away = positions[joint, axis] - targets[frame, joint, axis]
                total += away * away
                forces[joint, axis] = 2.0 * away
                torques[joint, axis] = 0.0
        for joint in range(joints - 1, -1, -1):
            parent = parents[joint]
            tx, ty, tz = torques[joint]
            if parent >= 0:
                fx, fy, fz = forces[joint]
                lx = positions[joint, 0] - positions[parent, 0]
                ly = positions[joint, 1] - positions[parent, 1]
                lz = positions[joint, 2] - positions[parent, 2]
                forces[parent, 0] += fx
                forces[parent, 1] += fy
                forces[parent, 2] += fz
                torques[parent, 0] += tx + ly * fz - lz * fy
                torques[parent, 1] += ty + lz * fx - lx * fz
                torques[parent, 2] += tz + lx * fy - ly * fx
                # The torque in the frame that the local rotation turns in: that of the parent.
                tx, ty, tz = rotate_vector(inverse(world[parent]), tx, ty, tz)
            qw, qx, qy, qz = local[joint]
            scale = 2.0 / lengths[joint]
            column = 3 + 4 * joint
            gradient[frame, column] = scale * (-tx * qx - ty * qy - tz * qz)
            gradient[frame, column + 1] = scale * (tx * qw + ty * qz - tz * qy)
            gradient[frame, column + 2] = scale * (-tx * qz + ty * qw + tz * qx)
            gradient[frame, column + 3] = scale * (tx * qy - ty * qx + tz * qw)
        gradient[frame, :3] = forces[0]
    return total
