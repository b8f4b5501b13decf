"""Reviews and checks of proposals, and what a proposal still needs before it can be merged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sqlalchemy import Row, Select, and_, func, or_, select

from marey_schemas.datasets.proposal_states import CheckState, Verdict
from marey_schemas.datasets.proposals import Missing, ProposalCheck, Review
from marey_schemas.datasets.protection import Protection
from marey_schemas.wording import counted
from marey_server.store.database.clock import datetime_of
from marey_server.store.projects import WRITERS
from marey_server.store.tables import member, proposal_check, proposal_review, user
from marey_server.store.transaction import Transaction


def select_reviews(row: Row[Any]) -> Select[*tuple[Any, ...]]:
    """Return the query of the reviews of a proposal, with the names of the reviewers."""
    return (
        select(proposal_review, user.c.name)
        .join(user, user.c.id == proposal_review.c.author_id)
        .where(proposal_review.c.dataset_id == row.dataset_id, proposal_review.c.proposal == row.number)
    )


def shown_review(one: Row[Any], head: str) -> Review:
    """Return a review as a document; `head` is the newest commit of the proposal."""
    return Review(
        number=one.number, author=one.name, verdict=Verdict(one.verdict), text=one.text, commit=one.digest,
        stale=one.digest != head, at=datetime_of(one.created_us),
    )  # fmt: skip


def verdicts_of(tx: Transaction, project_id: str, row: Row[Any]) -> list[Row[Any]]:
    """Return, for each reviewer, the newest review that approves the proposal or requests changes.

    The column `counts` is true if the reviewer may still write in the project.
    """
    mine = and_(member.c.project_id == project_id, member.c.user_id == proposal_review.c.author_id)
    may_write = and_(
        user.c.disabled.is_(False), or_(user.c.administrator, func.coalesce(member.c.role, "").in_(WRITERS))
    )
    statement = (
        select_reviews(row)
        .add_columns(may_write.label("counts"))
        .outerjoin(member, mine)
        .where(proposal_review.c.verdict != Verdict.COMMENT.value)
        .order_by(proposal_review.c.number)
    )
    newest = {one.author_id: one for one in tx.execute(statement)}
    return sorted(newest.values(), key=lambda one: int(one.number))


def checks_of(tx: Transaction, row: Row[Any]) -> dict[str, ProposalCheck]:
    """Return the checks of the newest commit of a proposal by name, sorted by name."""
    statement = (
        select(proposal_check, user.c.name.label("reporter"))
        .join(user, user.c.id == proposal_check.c.reporter_id)
        .where(proposal_check.c.dataset_id == row.dataset_id, proposal_check.c.proposal == row.number)
        .where(proposal_check.c.digest == row.head_now)
        .order_by(proposal_check.c.name)
    )
    return {
        one.name: ProposalCheck(
            name=one.name, state=CheckState(one.state), commit=one.digest, job=one.job_id, link=one.link,
            text=one.text, reporter=one.reporter, at=datetime_of(one.updated_us),
        )
        for one in tx.execute(statement)
    }  # fmt: skip


def find_missing(tx: Transaction, project_id: str, row: Row[Any], rule: Protection | None) -> Iterator[Missing]:
    """Yield the approvals and checks that a proposal still needs, and the requests for changes that block it."""
    verdicts = [one for one in verdicts_of(tx, project_id, row) if one.counts]
    for one in verdicts:
        if one.verdict == Verdict.REQUEST_CHANGES:
            yield Missing(code="changes-requested", detail=f"{one.name} requests changes and has not approved since.")
    if rule is None:
        return
    approvals = [
        one
        for one in verdicts
        if one.verdict == Verdict.APPROVE and one.digest == row.head_now and one.author_id != row.author_id
    ]
    if len(approvals) < rule.approvals:
        yield Missing(
            code="approvals",
            detail=f"The newest commit needs {counted(rule.approvals, 'approval')} by users other than the author of "
            f"the proposal; it has {len(approvals)}.",
        )
    yield from _missing_checks(rule, checks_of(tx, row))


def _missing_checks(rule: Protection, checks: Mapping[str, ProposalCheck]) -> Iterator[Missing]:
    for name in rule.checks:
        state = checks[name].state if name in checks else None
        if state is None:
            yield Missing(code="check-missing", detail=f"The check {name!r} of the newest commit has no result yet.")
        elif state is not CheckState.SUCCEEDED:
            yield Missing(code=f"check-{state}", detail=f"The check {name!r} of the newest commit is {state}.")
