"""Retries of failed or cancelled jobs, of their unsuccessful dependencies, and of dependants that could not run."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, or_, select, true

from marey_schemas.access import Role
from marey_schemas.queue.job_kinds import UnknownKindError, find_kind
from marey_schemas.queue.jobs import FailureReason, Job, JobState
from marey_schemas.queue.scripts import SCRIPT
from marey_server.access import roles
from marey_server.errors import ConflictProblem, UnavailableProblem
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.ids import new_id
from marey_server.store.jobs import commits
from marey_server.store.jobs.inputs import PinnedInputs
from marey_server.store.jobs.layout import Submission, request_of
from marey_server.store.jobs.reading import find_job, require_own
from marey_server.store.jobs.submission import lock_jobs, submit_checked
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.scripts.registry import require_unchanged
from marey_server.store.tables import job, job_dependency
from marey_server.store.transaction import Transaction, in_lists

MOST_AT_ONCE = 1000
"""Greatest number of jobs that one transaction retries."""
UNSUCCESSFUL = ("failed", "cancelled")


def retry_job(tx: Transaction, job_id: str, *, dependants: bool = True) -> Job:
    """Submit a failed or cancelled job again, and return the new job.

    The new job has the same inputs, and can share the results of tasks of the old job that have succeeded. If other
    jobs should have created an input but did not, the retries of these jobs create it. Unsuccessful dependencies are
    retried before the job. With `dependants`, jobs that ended only because of this job are retried after it, so that
    the rest of a pipeline continues; dependants that the caller may not retry are left out.

    Raises `ConflictProblem` for a task, for a job that has not ended or has succeeded, if more than `MOST_AT_ONCE` jobs
    would be retried, and if one of the jobs cannot run again, for example because an input was purged. Raises
    `ForbiddenProblem` for a job, or an unsuccessful dependency, of another user, unless the caller is a maintainer.
    Raises `UnavailableProblem` if the end of one of the jobs is still being propagated to the dependants.
    """
    row, project = find_job(tx, job_id)
    require_own(tx, row, project, "retry")
    hold_off_purges(tx, project.id)  # before the inputs of the jobs are read
    rights_of_caller(tx, project)  # here, because it must precede the locks of jobs
    if row.state not in UNSUCCESSFUL:
        raise ConflictProblem(
            f"Only a failed or cancelled job can be retried; this job is {row.state}.", code="not-failed"
        )
    if row.parent_id is not None:
        raise ConflictProblem(
            f"This job is a task of the job {row.parent_id} and cannot be retried alone; retry {row.parent_id}.",
            code="is-task",
            unnamed="This job is a task of a parent job and cannot be retried alone; retry the parent job.",
        )
    family = _Family(tx, project)
    family.add_with_needed([job_id])
    if dependants:
        family.add_dependants()
    made = family.submit()
    return made[job_id]


class _Family:
    """Set of jobs that are retried together, with the dependencies of each of them."""

    def __init__(self, tx: Transaction, project: ProjectRow) -> None:
        self._tx = tx
        self._project = project
        self._rows: dict[str, Row[Any]] = {}
        self._needs: dict[str, dict[str, str]] = {}
        """Dependencies of each job, and the newest retry of each dependency."""

    def add_with_needed(self, ids: Collection[str]) -> None:
        """Add jobs and the unsuccessful jobs that they depend on, directly or through others."""
        while ids:
            rows = _rows(self._tx, ids)
            for row in rows.values():
                require_own(self._tx, row, self._project, "retry")
            self._take(rows, _needs(self._tx, rows))
            self._require_few("first retry the jobs on which it depends")
            needed = {latest for needs in map(self._needs.__getitem__, rows) for latest in needs.values()}
            states = _states(self._tx, needed - self._rows.keys())
            ids = [one for one, state in states.items() if state in UNSUCCESSFUL]

    def add_dependants(self) -> None:
        """Add the jobs that ended only because one of the jobs in this set did not succeed, recursively."""
        behind: Collection[str] = list(self._rows)
        while behind:
            taken: list[str] = []
            for rows in self._ended_because_of(behind):
                needs = _needs(self._tx, rows)
                others = {latest for one in needs.values() for latest in one.values()} - self._rows.keys()
                missing = {one for one, state in _states(self._tx, others).items() if state in UNSUCCESSFUL}
                ready = [one for one in rows if not missing & set(needs[one].values())]
                self._take({one: rows[one] for one in ready}, {one: needs[one] for one in ready})
                self._require_few("retry it with --no-dependants (in requests: dependants=false), then each dependant")
                taken += ready
            behind = taken

    def submit(self) -> dict[str, Job]:
        """Submit the jobs again; return the new jobs by the ids of the old ones."""
        again = {one: new_id("job") for one in self._rows}
        outside = {latest for needs in self._needs.values() for latest in needs.values()} - again.keys()
        upstream = dict.fromkeys(again.values(), JobState.WAITING)
        upstream |= {one: found.state for one, found in lock_jobs(self._tx, self._project, outside).items()}
        submissions = []
        for one, row in self._rows.items():
            stand_ins = {earlier: again.get(latest, latest) for earlier, latest in self._needs[one].items()}
            submissions.append(_again(self._tx, self._project, row, again[one], stand_ins))
        made = submit_checked(self._tx, self._project, submissions, upstream)
        return dict(zip(self._rows, made, strict=True))

    def _take(self, rows: Mapping[str, Row[Any]], needs: Mapping[str, dict[str, str]]) -> None:
        if any(row.propagation_rank is not None for row in rows.values()):
            raise UnavailableProblem(
                "A job to be retried has just ended, and the server still stores its end; try again in a few seconds.",
                code="still-ending",
                headers={"Retry-After": "1"},
            )
        self._rows |= rows
        self._needs |= needs

    def _require_few(self, advice: str) -> None:
        if len(self._rows) > MOST_AT_ONCE:
            detail = f"More than {MOST_AT_ONCE:,} jobs would be retried together with this job; {advice}."
            raise ConflictProblem(detail, code="too-many")

    def _ended_because_of(self, ids: Collection[str]) -> Iterator[dict[str, Row[Any]]]:
        """Yield the jobs that could not run because one of the given jobs, on which they depend, did not succeed.

        Jobs that have a retry already, or that the caller may not retry, are left out. Each dictionary contains up to
        `MOST_AT_ONCE` jobs by id. There may be any number of them, because jobs that also depend on other unsuccessful
        jobs are among them, and are not retried.
        """
        later = job.alias("later")
        reason = job.c.failure["reason"].as_string()
        whole = roles.includes(self._project.role, Role.MAINTAINER)
        behind = select(job_dependency.c.job_id).where(job_dependency.c.on_job_id.in_(ids))
        statement = (
            select(job)
            .where(
                job.c.id.in_(behind),
                job.c.id.not_in(list(self._rows)),
                job.c.state.in_(UNSUCCESSFUL),
                job.c.cancel_requested_us.is_(None),
                job.c.parent_id.is_(None),
                or_(reason.is_(None), reason == FailureReason.DEPENDENCY_FAILED.value),
                true() if whole else job.c.author_id == self._tx.principal.user_id,
                ~select(later.c.id).where(later.c.retry_of == job.c.id).exists(),
            )
            .order_by(job.c.id)
            .limit(MOST_AT_ONCE)
        )
        last = ""
        while rows := {row.id: row for row in self._tx.execute(statement.where(job.c.id > last))}:
            yield rows
            last = max(rows)


# -- one of them -------------------------------------------------------------------------------------------------------


def _again(tx: Transaction, project: ProjectRow, row: Row[Any], new: str, stand_ins: Mapping[str, str]) -> Submission:
    """Return the submission that retries a job under the id `new`.

    `stand_ins` maps each dependency of the old job to the job on which the new job depends instead: its newest retry.
    Raises `ConflictProblem` if the kind is unknown now, the script has changed, or an input was purged.
    """
    try:
        kind = find_kind(row.kind)
    except UnknownKindError as error:
        raise ConflictProblem(
            "This version of the server does not know the kind of the job, which an earlier version "
            f"accepted: {error}.",
            code="unknown-kind",
        ) from error
    if row.kind == SCRIPT:
        require_unchanged(tx, project, row.params)
    pins = _late_pins(row, stand_ins) if row.unbound else _pins_of(tx, row, kind.fan_out)
    if purged := [pin["item"] for many in pins.values() for pin in many if "purged" in pin]:
        detail = f"The job cannot run again: its input {purged[0]} was purged, and the content of this input is gone."
        unnamed = "The job cannot run again: one of its inputs was purged, and the content of this input is gone."
        raise ConflictProblem(detail, code="input-purged", unnamed=unnamed)
    return Submission(
        kind,
        request_of(row).model_copy(update={"concurrency_key": _concurrency_key(tx, row)}),
        row.params,
        pins,
        row.size or 1,
        row.labels_key,
        tx.principal.user_id,
        after=tuple(dict.fromkeys(stand_ins.values())),
        unbound=row.unbound,
        id=new,
        retry_of=row.id,
        commit_to=commits.check_again(tx, project, kind, row.commit_to, row.into_path),
    )


def _late_pins(row: Row[Any], stand_ins: Mapping[str, str]) -> PinnedInputs:
    """Return the inputs for the retry of a job that ended while some inputs were still outputs of unfinished jobs.

    In these inputs, each unfinished job is replaced by its retry; `stand_ins` maps the ids of jobs to those of retries.
    """
    return {
        name: [{"job": stand_ins[entry["job"]]} if "job" in entry else entry for entry in entries]
        for name, entries in row.inputs.items()
    }


def _pins_of(tx: Transaction, row: Row[Any], fanned: str | None) -> PinnedInputs:
    """Return the inputs of a job.

    For a parent job whose input `fanned` was split among its tasks, the shares of the tasks are joined again.
    """
    if row.size is None or fanned is None:
        return dict(row.inputs)
    statement = select(job.c.inputs).where(job.c.parent_id == row.id).order_by(job.c.position)
    pins = [pin for inputs in tx.execute(statement).scalars() for pin in inputs[fanned]]
    return {**row.inputs, fanned: pins}


def _concurrency_key(tx: Transaction, row: Row[Any]) -> str | None:
    """Return the concurrency key of a job, or of a parent job's tasks."""
    key: str | None = row.concurrency_key
    if row.size is not None:
        key = tx.execute(select(job.c.concurrency_key).where(job.c.parent_id == row.id).limit(1)).scalar()
    return key


# -- looking up --------------------------------------------------------------------------------------------------------


def _rows(tx: Transaction, ids: Collection[str]) -> dict[str, Row[Any]]:
    rows = _select_in(tx, select(job).order_by(job.c.id), job.c.id, ids)
    return {row.id: row for row in rows}


def _states(tx: Transaction, ids: Collection[str]) -> dict[str, str]:
    rows = _select_in(tx, select(job.c.id, job.c.state).order_by(job.c.id), job.c.id, ids)
    return {row.id: row.state for row in rows}


def _needs(tx: Transaction, rows: Mapping[str, Row[Any]]) -> dict[str, dict[str, str]]:
    """Return, for each job, its dependencies, each mapped to its newest retry or, without a retry, to itself.

    The job whose result a job only waited to share is left out.
    """
    needs: dict[str, dict[str, str]] = {one: {} for one in rows}
    statement = select(job_dependency).order_by(job_dependency.c.on_job_id)
    for row in _select_in(tx, statement, job_dependency.c.job_id, rows):
        if row.on_job_id != rows[row.job_id].cached_from:
            needs[row.job_id][row.on_job_id] = row.on_job_id
    latest = _latest_tries(tx, {one for named in needs.values() for one in named})
    return {one: {earlier: latest[earlier] for earlier in named} for one, named in needs.items()}


def _latest_tries(tx: Transaction, ids: Collection[str]) -> dict[str, str]:
    """Return the newest retry of each job, or the job itself if it was not retried."""
    latest = {one: one for one in ids}
    looking: Collection[str] = set(ids)
    while looking:
        statement = select(job.c.id, job.c.retry_of).order_by(job.c.id)
        newer = {row.retry_of: row.id for row in _select_in(tx, statement, job.c.retry_of, looking)}
        latest = {one: newer.get(last, last) for one, last in latest.items()}
        looking = set(newer.values())
    return latest


def _select_in(
    tx: Transaction, statement: Select[*tuple[Any, ...]], column: ColumnElement[str], values: Iterable[str]
) -> Iterator[Row[Any]]:
    """Yield the rows whose `column` is among `values`, with several statements, because `values` may be a million.

    Each statement has its own order: the rows of all statements together are not sorted.
    """
    wanted = sorted(set(values))
    for some in in_lists(wanted):
        yield from tx.execute(statement.where(column.in_(some))).all()
