"""Inverse kinematics of limbs with two bones: the distance of the target determines the bend; then the limb is aimed at
the target.
"""

from __future__ import annotations

import math

import numpy as np

from marey_motion.editing.inverse_kinematics.pose_kernels import place_joints
from marey_motion.editing.inverse_kinematics.rotation_kernels import (
    between,
    cross,
    direction,
    dot,
    length,
    minus,
    plus,
    rotated,
    rotation_at,
    scaled,
    unit,
    vector_at,
)
from marey_motion.kernels import compiled, inverse, product, put_rotation

# Bends in radians: up to the first, a limb bends about its hinge; from the second on, about its present axis.
HINGE_BEND_RAD, CLEAR_BEND_RAD = math.radians(15.0), math.radians(30.0)
# Sine of the inner angle below which the axis of a folded limb is drawn towards its hinge.
NEARLY_FOLDED = 0.05
# Least length of the part of a hinge's unit direction that is perpendicular to the upper bone. Below it, the hinge is
# not used.
SHORTEST_HINGE = 0.1
# The joint at the limb's end turns with the bones, keeps its rotation in the world, or gets a given rotation.
CARRIED, HELD, GIVEN = 0, 1, 2


@compiled
def bend_at(distance, first, second):
    """Compute the angle, in radians, between two joined bones whose outer ends are `distance` apart; π if straight.

    `first` and `second` are the lengths of the bones.
    """
    near = max(distance * distance - (first - second) ** 2, 0.0)
    far = max((first + second) ** 2 - distance * distance, 0.0)
    return 2.0 * math.atan2(math.sqrt(near), math.sqrt(far))


@compiled
def damped_bend(angle, goal, zone):
    """Damp the change of the angle between the bones, from `angle` to `goal`, near a straight or folded limb.

    In the last `zone` radians before the limb is straight, and in the last `zone` radians before it is folded, the
    change is weighted by a cubic that falls from 1 to 0 (Kovar et al. 2002, section 5.2). Returns the damped angle; all
    angles are in radians.
    """
    if goal < angle and goal < zone:
        return math.pi - damped_bend(math.pi - angle, math.pi - goal, zone)
    if goal <= angle or zone <= 0.0:
        return goal
    return angle + _weighed(goal, zone) - _weighed(angle, zone)


@compiled
def _weighed(angle, zone):
    into = min(1.0, max(0.0, (angle - (math.pi - zone)) / zone))
    return min(angle, math.pi - zone) + zone * (into - into**3 + 0.5 * into**4)


@compiled
def _bent(upper, fore, goal, hinge):
    """Compute the vector of the lower bone after the limb is bent so that the angle between its bones is `goal`.

    `upper` and `fore` are the vectors from the middle joint to both ends of the limb; `hinge` is the direction about
    which a straight limb bends, zero if unknown.
    """
    back, way = direction(upper), direction(fore)
    axis = cross(back, way)
    hinge = minus(hinge, scaled(back, dot(hinge, back)))
    if length(hinge) > SHORTEST_HINGE:
        hinge = direction(hinge)
        side = cross(back, hinge)
        turn = _turn_from_hinge(dot(axis, hinge), dot(axis, side), dot(back, way), math.pi - goal)
        axis = plus(scaled(hinge, math.cos(turn)), scaled(side, math.sin(turn)))
    else:
        axis = direction(minus(axis, scaled(back, dot(axis, back))))
    across = cross(axis, back)
    size = length(fore)
    return plus(scaled(back, size * math.cos(goal)), scaled(across, size * math.sin(goal)))


@compiled
def _turn_from_hinge(along, across, cosine, goal):
    """Compute the angle, about the upper bone, from a limb's hinge to the axis about which the limb is to bend.

    `goal` is the desired bend in radians. A nearly straight limb, even a little overstretched, bends about its hinge
    and keeps an existing bend to the side. A bent limb continues to bend about the axis of its present bend.

    Parameters
    ----------
    along, across : components of the current axis of the bend, along the hinge and across the hinge; the length of the
        axis is the sine of the bend
    cosine : cosine of the current angle between the bones
    """
    sine = math.hypot(along, across)
    if cosine > 0.0:  # folded, not straight
        along += max(0.0, NEARLY_FOLDED - sine)
    now = math.atan2(sine, -cosine)
    measured = math.atan2(across, along)
    hinged = math.asin(now * math.sin(measured) / max(now, goal, 1e-12))
    share = min(1.0, max(0.0, (now - HINGE_BEND_RAD) / (CLEAR_BEND_RAD - HINGE_BEND_RAD)))
    return hinged + share * share * (3.0 - 2.0 * share) * (measured - hinged)


@compiled
def _reach(limb, body, offsets, root, local, target, rotation, work):
    """Turn the joints of the limb in one pose, `local` (K, 4), so that its tip reaches `target`.

    The other parameters are those of `reach_frames`, for one frame; `work` has arrays for intermediate results.
    """
    place_joints(body.parents, offsets, root, local, work.spins, work.places)
    spin = rotation_at(work.spins, limb.end)
    if limb.ending == GIVEN:
        spin = rotation
    tip = vector_at(work.places, limb.end)
    lever = rotated(spin, (limb.offset[0], limb.offset[1], limb.offset[2]))
    if limb.ending == CARRIED:
        tip = plus(tip, lever)
    else:
        target = minus(target, lever)
    start, middle = vector_at(work.places, limb.start), vector_at(work.places, limb.middle)
    upper, fore = minus(start, middle), minus(tip, middle)
    first, second = length(upper), length(fore)
    way = minus(target, start)
    distance = min(max(length(way), abs(first - second)), first + second)
    now = bend_at(length(minus(tip, start)), first, second)
    goal = damped_bend(now, bend_at(distance, first, second), limb.damping_zone)
    hinge = rotated(rotation_at(work.spins, limb.middle), (limb.hinge[0], limb.hinge[1], limb.hinge[2]))
    bent = _bent(upper, fore, goal, hinge)
    opening = between(direction(fore), direction(bent))
    aim = between(direction(minus(plus(middle, bent), start)), direction(way))
    _turn(body, work, local, limb.start, aim)
    _turn(body, work, local, limb.middle, opening)
    if limb.ending != CARRIED:
        above = rotation_at(work.spins, body.parents[limb.end])
        put_rotation(local, limb.end, unit(product(inverse(product(product(aim, opening), above)), spin)))


@compiled
def _turn(body, work, local, k, turn):
    """Rotate joint k of the pose `local` by `turn`, a rotation about world axes.

    `turn` was computed for the pose before any joint of the limb was turned. In that pose, `work.spins` are the
    rotations of the joints in the world.
    """
    parent = body.parents[k]
    spin = product(turn, rotation_at(work.spins, k))
    if parent >= 0:
        spin = product(inverse(rotation_at(work.spins, parent)), spin)
    put_rotation(local, k, unit(spin))


@compiled
def reach_frames(limb, body, targets, target_rotations, roots, rotations, work):
    """Turn the joints of a limb in each frame so that its tip reaches a target; change `rotations` (F, K, 4) in place.

    `targets` (F or 1, 3) are in metres in the world, and `roots` (F, 3) are the positions of the root. If `limb.ending`
    is GIVEN, the last joint of the limb gets the rotations `target_rotations` (F or 1, 4) in the world; otherwise,
    these rotations are not used.
    """
    for f in range(rotations.shape[0]):
        target = vector_at(targets, min(f, targets.shape[0] - 1))
        rotation = rotation_at(target_rotations, min(f, target_rotations.shape[0] - 1))
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        _reach(limb, body, offsets, roots[f], rotations[f], target, rotation, work)


@compiled
def undamped_reach(starts, firsts, seconds, zone):
    """Compute the greatest distances (F,), in metres, that a limb can reach without damping.

    `starts` (F,) are the current distances between the ends of the limb; `firsts` and `seconds` (F,) are the lengths of
    its bones, all in metres; `zone` is the damping zone in radians. A limb that is already straighter than the zone
    allows keeps its current distance.
    """
    reach = np.empty(starts.shape[0])
    for f in range(starts.shape[0]):
        first, second = firsts[f], seconds[f]
        bend = max(bend_at(starts[f], first, second), math.pi - zone)
        reach[f] = math.sqrt(max(first * first + second * second - 2.0 * first * second * math.cos(bend), 0.0))
    return reach
