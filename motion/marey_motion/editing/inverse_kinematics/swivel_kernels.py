"""Swivels of limbs: turns of a limb about the line between its ends, which move neither end."""

from __future__ import annotations

import math

from marey_motion.editing.inverse_kinematics.pose_kernels import place_joints
from marey_motion.editing.inverse_kinematics.rotation_kernels import (
    about,
    cross,
    direction,
    dot,
    length,
    minus,
    plus,
    put_vector,
    rotated,
    rotation_at,
    scaled,
    twist_angle,
    unit,
    vector_at,
)
from marey_motion.editing.inverse_kinematics.two_bone_kernels import CARRIED
from marey_motion.kernels import compiled, inverse, product, put_rotation


@compiled
def _far_end(limb, work):
    """Compute the position of the limb's far end, which a swivel does not move.

    The far end is the target's point if the end joint keeps its local rotation, otherwise the end joint itself.
    """
    place = vector_at(work.places, limb.end)
    if limb.ending != CARRIED:
        return place
    offset = (limb.offset[0], limb.offset[1], limb.offset[2])
    return plus(place, rotated(rotation_at(work.spins, limb.end), offset))


@compiled
def measure_swivels(limb, body, roots, before, after, work, lines, jumps, turns):
    """Measure how the change of a limb swivels from frame to frame.

    `before` and `after` (F, K, 4) are the poses before and after the limb was turned, and `roots` (F, 3) the positions
    of the root. Fills `lines` (F, 3), the unit directions between the limb's ends after the change, in the frame of the
    joint above the limb; `jumps` (F,), the angles about these lines by which the change of each frame differs from that
    of the frame before; and `turns` (F,), the angles by which the first joint was turned. Angles are in radians.
    """
    last = (1.0, 0.0, 0.0, 0.0)
    parent = body.parents[limb.start]
    for f in range(after.shape[0]):
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        place_joints(body.parents, offsets, roots[f], after[f], work.spins, work.places)
        line = direction(minus(_far_end(limb, work), vector_at(work.places, limb.start)))
        if parent >= 0:
            line = rotated(inverse(rotation_at(work.spins, parent)), line)
        put_vector(lines, f, line)
        change = unit(product(rotation_at(after[f], limb.start), inverse(rotation_at(before[f], limb.start))))
        turns[f] = 2.0 * math.atan2(length((change[1], change[2], change[3])), abs(change[0]))
        jumps[f] = twist_angle(product(change, inverse(last)), line) if f > 0 else 0.0
        last = change


@compiled
def fill_upper_bones(limb, body, roots, rotations, work, bones):
    """Fill `bones` (F, 3), the unit directions in the world from the first to the middle joint of a limb."""
    for f in range(rotations.shape[0]):
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        place_joints(body.parents, offsets, roots[f], rotations[f], work.spins, work.places)
        put_vector(bones, f, direction(minus(vector_at(work.places, limb.middle), vector_at(work.places, limb.start))))


@compiled
def pole_swivels(limb, body, roots, after, pole, work, angles, weights):
    """Fill `angles` (F,): the swivels, in radians, that direct the middle joint of a limb to the point `pole`.

    `pole` (3,) is in the world, in metres. Also fills `weights` (F,), from 0 to 1; a weight is 0 if the point is on the
    line through the limb's ends, or if the limb is straight. The other parameters are those of `measure_swivels`.
    """
    for f in range(after.shape[0]):
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        place_joints(body.parents, offsets, roots[f], after[f], work.spins, work.places)
        start = vector_at(work.places, limb.start)
        line = direction(minus(_far_end(limb, work), start))
        way = direction(minus((pole[0], pole[1], pole[2]), start))
        upper = direction(minus(vector_at(work.places, limb.middle), start))
        goal, now = minus(way, scaled(line, dot(way, line))), minus(upper, scaled(line, dot(upper, line)))
        angles[f] = math.atan2(dot(line, cross(now, goal)), dot(now, goal))
        weights[f] = length(goal) * min(1.0, 10.0 * length(now))


@compiled
def swivel_frames(limb, body, roots, angles, lines, rotations, work):
    """Turn a limb in each frame by `angles` (F,), in radians, about `lines` (F, 3); change `rotations` in place.

    `lines` are those of `measure_swivels`. If the limb does not carry its end, the end keeps its rotation in the world.
    """
    for f in range(rotations.shape[0]):
        if angles[f] == 0.0:
            continue
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        place_joints(body.parents, offsets, roots[f], rotations[f], work.spins, work.places)
        line = vector_at(lines, f)
        start = rotation_at(rotations[f], limb.start)
        put_rotation(rotations[f], limb.start, unit(product(about(line, angles[f]), start)))
        if limb.ending != CARRIED:
            parent = body.parents[limb.start]
            if parent >= 0:
                line = rotated(rotation_at(work.spins, parent), line)
            above = product(about(line, angles[f]), rotation_at(work.spins, body.parents[limb.end]))
            put_rotation(rotations[f], limb.end, unit(product(inverse(above), rotation_at(work.spins, limb.end))))
