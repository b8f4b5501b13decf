"""Limits of the texts of proposals: descriptions, comments, reviews and checks.

Limits are in bytes. A text takes its length in UTF-8 plus `BYTES_OF_ROW`, so that many short or empty texts are
limited, too. A quarter of each limit is reserved for maintainers. Otherwise, other members could prevent a review by
filling a proposal with texts.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, LargeBinary, Select, Table, cast, func, select

from marey_schemas.access import Role
from marey_server.access import roles
from marey_server.errors import ConflictProblem, QuotaExceededProblem
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import dataset, proposal, proposal_check, proposal_comment, proposal_review
from marey_server.store.transaction import Transaction

MOST_TEXT_OF_PROPOSAL = 2 * 2**20
"""Greatest number of bytes of all texts of one proposal."""
BYTES_OF_ROW = 200

_TEXTS: tuple[tuple[Table, ColumnElement[Any], ColumnElement[int]], ...] = (
    (proposal, proposal.c.description, proposal.c.number),
    (proposal_comment, proposal_comment.c.text, proposal_comment.c.proposal),
    (proposal_review, proposal_review.c.text, proposal_review.c.proposal),
    (proposal_check, proposal_check.c.text, proposal_check.c.proposal),
)
"""Tables with texts; for each, the column with the text, and the column with the number of the proposal."""


def require_room(tx: Transaction, project_row: ProjectRow, dataset_id: str, number: int, text: str) -> None:
    """Check that the caller may add a text to an existing proposal, or open a new proposal with the text.

    Concurrent checks of one project run one after another. Raises `ConflictProblem` if the text would exceed the limit
    of the proposal, and `QuotaExceededProblem` if it would exceed the limit of all proposals of the project.
    """
    more = len(text.encode()) + BYTES_OF_ROW
    tx.lock(f"texts of proposals {project_row.id}")
    used = sum(
        tx.execute(_size(tx, table, column).where(table.c.dataset_id == dataset_id, place == number)).scalar_one()
        for table, column, place in _TEXTS
    )
    limit = _limit_for(project_row.role, MOST_TEXT_OF_PROPOSAL)
    if used + more > limit:
        raise ConflictProblem(
            f"You can add texts to a proposal up to {limit:,} bytes in total. The texts of this proposal have {used:,} "
            f"bytes, and the new text needs {more:,} more. Close the proposal and open another, or write a shorter "
            "text.",
            code="long-proposal",
            context={"used": used, "limit": limit},
        )
    _require_room_in_project(tx, project_row, more)


def _limit_for(role: Role, limit: int) -> int:
    return limit if roles.includes(role, Role.MAINTAINER) else limit * 3 // 4


def _require_room_in_project(tx: Transaction, project_row: ProjectRow, more: int) -> None:
    of_project = select(dataset.c.id).where(dataset.c.project_id == project_row.id)
    used = sum(
        tx.execute(_size(tx, table, column).where(table.c.dataset_id.in_(of_project))).scalar_one()
        for table, column, _ in _TEXTS
    )
    limit = _limit_for(project_row.role, tx.quotas.project_proposal_bytes)
    if used + more > limit:
        raise QuotaExceededProblem(
            f"The texts of the project's proposals have {used:,} bytes, your limit is {limit:,}, and the new text "
            f"needs {more:,} more. Purge deleted datasets, because the texts of their proposals count, too, or ask the "
            "operator to raise the setting `project_proposal_bytes`.",
            context={"quota": "project_proposal_bytes", "used": used, "limit": limit},
        )


def _size(tx: Transaction, table: Table, text: ColumnElement[Any]) -> Select[*tuple[Any, ...]]:
    size = func.octet_length(text) if tx.is_postgres else func.length(cast(text, LargeBinary))
    return select(func.coalesce(func.sum(size + BYTES_OF_ROW), 0)).select_from(table)
