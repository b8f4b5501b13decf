"""Differences between two revisions, in terms of motion, annotations, skeletons, models and fields.

`before` and `after` are the two revisions; a pair contains the value in each of them. Ranges of frames are half open.
Frames are counted in the revision `after`, unless a description names the other revision.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from marey_schemas.base import Answer, Options
from marey_schemas.documents.annotations import Annotation, KeyframeDocument, SegmentDocument
from marey_schemas.documents.skeletons import Vector3
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.kinds import Kind
from marey_schemas.sizes import MOST_INTEGER

Range = tuple[int, int]
Change = Literal["added", "removed", "changed"]
MatchedFloats = Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=2)]


class DifferenceOptions(Options):
    """Thresholds of a comparison. Times at which a motion changed by more than a threshold are listed."""

    threshold_deg: float = Field(
        1.0,
        ge=0.01,
        le=180,
        description="Threshold in degrees: the times at which a joint's rotation changed by more than this are listed.",
    )
    threshold_cm: float = Field(
        1.0,
        ge=0.001,
        le=1e6,
        description="Threshold in centimetres: the times at which a position changed by more than this are listed.",
    )


class DifferenceRequest(DifferenceOptions):
    """Query parameters of a request for a difference: the two revisions, and what the answer contains."""

    from_: int | None = Field(
        None,
        alias="from",
        ge=1,
        le=MOST_INTEGER,
        description="Revision before the change. Absent: the revision before `to`, or the newest revision if "
        "`to_item` is given.",
    )
    to: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision after the change. Absent: the newest.")
    to_item: str | None = Field(
        None,
        max_length=64,
        description="Id of another item of the same kind in the project. If given, `to` is a revision of this item.",
    )
    plot: bool = Field(False, description="Include the values that a drawing of the difference needs.")


class ComparedRevision(Answer):
    """One of the two revisions of a difference."""

    item: str
    name: str = Field(description="Name of the item.")
    revision: int


class FrameRun(Answer):
    """Range of successive frames that correspond to each other in both revisions, or that only one revision has."""

    change: Literal["matched", "removed", "inserted"]
    before: Range = Field(description="Range of frames in the revision `before`; empty for inserted frames.")
    after: Range = Field(description="Range of frames in the revision `after`; empty for removed frames.")


class Exceeding(Answer):
    """Size of a change over the matched frames, and the times at which the change exceeds the threshold."""

    mean: float = Field(
        description="Mean size of the change over all matched frames, in the unit of the threshold: degrees for "
        "rotations, centimetres for positions and translations."
    )
    largest: float
    largest_at: int = Field(description="Frame of the revision `after` with the largest change.")
    spans: tuple[Range, ...] = Field(
        (),
        description="Ranges of frames of the revision `after` in which the change exceeds the threshold; at most 100. "
        "Ranges less than 0.1 s apart are joined. Ranges farther apart are also joined if there would otherwise be "
        "more than 100.",
    )


class JointChange(Exceeding):
    """Change of a joint's local rotation, in degrees, or translation, in centimetres."""

    joint: str = Field(description="Name of the joint in the revision `after`.")


class PathMove(Answer):
    """Movement of a whole path: a turn about the vertical axis through the origin, then a shift."""

    turn_deg: float = Field(description="Turn about the vertical axis, left positive.")
    shift_cm: Vector3
    remaining_cm: float = Field(
        description="Largest distance between the paths that remains after this movement is applied."
    )


class PathChange(Exceeding):
    """Change of the path of the body on the ground and in height; distances are in centimetres."""

    joint: str = Field(
        description="Joint whose path is compared: the root, or the first joint that moves if the root stands still."
    )
    moved: PathMove | None = Field(
        None,
        description="Movement of the whole path, if a movement explains at least nine tenths of the change; "
        "otherwise absent. The turn of this movement is not reported among the changes of the root's rotation.",
    )


class RestChange(Answer):
    """Changes of a joint of the skeleton: its parent, its offset, or its rest rotation."""

    joint: str = Field(description="Name of the joint in the revision `after`.")
    parent: tuple[str | None, str | None] | None = Field(None, description="Names of the parents, if they differ.")
    offset_cm: float = Field(0.0, description="Length of the difference between the two offsets.")
    rotation_deg: float = Field(0.0, description="Angle between the two rest rotations.")


class SkeletonDifference(Answer):
    """Differences between two hierarchies of joints."""

    joint_count: tuple[int, int]
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    renamed: tuple[tuple[str, str], ...] = Field((), description="Names of each renamed joint before and after.")
    joints: tuple[RestChange, ...] = Field(
        (), description="Joints that both revisions have, but with another rest pose or parent."
    )
    reordered: bool = Field(False, description="Whether the two revisions have their joints in different orders.")
    end_sites_changed: bool = False


class MotionDifference(Answer):
    """Differences between two motions: skeleton, timing, joints, and the path of the body."""

    frames: tuple[int, int]
    frame_rate_hz: tuple[float, float]
    duration_s: tuple[float, float]
    skeleton: SkeletonDifference | None = Field(
        None, description="Differences between the skeletons; absent if there are none."
    )
    runs: tuple[FrameRun, ...] = Field(description="All frames of both revisions, in order.")
    frames_per_frame: float = Field(
        1.0,
        description="Number of frames in the revision `after` that correspond to one matched frame in `before`; 1 "
        "unless the motion was resampled.",
    )
    duration_ratio: float = Field(
        1.0,
        description="Duration of the matched frames in the revision `after`, divided by their duration in `before`; "
        "1 unless the motion was re-timed.",
    )
    rotations: tuple[JointChange, ...] = Field((), description="Changed local rotations in degrees, largest first.")
    path: PathChange | None = Field(None, description="Change of the path of the body; absent if there is none.")
    translations: tuple[JointChange, ...] = Field(
        (),
        description="Changed translations in centimetres, largest first, of all joints except the joint whose path "
        "is compared.",
    )
    translated_joints: tuple[tuple[str, ...], tuple[str, ...]] = Field(
        ((), ()),
        description="Joints, other than the root, whose translations are stored: the joints in `before`, and the "
        "joints in `after`.",
    )


class SegmentChange(Answer):
    """Change of a segment: added if `before` is absent, removed if `after` is absent, else moved or relabelled."""

    before: SegmentDocument | None = None
    after: SegmentDocument | None = None


class KeyframeChange(Answer):
    """Change of a keyframe: added if `before` is absent, removed if `after` is absent, else moved or relabelled."""

    before: KeyframeDocument | None = None
    after: KeyframeDocument | None = None


class AnnotationDifference(Answer):
    """Differences between two annotations; frames are those of the annotated clips."""

    segment_count: tuple[int, int]
    segments: tuple[SegmentChange, ...] = Field((), description="Changed segments, in the order of their frames.")
    keyframe_count: tuple[int, int]
    keyframes: tuple[KeyframeChange, ...] = Field((), description="Changed keyframes, in the order of their frames.")


class MappedJoint(Answer):
    """Joints that are mapped to a standard joint in the two revisions; null if none is mapped."""

    standard: str
    before: str | None = None
    after: str | None = None


class MappingDifference(Answer):
    """Differences between the joint mappings of two skeletons."""

    joints: tuple[MappedJoint, ...] = ()
    axes: tuple[str, ...] = Field((), description="Joints whose anatomical axes differ.")


class ModelDifference(Answer):
    """Differences between the trainings of two models. Changed options are listed in `Difference.fields`."""

    examples: tuple[int, int] = Field(description="Number of training examples of the earlier and of the later model.")
    examples_added: tuple[str, ...] = ()
    examples_removed: tuple[str, ...] = ()
    mean_log_likelihood: tuple[float | None, float | None] = Field(
        (None, None),
        description="Mean log-likelihood of the training examples under each model; null if it is not stored.",
    )


class FieldChange(Answer):
    """Change of a value in a document. Changes that other members of the difference describe are not listed."""

    part: str
    pointer: str = Field(description="JSON pointer of the value in the document of the part.")
    change: Change
    before: Any = None
    after: Any = None


class DifferencePlot(Answer):
    """Values of a difference for a drawing: the change of rotations over time, and the paths of the body."""

    joints: tuple[str, ...] = Field(description="Joints in the order of the columns of `rotation_deg`.")
    frame_rate_hz: float = Field(description="Frame rate of the revision `after`.")
    frames: tuple[int, ...] = Field(
        description="First frame of each row of `rotation_deg`; the last element is the frame after the end of the "
        "last row."
    )
    rotation_deg: MatchedFloats = Field(
        description="[rows, joints]: largest change of rotation within the row's frames, in degrees; -1: no frame is "
        "matched."
    )
    path_before_m: MatchedFloats = Field(
        description="[points, 2]: x and z in metres of the path in the revision `before`."
    )
    path_after_m: MatchedFloats = Field(
        description="[points, 2]: x and z in metres of the path in the revision `after`."
    )


class Difference(Answer):
    """Difference between two revisions of an item, or of two items of the same kind."""

    schema_: Literal["marey/difference@1"] = Field("marey/difference@1", alias="schema")
    kind: Kind
    before: ComparedRevision
    after: ComparedRevision
    options: DifferenceOptions
    parts: dict[str, Change] = Field(description="Parts that differ; none if the two revisions are equal.")
    motion: MotionDifference | None = None
    skeleton: SkeletonDifference | None = None
    mapping: MappingDifference | None = None
    annotation: AnnotationDifference | None = None
    model: ModelDifference | None = None
    fields: tuple[FieldChange, ...] = ()
    more_fields: int = Field(
        0, description="Number of changed values that are not listed in `fields`, because there are too many."
    )
    plot: DifferencePlot | None = Field(None, description="Values of two motions to draw, if they were requested.")
    annotations: tuple[Annotation, Annotation] | None = Field(
        None, description="The compared annotations, if values to draw were requested."
    )
