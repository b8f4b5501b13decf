"""The commands of an edit that use inverse kinematics.

Joints are called by their own names or by standard ones, such as `left_wrist`. Positions are metres in the world,
rotations unit quaternions (w, x, y, z) in the world; offsets and axes are in the joint's own frame.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from marey_schemas.base import Request
from marey_schemas.editing.commands import WHOLE_OR_RANGE, Axis, Frames, Seconds, Shift
from marey_schemas.names import JointName

MOST_CONSTRAINTS = 256

Quaternion = tuple[float, float, float, float]


def _require_rotation(q: Quaternion) -> Quaternion:
    if not 0.99 <= sum(component**2 for component in q) <= 1.01:
        raise ValueError("a rotation is a unit quaternion (w, x, y, z)")
    return q


Rotation = Annotated[
    tuple[
        Annotated[float, Field(ge=-1.01, le=1.01, allow_inf_nan=False)],
        Annotated[float, Field(ge=-1.01, le=1.01, allow_inf_nan=False)],
        Annotated[float, Field(ge=-1.01, le=1.01, allow_inf_nan=False)],
        Annotated[float, Field(ge=-1.01, le=1.01, allow_inf_nan=False)],
    ],
    AfterValidator(_require_rotation),
]
HalfTurn = Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
Opening = Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)]


def _require_range(angles: tuple[float, float]) -> tuple[float, float]:
    if angles[0] > angles[1]:
        raise ValueError(f"the least angle {angles[0]} is greater than {angles[1]}")
    return angles


AngleRange = Annotated[tuple[HalfTurn, HalfTurn], AfterValidator(_require_range)]


class _Constraint(Request):
    joint: JointName
    frames: Frames | None = Field(None, description=WHOLE_OR_RANGE)
    top: JointName | None = Field(
        None,
        description="The highest joint that may turn; absent: of a wrist or an ankle the limb's, of others the one "
        "below the root.",
    )
    weight: float = Field(1.0, gt=0, le=1e6, allow_inf_nan=False, description="Where constraints contradict.")


class PositionConstraint(_Constraint):
    """A joint, or a point that it carries, is somewhere. Without a place or a shift it stays where it first is."""

    kind: Literal["position"]
    point_m: Shift | None = Field(None, description="The place.")
    shift_m: Shift | None = Field(None, description="Or how far from where it is in each frame.")
    axes: Literal["x", "y", "z", "xy", "xz", "yz", "xyz"] = Field("xyz", description="Coordinates that count.")
    offset_m: Shift = Field((0.0, 0.0, 0.0), description="From the joint to the point, in the joint's frame.")

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if self.point_m is not None and self.shift_m is not None:
            raise ValueError("point_m, shift_m: one of them, or neither to hold the joint where it first is")
        return self


class OrientationConstraint(_Constraint):
    """A joint is turned in a certain way. Without a rotation it stays as it first is."""

    kind: Literal["orientation"]
    rotation: Rotation | None = Field(None, description="Unit quaternion (w, x, y, z) in the world.")


class LookAtConstraint(_Constraint):
    """A joint looks, or points, at something."""

    kind: Literal["look_at"]
    point_m: Shift
    axis: Axis | None = Field(
        None, description="What looks, in the joint's frame; absent: of head and trunk the front, of limbs the bone."
    )
    offset_m: Shift = Field((0.0, 0.0, 0.0), description="From the joint to its eye, in the joint's frame.")


AnyConstraint = Annotated[PositionConstraint | OrientationConstraint | LookAtConstraint, Field(discriminator="kind")]


class HingeLimit(Request):
    """A joint turns about its swing axis alone, as knees and elbows do."""

    kind: Literal["hinge"]
    joint: JointName
    angle_deg: AngleRange = Field(description="Least and greatest angle from the rest pose.")


class ConeLimit(Request):
    """A joint's bone stays in an elliptical cone about where it is in the rest pose."""

    kind: Literal["cone"]
    joint: JointName
    swing_deg: tuple[Opening, Opening] = Field(description="How far about the swing axis, and across it.")
    twist_deg: AngleRange = Field((-180.0, 180.0), description="Least and greatest turn about the bone.")


AnyLimit = Annotated[HingeLimit | ConeLimit, Field(discriminator="kind")]


class Constrain(Request):
    """Meet constraints in ranges of frames by inverse kinematics, blended in and out with B-splines."""

    command: Literal["constrain"]
    constraints: tuple[AnyConstraint, ...] = Field(min_length=1, max_length=MOST_CONSTRAINTS)
    solver: Literal["auto", "ccd", "two_bone", "least_squares"] = Field(
        "auto", description="auto: closed form for limbs, damped least squares for everything else."
    )
    blend_s: Seconds = Field(0.3, description="Time before and after a range in which the motion may change; 0: none.")
    root_moves: bool = Field(False, description="Shift the root, too (least squares).")
    limits: tuple[AnyLimit, ...] = Field((), max_length=MOST_CONSTRAINTS, description="How far joints may turn.")
    stiffness: dict[JointName, Annotated[float, Field(ge=0, lt=1)]] = Field(
        default_factory=dict, max_length=MOST_CONSTRAINTS, description="0: turns freely, near 1: hardly."
    )


class FootContact(Request):
    """A range of frames in which a foot stands."""

    foot: Literal["left", "right"]
    frames: Frames


class PlantFeet(Request):
    """Keep feet where they stand."""

    command: Literal["plant_feet"]
    contacts: tuple[FootContact, ...] | None = Field(
        None, max_length=100_000, description="When feet stand; absent: found by their speed."
    )
    speed_m_s: float = Field(
        0.15, gt=0, le=100, allow_inf_nan=False, description="A toe or heel that stands is slower than this."
    )
    blend_s: Seconds = Field(
        0.15,
        description="Time before and after a contact in which the foot is blended. Where a leg is too short, the body "
        "comes down a little, within three times as long.",
    )
    knee_damping_deg: float = Field(
        10.0, ge=0, le=90, allow_inf_nan=False, description="How long before straight a stretching knee is damped."
    )
