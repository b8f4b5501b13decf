"""Submission of jobs: checks requests, pins inputs, splits fan-outs and inserts rows, many in one transaction."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

from pydantic import ValidationError
from sqlalchemy import insert, select

from marey_schemas.access import Role
from marey_schemas.problems import FieldError
from marey_schemas.queue.job_kinds import MOST_TASKS, UnknownKindError, find_kind, script_kind
from marey_schemas.queue.jobs import Job, JobCreate, JobState
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_schemas.queue.pipelines import (
    Pipeline,
    PipelineCreate,
    PipelineError,
    PipelineStep,
    job_of_step,
    order_steps,
)
from marey_schemas.queue.scripts import ScriptParams
from marey_server import faults
from marey_server.access.folder_rights import FolderRights
from marey_server.access.labels import labels_key
from marey_server.access.own_pods import labels_of_job
from marey_server.errors import InvalidProblem
from marey_server.field_errors import field_errors, json_pointer
from marey_server.store.database.prepared import Prepared
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.ids import new_id
from marey_server.store.jobs import commits, result_cache, staging
from marey_server.store.jobs.documents import document_of_new, job_documents
from marey_server.store.jobs.endings import dependency_failure
from marey_server.store.jobs.events import emit_job_events, wake_workers
from marey_server.store.jobs.exports import record_permission
from marey_server.store.jobs.inputs import (
    FoundItem,
    PinnedInputs,
    find_items,
    late_inputs,
    pin_inputs,
    record_named_items,
)
from marey_server.store.jobs.late_inputs import pin_late_inputs
from marey_server.store.jobs.layout import NewJob, Submission, count_inputs, lay_out, naming, new_row
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.jobs.result_places import find_clash, result_folders
from marey_server.store.projects import ProjectRow, require
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.quotas import daily
from marey_server.store.quotas.counting import require_room_for_jobs
from marey_server.store.scripts.registry import record_runs, resolve_params
from marey_server.store.tables import job, job_dependency
from marey_server.store.transaction import Transaction, in_lists

_INSERT_JOB = Prepared(insert(job))


class Upstream(NamedTuple):
    """Job on which other jobs depend."""

    kind: str
    state: JobState


def submit(tx: Transaction, project: str, requests: Sequence[JobCreate]) -> list[Job]:
    """Submit jobs to a project, all or none; return them in the order of the requests.

    Raises `InvalidProblem` with a pointer to each fault, and the errors of `projects.require`.
    """
    row = require(tx, project)
    hold_off_purges(tx, row.id)
    rights_of_caller(tx, row)  # here, because it must precede the locks of jobs
    many = len(requests) > 1
    return submit_at(tx, row, {f"/jobs/{index}" if many else "": one for index, one in enumerate(requests)})


def submit_at(
    tx: Transaction,
    project: ProjectRow,
    requests: Mapping[str, JobCreate],
    ids: Mapping[str, str] = MappingProxyType({}),
) -> list[Job]:
    """Submit the jobs of a request, as `submit` does; `requests` has the JSON Pointers to them as keys.

    `ids` maps JSON Pointers to ids that are reserved for these jobs, because later jobs of the request depend on them.
    The caller must have called `hold_off_purges` and `rights_of_caller`.
    """
    known = find_items(tx, project, requests.values())
    made = {ids[at]: Upstream(one.kind, JobState.WAITING) for at, one in requests.items() if at in ids}
    upstream = made | _lock_upstream(tx, project, requests, made)
    checked = []
    for at, one in requests.items():
        submission = _check(tx, project, one, known, at)
        _check_makers(submission, upstream, made, at)
        checked.append(replace(submission, id=ids[at]) if at in ids else submission)
    return submit_checked(tx, project, checked, {one: found.state for one, found in upstream.items()})


def check_request(tx: Transaction, project: ProjectRow, request: JobCreate, at: str) -> None:
    """Check that a job could be submitted now, without submitting it; `at` is the JSON Pointer to it in the request.

    Raises `InvalidProblem` with a pointer to the fault, and `ForbiddenProblem` if the caller may not write to the
    folder of the results.
    """
    checked = _check(tx, project, request, find_items(tx, project, (request,)), at)
    _require_folders(rights_of_caller(tx, project), checked)


def _require_folders(rights: FolderRights, submitted: Submission) -> None:
    for folder in result_folders(submitted.kind, submitted.params, submitted.pins, submitted.request.into):
        rights.require(folder, Role.CONTRIBUTOR)


def submit_checked(
    tx: Transaction, project: ProjectRow, submissions: Sequence[Submission], upstream: Mapping[str, JobState]
) -> list[Job]:
    """Insert the rows of checked jobs and queue those without unfinished dependencies.

    `upstream` maps the ids of the jobs on which the new jobs depend to their states. Jobs in `upstream` that exist must
    be locked; those that are themselves new have the state `waiting`.

    Raises `ForbiddenProblem` if the role of the caller is too low for an export without consent, or if the caller may
    not write to the folder of the results. Raises `QuotaExceededProblem` for too many unfinished jobs, or too many
    inputs in a day.
    """
    rights = rights_of_caller(tx, project)
    for submitted in submissions:
        _require_folders(rights, submitted)
        record_permission(tx, project, submitted.id, submitted.kind, submitted.params, submitted.pins)
    inputs = sum(map(count_inputs, submissions))
    daily.require_submittable(tx, inputs)
    heads = [_head(project, one, upstream) for one in submissions]
    tasks, sources = lay_out(tx, [one for one in heads if not one.unbound])
    everything = [*heads, *tasks]
    require_room_for_jobs(tx, sum(not JobState(one.state).terminal for one in everything))
    rows = {one.id: new_row(tx, one) for one in everything}
    tx.run_each(_INSERT_JOB, list(rows.values()))
    record_named_items(tx, map(naming, everything), new=True)
    record_runs(tx, project.id, [(one.id, one.submission.kind.name, one.submission.params) for one in heads])
    _insert_dependencies(tx, submissions, upstream)
    for one in heads:
        staging.keep_named_blobs(tx, one.id, set(staging.named_blobs(one.submission.params)))
    events = [(one.project_id, one.id, {"kind": one.submission.kind.name}) for one in heads]
    emit_job_events(tx, "job.submitted", events)
    wake_workers(tx, {one.submission.kind.name for one in everything if one.state == "queued"})
    ended = [one.as_ended() for one in everything if one.state in ("failed", "cancelled")]
    ended += result_cache.join(tx, [(one, sources[one.id]) for one in everything if one.id in sources])
    bindable = [one.id for one in heads if one.unbound and one.state == "waiting" and not one.dependencies_left]
    ended += pin_late_inputs(tx, bindable)
    propagate_ends(tx, ended)
    daily.count_submitted(tx, inputs)
    faults.point("submit.before_commit")
    tx.after_commit(lambda: faults.point("submit.after_commit"))
    if ended or sources or bindable or tasks:  # what was inserted has been changed since, or is not the whole of it
        return job_documents(tx, [one.id for one in heads])
    return [document_of_new(tx, project.name, rows[one.id], one.submission.after) for one in heads]


# -- checking ---------------------------------------------------------------------------------------------------------


def _check(
    tx: Transaction, project: ProjectRow, request: JobCreate, known: dict[str, FoundItem], at: str
) -> Submission:
    try:
        kind = find_kind(request.kind)
    except UnknownKindError as error:
        raise _invalid(f"{at}/kind", "unknown-kind", str(error)) from error
    try:
        params = kind.params.model_validate(request.params)
    except ValidationError as error:
        found = field_errors(error, kind.params, request.params, lambda steps: f"{at}/params{json_pointer(steps)}")
        detail = f"These parameters are not valid for {kind.name}: {found[0].pointer}: {found[0].detail}"
        raise InvalidProblem(detail, errors=found) from error
    image = None
    if isinstance(params, ScriptParams):
        params = resolve_params(tx, project, params, at)
        kind, request = _with_script(params, request)
        image = None if params.declaration is None else params.declaration.image
    pins = pin_inputs(tx, project, kind, request, known, at)
    if (clash := find_clash(kind, params, pins, request.into)) is not None:
        unnamed = "Two results of the job, or a result and an input, would have the same place, or a path is too long."
        raise _invalid(f"{at}{clash.place}", clash.code, clash.detail, unnamed)
    tasks, plain = _count_tasks(kind, params, pins, at), params.model_dump(mode="json")
    late = [maker for _, _, maker in late_inputs(request, at)]
    return Submission(
        kind,
        request,
        plain,
        pins,
        tasks,
        labels_key(labels_of_job(request, image, tx.pod_rules, at)),
        tx.principal.user_id,
        after=tuple(dict.fromkeys((*request.after, *late))),
        unbound=bool(late),
        commit_to=_target(tx, project, kind, request, at),
    )


def _with_script(params: ScriptParams, request: JobCreate) -> tuple[KindDeclaration, JobCreate]:
    """Return the job kind with the inputs that a script declares, and the request with the script's resource limits."""
    assert params.declaration is not None
    limits = {"resources": params.declaration.limits.resources}
    return script_kind(params.declaration), request.model_copy(update=limits)


def _target(
    tx: Transaction, project: ProjectRow, kind: KindDeclaration, request: JobCreate, at: str
) -> commits.Target | None:
    if request.commit is None:
        return None
    return commits.check_target(tx, project, kind, request.commit, request.into, f"{at}/commit")


def _count_tasks(kind: KindDeclaration, params: Any, pins: PinnedInputs, at: str) -> int:
    count = kind.count_tasks(params, pins)
    if not 1 <= count <= MOST_TASKS:
        detail = f"These parameters divide the job into {count} tasks; 1 to {MOST_TASKS} are allowed."
        raise _invalid(f"{at}/params", "too-many-tasks", detail)
    return count


def _invalid(pointer: str, code: str, detail: str, unnamed: str | None = None) -> InvalidProblem:
    errors = [FieldError(pointer=pointer, code=code, detail=detail)]
    return InvalidProblem(detail, errors=errors, unnamed=unnamed)


def _lock_upstream(
    tx: Transaction, project: ProjectRow, requests: Mapping[str, JobCreate], to_be: Collection[str]
) -> dict[str, Upstream]:
    """Return the existing jobs on which the requested jobs depend, by id, and lock them.

    So none of them ends before the dependent jobs are inserted. `to_be` are the ids reserved for jobs of the same
    request, which do not exist yet. A job can depend only on existing jobs and on earlier jobs of the same request, so
    no cycle is possible. Raises `InvalidProblem` for a job that is neither.
    """
    places = {
        place: one
        for at, request in requests.items()
        for place, one in (
            *((f"{at}/after/{index}", one) for index, one in enumerate(request.after)),
            *((f"{place}/job", one) for place, _, one in late_inputs(request, at)),
        )
        if one not in to_be
    }
    found = lock_jobs(tx, project, places.values())
    for place, one in places.items():
        if one not in found:
            raise _invalid(place, "unknown-job", f"The request names the job {one!r}, which is not in the project.")
    return found


def lock_jobs(tx: Transaction, project: ProjectRow, ids: Iterable[str]) -> dict[str, Upstream]:
    """Return, by id, those of the given jobs that exist in the project; lock them, so that none ends meanwhile.

    The lock lasts until the transaction ends.
    """
    wanted = sorted(set(ids))
    found: dict[str, Upstream] = {}
    for some in in_lists(wanted):
        statement = (
            select(job.c.id, job.c.kind, job.c.state)
            .where(job.c.id.in_(some), job.c.project_id == project.id)
            .order_by(job.c.id)
            .with_for_update(read=True)
        )
        found |= {row.id: Upstream(row.kind, JobState(row.state)) for row in tx.execute(statement)}
    return found


def _check_makers(submission: Submission, upstream: Mapping[str, Upstream], to_be: Collection[str], at: str) -> None:
    """Raise `InvalidProblem` if an input takes outputs of a job that creates no items of the input's kind.

    If this job belongs to the same request, the JSON Pointer of the error ends in `step`, otherwise in `job`.
    """
    for place, name, maker in late_inputs(submission.request, at):
        wanted = submission.kind.inputs[name].kind
        try:
            makes = find_kind(upstream[maker].kind).outputs.values()
        except UnknownKindError:
            continue  # of a kind that this server knew once: what it made counts
        if wanted not in makes:
            made = ", ".join(sorted(set(makes))) or "nothing"
            detail = f"A job of the kind {upstream[maker].kind} creates {made}, but this input needs {wanted}."
            raise _invalid(f"{place}/{'step' if maker in to_be else 'job'}", "wrong-kind", detail)


# -- rows -------------------------------------------------------------------------------------------------------------


def _head(project: ProjectRow, submission: Submission, upstream: Mapping[str, JobState]) -> NewJob:
    head = NewJob(submission.id, project.id, submission, submission.pins)
    states = {one: upstream[one] for one in submission.after}
    unfinished = [one for one, state in states.items() if not state.terminal]
    missed = [one for one, state in states.items() if state.terminal and state != JobState.SUCCEEDED]
    if missed and submission.request.on_failure == "skip":
        head.state = "cancelled"
    elif missed:
        head.state = "failed"
        head.failure = dependency_failure(missed[0], states[missed[0]])
    elif unfinished or submission.unbound:
        head.state, head.dependencies_left = "waiting", len(unfinished)
    return head


def _insert_dependencies(tx: Transaction, submissions: Sequence[Submission], upstream: Mapping[str, JobState]) -> None:
    rows = [
        {"job_id": one.id, "on_job_id": other, "satisfied": upstream[other].terminal}
        for one in submissions
        for other in one.after
    ]
    for some in in_lists(rows):
        tx.execute(insert(job_dependency), some)


def submit_pipeline(tx: Transaction, project: str, pipeline: PipelineCreate) -> Pipeline:
    """Submit a job for each step of a pipeline.

    If a step reads outputs of other steps, its job starts when the jobs of those steps have succeeded. Raises
    `InvalidProblem` with a pointer to each fault, and the errors of `projects.require`.
    """
    row = require(tx, project)
    hold_off_purges(tx, row.id)
    rights_of_caller(tx, row)  # here, because it must precede the locks of jobs
    try:
        order = order_steps(pipeline)
    except PipelineError as error:
        detail = str(error)
        raise InvalidProblem(
            detail, errors=[FieldError(pointer=error.pointer, code=error.code, detail=detail)]
        ) from error
    ids = {name: new_id("job") for name in order}
    places = {name: f"/steps/{name}" for name in order}
    requests = {places[name]: _placed(job_of_step(pipeline, name, ids), pipeline.steps[name]) for name in order}
    jobs = submit_at(tx, row, requests, {places[name]: ids[name] for name in order})
    return Pipeline(jobs=dict(zip(order, jobs, strict=True)))


def _placed(request: JobCreate, step: PipelineStep) -> JobCreate:
    """Return the job request of a step, without those settings of the pipeline that do not apply to the step.

    The field `into` is left out if the place of the results is fixed; for example, a tree is stored in its model. The
    field `commit` is left out if the step creates no items.
    """
    try:
        kind = find_kind(request.kind)
        params = kind.params.model_validate(request.params)
    except (UnknownKindError, ValidationError):
        return request  # it is refused where it is checked, with the place of what is wrong
    if step.commit is None and not commits.kinds_made_by(kind):
        request = request.model_copy(update={"commit": None})
    if step.into is not None:
        return request
    unclear = kind.unclear_place
    if unclear is None or unclear(params, request.into) is None or unclear(params, "") is not None:
        return request
    return request.model_copy(update={"into": ""})
