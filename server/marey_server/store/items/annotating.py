"""Annotations changed by commands, and made of documents of the predecessor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from marey_schemas.access import Role
from marey_schemas.annotations import AnnotationChange, AnnotationImport, command_arguments
from marey_schemas.documents import Annotation, RevisionRef
from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH
from marey_schemas.problems import FieldError
from marey_server.errors import Invalid, MareyError, NotFound, TooLarge
from marey_server.store import projects
from marey_server.store.documents import PreparedDocument
from marey_server.store.items.changing import prepare_part, prepare_parts, put_part
from marey_server.store.items.reading import read_item, read_part
from marey_server.store.revs import ExpectedRev, is_expected, moved_on
from marey_server.store.transaction import Transaction

MOST_WORK = 30_000_000
"""Commands times segments and keyframes: some seconds of one thread."""


@dataclass(frozen=True, slots=True)
class FoundAnnotation:
    """An annotation that the caller may change: its document, its item's rev, and the frames of what it is of."""

    tree: dict[str, Any]
    rev: int
    frame_count: int


@dataclass(frozen=True, slots=True)
class ChangedAnnotation:
    """What commands made of an annotation that was at `rev`, or why they were not carried out."""

    rev: int
    made: PreparedDocument | MareyError


def find_annotation(tx: Transaction, project: str, item_id: str) -> FoundAnnotation:
    """The annotation that shall be changed. Raises `NotFound`, and `Invalid` where its clip is gone."""
    projects.require(tx, project, Role.CONTRIBUTOR, "write")
    found = read_part(tx, project, Kind.ANNOTATION, item_id, "annotation")
    return FoundAnnotation(found.tree, found.rev, _frame_count(tx, project, found.tree["clip"]))


def apply_commands(
    found: FoundAnnotation, change: AnnotationChange, *, expected_rev: ExpectedRev = None
) -> ChangedAnnotation:
    """Apply commands to an annotation one after another, all of them or none. Needs no database, and much of the time.

    A refusal is handed on in place of the document, to be raised where the change is put: a request that is sent again
    gets its first answer, whatever has become of the annotation since.
    """
    if not is_expected(found.rev, expected_rev):
        return ChangedAnnotation(found.rev, moved_on(found.rev))
    try:
        return ChangedAnnotation(found.rev, _changed(found, change))
    except MareyError as refusal:
        return ChangedAnnotation(found.rev, refusal)


def put_changed(tx: Transaction, project: str, item_id: str, changed: ChangedAnnotation, message: str) -> Item:
    """The annotation with its new revision.

    Raises what the commands were refused with, and `PreconditionFailed` where somebody was faster.
    """
    if isinstance(changed.made, MareyError):
        raise changed.made
    return put_part(
        tx, project, Kind.ANNOTATION, item_id, "annotation", changed.made, expected_rev=changed.rev, message=message
    )


def _changed(found: FoundAnnotation, change: AnnotationChange) -> PreparedDocument:
    from marey_motion import documents
    from marey_motion.editing.annotations.layers import COMMANDS
    from marey_motion.errors import MotionError

    annotation = Annotation.model_validate(found.tree)
    layer = documents.layer_from_document(annotation, found.frame_count)
    work = 0
    for index, command in enumerate(change.commands):
        work += len(layer.segments) + len(layer.keyframes)
        if work > MOST_WORK:
            raise TooLarge(
                f"{len(change.commands)} commands are too many at once for {len(layer.segments)} segments and "
                f"{len(layer.keyframes)} keyframes; send at most {index} at a time.",
                code="too-many-commands",
            )
        try:
            layer = COMMANDS[command.command](layer, **command_arguments(command))
        except MotionError as error:
            wrong = FieldError(pointer=f"/commands/{index}", code=error.code, detail=str(error))
            detail = f"Command {index} ({command.command}) cannot be carried out, so none was: {error}"
            raise Invalid(detail, code="command-refused", errors=[wrong]) from error
    changed = documents.layer_to_document(layer, annotation.clip, annotation.layer, annotation.made_by)
    return prepare_part(Kind.ANNOTATION, "annotation", changed.model_dump(mode="json", by_alias=True))


@dataclass(frozen=True, slots=True)
class AnnotatedClip:
    """A clip at its newest revision, and how many frames that has."""

    item: Item
    frame_count: int


def find_annotated_clip(tx: Transaction, project: str, item_id: str) -> AnnotatedClip:
    """The clip that shall be annotated. Raises `NotFound`."""
    item = read_item(tx, project, Kind.CLIP, item_id)
    return AnnotatedClip(item, int(item.summary["frames"]))


def prepare_annotation(clip: AnnotatedClip, given: AnnotationImport) -> ItemCreate:
    """The annotation that a document of the predecessor makes of a clip, beside it. Raises `Invalid`."""
    from marey_motion import documents
    from marey_motion.errors import MotionError
    from marey_motion.formats.predecessor.annotation import layer_of_document

    try:
        layer = layer_of_document(
            given.document, "document", clip.frame_count, end_index=given.end_index, labels=given.labels
        )
    except MotionError as error:
        wrong = FieldError(pointer="/document", code=error.code, detail=str(error))
        raise Invalid(f"This is no annotation of the clip: {error}", code=error.code, errors=[wrong]) from error
    ref = RevisionRef(item=clip.item.id, revision=clip.item.revision)
    annotation = documents.layer_to_document(layer, ref, given.layer)
    return ItemCreate(
        name=given.name or f"{clip.item.name} {given.layer}"[:MAX_NAME_LENGTH],
        collection=clip.item.collection,
        parts=prepare_parts(Kind.ANNOTATION, {"annotation": annotation.model_dump(mode="json", by_alias=True)}),
        message=given.message,
    )


def _frame_count(tx: Transaction, project: str, annotated: dict[str, Any]) -> int:
    """Frames of the revision of the clip that an annotation is of. Raises `Invalid` where the clip is gone."""
    clip = RevisionRef.model_validate(annotated)
    try:
        motion = read_part(tx, project, Kind.CLIP, clip.item, "motion", revision=clip.revision, arrays="none").tree
    except NotFound as error:
        raise Invalid(f"Its clip is not there any more: {error.detail}", code="no-clip") from error
    return int(motion["poses"]["shape"][0])
