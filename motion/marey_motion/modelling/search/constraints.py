"""Constraints on a motion at a moment: position or orientation of a joint, place and heading of the body, and time.

A moment is the label of a keyframe of the model, `start`, `end`, or a canonical frame, which may be a fraction.
Positions and directions are in the world; a `Placement` gives the model's canonical frame in it, at its origin by
default. Each constraint has a tolerance sigma, the error that counts as 1, and a weight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, radians

from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import MotionPrimitive
from marey_schemas.options.searching import CONSTRAINT_WEIGHT, LOOK_AXIS, TOLERANCE_DEG, TOLERANCE_M, TOLERANCE_S

Moment = str | float
Coordinates = tuple[float | None, float | None, float | None]
Vector = tuple[float, float, float]
Rotation = tuple[float, float, float, float]

START, END = "start", "end"
TOLERANCE_RAD = radians(TOLERANCE_DEG)


class InvalidConstraint(MotionError):
    """The constraint is invalid, or the model lacks the joint or keyframe it names."""

    default_code = "constraint-invalid"


@dataclass(frozen=True)
class JointPosition:
    """Position of a joint.

    Parameters
    ----------
    joint : by its own name or its standard name
    at : moment
    target_m : (x, y, z) metres; None if the coordinate is free
    tolerance_m, weight : positive
    """

    joint: str
    at: Moment
    target_m: Coordinates
    tolerance_m: float = TOLERANCE_M
    weight: float = CONSTRAINT_WEIGHT

    def __post_init__(self) -> None:
        known = [value for value in self.target_m if value is not None]
        _require(len(self.target_m) == 3 and bool(known), "a position needs at least one of x, y and z", "target_m")
        _require(all(map(isfinite, known)), "coordinates are finite numbers", "target_m")
        _require_positive(tolerance_m=self.tolerance_m, weight=self.weight)


@dataclass(frozen=True)
class JointOrientation:
    """Orientation of a joint; the error is the angle between the target and the joint's rotation, about any axis.

    Parameters
    ----------
    rotation : (w, x, y, z) in the world, of any length but zero
    """

    joint: str
    at: Moment
    rotation: Rotation
    tolerance_rad: float = TOLERANCE_RAD
    weight: float = CONSTRAINT_WEIGHT

    def __post_init__(self) -> None:
        _require_direction(self.rotation, 4, "rotation")
        _require_positive(tolerance_rad=self.tolerance_rad, weight=self.weight)


@dataclass(frozen=True)
class LookDirection:
    """Direction, or point, that an axis of a joint points at; the error is the angle between them.

    Parameters
    ----------
    direction : (x, y, z) in the world, of any length but zero
    point_m : (x, y, z) metres, in place of a direction
    axis : (x, y, z) in the joint's own frame
    """

    joint: str
    at: Moment
    direction: Vector | None = None
    point_m: Vector | None = None
    axis: Vector = LOOK_AXIS
    tolerance_rad: float = TOLERANCE_RAD
    weight: float = CONSTRAINT_WEIGHT

    def __post_init__(self) -> None:
        _require((self.direction is None) != (self.point_m is None), "give a direction or a point", "direction")
        if self.direction is not None:
            _require_direction(self.direction, 3, "direction")
        if self.point_m is not None:
            _require(len(self.point_m) == 3 and all(map(isfinite, self.point_m)), "a point has x, y, z", "point_m")
        _require_direction(self.axis, 3, "axis")
        _require_positive(tolerance_rad=self.tolerance_rad, weight=self.weight)


@dataclass(frozen=True)
class RootPosition:
    """Position of the pelvis over the ground.

    Parameters
    ----------
    target_m : (x, z) metres; None if the coordinate is free
    """

    at: Moment
    target_m: tuple[float | None, float | None]
    tolerance_m: float = TOLERANCE_M
    weight: float = CONSTRAINT_WEIGHT

    def __post_init__(self) -> None:
        known = [value for value in self.target_m if value is not None]
        _require(len(self.target_m) == 2 and bool(known), "a place on the ground needs x or z", "target_m")
        _require(all(map(isfinite, known)), "coordinates are finite numbers", "target_m")
        _require_positive(tolerance_m=self.tolerance_m, weight=self.weight)


@dataclass(frozen=True)
class RootHeading:
    """Heading of the body on the ground, given by its hips and shoulders.

    Parameters
    ----------
    heading_rad : 0 along +z, positive to the left
    """

    at: Moment
    heading_rad: float
    tolerance_rad: float = TOLERANCE_RAD
    weight: float = CONSTRAINT_WEIGHT

    def __post_init__(self) -> None:
        _require(isfinite(self.heading_rad), "a heading is a finite number", "heading_rad")
        _require_positive(tolerance_rad=self.tolerance_rad, weight=self.weight)


@dataclass(frozen=True)
class KeyframeTime:
    """Time from the motion's beginning to a moment.

    Parameters
    ----------
    seconds : since the first canonical frame, not negative
    """

    at: Moment
    seconds: float
    tolerance_s: float = TOLERANCE_S
    weight: float = CONSTRAINT_WEIGHT

    def __post_init__(self) -> None:
        _require(isfinite(self.seconds) and self.seconds >= 0, "a time is not negative", "seconds")
        _require_positive(tolerance_s=self.tolerance_s, weight=self.weight)


Constraint = JointPosition | JointOrientation | LookDirection | RootPosition | RootHeading | KeyframeTime


def tolerance_of(constraint: Constraint) -> float:
    """Look up the tolerance sigma of a constraint.

    Parameters
    ----------
    constraint : constraint    any kind

    Returns
    -------
    float    metres, radians or seconds
    """
    match constraint:
        case JointPosition() | RootPosition():
            return constraint.tolerance_m
        case KeyframeTime():
            return constraint.tolerance_s
        case _:
            return constraint.tolerance_rad


def frame_at(primitive: MotionPrimitive, at: Moment) -> float:
    """Convert a moment to a canonical frame.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    at : str or float    the moment

    Returns
    -------
    float    canonical frame

    Raises
    ------
    InvalidConstraint    naming the existing keyframes
    """
    last = primitive.frame_count - 1
    if isinstance(at, str):
        moments: Mapping[str, int] = {START: 0, END: last, **primitive.keyframes}
        if at not in moments:
            known = ", ".join(moments)
            raise InvalidConstraint(f"{primitive.name} has no keyframe {at!r}; it has {known}", where="at")
        return float(moments[at])
    if not 0 <= at <= last:
        raise InvalidConstraint(f"canonical frame {at:g} is not within 0 to {last}", where="at")
    return float(at)


def joint_index(primitive: MotionPrimitive, name: str, standard_joints: Mapping[str, int]) -> int:
    """Find a joint by its name or its standard name.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    name : str    either name
    standard_joints : mapping of str to int    joint index by standard name

    Returns
    -------
    int    joint index

    Raises
    ------
    UnknownJoint    if neither name exists
    """
    if name not in primitive.skeleton and name in standard_joints:
        return standard_joints[name]
    return primitive.skeleton.index_of(name)


def _require(holds: bool, message: str, where: str) -> None:
    if not holds:
        raise InvalidConstraint(message, where=where)


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        _require(isfinite(value) and value > 0, f"{value} is not positive", name)


def _require_direction(values: tuple[float, ...], count: int, where: str) -> None:
    sound = len(values) == count and all(map(isfinite, values)) and any(abs(value) > 1e-9 for value in values)
    _require(sound, f"{count} finite numbers are needed, not all of them zero", where)
