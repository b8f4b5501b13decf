"""Merges of proposals.

A read transaction prepares the merge. A short write transaction checks the requirements, and records the merge.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any, NamedTuple

from sqlalchemy import Row, func, select

from marey_schemas.access import Role
from marey_schemas.datasets.merges import MergeRequest
from marey_schemas.datasets.proposal_states import ProposalState
from marey_schemas.datasets.proposals import Mergeability, Missing, Proposal, ProposalDetail, ProposalMerge
from marey_schemas.datasets.protection import Protection
from marey_server.access import roles
from marey_server.errors import ApiProblem, ConflictProblem, InvalidProblem
from marey_server.store import projects
from marey_server.store.datasets.merging import LARGE_MERGE, PreparedMerge, prepare_merge, record_merge
from marey_server.store.datasets.naming import BRANCH_MOVED, branch_moved, find_dataset, find_ref
from marey_server.store.datasets.proposals.opening import (
    end,
    find_proposal,
    is_waiting,
    lock_open,
    require_newest,
    shown_proposal,
    touch,
)
from marey_server.store.datasets.proposals.requirements import checks_of, find_missing, shown_review, verdicts_of
from marey_server.store.datasets.protection import Mover, require_move, rule_of
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import member, proposal_comment, user
from marey_server.store.transaction import Transaction

log = logging.getLogger(__name__)

MOST_PREVIEWED = 10_000
"""Greatest number of changed entries on each side of a merge that is previewed when its proposal is read."""
MOST_SHOWN_CONFLICTS = 100

WAITING_MERGE = ProposalMerge()
"""Request with default options; it is used to preview a merge, and to merge a waiting proposal."""


@dataclass(frozen=True)
class PreparedAcceptance:
    """Merge of a proposal that was computed but not recorded, or the error if it could not be computed."""

    request: MergeRequest
    merge: PreparedMerge | None
    refusal: ApiProblem | None


class WaitingOutcome(Enum):
    """Outcome of an attempt to merge a proposal for which an automatic merge (`when_green`) may be requested."""

    MERGED = auto()
    NOT_READY = auto()
    """No automatic merge is requested, an approval or a check is missing, or the user may not move the target."""
    OBSTRUCTED = auto()
    """An obstacle, such as a conflict, prevents the merge until a branch moves or the target's rule changes."""


class MergeBasis(NamedTuple):
    """Everything on which the result of a merge depends.

    This is the newest commit of the source (`head`), that of the target branch, and the protection rule of the target.
    """

    head: str
    target: str | None
    rule: Protection | None


# -- preparing --------------------------------------------------------------------------------------------------------


def prepare_acceptance(
    tx: Transaction, project: str, name: str, number: int, request: ProposalMerge
) -> PreparedAcceptance | None:
    """Compute the merge of a proposal; return None if the proposal is not open."""
    found = find_dataset(tx, projects.require(tx, project), name)
    row = find_proposal(tx, found.id, number)
    return None if row.state != ProposalState.OPEN else _prepare(tx, project, name, row, request)


def prepare_waiting(tx: Transaction, project: str, name: str, number: int) -> PreparedAcceptance | None:
    """Compute the merge of a proposal for which an automatic merge (`when_green`) is requested.

    Returns None for other proposals.
    """
    found = find_dataset(tx, projects.require(tx, project), name)
    row = find_proposal(tx, found.id, number)
    return _prepare(tx, project, name, row, WAITING_MERGE) if is_waiting(row) else None


def _prepare(
    tx: Transaction, project: str, name: str, row: Row[Any], request: ProposalMerge, most: int | None = None
) -> PreparedAcceptance:
    message = request.message or f"Merge proposal {row.number}: {row.title}"
    merge = MergeRequest(into=row.target, version=row.head_now, message=message, resolutions=request.resolutions)
    try:
        return PreparedAcceptance(merge, prepare_merge(tx, project, name, merge, most=most), None)
    except (ConflictProblem, InvalidProblem) as refusal:
        return PreparedAcceptance(merge, None, refusal)


# -- what is missing --------------------------------------------------------------------------------------------------


def _missing(
    tx: Transaction, project_row: ProjectRow, row: Row[Any], target: Row[Any], prepared: PreparedAcceptance
) -> tuple[Missing, ...]:
    """Return the reasons for which an open proposal cannot be merged yet."""
    rule = rule_of(target)
    return (*find_missing(tx, project_row.id, row, rule), *_obstacles(prepared, rule))


def _target(tx: Transaction, row: Row[Any], *, lock: bool = False) -> Row[Any]:
    """Return the row of the branch into which an open proposal is merged.

    With `lock`, the row is locked until the transaction ends.
    """
    ref = find_ref(tx, row.dataset_id, row.target, lock=lock)
    assert ref is not None, "branches of open proposals are not deleted"
    return ref


def _obstacles(prepared: PreparedAcceptance, rule: Protection | None) -> Iterator[Missing]:
    """Yield the reasons why the two versions cannot be merged: an error, conflicts, or missing commits.

    Commits of the target that the source lacks are a reason only if `rule` requires that the source is up to date.
    """
    if prepared.refusal is not None and prepared.refusal.error_code != LARGE_MERGE:
        yield Missing(code=prepared.refusal.error_code, detail=prepared.refusal.detail)
    if prepared.merge is None:
        return
    answer = prepared.merge.answer
    if answer.conflict_count:
        yield Missing(
            code="merge-conflicts",
            detail="Both sides have changed the same entries. Merge the target into the source and resolve the "
            "conflicts there, or send resolutions with the merge.",
        )
    if rule is not None and rule.up_to_date and answer.base != answer.ours:
        yield Missing(
            code="not-up-to-date",
            detail="The target has commits that the source does not have. Merge the target into the source first.",
        )


def read_proposal(tx: Transaction, project: str, name: str, number: int) -> ProposalDetail:
    """Return a proposal with its reviews, the checks of its newest commit, and the result that a merge would have."""
    project_row = projects.require(tx, project)
    found = find_dataset(tx, project_row, name)
    row = find_proposal(tx, found.id, number)
    of_proposal = (proposal_comment.c.dataset_id == found.id, proposal_comment.c.proposal == number)
    mergeability = None
    if row.state == ProposalState.OPEN:
        prepared = _prepare(tx, project, name, row, WAITING_MERGE, MOST_PREVIEWED)
        mergeability = _shown(prepared.merge, _missing(tx, project_row, row, _target(tx, row), prepared))
    return ProposalDetail(
        **dict(shown_proposal(row)),
        comments=tx.execute(select(func.count()).where(*of_proposal)).scalar_one(),
        reviews=tuple(shown_review(one, row.head_now) for one in verdicts_of(tx, project_row.id, row)),
        checks=tuple(checks_of(tx, row).values()),
        mergeability=mergeability,
    )


def _shown(merge: PreparedMerge | None, missing: tuple[Missing, ...]) -> Mergeability:
    if merge is None:
        return Mergeability(missing=missing, changes=None, conflict_count=None, conflicts=())
    answer = merge.answer
    return Mergeability(
        missing=missing, changes=answer.changes, conflict_count=answer.conflict_count,
        conflicts=answer.conflicts[:MOST_SHOWN_CONFLICTS],
    )  # fmt: skip


# -- merging ----------------------------------------------------------------------------------------------------------


def merge_proposal(
    tx: Transaction, project: str, name: str, number: int, request: ProposalMerge, prepared: PreparedAcceptance | None
) -> Proposal:
    """Merge a proposal. With `when_green`, merge it later if approvals, checks or other requirements are missing.

    Raises `ConflictProblem` if the proposal has ended, or if a branch has moved since the merge was prepared. Without
    `when_green`, also raises `ConflictProblem` if a requirement is missing. Raises the errors of `require_move`, too.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_dataset(tx, project_row, name)
    row = lock_open(tx, found.id, number)
    require_newest(tx, row, request.commit)
    target = _target(tx, row, lock=True)
    mover = Mover(tx.principal.user_name or "", project_row.role, by_proposal=True, user_id=tx.principal.user_id)
    require_move(target, mover)
    prepared = _require_current(row, prepared)
    missing = _missing(tx, project_row, row, target, prepared)
    if missing and request.when_green:
        touch(tx, row, when_green_id=tx.principal.user_id, when_green_head=row.head_now)
        tx.emit("proposal.waiting", found.id, project_id=project_row.id, number=number)
    else:
        _require_green(prepared, missing)
        _record(tx, project, name, row, prepared, mover, tx.principal.user_id)
    return shown_proposal(find_proposal(tx, found.id, number))


def _require_current(row: Row[Any], prepared: PreparedAcceptance | None) -> PreparedAcceptance:
    """Return `prepared` if no branch has moved since this merge was prepared; otherwise raise `ConflictProblem`."""
    if prepared is None or prepared.request.version != row.head_now:
        raise branch_moved(row.source, row.head_now)
    if prepared.merge is not None and prepared.merge.answer.ours != row.target_now:
        raise branch_moved(row.target, row.target_now)
    return prepared


def _require_green(prepared: PreparedAcceptance, missing: tuple[Missing, ...]) -> None:
    if prepared.refusal is not None:
        raise prepared.refusal
    if missing and [one.code for one in missing] != ["merge-conflicts"]:
        raise ConflictProblem(
            f"The proposal cannot be merged yet. {' '.join(one.detail for one in missing)}",
            code="proposal-not-green",
            context={"missing": [one.model_dump(mode="json") for one in missing]},
            unnamed="The proposal cannot be merged yet: approvals or checks are missing, or it has conflicts.",
        )


def _record(
    tx: Transaction,
    project: str,
    name: str,
    row: Row[Any],
    prepared: PreparedAcceptance,
    mover: Mover,
    user_id: str | None,
) -> None:
    """Record the merge of a locked proposal, and end the proposal."""
    assert prepared.merge is not None
    answer = record_merge(tx, project, name, prepared.request, prepared.merge, mover)
    assert answer.commit is not None
    end(tx, row, ProposalState.MERGED, merged=answer.commit.digest, ended_id=user_id)
    tx.emit(
        "proposal.merged", row.dataset_id, project_id=projects.require(tx, project).id, number=row.number,
        commit=answer.commit.digest, merged_by=mover.name,
    )  # fmt: skip


def withdraw_merge(tx: Transaction, project: str, name: str, number: int) -> Proposal:
    """Cancel the request (`when_green`) to merge a proposal automatically; the proposal stays open."""
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_dataset(tx, project_row, name)
    row = lock_open(tx, found.id, number)
    if is_waiting(row):
        touch(tx, row, when_green_id=None, when_green_head=None)
    return shown_proposal(find_proposal(tx, found.id, number))


def merge_if_green(
    tx: Transaction, project: str, name: str, row: Row[Any], prepared: PreparedAcceptance | None
) -> WaitingOutcome:
    """Merge a locked proposal if its automatic merge (`when_green`) was requested and all requirements are met.

    The proposal is not merged if the user who requested the merge may no longer move the branch. Raises
    `ConflictProblem` if a branch has moved since the merge was prepared.
    """
    if not is_waiting(row):
        return WaitingOutcome.NOT_READY
    target = _target(tx, row, lock=True)
    mover = _ready_mover(tx, projects.require(tx, project), row, target)
    if mover is None:
        return WaitingOutcome.NOT_READY
    prepared = _require_current(row, prepared)
    if any(_obstacles(prepared, rule_of(target))):
        return WaitingOutcome.OBSTRUCTED
    _record(tx, project, name, row, prepared, mover, row.when_green_id)
    return WaitingOutcome.MERGED


def merge_if_possible(
    tx: Transaction, project: str, name: str, row: Row[Any], prepared: PreparedAcceptance | None
) -> None:
    """Call `merge_if_green`; if it refuses the merge, for example because of a quota, housekeeping tries again later.

    The caller's request, such as a review, must be stored even if the merge is refused. Raises `ConflictProblem` if a
    branch has moved since the merge was prepared.
    """
    try:
        with tx.connection.begin_nested():
            merge_if_green(tx, project, name, row, prepared)
    except ApiProblem as problem:
        if problem.error_code == BRANCH_MOVED:
            raise
        log.info("proposal %d of %s is merged later: %s", row.number, row.dataset_id, problem.detail)


def merge_basis(tx: Transaction, project_row: ProjectRow, row: Row[Any]) -> MergeBasis | None:
    """Return the commits and the protection rule on which the result of a proposal's automatic merge depends.

    An automatic merge (`when_green`) is a merge that a user has requested to happen as soon as it is allowed. Returns
    None if no automatic merge is requested. Also returns None if the merge is not allowed yet: approvals or checks are
    missing, a reviewer has requested changes, or the user may no longer move the branch.
    """
    if not is_waiting(row):
        return None
    target = _target(tx, row)
    if _ready_mover(tx, project_row, row, target) is None:
        return None
    return MergeBasis(row.head_now, target.digest, rule_of(target))


def _ready_mover(tx: Transaction, project_row: ProjectRow, row: Row[Any], target: Row[Any]) -> Mover | None:
    """Return the user who requested the merge, if the proposal has all required approvals and checks.

    Returns None if an approval or a check is missing, or if a reviewer has requested changes. Also returns None if the
    user who requested the merge may no longer move the branch.
    """
    if any(find_missing(tx, project_row.id, row, rule_of(target))):
        return None
    return _waiting_mover(tx, project_row, row, target)


def _waiting_mover(tx: Transaction, project_row: ProjectRow, row: Row[Any], target: Row[Any]) -> Mover | None:
    """Return the user who requested the merge; None if that user may no longer move the branch."""
    of_member = member.c.project_id == project_row.id, member.c.user_id == row.when_green_id
    role = tx.execute(select(member.c.role).where(*of_member)).scalar()
    asked = tx.execute(select(user).where(user.c.id == row.when_green_id)).one()
    held = Role.OWNER if asked.administrator else Role(role or Role.READER)
    mover = Mover(asked.name, held, by_proposal=True, user_id=asked.id)
    if asked.disabled or not roles.includes(mover.role, Role.CONTRIBUTOR):
        return None
    try:
        require_move(target, mover)
    except ApiProblem:
        return None
    return mover
