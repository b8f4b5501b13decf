"""Commands of an edit that use inverse kinematics.

Joints are given by their own names or by standard ones, such as `left_wrist`. Positions (in metres) and rotations (unit
quaternions w, x, y, z) are in the world; offsets and axes are in the joint's own frame.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from marey_schemas.base import Options, Request, Tagged
from marey_schemas.editing.commands import WHOLE_OR_RANGE, Axis, Examples, Frames, NamedCommand, Seconds, Shift
from marey_schemas.names import JointName
from marey_schemas.options.contacts import TOE_SPEED_M_S

MOST_CONSTRAINTS = 256

Axes = Literal["x", "y", "z", "xy", "xz", "yz", "xyz"]
Solver = Literal["auto", "ccd", "two_bone", "least_squares"]

Quaternion = tuple[float, float, float, float]


def _require_rotation(q: Quaternion) -> Quaternion:
    if not 0.99 <= sum(component**2 for component in q) <= 1.01:
        raise ValueError("a rotation must be a quaternion (w, x, y, z) of length 1")
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
        raise ValueError(f"the least angle, {angles[0]}, is greater than the greatest angle, {angles[1]}")
    return angles


AngleRange = Annotated[tuple[HalfTurn, HalfTurn], AfterValidator(_require_range)]


class _Constraint(Tagged):
    tag: ClassVar[str] = "kind"
    joint: JointName
    frames: Frames | None = Field(None, description=WHOLE_OR_RANGE)
    top: JointName | None = Field(
        None,
        description="The highest joint of the chain that may turn; absent: the upper joint of the limb for a "
        "wrist or an ankle, the joint below the root for other joints.",
    )
    weight: float = Field(
        1.0,
        gt=0,
        le=1e6,
        allow_inf_nan=False,
        description="Weight of the constraint, relative to other constraints that it contradicts.",
    )


class PositionConstraint(_Constraint):
    """Constraint on the position of a joint, or of a point fixed to a joint.

    By default, the position in the first frame of the range is kept.
    """

    kind: Literal["position"] = "position"
    point_m: Shift | None = Field(
        None,
        description="Target position in the world, in metres. Without it and "
        "`shift_m`: the position in the first frame of the range.",
    )
    shift_m: Shift | None = Field(
        None, description="Shift of the joint from its position in each frame, in metres; an alternative to `point_m`."
    )
    axes: Axes = Field("xyz", description="Coordinates that are constrained.")
    offset_m: Shift = Field(
        (0.0, 0.0, 0.0), description="Offset of the constrained point from the joint, in the joint's frame."
    )
    pole_m: Shift | None = Field(
        None,
        description="Point in the world, in metres, to which the elbow or knee is directed; absent: elbow and knee "
        "stay near their side in the source pose. Only for a wrist or ankle that is constrained in all axes.",
    )

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if self.point_m is not None and self.shift_m is not None:
            raise ValueError(
                "give point_m or shift_m, not both; if neither is given, the joint keeps its position in the first "
                "frame"
            )
        return self


class OrientationConstraint(_Constraint):
    """Constraint on the orientation of a joint in the world.

    By default, the orientation in the first frame of the range is kept.
    """

    kind: Literal["orientation"] = "orientation"
    rotation: Rotation | None = Field(
        None,
        description="Target rotation in the world, as a unit quaternion (w, x, y, z); absent: the rotation "
        "in the first frame of the range.",
    )


class LookAtConstraint(_Constraint):
    """Constraint that an axis of a joint, such as the direction of view of the head, points at a target."""

    kind: Literal["look_at"] = "look_at"
    point_m: Shift
    axis: Axis | None = Field(
        None,
        description="The direction, in the joint's frame, that must point at the target. Absent: for joints of "
        "head and trunk, the direction that they face; for limbs, the direction of the bone.",
    )
    offset_m: Shift = Field((0.0, 0.0, 0.0), description="Offset of the eye from the joint, in the joint's frame.")


AnyConstraint = Annotated[PositionConstraint | OrientationConstraint | LookAtConstraint, Field(discriminator="kind")]


class _Limit(Tagged):
    tag: ClassVar[str] = "kind"


class HingeLimit(_Limit):
    """Limit of the angle of a joint that turns about its swing axis alone, such as a knee or an elbow."""

    kind: Literal["hinge"] = "hinge"
    joint: JointName
    angle_deg: AngleRange = Field(
        description="Least and greatest angle in degrees. For knees and elbows, the angle is the bend: 0 in a "
        "straight limb, positive in the natural direction on every skeleton. For other joints, it is the angle "
        "from the rest pose."
    )


class ConeLimit(_Limit):
    """Limit of a bone to an elliptical cone about its direction in the rest pose."""

    kind: Literal["cone"] = "cone"
    joint: JointName
    swing_deg: tuple[Opening, Opening] = Field(
        description="Greatest swing of the bone in degrees: about the swing axis, and about the axis orthogonal "
        "to swing axis and bone."
    )
    twist_deg: AngleRange = Field((-180.0, 180.0), description="Least and greatest twist about the bone, in degrees.")


AnyLimit = Annotated[HingeLimit | ConeLimit, Field(discriminator="kind")]


class Constrain(NamedCommand):
    """Meet constraints in ranges of frames by inverse kinematics; changes are blended in and out with B-splines."""

    examples: ClassVar[Examples] = (
        {"constraints": [{"kind": "position", "joint": "LeftHand", "frames": [40, 50], "shift_m": [0.0, 0.05, 0.02]}]},
    )
    command: Literal["constrain"] = "constrain"
    constraints: tuple[AnyConstraint, ...] = Field(min_length=1, max_length=MOST_CONSTRAINTS)
    solver: Solver = Field(
        "auto", description="Solver; auto: closed form for limbs, damped least squares for everything else."
    )
    blend_s: Seconds = Field(
        0.3, description="Seconds before and after the range in which the motion is blended; 0: none."
    )
    stretch_damping_deg: float = Field(
        40.0,
        ge=0,
        le=90,
        allow_inf_nan=False,
        description="Angle before full extension, and before a full fold, at which the damping of an elbow or knee "
        "begins, in degrees (closed form only). Targets near full reach are missed by a few millimetres, targets close "
        "to the shoulder or hip by up to a few centimetres; 0: none, limbs may snap straight.",
    )
    root_moves: bool = Field(False, description="Also shift the root (least squares only).")
    limits: tuple[AnyLimit, ...] = Field((), max_length=MOST_CONSTRAINTS, description="Limits of the joints' angles.")
    stiffness: dict[JointName, Annotated[float, Field(ge=0, lt=1)]] = Field(
        default_factory=dict,
        max_length=MOST_CONSTRAINTS,
        description="Stiffness of joints, by name; 0: turns freely, near 1: hardly turns.",
    )


class FootContact(Request):
    """Range of frames in which a foot is in contact with the ground."""

    foot: Literal["left", "right"]
    frames: Frames


class PlantOptions(Options):
    """Options for the detection of contacts of the feet, and for the blending before and after each contact."""

    speed_m_s: float = Field(
        TOE_SPEED_M_S,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Greatest speed of a toe or heel in contact, in metres per second.",
    )
    blend_s: Seconds = Field(
        0.15,
        description="Seconds before and after a contact in which the motion of the foot is blended. If a leg is too "
        "short, the body is also lowered a little, beginning up to three times this time before the contact, and "
        "ending up to three times this time after it.",
    )
    knee_damping_deg: float = Field(
        10.0,
        ge=0,
        le=90,
        allow_inf_nan=False,
        description="Angle before full extension at which the damping of a stretching knee begins, in degrees.",
    )


class PlantFeet(NamedCommand, PlantOptions):
    """Keep feet in place while they are in contact with the ground."""

    examples: ClassVar[Examples] = ({},)
    command: Literal["plant_feet"] = "plant_feet"
    contacts: tuple[FootContact, ...] | None = Field(
        None,
        max_length=100_000,
        description="Contacts of the feet; absent: detected by the speed of the feet. Contacts of one foot do not "
        "overlap.",
    )

    @model_validator(mode="after")
    def _check_contacts(self) -> Self:
        for foot in ("left", "right"):
            ranges = sorted((one.frames for one in self.contacts or () if one.foot == foot), key=lambda each: each[0])
            for (start, stop), (then, _) in pairwise(ranges):
                if stop is None or then < stop:
                    raise ValueError(
                        f"contacts: two contacts of the {foot} foot overlap at frame {then}, the first begins at "
                        f"frame {start}; join them, or end the first one earlier"
                    )
        return self


ConstraintCommand = Constrain | PlantFeet
"""Every command of this module, in the order of the reference page."""
