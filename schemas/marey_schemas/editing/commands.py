"""The commands of an edit, each as a model; the field `command` names the command.

Frames count from 0. Ranges are half open; the stop null means the end of the clip. Lengths are in metres and times in
seconds. Angles are in degrees if the name of the field ends in `_deg`. Directions and positions are in the world, which
is right-handed with Y up.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from marey_schemas.base import Tagged, require_tag
from marey_schemas.documents.metrics import BuiltInMetric
from marey_schemas.names import ItemId, JointName
from marey_schemas.options.annotations import ContactOptions
from marey_schemas.options.perception import DEFAULT_METRIC

MOST_FRAME = 100_000_000
MOST_LISTED = 4096

Frame = Annotated[int, Field(ge=0, le=MOST_FRAME)]


def _require_order(frames: tuple[int, int | None]) -> tuple[int, int | None]:
    if frames[1] is not None and frames[1] <= frames[0]:
        raise ValueError(f"the stop, frame {frames[1]}, must be after the start, frame {frames[0]}")
    return frames


Frames = Annotated[tuple[Frame, Frame | None], AfterValidator(_require_order)]
Metres = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Shift = tuple[Metres, Metres, Metres]
Degrees = Annotated[float, Field(ge=-36_000, le=36_000, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=600, allow_inf_nan=False)]
Joints = Annotated[tuple[JointName, ...], Field(min_length=1, max_length=MOST_LISTED)]


def _require_direction(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(map(abs, axis)) < 1e-6:
        raise ValueError("axis: at least one of the three numbers must not be zero")
    return axis


Axis = Annotated[tuple[Metres, Metres, Metres], AfterValidator(_require_direction)]

WHOLE_OR_RANGE = "Half-open range of frames; absent: all."


Examples = tuple[dict[str, Any], ...]
EXAMPLE_SOURCE = "other"
"""Id of the second clip in the examples of commands that need two clips."""


def _show_examples(schema: dict[str, Any], model: type[NamedCommand]) -> None:
    require_tag(schema, model)
    schema["examples"] = [{"command": schema["properties"]["command"]["const"], **each} for each in model.examples]


class NamedCommand(Tagged):
    """Base of the commands of an edit. `examples` are parameters that are used to document and test the command."""

    model_config = ConfigDict(json_schema_extra=_show_examples)
    tag: ClassVar[str] = "command"
    examples: ClassVar[Examples]


# Frames and time


class Trim(NamedCommand):
    """Keep a range of frames, and remove all frames before and after it."""

    examples: ClassVar[Examples] = ({"start": 10, "stop": 170}, {"start": 3})
    command: Literal["trim"] = "trim"
    start: Frame = Field(0, description="The first frame to keep.")
    stop: Frame | None = Field(None, description="The frame after the last one to keep; absent: up to the end.")

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"the stop, frame {self.stop}, must be after the start, frame {self.start}")
        return self


class Split(NamedCommand):
    """Cut the motion into several clips; later commands of the edit apply to each of them."""

    examples: ClassVar[Examples] = ({"at": [60, 90]},)
    command: Literal["split"] = "split"
    at: tuple[Annotated[int, Field(ge=1, le=MOST_FRAME)], ...] = Field(
        min_length=1, max_length=1000, description="Cut before each of these frames, in increasing order."
    )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if any(after <= before for before, after in pairwise(self.at)):
            raise ValueError("at: the frames must be in increasing order, each only once")
        return self


class Concatenate(NamedCommand):
    """Append another clip of the same skeleton, with a blend where the clips meet."""

    examples: ClassVar[Examples] = (
        {"source": EXAMPLE_SOURCE},
        {"source": EXAMPLE_SOURCE, "place": "keep", "blend": "slerp", "blend_s": 0.5},
    )
    command: Literal["concatenate"] = "concatenate"
    source: ItemId = Field(description="The clip to append.")
    place: Literal["seam", "keep"] = Field(
        "seam",
        description="seam: the appended clip is turned and shifted on the ground, so that it continues where the "
        "motion before it ends; keep: the appended clip is not moved.",
    )
    blend: Literal["inertialise", "slerp"] = Field(
        "inertialise",
        description="Method of blending. inertialise: the difference where the clips meet decays in the appended "
        "clip, and no frame is lost; slerp: the end of the first clip is cross-faded with the start "
        "of the second, and these frames overlap.",
    )
    blend_s: Seconds = Field(0.3, description="Duration of the blend in seconds; 0: a hard cut.")
    keep_feet: bool = Field(
        True,
        description="Keep a foot in place that is in contact before and after the seam between the clips (only "
        "with `blend` inertialise), and keep all feet above their floors. false: only rotations and "
        "the path of the root are blended.",
    )


class Resample(NamedCommand):
    """Sample the motion at another frame rate."""

    examples: ClassVar[Examples] = ({"frame_rate_hz": 45.0},)
    command: Literal["resample"] = "resample"
    frame_rate_hz: float = Field(
        ge=0.1, le=100_000, allow_inf_nan=False, description="New frame rate, in frames per second."
    )


class Retime(NamedCommand):
    """Play the motion faster or slower, at the same frame rate."""

    examples: ClassVar[Examples] = ({"speed": 0.7},)
    command: Literal["retime"] = "retime"
    speed: float = Field(
        ge=0.01, le=100, allow_inf_nan=False, description="Speed factor; 2: twice as fast, in half the time."
    )


class CloseLoop(NamedCommand):
    """Change poses so that the last frame continues seamlessly with the first one."""

    examples: ClassVar[Examples] = ({}, {"in_place": True, "blend_s": 0.4})
    command: Literal["close_loop"] = "close_loop"
    in_place: bool = Field(
        False, description="Remove the travel and turn of one cycle, so that each cycle starts at the same place."
    )
    blend_s: Seconds | None = Field(
        None,
        description="Seconds from the start and from the end of the clip within which poses may change; absent: "
        "up to the middle.",
    )


class CutLoop(NamedCommand):
    """Find a cycle of a periodic motion, and blend two successive cycles into a loop without a seam.

    The loop begins at the origin and faces +z. It has the frame rate of the clip.
    """

    examples: ClassVar[Examples] = ({}, {"metric": "published/sigmoid"})
    command: Literal["cut_loop"] = "cut_loop"
    metric: BuiltInMetric = Field(
        DEFAULT_METRIC, description="Built-in perceptual metric by which frames a cycle apart are compared."
    )


# Where the body is


class Translate(NamedCommand):
    """Shift the whole motion in the world."""

    examples: ClassVar[Examples] = ({"shift_m": [1.0, 0.5, -2.0]},)
    command: Literal["translate"] = "translate"
    shift_m: Shift = Field(description="Shift in metres along x, y and z.")


class Rotate(NamedCommand):
    """Turn the whole motion about an axis of the world."""

    examples: ClassVar[Examples] = ({"angle_deg": 30.0}, {"angle_deg": -20.0, "axis": [1.0, 0.0, 0.5], "pivot": "body"})
    command: Literal["rotate"] = "rotate"
    angle_deg: Degrees = Field(
        description="Angle about `axis`, in degrees; about the vertical, positive is to the left."
    )
    axis: Axis = Field((0.0, 1.0, 0.0), description="Direction of the rotation axis; default: the vertical.")
    pivot: Literal["origin", "body"] = Field(
        "origin",
        description="The point that stays in place: the origin, or the ground under the body in the first frame.",
    )


class Face(NamedCommand):
    """Turn the whole motion about the vertical so that the body has a given heading in a frame."""

    examples: ClassVar[Examples] = ({"heading_deg": 45.0, "frame": 10},)
    command: Literal["face"] = "face"
    heading_deg: Degrees = Field(0.0, description="Heading in degrees; 0 faces +z, and positive is to the left.")
    frame: Frame = Field(
        0, description="The frame in which the body has this heading; its position in that frame does not change."
    )


class MoveToOrigin(NamedCommand):
    """Shift the whole motion on the ground so that the body is above the origin in a frame; heights do not change."""

    examples: ClassVar[Examples] = ({"frame": 20},)
    command: Literal["move_to_origin"] = "move_to_origin"
    frame: Frame = Field(0, description="The frame in which the body is above the origin.")


class Scale(NamedCommand):
    """Scale the path of the body, including its heights. The skeleton is a separate item and does not change."""

    examples: ClassVar[Examples] = ({"factor": 1.2, "translations": True},)
    command: Literal["scale"] = "scale"
    factor: float = Field(ge=1e-4, le=1e4, allow_inf_nan=False, description="Scale factor, about the origin.")
    translations: bool = Field(False, description="Also scale the translations of joints other than the root.")


SignedAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


class FlipAxes(NamedCommand):
    """Convert a motion recorded with other axes, such as Blender's Z up, to axes with Y up."""

    examples: ClassVar[Examples] = ({"up": "-x", "forward": "+y"},)
    command: Literal["flip_axes"] = "flip_axes"
    up: SignedAxis = Field("+z", description="The axis of the clip that points up before the conversion.")
    forward: SignedAxis = Field("-y", description="The axis that becomes +z; it is orthogonal to `up`.")

    @model_validator(mode="after")
    def _check_axes(self) -> Self:
        if self.up[1] == self.forward[1]:
            raise ValueError(
                f"up {self.up} and forward {self.forward} are directions of the same axis; choose two different axes"
            )
        return self


class FixDrift(NamedCommand):
    """Correct drift: spread a shift and a turn of the body over a range of frames; later frames get both in full."""

    examples: ClassVar[Examples] = (
        {"shift_m": [0.2, 0.0, -0.1], "turn_deg": 10.0, "frames": [20, 80], "profile": "smooth"},
    )
    command: Literal["fix_drift"] = "fix_drift"
    shift_m: Shift = Field(
        (0.0, 0.0, 0.0), description="Shift that the last frame of the range gets, in metres along x, y and z."
    )
    turn_deg: Degrees = Field(
        0.0,
        description="Turn about the vertical that the last frame of the range gets, in degrees, positive to the left.",
    )
    frames: Frames | None = Field(None, description=f"{WHOLE_OR_RANGE} The range has at least two frames.")
    profile: Literal["linear", "smooth"] = Field(
        "linear",
        description="Growth of the correction over the range. linear: by the same amount in each frame; "
        "smooth: slow at the start and the end.",
    )


# The ground

Sole = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
SOLE = (
    "Distance from the lowest joint or tip of a foot down to its sole, in metres; absent: estimated from the length of "
    "the leg."
)


class MoveToGround(NamedCommand):
    """Shift the whole motion vertically so that the ground is at height zero."""

    examples: ClassVar[Examples] = ({}, {"height_m": 0.1})
    command: Literal["move_to_ground"] = "move_to_ground"
    height_m: Metres | None = Field(
        None,
        description="Height of the ground before the command, in metres; absent: estimated from feet in contact.",
    )
    sole_m: Sole | None = Field(None, description=SOLE)


class FindGround(NamedCommand):
    """Estimate the height of the ground from feet in contact with it; the motion does not change."""

    examples: ClassVar[Examples] = ({},)
    command: Literal["find_ground"] = "find_ground"
    sole_m: Sole | None = Field(None, description=SOLE)


class FindContacts(NamedCommand, ContactOptions):
    """Find the frames in which feet are in contact with the ground; the motion does not change."""

    examples: ClassVar[Examples] = ({"speed_m_s": 0.4},)
    command: Literal["find_contacts"] = "find_contacts"
    height_limit_m: float | None = Field(
        0.1,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Greatest height above the ground of a foot in contact, in metres; null: any height.",
    )


# The pose


class Mirror(NamedCommand):
    """Swap left and right, using the skeleton's own symmetry."""

    examples: ClassVar[Examples] = ({},)
    command: Literal["mirror"] = "mirror"


class Smooth(NamedCommand):
    """Smooth rotations and translations over time; the first and last frame do not change."""

    examples: ClassVar[Examples] = (
        {},
        {"method": "gaussian", "joints": ["Head", "LeftArm"], "frames": [10, 90], "window_s": 0.3},
    )
    command: Literal["smooth"] = "smooth"
    method: Literal["savitzky_golay", "gaussian"] = Field(
        "savitzky_golay", description="Filter: savitzky_golay keeps peaks, gaussian flattens them."
    )
    window_s: float = Field(
        0.25,
        gt=0,
        le=60,
        allow_inf_nan=False,
        description="Width of the filter, in seconds: each frame becomes a weighted mean of the frames within this "
        "width.",
    )
    order: int = Field(
        3, ge=0, le=9, description="Degree of the polynomials of the filter savitzky_golay; other filters ignore it."
    )
    joints: Joints | None = Field(None, description="Joints to smooth; absent: all.")
    root_translation: bool = Field(True, description="Also smooth the path of the root.")
    keep_feet: bool = Field(
        True,
        description="Smooth the paths of the feet separately, so that contacts are kept and no foot sinks into its "
        "floor. false: the positions of the feet follow from the smoothed rotations.",
    )
    frames: Frames | None = Field(None, description=WHOLE_OR_RANGE)
    border_s: Seconds = Field(
        0.2, description="Seconds at either end of the range in which the change is blended in and out."
    )


class RotateJoint(NamedCommand):
    """Add a rotation to the motion of a joint in a range of frames; the rotation is blended in and out at the ends."""

    examples: ClassVar[Examples] = ({"joint": "LeftArm", "angle_deg": 20.0, "axis": [0.0, 1.0, 0.0], "space": "world"},)
    command: Literal["rotate_joint"] = "rotate_joint"
    joint: JointName = Field(description="Name of the joint.")
    angle_deg: Degrees = Field(
        description="Angle of the rotation, in degrees; smaller in the frames in which the change is blended in or out."
    )
    axis: Axis = Field(description="Direction of the rotation axis.")
    space: Literal["joint", "parent", "world"] = Field(
        "joint", description="Frame of reference of `axis`: the joint's own, its parent's, or the world's."
    )
    frames: Frames | None = Field(None, description=WHOLE_OR_RANGE)
    border_s: Seconds = Field(
        0.2, description="Seconds at either end of the range in which the change is blended in and out."
    )


class Paste(NamedCommand):
    """Replace the motion of joints by their motion in another clip, stretched in time to fit."""

    examples: ClassVar[Examples] = (
        {"source": EXAMPLE_SOURCE, "joints": ["LeftArm", "LeftForeArm"], "frames": [20, 80], "source_frames": [0, 40]},
    )
    command: Literal["paste"] = "paste"
    source: ItemId = Field(description="The clip to copy from.")
    joints: Joints = Field(description="Joints to copy. Both skeletons must have these joints, with the same axes.")
    source_frames: Frames | None = Field(None, description="Half-open range of frames to copy; absent: the whole clip.")
    frames: Frames | None = Field(None, description="Half-open range of frames to replace; absent: the whole motion.")
    border_s: Seconds = Field(
        0.2, description="Seconds at either end of the replaced range in which the copied motion is blended in and out."
    )


MotionCommand = (
    Trim
    | Split
    | Concatenate
    | Resample
    | Retime
    | CloseLoop
    | CutLoop
    | Translate
    | Rotate
    | Face
    | MoveToOrigin
    | Scale
    | FlipAxes
    | FixDrift
    | MoveToGround
    | FindGround
    | FindContacts
    | Mirror
    | Smooth
    | RotateJoint
    | Paste
)
"""Every command of this module, in the order of the reference page."""
