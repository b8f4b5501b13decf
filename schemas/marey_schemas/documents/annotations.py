"""Annotations: labelled ranges of frames and labelled frames of a clip."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.originals import StoredOriginal
from marey_schemas.documents.references import OutputRef as OutputRef
from marey_schemas.documents.references import RevisionRef as RevisionRef


class SegmentDocument(Request):
    """Segment: a half-open range of frames with a label."""

    label: Annotated[str, StringConstraints(min_length=1, max_length=255)]
    start: int = Field(ge=0)
    end: int = Field(gt=0)

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if self.end <= self.start:
            raise ValueError(
                f"segment {self.label!r}: the end, frame {self.end}, must be after the start, frame {self.start}"
            )
        return self


class KeyframeDocument(Request):
    """Keyframe: a frame with a label."""

    label: Annotated[str, StringConstraints(min_length=1, max_length=255)]
    frame: int = Field(ge=0)


class Annotation(Request):
    """Part `annotation`: one layer of labels of a clip, by one author or algorithm. Segments do not overlap."""

    schema_: Literal["marey/annotation@1"] = Field("marey/annotation@1", alias="schema")
    clip: RevisionRef | OutputRef
    layer: str = "default"
    made_by: Literal["person", "algorithm"] = "person"
    segments: tuple[SegmentDocument, ...] = Field((), description="Segments in the order of their frames.")
    keyframes: tuple[KeyframeDocument, ...] = Field((), description="Keyframes in the order of their frames.")
    original: StoredOriginal | None = Field(
        None, description="The file that the annotation was imported from; absent: it was not imported."
    )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for index, (before, after) in enumerate(pairwise(self.segments), start=1):
            if after.start < before.end:
                place = f"segments[{index}] ({after.label!r} {after.start}:{after.end})"
                raise ValueError(f"{place} must start at frame {before.end} or later, where {before.label!r} ends")
        for index, (earlier, later) in enumerate(pairwise(self.keyframes), start=1):
            if (later.frame, later.label) <= (earlier.frame, earlier.label):
                place = f"keyframes[{index}] ({later.label!r} at frame {later.frame})"
                raise ValueError(f"{place} must come after {earlier.label!r} at frame {earlier.frame}")
        return self
