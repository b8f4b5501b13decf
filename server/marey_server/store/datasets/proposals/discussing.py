"""Comments on proposals."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, Table, func, insert, select

from marey_schemas.datasets.proposals import Comment, CommentCreate
from marey_schemas.items import Page
from marey_schemas.kinds import Kind
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.datasets.chunks import StoredChunks
from marey_server.store.datasets.history import tree_of
from marey_server.store.datasets.naming import find_dataset
from marey_server.store.datasets.proposals.opening import find_proposal, lock_open, touch
from marey_server.store.datasets.proposals.texts import require_room
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import proposal_comment, user
from marey_server.store.transaction import Transaction
from marey_versions.records import key_of
from marey_versions.tree.reading import Tree

MOST_OF_EACH = 1000
"""Greatest number of comments, of reviews and of checks that a proposal can have."""


def add_comment(tx: Transaction, project: str, name: str, number: int, request: CommentCreate) -> Comment:
    """Comment on an open proposal.

    Raises `NotFoundProblem` if the request names an entry that neither the proposed version nor the target has, and
    `ConflictProblem` if the proposal has ended, has too many comments, or has no space for a comment of this length.
    Raises `QuotaExceededProblem` if the texts of all proposals of the project would be too long.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_dataset(tx, project_row, name)
    row = lock_open(tx, found.id, number)
    if request.path is not None and request.kind is not None:
        _require_entry(tx, row, request.path, request.kind)
    require_room(tx, project_row, found.id, number, request.text)
    first, end = request.frames or (None, None)
    values = {
        "dataset_id": found.id, "proposal": number, "number": next_number(tx, proposal_comment, row, "comments"),
        "author_id": tx.principal.user_id, "text": request.text, "path": request.path,
        "kind": None if request.kind is None else request.kind.value, "first_frame": first, "end_frame": end,
        "digest": row.head_now, "created_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(proposal_comment).values(**values))
    touch(tx, row)
    tx.emit("proposal.commented", found.id, project_id=project_row.id, number=number, comment=values["number"])
    made = select(proposal_comment, user.c.name).join(user, user.c.id == proposal_comment.c.author_id)
    return _shown(tx.execute(made.where(*_of(row), proposal_comment.c.number == values["number"])).one())


def next_number(tx: Transaction, table: Table, row: Row[Any], things: str) -> int:
    """Return the number of the next comment or review of a locked proposal, whose rows are in `table`.

    Raises `ConflictProblem` if there are `MOST_OF_EACH` already; its text calls them `things`, such as "comments".
    """
    held = select(func.count()).where(table.c.dataset_id == row.dataset_id, table.c.proposal == row.number)
    count: int = tx.execute(held).scalar_one()
    if count >= MOST_OF_EACH:
        raise ConflictProblem(
            f"A proposal has at most {MOST_OF_EACH:,} {things}; close this one and open another.",
            code="long-proposal",
        )
    return count + 1


def _require_entry(tx: Transaction, row: Row[Any], path: str, kind: Kind) -> None:
    store, key = StoredChunks(tx), key_of(path, kind)
    versions = {digest for digest in (row.head_now, row.target_now) if digest is not None}
    if not any(Tree(store, tree_of(tx, row.dataset_id, digest)).get_several({key}) for digest in sorted(versions)):
        raise NotFoundProblem(
            f"Neither the proposed version nor the branch has an entry of the kind {kind.value} at {path!r}.",
            code="no-entry",
        )


def _of(row: Row[Any]) -> tuple[Any, ...]:
    return proposal_comment.c.dataset_id == row.dataset_id, proposal_comment.c.proposal == row.number


def _shown(row: Row[Any]) -> Comment:
    return Comment(
        number=row.number, author=row.name, text=row.text, path=row.path,
        kind=None if row.kind is None else Kind(row.kind),
        frames=None if row.first_frame is None else (row.first_frame, row.end_frame),
        commit=row.digest, at=datetime_of(row.created_us),
    )  # fmt: skip


def list_comments(tx: Transaction, project: str, name: str, number: int, *, cursor: str | None, limit: int) -> Page:
    """List the comments of a proposal, oldest first."""
    found = find_dataset(tx, projects.require(tx, project), name)
    row = find_proposal(tx, found.id, number)
    statement = select(proposal_comment, user.c.name).join(user, user.c.id == proposal_comment.c.author_id)
    order = listing.parse_order("number", {"number": proposal_comment.c.number}, unique="number")
    identity = ["comments", found.id, number]
    rows, following = listing.read_page(tx, statement.where(*_of(row)), order, identity, cursor, limit)
    return Page(items=tuple(map(_shown, rows)), next_cursor=following)
