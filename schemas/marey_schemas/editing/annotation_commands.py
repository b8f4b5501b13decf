"""Commands that change an annotation, and requests to import annotations in the forms of Marey's predecessor."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Request
from marey_schemas.formats import DEFAULT_END_INDEX, EndIndex
from marey_schemas.imports import ImportFile
from marey_schemas.names import ItemName, Label, LayerName, Message
from marey_schemas.sizes import MOST_INTEGER

MAX_COMMANDS = 1000
Frame = Annotated[int, Field(ge=0, le=MOST_INTEGER)]


class CreateSegment(Request):
    """Label the frames [start, end) as a segment."""

    command: Literal["create_segment"]
    label: Label
    start: Frame
    end: Frame
    overwrite: bool = Field(
        False, description="Shorten or remove overlapping segments; otherwise an overlap is an error."
    )


class RemoveSegment(Request):
    """Remove a segment."""

    command: Literal["remove_segment"]
    at: Frame = Field(description="Any frame of the segment.")


class SplitSegment(Request):
    """Cut a segment in two."""

    command: Literal["split_segment"]
    at: Frame = Field(description="First frame of the second part.")
    label: Label | None = Field(None, description="Label of the second part; absent: the label of the first part.")


class MergeSegment(Request):
    """Merge a segment with its neighbour, including the gap between them."""

    command: Literal["merge_segment"]
    at: Frame = Field(description="Any frame of the segment whose label is kept.")
    neighbour: Literal["next", "previous", "nearest"] = Field("next", description="Neighbouring segment to merge with.")


class MoveBoundary(Request):
    """Move the start or end of a segment; an adjacent neighbour is extended or shortened."""

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
    """Add a keyframe."""

    command: Literal["add_keyframe"]
    label: Label
    frame: Frame


class MoveKeyframe(Request):
    """Move a keyframe to another frame."""

    command: Literal["move_keyframe"]
    label: Label
    frame: Frame
    to: Frame


class RemoveKeyframe(Request):
    """Remove a keyframe."""

    command: Literal["remove_keyframe"]
    label: Label
    frame: Frame


class Clear(Request):
    """Remove all segments and keyframes."""

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
    """Commands that are applied to an annotation in order, all or none."""

    commands: tuple[AnnotationCommand, ...] = Field(min_length=1, max_length=MAX_COMMANDS)
    message: Message = Field("", description="Message shown in the history.")


class AnnotationImport(Request):
    """Request to import an annotation of a clip from a document of Marey's predecessor, or a file with this document.

    The document has one of the forms `sections` and `semantic_annotation`. An export of the annotation returns the file
    byte for byte, unless the annotation was changed.
    """

    document: dict[str, Any] | None = Field(
        None,
        description="Document in the form in which the predecessor stores or exports it. Give either "
        "`document` or `file`.",
    )
    file: ImportFile | None = Field(
        None,
        description="File with the document, as JSON, BSON or compressed BSON; the server already has its "
        "bytes. An alternative to `document`.",
    )
    layer: LayerName = "imported"
    name: ItemName | None = Field(
        None, description="Name of the annotation; default: the name of the clip, a space, and the name of the layer."
    )
    end_index: EndIndex = Field(
        DEFAULT_END_INDEX,
        description="Whether a segment includes its frame `end_idx`, as in the editor of Marey's predecessor, or ends "
        "before this frame, as in the predecessor's time warping.",
    )
    labels: tuple[Label, ...] | None = Field(
        None,
        max_length=1000,
        description="Labels to import; absent: all labels. Labels whose segments overlap must be imported into "
        "separate layers.",
    )
    message: Message = ""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if (self.document is None) == (self.file is None):
            raise ValueError("give either `document` or `file`")
        return self


def command_arguments(command: Request) -> dict[str, Any]:
    """Return the fields of a command by name, without `command` itself."""
    return command.model_dump(exclude={"command"})
