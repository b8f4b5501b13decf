"""The canonical frame of a motion: it begins where the axes cross, and faces +z."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.alignment.aligned import Placement
from marey_motion.kinematics import forward_directions, headings
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion

Floats = NDArray[np.float64]


def to_canonical(motion: Motion, body: MatchingBody, *, keep_height: bool = True) -> tuple[Motion, Placement]:
    """The motion turned and moved as a whole so that its first frame stands at x = z = 0 and faces +z.

    Where it faces is what hips and shoulders say together; where they say nothing in the first frame, the first frame
    counts in which they do.

    Parameters
    ----------
    keep_height : leave heights above the floor as they are; else the root begins at y = 0, too

    Raises `MotionError` when hips and shoulders never tell a direction.
    """
    directions = forward_directions(motion.positions(body.skeleton), body.lefts, body.rights)
    x, y, z = (float(coordinate) for coordinate in motion.root_translations[0])
    placement = Placement(float(headings(directions[:1])[0]), x, z, 0.0 if keep_height else y)
    moved = motion._replace(root_translations=motion.root_translations - _origin(placement))
    return _turned(moved, -placement.heading_rad), placement


def placed(motion: Motion, placement: Placement) -> Motion:
    """A motion of the canonical frame where it was: the inverse of `to_canonical`."""
    turned = _turned(motion, placement.heading_rad)
    return turned._replace(root_translations=turned.root_translations + _origin(placement))


def _origin(placement: Placement) -> Floats:
    return np.array((placement.x, placement.y, placement.z))


def _turned(motion: Motion, angle_rad: float) -> Motion:
    """The motion turned to the left about the vertical through the origin."""
    turn = quaternions.from_axis_angle((0.0, 1.0, 0.0), angle_rad)
    rotations = motion.rotations.copy()
    rotations[:, 0] = quaternions.multiply(turn, rotations[:, 0])
    moved = quaternions.rotate_vectors(turn, motion.root_translations)
    return motion._replace(root_translations=np.asarray(moved, dtype=np.float64), rotations=rotations)
