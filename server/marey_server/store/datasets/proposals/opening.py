"""Opening, listing and closing of proposals, and their rows."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Row, Select, and_, func, insert, select, update

from marey_schemas.access import Role
from marey_schemas.datasets.naming import RefKind
from marey_schemas.datasets.proposal_states import ProposalState
from marey_schemas.datasets.proposals import Proposal, ProposalCreate
from marey_schemas.items import Page
from marey_server.access import roles
from marey_server.errors import ConflictProblem, ForbiddenProblem, InvalidProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.datasets.committing import head_of
from marey_server.store.datasets.naming import find_dataset, find_ref, lock_refs, resolve
from marey_server.store.datasets.proposals.texts import require_room
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import dataset_ref, proposal, user
from marey_server.store.transaction import Transaction

MOST_OPEN = 1000
"""Greatest number of open proposals in a dataset."""

_SOURCE, _TARGET = dataset_ref.alias("source_ref"), dataset_ref.alias("target_ref")
_AUTHOR, _WAITING, _ENDING = user.alias("author"), user.alias("waiting"), user.alias("ending")


# -- rows -------------------------------------------------------------------------------------------------------------


def find_proposal(tx: Transaction, dataset_id: str, number: int) -> Row[Any]:
    """Return the row of a proposal, with the names of the users to whom the row refers.

    The columns `head_now` and `target_now` are the newest commits of the proposal's source and of its target. Raises
    `NotFoundProblem` if there is no such proposal.
    """
    row = tx.execute(_rows(dataset_id).where(proposal.c.number == number)).first()
    if row is None:
        raise NotFoundProblem(f"The dataset has no proposal {number}.", code="no-proposal")
    return row


def lock_open(tx: Transaction, dataset_id: str, number: int) -> Row[Any]:
    """Lock the row of an open proposal until the end of the transaction, and return it.

    Raises `NotFoundProblem` if there is no such proposal, and `ConflictProblem` if it is merged or closed.
    """
    tx.execute(select(proposal.c.number).where(*is_proposal(dataset_id, number)).with_for_update())
    row = find_proposal(tx, dataset_id, number)
    if row.state != ProposalState.OPEN:
        raise ConflictProblem(
            f"The proposal {number} is {row.state} already, by {row.ending_name}.",
            code=f"proposal-{row.state}",
            context={"state": row.state, "merged": row.merged},
            unnamed=f"The proposal {number} is {row.state} already.",
        )
    return row


def require_newest(tx: Transaction, row: Row[Any], version: str | None) -> None:
    """Raise `ConflictProblem` if `version` is given and is not the newest commit of the proposal."""
    if version is not None and resolve(tx, row.dataset_id, version) != row.head_now:
        raise ConflictProblem(
            "The proposal has a newer commit than the one in the request; review the newest commit first.",
            code="proposal-moved",
            context={"commit": row.head_now},
            unnamed=True,
        )


def is_proposal(dataset_id: str, number: int) -> tuple[ColumnElement[bool], ...]:
    """Return the SQL conditions that select the row of a proposal."""
    return proposal.c.dataset_id == dataset_id, proposal.c.number == number


def _rows(dataset_id: str) -> Select[*tuple[Any, ...]]:
    followed = and_(
        _SOURCE.c.dataset_id == proposal.c.dataset_id, _SOURCE.c.name == proposal.c.source, proposal.c.head.is_(None)
    )
    into = and_(_TARGET.c.dataset_id == proposal.c.dataset_id, _TARGET.c.name == proposal.c.target)
    return (
        select(
            proposal,
            _AUTHOR.c.name.label("author_name"),
            _WAITING.c.name.label("waiting_name"),
            _ENDING.c.name.label("ending_name"),
            func.coalesce(proposal.c.head, _SOURCE.c.digest).label("head_now"),
            func.coalesce(proposal.c.target_commit, _TARGET.c.digest).label("target_now"),
        )
        .join(_AUTHOR, _AUTHOR.c.id == proposal.c.author_id)
        .outerjoin(_WAITING, _WAITING.c.id == proposal.c.when_green_id)
        .outerjoin(_ENDING, _ENDING.c.id == proposal.c.ended_id)
        .outerjoin(_SOURCE, followed)
        .outerjoin(_TARGET, into)
        .where(proposal.c.dataset_id == dataset_id)
    )


def is_waiting(row: Row[Any]) -> bool:
    """Return whether an automatic merge (`when_green`) of the proposal's newest commit is requested.

    A request for an earlier commit does not count: a new commit in the source cancels it.
    """
    return row.when_green_id is not None and row.when_green_head == row.head_now


def shown_proposal(row: Row[Any]) -> Proposal:
    """Return a proposal as a document."""
    return Proposal(
        number=row.number, title=row.title, description=row.description, author=row.author_name,
        state=ProposalState(row.state), source=row.source, target=row.target, head=row.head_now,
        target_commit=row.target_now, merged=row.merged, when_green=row.waiting_name if is_waiting(row) else None,
        ended_by=row.ending_name,
        created_at=datetime_of(row.created_us), updated_at=datetime_of(row.updated_us),
        ended_at=None if row.ended_us is None else datetime_of(row.ended_us), rev=row.rev,
    )  # fmt: skip


# -- opening and closing ----------------------------------------------------------------------------------------------


def open_proposal(tx: Transaction, project: str, name: str, request: ProposalCreate) -> Proposal:
    """Open a proposal to merge a version into a branch.

    Raises `NotFoundProblem` for an unknown version or branch, `InvalidProblem` if both are the same branch, and
    `ConflictProblem` if the dataset has too many open proposals. Raises the errors of `require_room`.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_dataset(tx, project_row, name)
    lock_refs(tx, found.id)
    if request.source == request.target:
        raise InvalidProblem("The source and the target of a proposal must be different.", code="same-branch")
    head_of(tx, found.id, request.target, None)
    head = resolve(tx, found.id, request.source)
    source = find_ref(tx, found.id, request.source)
    follows = source is not None and source.kind == RefKind.BRANCH
    _require_room(tx, found.id)
    newest = select(func.coalesce(func.max(proposal.c.number), 0)).where(proposal.c.dataset_id == found.id)
    number = tx.execute(newest).scalar_one() + 1
    require_room(tx, project_row, found.id, number, request.description)
    row = {
        "dataset_id": found.id, "number": number, "title": request.title,
        "description": request.description, "author_id": tx.principal.user_id, "source": request.source,
        "target": request.target, "state": ProposalState.OPEN.value, "head": None if follows else head,
        "created_us": tx.now_us, "updated_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(proposal).values(**row))
    tx.emit("proposal.opened", found.id, project_id=project_row.id, number=number, title=request.title)
    return shown_proposal(find_proposal(tx, found.id, number))


def _require_room(tx: Transaction, dataset_id: str) -> None:
    opened = (proposal.c.dataset_id == dataset_id, proposal.c.state == ProposalState.OPEN.value)
    if tx.execute(select(func.count()).where(*opened)).scalar_one() >= MOST_OPEN:
        raise ConflictProblem(
            f"There can be at most {MOST_OPEN:,} open proposals in a dataset; merge or close one first.",
            code="too-many-proposals",
        )


def close_proposal(tx: Transaction, project: str, name: str, number: int) -> Proposal:
    """Close a proposal without merging it; its author and maintainers may do this.

    Raises `ForbiddenProblem` for other callers, and `ConflictProblem` if the proposal is merged or closed already.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_dataset(tx, project_row, name)
    row = lock_open(tx, found.id, number)
    if row.author_id != tx.principal.user_id and not roles.includes(project_row.role, Role.MAINTAINER):
        raise ForbiddenProblem("Only the author of a proposal and maintainers may close it.", code="not-author")
    end(tx, row, ProposalState.CLOSED, ended_id=tx.principal.user_id)
    tx.emit("proposal.closed", found.id, project_id=project_row.id, number=number)
    return shown_proposal(find_proposal(tx, found.id, number))


def end(tx: Transaction, row: Row[Any], state: ProposalState, **values: Any) -> None:
    """Set the final state of a proposal, and record the commits at which its source and target are now."""
    touch(
        tx, row, state=state.value, head=row.head_now, target_commit=row.target_now, when_green_id=None,
        when_green_head=None, ended_us=tx.now_us, **values,
    )  # fmt: skip


def touch(tx: Transaction, row: Row[Any], **values: Any) -> None:
    """Set columns of a locked proposal and the time of its last change, and increase its `rev` by one."""
    changed = update(proposal).where(*is_proposal(row.dataset_id, row.number))
    tx.execute(changed.values(**values, updated_us=tx.now_us, rev=proposal.c.rev + 1))


# -- lists ------------------------------------------------------------------------------------------------------------


def list_proposals(
    tx: Transaction, project: str, name: str, *, state: ProposalState | None, cursor: str | None, limit: int
) -> Page:
    """List the proposals of a dataset, newest first; with `state`, only those in this state."""
    found = find_dataset(tx, projects.require(tx, project), name)
    statement = _rows(found.id)
    if state is not None:
        statement = statement.where(proposal.c.state == state.value)
    order = listing.parse_order("-number", {"number": proposal.c.number}, unique="number")
    identity = ["proposals", found.id, state]
    rows, following = listing.read_page(tx, statement, order, identity, cursor, limit)
    return Page(items=tuple(map(shown_proposal, rows)), next_cursor=following)
