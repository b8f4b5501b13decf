"""What can be asked of annotations: to be proposed, to be changed by commands, and to cut clips."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, field_validator, model_validator

from marey_schemas.base import Request
from marey_schemas.names import MAX_NAME_LENGTH, ItemName, Message, Tag

MAX_FRAME = 2**31 - 1
MAX_COMMANDS = 1000

_NAME_FIELD = re.compile(r"\{(clip|label|number)(?::([1-9]))?\}")

Label = Annotated[str, StringConstraints(min_length=1, max_length=255)]
LayerName = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=r"^[^/\x00-\x1f\x7f]+$")]
JointName = Annotated[str, StringConstraints(min_length=1, max_length=1024)]
Frame = Annotated[int, Field(ge=0, le=MAX_FRAME)]
Seconds = Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=0, le=360, allow_inf_nan=False)]


# Proposals


class StepsProposal(Request):
    """Steps of a walk or run, from the contact of one foot to that of the other, named after the foot that swings."""

    method: Literal["steps"] = "steps"
    contact_speed_m_s: float = Field(
        0.5, gt=0, le=10, allow_inf_nan=False, description="A foot slower than this begins to stand."
    )
    shortest_s: Seconds = Field(0.2, description="Shorter steps get no label.")
    longest_s: Seconds = Field(1.5, description="Longer steps get no label.")
    shortest_m: float = Field(0.2, ge=0, le=10, allow_inf_nan=False, description="Way of the hips in a step.")
    most_turn_deg: Degrees = Field(45.0, description="Steps that turn the body more get no label.")
    most_aside_deg: Degrees = Field(45.0, description="Steps that lead further off where the body faces get no label.")
    standing_s: Seconds = Field(0.6, description="Both feet on the ground for so long: labelled `standing`.")

    @model_validator(mode="after")
    def _check_durations(self) -> Self:
        if self.longest_s <= self.shortest_s:
            raise ValueError("longest_s must be more than shortest_s")
        return self


class VelocityMinimaProposal(Request):
    """Movements from one minimum of the speed of joints to the next, with a keyframe `pause` at each minimum."""

    method: Literal["velocity_minima"] = "velocity_minima"
    joints: tuple[JointName, ...] = Field(
        (), max_length=256, description="Joints, by their own or their standard names, whose mean speed counts."
    )
    smoothing_s: float = Field(0.05, gt=0, le=10, allow_inf_nan=False, description="Deviation of the smoothing.")
    least_depth: float = Field(
        0.1, gt=0, le=1, allow_inf_nan=False, description="Depth of a minimum, as a share of the highest speed."
    )
    least_apart_s: float = Field(0.2, gt=0, le=3600, allow_inf_nan=False, description="Time between minima.")


class WristContactProposal(Request):
    """Reaches of a hand out of its rest and back, with a keyframe `contact` where it arrives at its far place."""

    method: Literal["wrist_contact"] = "wrist_contact"
    hand: Literal["left", "right", "either"] = Field("either", description="Either: the one that reaches farther.")
    least_reach_m: float = Field(0.2, gt=0, le=10, allow_inf_nan=False, description="Less is no reach.")
    arrived: float = Field(
        0.95, gt=0.25, le=1, allow_inf_nan=False, description="Share of the way at which a hand has arrived."
    )
    release: bool = Field(False, description="A keyframe `release` at the last frame at the far place, too.")


Proposal = Annotated[StepsProposal | VelocityMinimaProposal | WristContactProposal, Field(discriminator="method")]


class AnnotateParams(Request):
    """Parameters of `annotate`."""

    proposal: Proposal
    layer: LayerName | None = Field(None, description="Name of the layer; default: that of the method.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the annotations.")


class CutParams(Request):
    """Parameters of `cut`."""

    layer: LayerName | None = Field(None, description="Only annotations of this layer.")
    labels: tuple[Label, ...] = Field((), max_length=1000, description="Labels to cut out; none: all of them.")
    margin_before_s: Seconds = Field(0.0, description="Time before each segment that is taken along, where there is.")
    margin_after_s: Seconds = Field(0.0, description="Time after each segment that is taken along, where there is.")
    shortest_s: Seconds = Field(0.0, description="Shorter segments are left out.")
    longest_s: Annotated[float, Field(gt=0, le=86400, allow_inf_nan=False)] | None = Field(
        None, description="Longer segments are left out."
    )
    name: str = Field(
        "{clip}_{label}_{number:2}",
        min_length=1,
        max_length=MAX_NAME_LENGTH,
        description="Names of the pieces; {number:2} counts the segments of a label in a clip from 1, in two digits.",
    )
    by_label: bool = Field(False, description="Put the pieces of each label into a folder of its own.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the pieces.")

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        fields = {found.group(1) for found in _NAME_FIELD.finditer(name)}
        if fields != {"clip", "label", "number"}:
            raise ValueError("must have {clip}, {label} and {number} in it, so that no two pieces share a name")
        if set("{}/") & set(_NAME_FIELD.sub("", name)):
            raise ValueError("only {clip}, {label} and {number} (or {number:3} for three digits) may be in braces")
        return name

    @model_validator(mode="after")
    def _check_durations(self) -> Self:
        if self.longest_s is not None and self.longest_s < self.shortest_s:
            raise ValueError("longest_s must not be less than shortest_s")
        return self

    def piece_name(self, clip: str, label: str, number: int) -> str:
        """Name of a piece."""
        given = {"clip": clip, "label": label.replace("/", "-")}

        def text(found: re.Match[str]) -> str:
            name, digits = found.groups()
            return given[name] if name in given else str(number).zfill(int(digits or 1))

        return _NAME_FIELD.sub(text, self.name)


# Commands


class CreateSegment(Request):
    """Put the frames [start, end) under a label."""

    command: Literal["create_segment"]
    label: Label
    start: Frame
    end: Frame
    overwrite: bool = Field(False, description="Segments that are there give way; else they forbid it.")


class RemoveSegment(Request):
    """Leave the frames of a segment without a label."""

    command: Literal["remove_segment"]
    at: Frame = Field(description="Any frame of the segment.")


class SplitSegment(Request):
    """Cut a segment in two."""

    command: Literal["split_segment"]
    at: Frame = Field(description="First frame of the second part.")
    label: Label | None = Field(None, description="Of the second part; absent: that of the first.")


class MergeSegment(Request):
    """Make one of a segment and its neighbour, with the gap between them."""

    command: Literal["merge_segment"]
    at: Frame = Field(description="Any frame of the segment, whose label stays.")
    neighbour: Literal["next", "previous", "nearest"] = "next"


class MoveBoundary(Request):
    """Let a segment start or end at another frame; a neighbour at that edge follows or gives way."""

    command: Literal["move_boundary"]
    at: Frame = Field(description="Any frame of the segment.")
    edge: Literal["start", "end"]
    to: Frame


class RelabelSegment(Request):
    """Give a segment another label."""

    command: Literal["relabel_segment"]
    at: Frame = Field(description="Any frame of the segment.")
    label: Label


class AddKeyframe(Request):
    """Mark a frame."""

    command: Literal["add_keyframe"]
    label: Label
    frame: Frame


class MoveKeyframe(Request):
    """Mark another frame instead."""

    command: Literal["move_keyframe"]
    label: Label
    frame: Frame
    to: Frame


class RemoveKeyframe(Request):
    """Take a mark away."""

    command: Literal["remove_keyframe"]
    label: Label
    frame: Frame


class Clear(Request):
    """Take every segment and keyframe away."""

    command: Literal["clear"]


AnnotationCommand = Annotated[
    CreateSegment
    | RemoveSegment
    | SplitSegment
    | MergeSegment
    | MoveBoundary
    | RelabelSegment
    | AddKeyframe
    | MoveKeyframe
    | RemoveKeyframe
    | Clear,
    Field(discriminator="command"),
]


class AnnotationChange(Request):
    """Commands that are applied to an annotation one after another: all of them, or none."""

    commands: tuple[AnnotationCommand, ...] = Field(min_length=1, max_length=MAX_COMMANDS)
    message: Message = Field("", description="Shown in the history.")


# Exchange


class AnnotationImport(Request):
    """An annotation of a clip in one of the predecessor's forms: `sections`, or `semantic_annotation`."""

    document: dict[str, Any] = Field(description="The document, as the predecessor keeps or exports it.")
    layer: LayerName = "imported"
    name: ItemName | None = Field(None, description="Of the annotation; default: that of the clip and the layer's.")
    end_index: Literal["inclusive", "exclusive"] = Field(
        "inclusive",
        description="Whether a section holds its frame `end_idx`, as the predecessor's editor means it, or ends before "
        "it, as its time warping means it.",
    )
    labels: tuple[Label, ...] | None = Field(
        None, max_length=1000, description="Only these: labels that overlap make layers of their own."
    )
    message: Message = ""


def command_arguments(command: Request) -> dict[str, Any]:
    """What a command says besides its name."""
    return command.model_dump(exclude={"command"})
