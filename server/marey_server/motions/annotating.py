"""Commands on annotations, and conversion of annotations of Marey's predecessor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.originals import original_of
from marey_schemas.documents.references import RevisionRef
from marey_schemas.editing.annotation_commands import AnnotationChange, AnnotationImport, command_arguments
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH, base_name
from marey_schemas.problems import FieldError
from marey_schemas.validation.reasons import first_reason
from marey_server.errors import ApiProblem, InvalidProblem, TooLargeProblem
from marey_server.motions.child import Message, pack_tree, unpack_tree
from marey_server.motions.loading import LOADING
from marey_server.prepared_documents import PreparedDocument
from marey_server.store import blobs
from marey_server.store.items import prepare_part, prepare_parts
from marey_server.store.items.annotating import AnnotatedClip, ChangedAnnotation, FoundAnnotation
from marey_server.store.revs import ExpectedRev, is_expected, moved_on
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules take a second to load
    from marey_motion.errors import MotionError

READ_ANNOTATION = "marey_server.motions.annotating:read_annotation"
"""Function that child processes run."""

MOST_WORK = 30_000_000
"""Greatest amount of work in a request; this amount takes a few seconds.

The work of a command is the number of segments and keyframes of the annotation; the work of a request is the sum over
its commands.
"""

_LONGEST_REASON = 4000


def apply_commands(
    found: FoundAnnotation, change: AnnotationChange, *, expected_rev: ExpectedRev = None
) -> ChangedAnnotation:
    """Apply commands to an annotation, one after another; return a `ChangedAnnotation` with the result or the error.

    If a command fails, no command is applied. The function needs no database. It returns the error and does not raise
    it: `put_changed` raises it later, inside the transaction that stores the answer under the idempotency key. So a
    repeated request gets the same error, even if the annotation has changed in the meantime.
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
    """Convert the document in `given` to the request that creates an annotation in the clip's folder.

    `given` contains a document in a format of Marey's predecessor. Raises `InvalidProblem` if the document is not a
    valid annotation of this clip.
    """
    assert given.document is not None
    part = _imported(given.document, "document", clip.item.id, clip.item.revision, clip.frame_count, given)
    return created(clip, given, prepare_parts(Kind.ANNOTATION, {"annotation": part}))


def created(clip: AnnotatedClip, given: AnnotationImport, parts: dict[str, PreparedDocument]) -> ItemCreate:
    """Return the request that creates an imported annotation, with the documents in `parts`, in its clip's folder."""
    return ItemCreate(
        name=given.name or f"{clip.item.name} {given.layer}"[:MAX_NAME_LENGTH],
        collection=clip.item.collection,
        parts=parts,
        message=given.message,
    )


class AnnotationOrder(Message):
    """Message that asks a child process to read the file of an annotation of Marey's predecessor."""

    content: bytes
    clip: str
    revision: int
    frame_count: int
    given: AnnotationImport


def find_file(tx: Transaction, given: AnnotationImport, most_bytes: int) -> bytes:
    """Return the content of the file to import, which the request names by its digest.

    Raises `NotFoundProblem` if the caller may not read the file, and `TooLargeProblem` if it has more than `most_bytes`
    bytes.
    """
    assert given.file is not None
    digest = given.file.blob
    size_bytes = blobs.sizes_of_readable(tx, [digest])[digest]
    if size_bytes > most_bytes:
        raise TooLargeProblem(f"The file has {size_bytes:,} bytes; an annotation may have at most {most_bytes:,}.")
    return blobs.read_blob(tx, digest, 0, size_bytes)


def annotation_order(clip: AnnotatedClip, given: AnnotationImport, content: bytes) -> bytes:
    """Return the packed message that asks a child process to read the file of an annotation."""
    return AnnotationOrder(
        content=content, clip=clip.item.id, revision=clip.item.revision, frame_count=clip.frame_count, given=given
    ).pack()


def found_annotation(answer: bytes) -> dict[str, PreparedDocument]:
    """Unpack the parts of the annotation from the answer of a child process."""
    return prepare_parts(Kind.ANNOTATION, {"annotation": unpack_tree(answer)})


def read_annotation(order: bytes) -> bytes:
    """Read the file of an annotation, in a child process. `order` is an `AnnotationOrder` as bytes.

    Return the part `annotation` as bytes. Raises `InvalidProblem` if the file is not a valid annotation of the clip.
    """
    with LOADING:
        from marey_motion.errors import MotionError
        from marey_motion.formats.predecessor.encoding import decode_document

    wanted = AnnotationOrder.unpack(order)
    assert wanted.given.file is not None
    name = base_name(wanted.given.file.name)
    try:
        document = decode_document(wanted.content, name)
    except MotionError as error:
        raise _not_an_annotation(error, "/file") from error
    part = _imported(document, name, wanted.clip, wanted.revision, wanted.frame_count, wanted.given)
    part["original"] = original_of("annotation", part, name, wanted.given.file.blob)
    return pack_tree(part)


def _imported(
    document: Mapping[str, Any], name: str, clip: str, revision: int, frame_count: int, given: AnnotationImport
) -> dict[str, Any]:
    """Convert a document of Marey's predecessor to the part `annotation` of an item.

    Raises `InvalidProblem` if the document is not a valid annotation of the clip.
    """
    with LOADING:
        from marey_motion import documents
        from marey_motion.errors import MotionError
        from marey_motion.formats.predecessor.annotation import layer_of_document

    pointer = "/document" if given.file is None else "/file"
    try:
        layer = layer_of_document(document, name, frame_count, end_index=given.end_index, labels=given.labels)
        annotation = documents.layer_to_document(layer, RevisionRef(item=clip, revision=revision), given.layer)
    except MotionError as error:
        raise _not_an_annotation(error, pointer) from error
    except ValidationError as error:  # of a label that no document may contain
        raise _not_an_annotation(MotionError(f"{name}: {first_reason(error)}", code="value-range"), pointer) from error
    return annotation.model_dump(mode="json", by_alias=True, exclude_none=True)


def _not_an_annotation(error: MotionError, pointer: str) -> InvalidProblem:
    """Return an `InvalidProblem` for a document that is not a valid annotation, with the text of `error`."""
    with LOADING:
        from marey_motion.formats.texts import cut_text

    detail = cut_text(
        f"The {pointer.removeprefix('/')} is not a valid annotation of the clip: {error}", _LONGEST_REASON
    )
    return InvalidProblem(detail, code=error.code, errors=[FieldError(pointer=pointer, code=error.code, detail=detail)])
