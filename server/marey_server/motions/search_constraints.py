"""Constraints as they are asked for, as what the models know."""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING

from marey_schemas import search as asked

if TYPE_CHECKING:
    from marey_motion.alignment.aligned import Placement
    from marey_motion.modelling.search.constraints import Constraint

CM = 0.01


def constraint_of(one: asked.SearchConstraint) -> Constraint:
    """Metres and radians for centimetres and degrees. Raises `MotionError` for what makes no sense."""
    from marey_motion.modelling.search import constraints as known

    match one:
        case asked.JointPositionConstraint():
            return known.JointPosition(one.joint, one.at, one.target_m, one.tolerance_cm * CM, one.weight)
        case asked.JointOrientationConstraint():
            return known.JointOrientation(one.joint, one.at, one.rotation, radians(one.tolerance_deg), one.weight)
        case asked.LookDirectionConstraint():
            tolerance = radians(one.tolerance_deg)
            return known.LookDirection(one.joint, one.at, one.direction, one.point_m, one.axis, tolerance, one.weight)
        case asked.RootPositionConstraint():
            return known.RootPosition(one.at, one.target_m, one.tolerance_cm * CM, one.weight)
        case asked.RootHeadingConstraint():
            return known.RootHeading(one.at, radians(one.heading_deg), radians(one.tolerance_deg), one.weight)
        case asked.KeyframeTimeConstraint():
            return known.KeyframeTime(one.at, one.seconds, one.tolerance_s, one.weight)


def placement_of(start: asked.StartPlacement) -> Placement:
    """Where the canonical frame lies."""
    from marey_motion.alignment.aligned import Placement

    return Placement(radians(start.heading_deg), start.x, start.z)
