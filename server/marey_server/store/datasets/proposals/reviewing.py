"""Reviews of proposals, and reports of checks."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, delete, insert, select

from marey_schemas.datasets.proposal_states import CheckState
from marey_schemas.datasets.proposals import CheckReport, ProposalCheck, Review, ReviewCreate
from marey_schemas.items import Page
from marey_schemas.queue.jobs import JobState, commits_of
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.datasets.naming import find_dataset
from marey_server.store.datasets.proposals.accepting import PreparedAcceptance, merge_if_possible
from marey_server.store.datasets.proposals.discussing import next_number
from marey_server.store.datasets.proposals.opening import find_proposal, lock_open, require_newest, touch
from marey_server.store.datasets.proposals.requirements import checks_of, select_reviews, shown_review
from marey_server.store.datasets.proposals.texts import require_room
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import job, proposal_check, proposal_review
from marey_server.store.transaction import Transaction


def add_review(
    tx: Transaction, project: str, name: str, number: int, request: ReviewCreate, waiting: PreparedAcceptance | None
) -> Review:
    """Review the newest commit of an open proposal; then merge the proposal if it only waited for this review.

    Raises `ConflictProblem` if the proposal has ended, or if its newest commit is not the one that the request names.
    Raises the errors of `require_room`.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)  # for `merge_if_possible`
    found = find_dataset(tx, project_row, name)
    row = lock_open(tx, found.id, number)
    require_newest(tx, row, request.commit)
    require_room(tx, project_row, found.id, number, request.text)
    values = {
        "dataset_id": found.id, "proposal": number, "number": next_number(tx, proposal_review, row, "reviews"),
        "author_id": tx.principal.user_id, "verdict": request.verdict.value, "text": request.text,
        "digest": row.head_now, "created_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(proposal_review).values(**values))
    touch(tx, row)
    tx.emit(
        "proposal.reviewed", found.id, project_id=project_row.id, number=number, verdict=request.verdict.value,
        commit=row.head_now,
    )  # fmt: skip
    merge_if_possible(tx, project, name, row, waiting)
    made = tx.execute(select_reviews(row).where(proposal_review.c.number == values["number"])).one()
    return shown_review(made, row.head_now)


def list_reviews(tx: Transaction, project: str, name: str, number: int, *, cursor: str | None, limit: int) -> Page:
    """List all reviews of a proposal, oldest first."""
    found = find_dataset(tx, projects.require(tx, project), name)
    row = find_proposal(tx, found.id, number)
    order = listing.parse_order("number", {"number": proposal_review.c.number}, unique="number")
    rows, following = listing.read_page(tx, select_reviews(row), order, ["reviews", found.id, number], cursor, limit)
    return Page(items=tuple(shown_review(one, row.head_now) for one in rows), next_cursor=following)


def report_check(
    tx: Transaction, project: str, name: str, number: int, request: CheckReport, waiting: PreparedAcceptance | None
) -> ProposalCheck:
    """Record the state of a check of the newest commit; then merge the proposal if it only waited for this check.

    Raises `ConflictProblem` if the proposal has ended, or if its newest commit is not the commit of the report. A
    report of success may name a job; `ConflictProblem` is also raised if this job has not succeeded, or has read only
    other versions of the dataset. Raises `NotFoundProblem` if the project has no such job.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)  # for `merge_if_possible`
    found = find_dataset(tx, project_row, name)
    row = lock_open(tx, found.id, number)
    require_newest(tx, row, request.commit)
    if request.job is not None:
        _require_job(tx, project_row.id, request.job, request.state, row.head_now)
    _store_check(tx, project_row, row, request)
    touch(tx, row)
    tx.emit(
        "proposal.checked", found.id, project_id=project_row.id, number=number, check=request.name,
        state=request.state.value, commit=row.head_now,
    )  # fmt: skip
    merge_if_possible(tx, project, name, row, waiting)
    return checks_of(tx, row)[request.name]


def _require_job(tx: Transaction, project_id: str, job_id: str, state: CheckState, head: str) -> None:
    held = select(job.c.state, job.c.inputs).where(job.c.id == job_id, job.c.project_id == project_id)
    found = tx.execute(held).first()
    if found is None:
        raise NotFoundProblem(f"The project has no job {job_id!r}.", code="no-job")
    if state is not CheckState.SUCCEEDED:
        return
    if found.state != JobState.SUCCEEDED:
        raise ConflictProblem(
            f"The job {job_id} has the state {found.state}; the check succeeds only if its job has succeeded.",
            code="job-not-succeeded",
            context={"state": found.state},
        )
    read = commits_of(found.inputs)
    if read and head not in read:
        raise ConflictProblem(
            f"The job {job_id} read versions of the dataset, but not the newest commit of the proposal; run the check "
            "on this commit.",
            code="job-of-another-commit",
            context={"commits": sorted(read)},
            unnamed=True,
        )


def _store_check(tx: Transaction, project_row: ProjectRow, row: Row[Any], request: CheckReport) -> None:
    earlier = delete(proposal_check).where(
        proposal_check.c.dataset_id == row.dataset_id,
        proposal_check.c.proposal == row.number,
        proposal_check.c.digest == row.head_now,
        proposal_check.c.name == request.name,
    )
    tx.execute(earlier)
    next_number(tx, proposal_check, row, "checks")
    require_room(tx, project_row, row.dataset_id, row.number, request.text)
    values = {
        "dataset_id": row.dataset_id, "proposal": row.number, "digest": row.head_now, "name": request.name,
        "state": request.state.value, "job_id": request.job, "link": request.link, "text": request.text,
        "reporter_id": tx.principal.user_id, "updated_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(proposal_check).values(**values))
