"""Annotations changed by commands, and made of documents of the predecessor."""

from __future__ import annotations

from dataclasses import dataclass

from marey_schemas.access import Role
from marey_schemas.annotations import AnnotationChange, AnnotationImport, command_arguments
from marey_schemas.documents import Annotation, RevisionRef
from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH
from marey_schemas.problems import FieldError
from marey_server.errors import Invalid, NotFound
from marey_server.store import projects
from marey_server.store.items.changing import prepare_parts, put_part
from marey_server.store.items.reading import read_item, read_part
from marey_server.store.revs import moved_on
from marey_server.store.transaction import Transaction


def apply_commands(
    tx: Transaction, project: str, item_id: str, change: AnnotationChange, *, expected_rev: int | None
) -> Item:
    """Apply commands to an annotation one after another, all of them or none; the item with its new revision.

    Raises `Invalid` naming the command that cannot be carried out, `PreconditionFailed` where the annotation is not at
    `expected_rev` any more.
    """
    from marey_motion import documents
    from marey_motion.editing.annotations.layers import COMMANDS
    from marey_motion.errors import MotionError

    projects.require(tx, project, Role.CONTRIBUTOR, "write")
    found = read_part(tx, project, Kind.ANNOTATION, item_id, "annotation")
    if expected_rev not in (None, found.rev):
        raise moved_on(found.rev)
    annotation = Annotation.model_validate(found.tree)
    layer = documents.layer_from_document(annotation, _frame_count(tx, project, annotation))
    for index, command in enumerate(change.commands):
        try:
            layer = COMMANDS[command.command](layer, **command_arguments(command))
        except MotionError as error:
            wrong = FieldError(pointer=f"/commands/{index}", code=error.code, detail=str(error))
            detail = f"Command {index} ({command.command}) cannot be carried out, so none was: {error}"
            raise Invalid(detail, code="command-refused", errors=[wrong]) from error
    changed = documents.layer_to_document(layer, annotation.clip, annotation.layer, annotation.made_by)
    return put_part(
        tx,
        project,
        Kind.ANNOTATION,
        item_id,
        "annotation",
        changed.model_dump(mode="json", by_alias=True),
        expected_rev=found.rev,
        message=change.message,
    )


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
    from marey_motion.formats.predecessor_annotation import layer_of_document

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


def _frame_count(tx: Transaction, project: str, annotation: Annotation) -> int:
    """Frames of the revision of the clip that an annotation is of. Raises `Invalid` where the clip is gone."""
    clip = RevisionRef.model_validate(annotation.clip.model_dump())
    try:
        motion = read_part(tx, project, Kind.CLIP, clip.item, "motion", revision=clip.revision, arrays="none").tree
    except NotFound as error:
        raise Invalid(f"Its clip is not there any more: {error.detail}", code="no-clip") from error
    return int(motion["poses"]["shape"][0])
