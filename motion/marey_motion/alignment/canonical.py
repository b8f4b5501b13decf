"""Conversion of motions to canonical coordinates, in which they begin at the origin of the ground and face +z."""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.kinematics import forward_directions, headings
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.root_carrier import carried_at, spins_of
from marey_motion.skeleton import Skeleton


def to_canonical(motion: Motion, body: MatchingBody, *, keep_height: bool = True) -> tuple[Motion, Placement]:
    """Rotate and move a motion as a whole so that its first frame is at x = z = 0 and faces +z.

    The joint placed at the origin is the one that carries the body: the root, unless the root is a static reference on
    the floor. Such a root keeps its rotations and moves with the body; translations of the joints between the root and
    the carrying joint are merged into the root's translation. The facing direction is computed from hips and shoulders,
    in the first frame in which it is defined.

    Parameters
    ----------
    motion : Motion    F frames
    body : MatchingBody    body of its skeleton
    keep_height : bool    whether heights above the floor stay unchanged; if False, the body also begins at y = 0

    Returns
    -------
    motion : Motion    F frames in canonical coordinates
    placement : Placement    original position and heading, input of `placed`

    Raises
    ------
    MotionError    if no frame has a facing direction
    """
    positions = motion.positions(body.skeleton)
    directions = forward_directions(positions, body.lefts, body.rights)
    carrier = positions[:, body.carrier]
    x, y, z = (float(coordinate) for coordinate in carrier[0])
    placement = Placement(float(headings(directions[:1])[0]), x, z, 0.0 if keep_height else y, body.carrier)
    turn = _turn(-placement.heading_rad)
    places = quaternions.rotate_vectors(turn, carrier - _origin(placement))
    return _carried(motion, body.skeleton, body.carrier, turn, places), placement


def placed(motion: Motion, placement: Placement, skeleton: Skeleton) -> Motion:
    """Move a motion from canonical coordinates to its original place: the inverse of `to_canonical`.

    Parameters
    ----------
    motion : Motion    F frames in canonical coordinates
    placement : Placement    result of `to_canonical`
    skeleton : Skeleton    its skeleton

    Returns
    -------
    Motion    F frames in the world
    """
    turn = _turn(placement.heading_rad)
    carrier = motion.positions(skeleton)[:, placement.joint]
    places = quaternions.rotate_vectors(turn, carrier) + _origin(placement)
    return _carried(motion, skeleton, placement.joint, turn, places)


def _origin(placement: Placement) -> Floats:
    return np.array((placement.x, placement.y, placement.z))


def _turn(angle_rad: float) -> Floats:
    """Make the rotation by an angle about the vertical axis, positive to the left."""
    return np.asarray(quaternions.from_axis_angle((0.0, 1.0, 0.0), angle_rad), dtype=np.float64)


def _carried(motion: Motion, skeleton: Skeleton, carrier: int, turn: Floats, places: AnyFloats) -> Motion:
    """Move a joint to `places` (F, 3) and rotate it by `turn` (4,) in the world; the body moves with this joint."""
    spins = quaternions.multiply(turn, spins_of(motion, skeleton, carrier))
    return carried_at(motion, skeleton, carrier, np.asarray(places, np.float64), np.asarray(spins, np.float64))
