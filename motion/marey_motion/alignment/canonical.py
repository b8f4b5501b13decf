"""The canonical frame of a motion: it begins at the origin of the ground and faces +z."""

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

    The joint that carries the body is placed there: the root, except where that is a static reference on the floor.
    Such a reference keeps its rotations and is moved along; translations of joints between the two are merged into
    those of the root. The facing direction comes from hips and shoulders; where it is undefined in the first frame, the
    first frame with a direction counts.

    Parameters
    ----------
    motion : Motion    F frames
    body : MatchingBody    body of its skeleton
    keep_height : bool    leave heights above the floor as they are; else the body begins at y = 0, too

    Returns
    -------
    motion : Motion    F frames in the canonical frame
    placement : Placement    input of `placed`

    Raises
    ------
    MotionError    when no frame has a facing direction
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
    """Move a motion of the canonical frame to its original place: the inverse of `to_canonical`.

    Parameters
    ----------
    motion : Motion    F frames in the canonical frame
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
    """Make the rotation by an angle to the left about the vertical."""
    return np.asarray(quaternions.from_axis_angle((0.0, 1.0, 0.0), angle_rad), dtype=np.float64)


def _carried(motion: Motion, skeleton: Skeleton, carrier: int, turn: Floats, places: AnyFloats) -> Motion:
    """Place the joint `carrier` of a motion at `places` (F, 3), turned in the world by `turn`."""
    spins = quaternions.multiply(turn, spins_of(motion, skeleton, carrier))
    return carried_at(motion, skeleton, carrier, np.asarray(places, np.float64), np.asarray(spins, np.float64))
