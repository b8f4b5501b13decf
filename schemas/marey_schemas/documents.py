"""The documents that revisions are made of: skeletons, motions, clip descriptions, annotations.

Every document carries its `schema`. Lengths are metres, angles radians, times seconds, quaternions w,x,y,z;
axes are right-handed with Y up (docs/explanation/conventions.md).
"""

from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, StringConstraints, model_validator

from marey_schemas.alignment import AlignmentInfo
from marey_schemas.base import Request
from marey_schemas.editing.edits import EditDocument
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.evaluation import EvaluationDocument, EvaluationRecords
from marey_schemas.graphs import ModelGraph
from marey_schemas.modelling import MotionPrimitiveDocument
from marey_schemas.names import Digest, JointName, Tag
from marey_schemas.references import OutputRef as OutputRef
from marey_schemas.references import RevisionRef as RevisionRef
from marey_schemas.reports import EvaluationReport, ModelReport
from marey_schemas.sample_trees import SampleTreeDocument

MAX_JOINTS = 4096
MAX_FRAME_RATE_HZ = 100_000.0

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Joint(Request):
    """One joint of a hierarchy."""

    name: JointName
    parent: int = Field(ge=-1, description="Index of the parent, smaller than the joint's own; -1 for the root.")
    offset: Vector3 = Field(description="Position in the parent's rest frame, metres.")
    rest_rotation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="Local rest rotation, w,x,y,z.")
    display_name: str | None = Field(None, description="Name in the source, where it differs from `name`.")


class EndSite(Request):
    """A point at the end of a chain that has no rotation of its own."""

    joint: int = Field(ge=0)
    offset: Vector3


class SkeletonHierarchy(Request):
    """Part `hierarchy` of a skeleton: joints with parents before children."""

    schema_: Literal["marey/skeleton@1"] = Field("marey/skeleton@1", alias="schema")
    joints: tuple[Joint, ...] = Field(min_length=1, max_length=MAX_JOINTS)
    end_sites: tuple[EndSite, ...] = Field((), max_length=4 * MAX_JOINTS)

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        seen: set[str] = set()
        for index, joint in enumerate(self.joints):
            if joint.name in seen:
                raise ValueError(f"joints[{index}]: the name {joint.name!r} stands twice")
            seen.add(joint.name)
            if (joint.parent == -1) != (index == 0) or joint.parent >= index:
                place = f"joints[{index}] ({joint.name})"
                raise ValueError(f"{place}: parent {joint.parent} must come before it; only joint 0 is the root")
        for index, site in enumerate(self.end_sites):
            if site.joint >= len(self.joints):
                raise ValueError(f"end_sites[{index}]: joint {site.joint} does not exist")
        return self


class JointAxes(Request):
    """Anatomical axes of a joint in its own local frame: `twist` along the bone, `swing` orthogonal to it."""

    twist: Vector3
    swing: Vector3


class SkeletonMapping(Request):
    """Part `mapping` of a skeleton: which joint plays which standard joint, and its axes. Editable."""

    schema_: Literal["marey/skeleton-mapping@1"] = Field("marey/skeleton-mapping@1", alias="schema")
    rig: str | None = Field(None, description="The known rig whose names were recognised.")
    method: Literal["names", "geometry", "manual"] = "manual"
    confidence: float = Field(1.0, ge=0.0, le=1.0)
    joints: dict[str, JointName] = Field(default_factory=dict, description="Standard joint name to joint name.")
    axes: dict[JointName, JointAxes] = Field(default_factory=dict)
    notes: tuple[str, ...] = ()


class Motion(Request):
    """Part `motion` of a clip: the poses."""

    schema_: Literal["marey/motion@1"] = Field("marey/motion@1", alias="schema")
    skeleton: RevisionRef | OutputRef
    frame_rate_hz: float = Field(gt=0, le=MAX_FRAME_RATE_HZ, allow_inf_nan=False)
    joints: tuple[JointName, ...] = Field(min_length=1, max_length=MAX_JOINTS, description="Order of the rotations.")
    poses: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=2)] = Field(
        description="[frames, 3 + 4*joints]: root translation (m), then local quaternions."
    )
    translations: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=3, columns=3)] | None = Field(
        None, description="[frames, k, 3] local translations (m) that replace offsets."
    )
    translated_joints: tuple[JointName, ...] = ()

    @model_validator(mode="after")
    def _check_shapes(self) -> Self:
        frames, width = self.poses.shape
        if frames < 1:
            raise ValueError("poses: a motion needs at least one frame")
        if width != 3 + 4 * len(self.joints):
            raise ValueError(f"poses: {width} columns, but {len(self.joints)} joints need {3 + 4 * len(self.joints)}")
        if (self.translations is None) != (not self.translated_joints):
            raise ValueError("translations and translated_joints go together")
        if self.translations is not None and self.translations.shape != (frames, len(self.translated_joints), 3):
            raise ValueError(
                f"translations: shape {self.translations.shape}, expected {(frames, len(self.translated_joints), 3)}"
            )
        if unknown := set(self.translated_joints) - set(self.joints):
            raise ValueError(f"translated_joints: {sorted(unknown)} are none of the joints")
        return self


class Check(Request):
    """One finding about a motion: a stable code, where it was seen, and a sentence for people."""

    code: Annotated[str, StringConstraints(pattern=r"^[a-z0-9-]{1,64}$")]
    message: str
    joints: tuple[str, ...] = ()
    frames: tuple[int, int] | None = Field(None, description="Half-open frame range.")
    values: dict[str, Any] = Field(default_factory=dict)


class Source(Request):
    """Where a clip came from and what the importer did to it."""

    file: Digest | None = Field(None, description="The file exactly as it came.")
    file_name: str | None = None
    companion: Digest | None = Field(None, description="A second file the format needs, as an ASF beside an AMC.")
    companion_name: str | None = None
    format: str | None = None
    details: dict[str, Any] = Field(
        default_factory=dict,
        description="Unit scale, axes, channel orders, trimmed frames, floor shift, with the evidence.",
    )


class ClipInfo(Request):
    """Part `info` of a clip: what people and importers say about it."""

    schema_: Literal["marey/clip-info@1"] = Field("marey/clip-info@1", alias="schema")
    subject: str | None = None
    action: str | None = None
    tags: tuple[Tag, ...] = ()
    capture_system: str | None = None
    licence: str | None = None
    comment: str | None = None
    source: Source | None = None
    checks: tuple[Check, ...] = ()


class Segment(Request):
    """A labelled half-open range of frames."""

    label: Annotated[str, StringConstraints(min_length=1, max_length=255)]
    start: int = Field(ge=0)
    end: int = Field(gt=0)

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if self.end <= self.start:
            raise ValueError(f"segment {self.label!r}: end {self.end} must lie after start {self.start}")
        return self


class Keyframe(Request):
    """A labelled frame."""

    label: Annotated[str, StringConstraints(min_length=1, max_length=255)]
    frame: int = Field(ge=0)


class Annotation(Request):
    """Part `annotation`: one layer over a clip, by one author or algorithm. Segments do not overlap."""

    schema_: Literal["marey/annotation@1"] = Field("marey/annotation@1", alias="schema")
    clip: RevisionRef | OutputRef
    layer: str = "default"
    made_by: Literal["person", "algorithm"] = "person"
    segments: tuple[Segment, ...] = Field((), description="In the order of time.")
    keyframes: tuple[Keyframe, ...] = Field((), description="In the order of time.")

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for index, (before, after) in enumerate(pairwise(self.segments), start=1):
            if after.start < before.end:
                place = f"segments[{index}] ({after.label!r} {after.start}:{after.end})"
                raise ValueError(f"{place} must start at {before.end} or later, where {before.label!r} ends")
        for index, (earlier, later) in enumerate(pairwise(self.keyframes), start=1):
            if (later.frame, later.label) <= (earlier.frame, earlier.label):
                place = f"keyframes[{index}] ({later.label!r} at frame {later.frame})"
                raise ValueError(f"{place} must come after {earlier.label!r} at frame {earlier.frame}")
        return self


class OpenDocument(Request):
    """A document of a kind whose own schema is not fixed yet: anything under `body`."""

    model_config = ConfigDict(extra="allow")

    schema_: Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]*/[a-z0-9][a-z0-9_-]*@[1-9][0-9]*$")] = (
        Field("marey/document@1", alias="schema")
    )


SCHEMAS: dict[str, type[Request]] = {
    "marey/skeleton@1": SkeletonHierarchy,
    "marey/skeleton-mapping@1": SkeletonMapping,
    "marey/motion@1": Motion,
    "marey/clip-info@1": ClipInfo,
    "marey/annotation@1": Annotation,
    "marey/evaluation@1": EvaluationDocument,
    "marey/evaluation-records@1": EvaluationRecords,
    "marey/evaluation-report@1": EvaluationReport,
    "marey/edit@1": EditDocument,
    "marey/alignment@1": AlignmentInfo,
    "marey/motion-primitive@1": MotionPrimitiveDocument,
    "marey/sample-tree@1": SampleTreeDocument,
    "marey/model-report@1": ModelReport,
    "marey/model-graph@1": ModelGraph,
    "marey/document@1": OpenDocument,
}
"""Model by schema name."""
