"""Late inputs: inputs of a job that are outputs of other jobs, pinned when those jobs have succeeded.

To pin an input means to store the exact revisions that the job reads. Late inputs are pinned in the transaction that
makes the job ready, while the row of the job is locked. The job is then processed like a submission with existing
inputs: it is split into tasks, gets its cache key, and is queued or shares a result.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from pydantic import ValidationError
from sqlalchemy import Row, and_, insert, select, update

from marey_schemas.queue.job_kinds import UnknownKindError, kind_of_job
from marey_schemas.queue.jobs import FailureReason, InputSpec
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_schemas.validation.reasons import first_reason
from marey_server import faults
from marey_server.errors import QuotaExceededProblem
from marey_server.store.jobs import commits, layout, result_cache
from marey_server.store.jobs.endings import Ended, end_jobs, failure_document
from marey_server.store.jobs.events import emit_job_events, wake_workers
from marey_server.store.jobs.fencing import WAITING
from marey_server.store.jobs.inputs import MOST_INPUTS, Pin, PinnedInputs, items_by_id, pin, record_named_items
from marey_server.store.jobs.layout import NewJob, Submission
from marey_server.store.jobs.result_places import find_clash
from marey_server.store.quotas.counting import note_jobs, room_of
from marey_server.store.quotas.daily import count_late
from marey_server.store.tables import job
from marey_server.store.transaction import Transaction, in_lists


class LateInputError(Exception):
    """Late input that cannot be pinned, with the code and detail of the job's failure."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code = code


def pin_late_inputs(tx: Transaction, ids: Sequence[str]) -> list[Ended]:
    """Pin the outputs of succeeded dependencies as inputs of the waiting jobs, and queue these jobs.

    Returns the jobs that ended now: jobs that failed because of a `LateInputError`, such as a missing input or an
    exceeded quota, and jobs that share an existing result.
    """
    if not ids:
        return []
    heads: list[NewJob] = []
    ended: list[Ended] = []
    room: dict[str, int] = {}
    for row in _ready_for_inputs(tx, ids):
        try:
            head = _with_late_inputs(tx, row)
            _take_room(tx, head.submission, room)
            _count_inputs(tx, head.submission, known=sum(map(len, row.inputs.values())))
            heads.append(head)
        except LateInputError as error:
            failure = failure_document(FailureReason.ERROR, error.code, str(error))
            ended += end_jobs(tx, and_(job.c.id == row.id, job.c.state == WAITING), "failed", failure=failure)
    tasks, sources = layout.lay_out(tx, heads)
    _write(tx, heads, tasks)
    everything = [*heads, *tasks]
    wake_workers(tx, {one.submission.kind.name for one in everything if one.state == "queued"})
    ended += result_cache.join(tx, [(one, sources[one.id]) for one in everything if one.id in sources])
    faults.point("late_inputs.before_commit")
    tx.after_commit(lambda: faults.point("late_inputs.after_commit"))
    return ended


def _ready_for_inputs(tx: Transaction, ids: Sequence[str]) -> Iterable[Row[Any]]:
    for some in in_lists(ids):
        chosen = and_(job.c.id.in_(some), job.c.state == WAITING, job.c.unbound)
        yield from tx.execute(select(job).where(chosen).order_by(job.c.id).with_for_update()).all()


def _with_late_inputs(tx: Transaction, row: Row[Any]) -> NewJob:
    """Return the job with its inputs pinned.

    Raises `LateInputError` if the inputs cannot be pinned, if the paths of the results conflict (`find_clash`), or if
    this version of the server does not accept the kind, the inputs or the parameters any more.
    """
    try:
        kind = kind_of_job(row.kind, row.params)
        params = kind.params.model_validate(row.params)
    except UnknownKindError as error:
        raise LateInputError(
            "unknown-kind",
            "This version of the server does not know the kind of the job, which an earlier "
            f"version accepted: {error}.",
        ) from error
    except ValidationError as error:
        detail = f"In this version of the server, these parameters of {row.kind} are not valid: {first_reason(error)}"
        raise LateInputError("invalid-params", detail) from error
    pins = _pin_outputs(tx, row, kind)
    if (clash := find_clash(kind, params, pins, row.into_path)) is not None:
        raise LateInputError(clash.code, clash.detail)
    submission = Submission(
        kind,
        layout.request_of(row),
        row.params,
        pins,
        kind.count_tasks(params, pins),
        row.labels_key,
        row.author_id,
        id=row.id,
        commit_to=commits.with_new_base(tx, row.commit_to),
    )
    return NewJob(row.id, row.project_id, submission, pins)


def _take_room(tx: Transaction, submission: Submission, room: dict[str, int]) -> None:
    """Count the tasks of a job towards the quota `user_jobs` of its author.

    `room` contains the number of jobs that each author may still have; it is updated. Raises `LateInputError` if the
    quota would be exceeded.
    """
    tasks, author_id = layout.count_tasks(submission), submission.author_id
    if not tasks or author_id is None:
        return
    if author_id not in room:
        room[author_id] = room_of(tx, "user_jobs", author_id)
    if tasks > room[author_id]:
        detail = (
            f"The job would have {tasks} tasks, but its author may have only {max(0, room[author_id])} more unfinished "
            "jobs (quota `user_jobs`). Retry the job when some have ended."
        )
        raise LateInputError(QuotaExceededProblem.code, detail)
    room[author_id] -= tasks
    note_jobs(tx, author_id, tasks)


def _count_inputs(tx: Transaction, submission: Submission, known: int) -> None:
    """Count the inputs that a job gets now towards the quota `user_daily_inputs` of its author.

    `known` is the number of inputs that were counted at the submission. Raises `LateInputError` if the quota would be
    exceeded.
    """
    if submission.author_id is None:
        return
    more = layout.count_inputs(submission) - known
    try:
        count_late(tx, submission.author_id, more)
    except QuotaExceededProblem as problem:
        detail = (
            f"The job and its tasks would get {more:,} inputs, more than its author may submit now (quota "
            "`user_daily_inputs`). Retry the job later."
        )
        raise LateInputError(problem.error_code, detail) from problem


def _write(tx: Transaction, heads: Sequence[NewJob], tasks: Sequence[NewJob]) -> None:
    for one in heads:
        tx.execute(
            update(job)
            .where(job.c.id == one.id, job.c.state == WAITING)
            .values(**layout.layout_columns(tx, one), rev=job.c.rev + 1)
        )
    for some in in_lists(tasks):
        tx.execute(insert(job), [layout.new_row(tx, one) for one in some])
    record_named_items(tx, map(layout.naming, (*heads, *tasks)))
    emit_job_events(tx, "job.bound", [(one.project_id, one.id, {"tasks": one.size or 1}) for one in heads])


# -- what the other jobs made -----------------------------------------------------------------------------------------


class _Made(NamedTuple):
    """Outputs of a succeeded job, and the collection to which the job wrote them."""

    into: str
    pins: list[Pin]

    def below(self, one: Pin) -> str:
        """Return the collection of the output `one`: relative to `self.into` if possible, otherwise the full path."""
        path: str = one["collection"]
        return f"{path}/".removeprefix(f"{self.into}/").rstrip("/") if self.into else path


def _pin_outputs(tx: Transaction, row: Row[Any], kind: KindDeclaration) -> PinnedInputs:
    pins: PinnedInputs = {}
    made: dict[str, _Made] = {}
    for name, entries in row.inputs.items():
        spec = kind.inputs.get(name)
        if spec is None:
            raise LateInputError(
                "unknown-input",
                f"In this version of the server, jobs of the kind {kind.name} have no input {name!r}. Submit a new "
                f"job; its inputs may be: {', '.join(map(repr, kind.inputs)) or 'none'}.",
            )
        chosen: dict[tuple[str, int], Pin] = {}
        for entry in entries:
            for one in _resolved(tx, row.project_id, name, spec, entry, made):
                chosen.setdefault((one["item"], one["revision"]), one)
        if not chosen and not spec.required:
            continue
        if not spec.many and len(chosen) != 1:
            sources = ", ".join(f"the job {entry['job']}" for entry in entries if "job" in entry)
            detail = f"The input {name!r} takes one {spec.kind}, but {len(chosen)} were created by {sources}."
            raise LateInputError("one-item", detail)
        pins[name] = list(chosen.values())
        if len(entries) == 1 and "job" in entries[0]:  # of several makers, items of one name may be in like places
            pins[name] = [one | {"below": made[entries[0]["job"]].below(one)} for one in pins[name]]
    total = sum(map(len, pins.values()))
    if total > MOST_INPUTS:
        raise LateInputError("too-many", f"The job has {total} inputs; at most {MOST_INPUTS} are allowed.")
    return pins


def _resolved(
    tx: Transaction, project_id: str, name: str, spec: InputSpec, entry: dict[str, Any], made: dict[str, _Made]
) -> list[Pin]:
    """Return the pins (exact revisions) of one entry of an input.

    An entry is a pin already, or names a job, whose outputs are then pinned. Raises `LateInputError` if a required
    input has no outputs.
    """
    if "job" not in entry:
        return [entry]
    source: str = entry["job"]
    if source not in made:
        made[source] = _outputs(tx, project_id, source)
    found = [one for one in made[source].pins if one["kind"] == spec.kind]
    if not found and spec.required:
        detail = (
            f"The input {name!r} needs a {spec.kind} that the job {source} creates, but this job has created none, or "
            "all of them were deleted."
        )
        raise LateInputError("no-input", detail)
    return found


def _outputs(tx: Transaction, project_id: str, job_id: str) -> _Made:
    """Return the outputs of a job or of its tasks, without deleted items.

    If the job or its tasks published several revisions of an item, only the last of these is returned.
    """
    columns = (job.c.size, job.c.gathers, job.c.outputs, job.c.into_path)
    row = tx.execute(select(*columns).where(job.c.id == job_id)).one()
    published = [row.outputs]
    if row.size is not None and not row.gathers:
        tasks = select(job.c.outputs).where(job.c.parent_id == job_id).order_by(job.c.position)
        published = list(tx.execute(tasks).scalars())
    revisions: dict[str, int] = {}
    for output in (one for outputs in published for one in outputs or ()):
        revisions[output["item"]] = max(output["revision"], revisions.get(output["item"], 0))
    found = items_by_id(tx, project_id, revisions)
    return _Made(row.into_path, [pin(found[item], number) for item, number in revisions.items() if item in found])
