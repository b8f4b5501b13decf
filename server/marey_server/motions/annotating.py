"""Commands on annotations, and conversion of annotations of Marey's predecessor."""

from __future__ import annotations

from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.references import RevisionRef
from marey_schemas.editing.annotation_commands import AnnotationChange, AnnotationImport, command_arguments
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH
from marey_schemas.problems import FieldError
from marey_server.errors import ApiProblem, InvalidProblem, TooLargeProblem
from marey_server.motions.loading import LOADING
from marey_server.prepared_documents import PreparedDocument
from marey_server.store.items import prepare_part, prepare_parts
from marey_server.store.items.annotating import AnnotatedClip, ChangedAnnotation, FoundAnnotation
from marey_server.store.revs import ExpectedRev, is_expected, moved_on

MOST_WORK = 30_000_000
"""Greatest amount of work in a request; this amount takes a few seconds.

The work of a command is the number of segments and keyframes of the annotation; the work of a request is the sum over
its commands.
"""


def apply_commands(
    found: FoundAnnotation, change: AnnotationChange, *, expected_rev: ExpectedRev = None
) -> ChangedAnnotation:
    """Apply commands to an annotation in order; return a `ChangedAnnotation` with the result or the error.

    If a command fails, no command is applied. The function needs no database. An error is returned, not raised.
    `put_changed` raises it later, inside the transaction that stores the answer under the idempotency key. So a
    repeated request gets the same error, even if the annotation has changed since.
    """
    if not is_expected(found.rev, expected_rev):
        return ChangedAnnotation(found.rev, moved_on(found.rev))
    try:
        return ChangedAnnotation(found.rev, _changed(found, change))
    except ApiProblem as refusal:
        return ChangedAnnotation(found.rev, refusal)


def _changed(found: FoundAnnotation, change: AnnotationChange) -> PreparedDocument:
    with LOADING:
        from marey_motion import documents
        from marey_motion.editing.annotations.commands import COMMANDS
        from marey_motion.errors import MotionError

    annotation = Annotation.model_validate(found.tree)
    layer = documents.layer_from_document(annotation, found.frame_count)
    work = 0
    for index, command in enumerate(change.commands):
        work += len(layer.segments) + len(layer.keyframes)
        if work > MOST_WORK:
            raise TooLargeProblem(
                f"{len(change.commands)} commands are too many at once for {len(layer.segments)} segments and "
                f"{len(layer.keyframes)} keyframes; send at most {index} at a time.",
                code="too-many-commands",
            )
        try:
            layer = COMMANDS[command.command](layer, **command_arguments(command))
        except MotionError as error:
            wrong = FieldError(pointer=f"/commands/{index}", code=error.code, detail=str(error))
            detail = f"Command {index} ({command.command}) cannot be carried out, so nothing was changed: {error}"
            unnamed = f"Command {index} ({command.command}) cannot be carried out, so nothing was changed."
            raise InvalidProblem(detail, code="command-refused", errors=[wrong], unnamed=unnamed) from error
    changed = documents.layer_to_document(layer, annotation.clip, annotation.layer, annotation.made_by)
    return prepare_part(Kind.ANNOTATION, "annotation", changed.model_dump(mode="json", by_alias=True))


def prepare_annotation(clip: AnnotatedClip, given: AnnotationImport) -> ItemCreate:
    """Convert a document of Marey's predecessor into an annotation of a clip, to be created in the clip's folder.

    Raises `InvalidProblem` if the document is not a valid annotation of this clip.
    """
    with LOADING:
        from marey_motion import documents
        from marey_motion.errors import MotionError
        from marey_motion.formats.predecessor.annotation import layer_of_document

    try:
        layer = layer_of_document(
            given.document, "document", clip.frame_count, end_index=given.end_index, labels=given.labels
        )
    except MotionError as error:
        wrong = FieldError(pointer="/document", code=error.code, detail=str(error))
        raise InvalidProblem(
            f"The document is not a valid annotation of the clip: {error}", code=error.code, errors=[wrong]
        ) from error
    ref = RevisionRef(item=clip.item.id, revision=clip.item.revision)
    annotation = documents.layer_to_document(layer, ref, given.layer)
    return ItemCreate(
        name=given.name or f"{clip.item.name} {given.layer}"[:MAX_NAME_LENGTH],
        collection=clip.item.collection,
        parts=prepare_parts(Kind.ANNOTATION, {"annotation": annotation.model_dump(mode="json", by_alias=True)}),
        message=given.message,
    )
