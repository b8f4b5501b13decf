"""Constraints on a motion: where a joint or the body is, how it is turned, or when a keyframe is reached.

Positions and directions are in the world. The error of each constraint is divided by the tolerance of the constraint
and weighted before the errors of several constraints are added up.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, model_validator

from marey_schemas.base import Tagged
from marey_schemas.names import Label
from marey_schemas.old_units import in_centimetres, read_old_unit

Moment = Label | Annotated[float, Field(allow_inf_nan=False)]
"""Time in a motion: the label of a keyframe, `start`, `end`, or a canonical frame, which may be fractional."""

Joint = Annotated[Label, Field(description="Name of the joint, its own or its standard name.")]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Component = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
Tolerance = Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)]
"""Tolerance of a constraint, in the unit of its target: metres, degrees or seconds.

The smallest tolerance is finer than the accuracy of any motion capture. It is also large enough that squared errors,
divided by the tolerance, stay finite.
"""
Distance = Annotated[float, Field(ge=1e-5, le=1e4, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-36_000, le=36_000, allow_inf_nan=False)]


_Target = TypeVar("_Target", bound=tuple[float | None, ...])
_Vector = TypeVar("_Vector", bound=tuple[float, ...])


def _require_coordinate(target: _Target) -> _Target:
    if all(coordinate is None for coordinate in target):
        raise ValueError("give at least one coordinate of the target position")
    return target


def _require_length(vector: _Vector) -> _Vector:
    if not any(abs(component) > 1e-9 for component in vector):
        raise ValueError("at least one component must not be zero")
    return vector


Direction = Annotated[tuple[Component, Component, Component], AfterValidator(_require_length)]


class _SearchConstraint(Tagged):
    tag: ClassVar[str] = "type"
    at: Moment = Field(
        description="Time of the constraint: the label of a keyframe of the model, start, end, or a canonical frame."
    )
    weight: Positive = Field(1.0, description="Weight of the error of the constraint, relative to other constraints.")


class _PositionConstraint(_SearchConstraint):
    tolerance_m: Distance = Field(
        0.01, description="Distance from the target, in metres, that counts as an error of 1."
    )
    tolerance_cm: Tolerance | None = in_centimetres("tolerance_m")

    @model_validator(mode="after")
    def _read_centimetres(self) -> Self:
        read_old_unit(self, "tolerance_m", "tolerance_cm")
        return self


class _AngularConstraint(_SearchConstraint):
    tolerance_deg: Tolerance = Field(5.0, description="Angle to the target, in degrees, that counts as an error of 1.")


class JointPositionConstraint(_PositionConstraint):
    """Constraint that a joint is at a position."""

    type: Literal["joint_position"] = "joint_position"
    joint: Joint
    target_m: Annotated[
        tuple[Coordinate | None, Coordinate | None, Coordinate | None], AfterValidator(_require_coordinate)
    ] = Field(description="Target position (x, y, z) in the world, in metres; null for free coordinates.")


class JointOrientationConstraint(_AngularConstraint):
    """Constraint that a joint has a rotation in the world."""

    type: Literal["joint_orientation"] = "joint_orientation"
    joint: Joint
    rotation: Annotated[tuple[Component, Component, Component, Component], AfterValidator(_require_length)] = Field(
        description="Target rotation in the world, as a quaternion (w, x, y, z)."
    )


class LookDirectionConstraint(_AngularConstraint):
    """Constraint that an axis of a joint points in a direction, or at a point."""

    type: Literal["look_direction"] = "look_direction"
    joint: Joint
    direction: Direction | None = Field(
        None, description="Target direction (x, y, z) in the world; an alternative to `point_m`."
    )
    point_m: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="Target point (x, y, z) in the world, in metres, instead of a direction."
    )
    axis: Direction = Field(
        (0.0, 0.0, 1.0),
        description="Axis, in the joint's own frame, that must point in the direction or at the point.",
    )

    @model_validator(mode="after")
    def _check_target(self) -> Self:
        if (self.direction is None) == (self.point_m is None):
            raise ValueError("give exactly one of direction and point_m")
        return self


class RootPositionConstraint(_PositionConstraint):
    """Constraint that the body is at a position on the ground."""

    type: Literal["root_position"] = "root_position"
    target_m: Annotated[tuple[Coordinate | None, Coordinate | None], AfterValidator(_require_coordinate)] = Field(
        description="Target position (x, z) on the ground, in metres; null for free coordinates."
    )


class RootHeadingConstraint(_AngularConstraint):
    """Constraint that the body faces a heading on the ground."""

    type: Literal["root_heading"] = "root_heading"
    heading_deg: Degrees = Field(description="Target heading in degrees: 0 along +z, positive to the left.")


class KeyframeTimeConstraint(_SearchConstraint):
    """Constraint that a keyframe is reached at a given time, counted from the beginning of the motion."""

    type: Literal["keyframe_time"] = "keyframe_time"
    seconds: float = Field(ge=0, le=1e6, allow_inf_nan=False, description="Seconds after the beginning of the motion.")
    tolerance_s: Tolerance = Field(0.05, description="Deviation in seconds that counts as an error of 1.")


SearchConstraint = Annotated[
    JointPositionConstraint
    | JointOrientationConstraint
    | LookDirectionConstraint
    | RootPositionConstraint
    | RootHeadingConstraint
    | KeyframeTimeConstraint,
    Field(discriminator="type"),
]
