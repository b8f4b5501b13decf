"""Database access of the commands that edit annotations: reads the annotation and its clip, writes the new revision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from marey_schemas.documents.references import RevisionRef
from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_server.errors import ApiProblem, InvalidProblem, NotFoundProblem
from marey_server.prepared_documents import PreparedDocument
from marey_server.store import projects
from marey_server.store.items.changing import put_part
from marey_server.store.items.reading import read_item, read_part
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class FoundAnnotation:
    """Annotation that the caller may change: its document, the `rev` of its item, and the frame count of its clip."""

    tree: dict[str, Any]
    rev: int
    frame_count: int


@dataclass(frozen=True, slots=True)
class ChangedAnnotation:
    """Result of editing an annotation: the new document, or the error of the edit.

    `rev` is the `rev` of the annotation's item when the annotation was read.
    """

    rev: int
    made: PreparedDocument | ApiProblem


def find_annotation(tx: Transaction, project: str, item_id: str) -> FoundAnnotation:
    """Return an annotation that is to be changed, with the number of frames of its clip.

    Raises `NotFoundProblem` if the annotation does not exist, and `InvalidProblem` if its clip does not exist.
    """
    projects.require(tx, project)
    found = read_part(tx, project, Kind.ANNOTATION, item_id, "annotation")
    return FoundAnnotation(found.tree, found.rev, _frame_count(tx, project, found.tree["clip"]))


def put_changed(tx: Transaction, project: str, item_id: str, changed: ChangedAnnotation, message: str) -> Item:
    """Store the changed document as a new revision of the annotation.

    Raises the error of the edit, if there was one, and `PreconditionFailedProblem` if another request has changed the
    annotation meanwhile.
    """
    if isinstance(changed.made, ApiProblem):
        raise changed.made
    return put_part(
        tx, project, Kind.ANNOTATION, item_id, "annotation", changed.made, expected_rev=changed.rev, message=message
    )


@dataclass(frozen=True, slots=True)
class AnnotatedClip:
    """Clip that is to be annotated, at its newest revision, with its number of frames."""

    item: Item
    frame_count: int


def find_annotated_clip(tx: Transaction, project: str, item_id: str) -> AnnotatedClip:
    """Return the clip that is to be annotated. Raises `NotFoundProblem` if it does not exist."""
    item = read_item(tx, project, Kind.CLIP, item_id)
    return AnnotatedClip(item, int(item.summary["frames"]))


def _frame_count(tx: Transaction, project: str, annotated: dict[str, Any]) -> int:
    """Return the number of frames of the clip revision that an annotation belongs to.

    Raises `InvalidProblem` if the clip does not exist.
    """
    clip = RevisionRef.model_validate(annotated)
    try:
        motion = read_part(tx, project, Kind.CLIP, clip.item, "motion", revision=clip.revision, arrays="none").tree
    except NotFoundProblem as error:
        raise InvalidProblem(
            f"The clip of the annotation no longer exists: {error.detail}",
            code="no-clip",
            unnamed="The clip of the annotation no longer exists.",
        ) from error
    return int(motion["poses"]["shape"][0])
