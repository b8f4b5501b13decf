"""Designs of studies, which are the documents of the revisions of studies."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select

from marey_schemas.documents.studies import StudyDocument
from marey_schemas.kinds import Kind
from marey_server.errors import NotFoundProblem
from marey_server.store import documents, projects
from marey_server.store.items.reading import find_item
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import document, revision_part
from marey_server.store.transaction import Transaction

_SCHEMA = StudyDocument.model_fields["schema_"].default


def require_study(tx: Transaction, project: str, kind: Kind, item_id: str) -> tuple[ProjectRow, Any]:
    """Return the project and the row of a study, if the caller has the role that the operation declares.

    Raises `NotFoundProblem` if there is no such study.
    """
    project_row = projects.require(tx, project)
    if kind is not Kind.STUDY:
        raise NotFoundProblem(f"The item is a {kind}, but only studies have participants.", code="not-a-study")
    return project_row, find_item(tx, project_row, Kind.STUDY, item_id)


def load_design(tx: Transaction, item_id: str, revision: int) -> StudyDocument:
    """Return the design of one revision of a study, without checking rights.

    Raises `NotFoundProblem` if there is no such revision, or if it was stored before studies had a fixed schema.
    """
    statement = (
        select(revision_part.c.document_digest)
        .join(document, document.c.digest == revision_part.c.document_digest)
        .where(
            revision_part.c.item_id == item_id,
            revision_part.c.number == revision,
            revision_part.c.part == "study",
            document.c.schema == _SCHEMA,
        )
    )
    digest = tx.execute(statement).scalar()
    if digest is None:
        raise NotFoundProblem(
            f"The study {item_id} has no revision {revision} that this version of Marey can read; use a newer "
            "revision.",
            code="no-item",
        )
    return StudyDocument.model_validate(documents.load_body(tx, digest))
