"""Ends attempts: publishes the results of successful attempts, and records failures."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sqlalchemy import and_, bindparam, exists, select, tuple_, update

from marey_schemas.queue.job_kinds import UnknownKindError, find_kind
from marey_schemas.queue.jobs import JobOutput, JobState
from marey_schemas.queue.worker_protocol import (
    BatchCompletion,
    BatchCompletionResult,
    CompleteAnswer,
    CompleteRequest,
    FailAnswer,
    FailRequest,
)
from marey_server import faults
from marey_server.access.principal import Principal
from marey_server.errors import ApiProblem, NotFoundProblem
from marey_server.store.database.prepared import Prepared
from marey_server.store.jobs import commits, staging
from marey_server.store.jobs.endings import ENDED_COLUMNS, AttemptEnd, Ended, as_ended, end_attempts, end_jobs
from marey_server.store.jobs.failure import ENDING_COLUMNS, apply_outcome, decide_outcome
from marey_server.store.jobs.fan_out import release_tasks
from marey_server.store.jobs.fencing import (
    AUTHOR_MAY_RUN,
    COUNT_ATTEMPT,
    HELD,
    held,
    held_parameters,
    lease_lost,
    lock_held_job,
    require_attempt,
    stored_answer,
)
from marey_server.store.jobs.inputs import NamingJob, record_named_items
from marey_server.store.jobs.policy import DEFAULT_POLICY, SECOND_US, QueuePolicy
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.purge_lock import hold_off_purges_of_jobs
from marey_server.store.tables import attempt, job, staged_output
from marey_server.store.transaction import Transaction

_Place = tuple[str, int]
"""Id of a job and fence of its attempt."""


def complete(tx: Transaction, job_id: str, fence: int, request: CompleteRequest) -> CompleteAnswer:
    """End the job with success and publish its staged outputs; a repeated `write_id` gets the same answer.

    If the cancellation of the job was requested, the job is cancelled instead. If its outputs may not be published or
    committed, it fails instead. In both cases, nothing is published. Raises `LeaseLostProblem` if the attempt does not
    hold the job, or has ended the job with another `write_id`.
    """
    require_attempt(tx.principal, job_id, fence)
    hold_off_purges_of_jobs(tx, [job_id])
    place = (job_id, fence)
    ended = _complete(tx, {place: request})
    if place not in ended:
        return _same_answer(tx, place, request.write_id)
    propagate_ends(tx, [end for end, _ in ended.values()])
    _pass_fault_points(tx)
    return ended[place][1]


def complete_many(tx: Transaction, completions: Sequence[BatchCompletion]) -> list[BatchCompletionResult]:
    """Complete many jobs of one worker in one transaction; return the results in the order of `completions`.

    Each completion is accepted or refused separately. Only attempts that were claimed with the caller's own token are
    accepted.
    """
    requests = {(one.job, one.fence): one for one in reversed(completions)}
    own = _claimed_by_caller(tx, requests)
    hold_off_purges_of_jobs(tx, (job_id for job_id, _ in own))
    publishing = {place for place in own if any(staging.named_blobs(requests[place].result))} | _staged(tx, own)
    ended = _complete(tx, {place: requests[place] for place in own - publishing})
    refused: dict[_Place, ApiProblem] = {}
    for place in sorted(publishing):  # each in a savepoint: a refusal does not undo the others
        try:
            with tx.connection.begin_nested():
                ended |= _complete(tx, {place: requests[place]})
        except ApiProblem as error:
            refused[place] = error
    propagate_ends(tx, [end for end, _ in ended.values()])
    _pass_fault_points(tx)
    answers = {(place, requests[place].write_id): answer for place, (_, answer) in ended.items()}
    return [_result(tx, one, answers, refused, own) for one in completions]


_WIN = Prepared(
    update(job)
    .where(HELD, AUTHOR_MAY_RUN, job.c.cancel_requested_us.is_(None))
    .values(state="succeeded", finished_us=bindparam("now"), lease_expires_us=None, rev=job.c.rev + 1, **COUNT_ATTEMPT)
    .returning(
        *ENDED_COLUMNS,
        job.c.fence,
        job.c.into_path,
        job.c.author_id,
        job.c.message,
        job.c.kind,
        job.c.commit_to,
        job.c.cache_key,
        job.c.gathers,
    )
)


def _complete(
    tx: Transaction, requests: Mapping[_Place, CompleteRequest]
) -> dict[_Place, tuple[Ended, CompleteAnswer]]:
    """End the jobs whose attempts are still valid, and publish their outputs.

    Returns, by job and fence (number of the claim), the ended job and the answer. Attempts that are no longer valid are
    missing.
    """
    if not requests:
        return {}
    won = tx.run(_WIN, {"now": tx.now_us, **held_parameters(requests)})
    staged = staging.staged_drafts(tx, [(row.id, row.fence) for row in won]) if won else {}
    keyless = _keep_from_sharing(tx, won, requests)
    done: dict[_Place, tuple[Ended, CompleteAnswer]] = {}
    records = []
    for row in sorted(won, key=lambda row: row.id):
        request = requests[row.id, row.fence]
        published = commits.publish_outputs(tx, row, staged.get((row.id, row.fence), {}))
        if published.failure is not None:
            done[row.id, row.fence] = _fail_unpublished(tx, row, published.failure)
            continue
        outputs = published.outputs
        of_attempt = Principal("attempt", job_id=row.id, fence=row.fence, project_id=row.project_id)
        staging.keep_named_blobs(tx.beside(of_attempt), row.id, set(staging.named_blobs(request.result)))
        records.append(
            {
                "of_job": row.id,
                "its_result": {**published.result(row.kind, request.result), "outputs": len(outputs)},
                "its_outputs": outputs,
                "its_code": request.code_version,
                "its_environment": request.environment,
            }
        )
        if published.columns:
            tx.execute(update(job).where(job.c.id == row.id).values(**published.columns))
        answer = CompleteAnswer(
            job=row.id,
            state=JobState.SUCCEEDED,
            outputs=tuple(JobOutput(**output) for output in outputs),
            commit=published.commit,
        )
        shareable = (row.id, row.fence) not in keyless
        done[row.id, row.fence] = (replace(as_ended(row), commit=published.commit, shareable=shareable), answer)
    if done:
        _record(tx, records)
        failed = {place for place, (end, _) in done.items() if not end.succeeded}
        if unshared := (failed | keyless) & staged.keys():
            staging.drop_staged(tx, unshared)
        if gathered := [row.id for row in won if row.gathers and (row.id, row.fence) not in failed]:
            release_tasks(tx, gathered)
        end_attempts(
            tx,
            [
                AttemptEnd(
                    job_id,
                    fence,
                    end.state,
                    None if end.failure is None else end.failure["detail"],
                    write_id=requests[job_id, fence].write_id,
                    answer=answer.model_dump(mode="json"),
                )
                for (job_id, fence), (end, answer) in done.items()
            ],
        )
    return done


def _keep_from_sharing(
    tx: Transaction, won: Collection[Any], requests: Mapping[_Place, CompleteRequest]
) -> set[_Place]:
    """Remove the cache keys of completed jobs whose results must not be shared.

    A result must not be shared if the worker reports that it is not shareable, or if the worker has another version of
    the job kind. The result of a parent job must not be shared if the result of a task must not be shared. Returns all
    completed attempts whose jobs have no cache key.
    """
    unshared = {(row.id, row.fence) for row in won if row.cache_key is None}
    barred = {(row.id, row.fence) for row in won if not _may_share(row.kind, requests[row.id, row.fence])}
    if gathering := {row.id: (row.id, row.fence) for row in won if row.gathers}:
        of_tasks = select(job.c.parent_id).where(job.c.parent_id.in_(gathering), job.c.cache_key.is_(None)).distinct()
        barred |= {gathering[parent_id] for parent_id in tx.execute(of_tasks).scalars()}
    if barred - unshared:
        of_jobs = job.c.id.in_([job_id for job_id, _ in barred])
        tx.execute(update(job).where(of_jobs).values(cache_key=None))
    return unshared | barred


def _may_share(kind_name: str, request: CompleteRequest) -> bool:
    """Return whether the worker allows sharing the result, and has not reported another version of the job kind.

    The version is compared with that of the server. The result is False for a kind that the server does not know.
    """
    try:
        known = find_kind(kind_name).code_version
    except UnknownKindError:  # an earlier version of the server accepted the job
        return False
    return request.shareable and request.code_version in (None, known)


def _fail_unpublished(tx: Transaction, row: Any, failure: dict[str, Any]) -> tuple[Ended, CompleteAnswer]:
    """Record that a job failed because its outputs may not be published or committed; return the job and the answer.

    No output of the job was published.
    """
    tx.execute(update(job).where(job.c.id == row.id).values(state="failed", failure=failure))
    end = replace(as_ended(row), state=JobState.FAILED.value, failure=failure)
    return end, CompleteAnswer(job=row.id, state=JobState.FAILED)


_RECORD = Prepared(
    update(job)
    .where(job.c.id == bindparam("of_job"))
    .values(
        result=bindparam("its_result"),
        outputs=bindparam("its_outputs"),
        code_version=bindparam("its_code"),
        environment=bindparam("its_environment"),
    )
)


def _record(tx: Transaction, records: Sequence[dict[str, Any]]) -> None:
    """Store the results of the jobs that this transaction completed."""
    tx.run_each(_RECORD, records)
    record_named_items(tx, (NamingJob(one["of_job"], outputs=one["its_outputs"]) for one in records))


def _pass_fault_points(tx: Transaction) -> None:
    faults.point("complete.before_commit")
    tx.after_commit(lambda: faults.point("complete.after_commit"))


def _same_answer(tx: Transaction, place: _Place, write_id: str) -> CompleteAnswer:
    earlier = stored_answer(tx, *place, write_id)
    if earlier is None:
        return _end_cancelled(tx, place, write_id)
    if earlier["state"] != JobState.CANCELLED and "outputs" not in earlier:  # the answer to a report of failure
        raise lease_lost(*place)
    return CompleteAnswer(**earlier)


def _end_cancelled(tx: Transaction, place: _Place, write_id: str) -> CompleteAnswer:
    """End a job as cancelled, because its cancellation was requested before the attempt completed; return the answer.

    Raises `LeaseLostProblem` if the attempt does not hold the job.
    """
    ended = end_jobs(tx, and_(held(*place), job.c.cancel_requested_us.is_not(None)), JobState.CANCELLED.value)
    if not ended:
        raise lease_lost(*place)
    answer = CompleteAnswer(job=place[0], state=JobState.CANCELLED)
    end = AttemptEnd(*place, "cancelled", write_id=write_id, answer=answer.model_dump(mode="json"))
    end_attempts(tx, [end])
    staging.drop_staged(tx, [place])
    propagate_ends(tx, ended)
    return answer


# -- batches ----------------------------------------------------------------------------------------------------------


def _claimed_by_caller(tx: Transaction, places: Iterable[_Place]) -> set[_Place]:
    """Return the attempts that were claimed with the caller's own token."""
    wanted = list(places)
    statement = select(attempt.c.job_id, attempt.c.fence).where(
        attempt.c.job_id.in_([job_id for job_id, _ in wanted]),  # for pairs alone SQLite would scan the table
        tuple_(attempt.c.job_id, attempt.c.fence).in_(wanted),
    )
    if tx.principal.kind != "system":
        statement = statement.where(attempt.c.claimed_by == (tx.principal.token_id or ""))
    return {(row.job_id, row.fence) for row in tx.execute(statement)}


def _staged(tx: Transaction, places: Collection[_Place]) -> set[_Place]:
    """Return those of the given attempts for which outputs are staged."""
    columns = (staged_output.c.job_id, staged_output.c.fence)
    of_jobs = staged_output.c.job_id.in_([job_id for job_id, _ in places])
    rows = tx.execute(select(*columns).where(of_jobs, tuple_(*columns).in_(list(places))).distinct())
    return {(row.job_id, row.fence) for row in rows}


def _result(
    tx: Transaction,
    one: BatchCompletion,
    answers: Mapping[tuple[_Place, str], CompleteAnswer],
    refused: Mapping[_Place, ApiProblem],
    own: Collection[_Place],
) -> BatchCompletionResult:
    place = (one.job, one.fence)
    try:
        if place not in own:
            raise NotFoundProblem(f"You have not claimed attempt {one.fence} of the job {one.job}.")
        if place in refused:
            raise refused[place]
        answer = answers.get((place, one.write_id)) or _same_answer(tx, place, one.write_id)
    except ApiProblem as error:
        return BatchCompletionResult(job=one.job, fence=one.fence, code=error.error_code, detail=error.detail)
    return BatchCompletionResult(job=one.job, fence=one.fence, answer=answer)


# -- failure ----------------------------------------------------------------------------------------------------------


def fail(
    tx: Transaction, job_id: str, fence: int, request: FailRequest, policy: QueuePolicy = DEFAULT_POLICY
) -> FailAnswer:
    """End the attempt without success; a repeated `write_id` gets the same answer.

    Raises `LeaseLostProblem` if the attempt does not hold the job, or has ended with another `write_id`.
    """
    require_attempt(tx.principal, job_id, fence)
    hold_off_purges_of_jobs(tx, [job_id])
    earlier = stored_answer(tx, job_id, fence, request.write_id)
    if earlier is not None:
        if earlier["state"] == JobState.SUCCEEDED:
            raise lease_lost(job_id, fence)
        return FailAnswer(**earlier)
    row = lock_held_job(tx, job_id, fence, *ENDING_COLUMNS)
    outcome = decide_outcome(row, request, policy, poisoned=_is_poisoned(tx, job_id, request.signature))
    answer = FailAnswer(
        job=job_id,
        state=JobState(outcome.state),
        retry_in_s=None if outcome.rest_us is None else outcome.rest_us / SECOND_US,
    )
    end = AttemptEnd(
        job_id,
        fence,
        outcome.attempt_outcome,
        request.detail,
        request.signature,
        request.write_id,
        answer.model_dump(mode="json"),
    )
    apply_outcome(tx, row, held(job_id, fence), outcome, end)
    faults.point("fail.before_commit")
    return answer


def _is_poisoned(tx: Transaction, job_id: str, signature: str | None) -> bool:
    """Return whether an earlier attempt of the job ended with the same failure signature.

    The signature identifies the error and the place in the code where the error occurred. If it is the same, a retry
    would fail in the same way, and perhaps stop another worker.
    """
    if signature is None:
        return False
    seen = exists().where(attempt.c.job_id == job_id, attempt.c.signature == signature)
    return bool(tx.execute(select(seen)).scalar())
