"""Claims and heartbeats of jobs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sqlalchemy import (
    CTE,
    BigInteger,
    ColumnElement,
    FromClause,
    Row,
    and_,
    bindparam,
    case,
    cast,
    exists,
    func,
    insert,
    or_,
    select,
    update,
)
from sqlalchemy.sql.dml import ReturningUpdate

from marey_schemas.problems import FieldError
from marey_schemas.queue.jobs import Resources
from marey_schemas.queue.worker_protocol import (
    PROTOCOL_VERSION,
    ClaimRequest,
    Heartbeat,
    HeartbeatAnswer,
    JobTrace,
    Lease,
    PinnedInput,
)
from marey_server import faults
from marey_server.access.labels import keys_within
from marey_server.access.secret_tokens import IssuedToken, derive_attempt_token, issue_attempt_token, sealed
from marey_server.errors import InvalidProblem, LeaseLostProblem
from marey_server.store.credentials.server_key import read_seal_key
from marey_server.store.database.prepared import Prepared
from marey_server.store.jobs.claiming.rights import named_job, require_worker
from marey_server.store.jobs.claiming.turns import (
    Restriction,
    Turn,
    claim_order,
    is_claimable,
    next_projects,
    note_served,
    statement_of_turns,
    take_within_limit,
    turns_of,
)
from marey_server.store.jobs.events import emit_job_events
from marey_server.store.jobs.exports import lease_inputs
from marey_server.store.jobs.fencing import (
    COUNT_ATTEMPT,
    HELD,
    RUNNING,
    UNCOUNTED,
    earlier,
    held,
    held_parameters,
    lease_lost,
    require_attempt,
)
from marey_server.store.jobs.layout import trace_header
from marey_server.store.jobs.policy import DEFAULT_POLICY, SECOND_US, QueuePolicy
from marey_server.store.tables import attempt, job, project
from marey_server.store.transaction import Transaction


def claim(tx: Transaction, request: ClaimRequest, policy: QueuePolicy = DEFAULT_POLICY) -> list[Lease]:
    """Claim up to `request.max` queued jobs for the caller, in order of priority.

    Each claim of a job increases its fence, the number by which the new attempt is identified. A repeated `claim_id`
    gets the leases of the earlier claim that are still held. If none of these leases is held, raises
    `LeaseLostProblem`. Raises `ForbiddenProblem` if the caller may not claim jobs or may not announce these labels.
    Raises `InvalidProblem` if the worker uses another version of the protocol.
    """
    if request.protocol != PROTOCOL_VERSION:
        detail = (
            f"The worker uses version {request.protocol} of the protocol, but the server uses version "
            f"{PROTOCOL_VERSION}. Install the same version of Marey for both."
        )
        raise InvalidProblem(detail, errors=[FieldError(pointer="/protocol", code="protocol", detail=detail)])
    scopes = require_worker(tx.principal, request)
    claim_id = request.claim_id if tx.principal.token_key else None
    queries = _claim_queries(tx, request, scopes, policy)
    places, turns = _read_turns(tx, claim_id, queries)
    if claim_id is not None and places:
        return _leases_again(tx, claim_id, places, policy)
    rows = _claim_in_turn(tx, queries, turns, request.max)
    if not rows:
        return []
    tokens = [_issue_token(tx, claim_id, row) for row in rows]
    tx.run_each(
        _INSERT_ATTEMPT,
        [
            {
                "job_id": row.id,
                "fence": row.fence,
                "worker": request.worker,
                "claimed_by": tx.principal.token_id,
                "claim_id": claim_id,
                "token_hash": token.secret_hash,
                "started_us": tx.now_us,
            }
            for row, token in zip(rows, tokens, strict=True)
        ],
    )
    emit_job_events(tx, "job.started", [(row.project_id, row.id, {"fence": row.fence}) for row in rows])
    delays_s = [_delay_s(tx, row) for row in rows]
    tx.after_commit(lambda: tx.observer.observe_claims(delays_s))
    tx.after_commit(lambda: faults.point("claim.after_commit"))
    return _leases(tx, rows, tokens, policy)


_INSERT_ATTEMPT = Prepared(insert(attempt))

_CLAIMED_BEFORE = Prepared(
    select(attempt.c.job_id, attempt.c.fence).where(
        attempt.c.claimed_by == bindparam("token"), attempt.c.claim_id == bindparam("claim")
    )
)


def _read_turns(
    tx: Transaction, claim_id: str | None, queries: _ClaimQueries
) -> tuple[list[tuple[str, int]], list[Turn]]:
    """Return the attempts of an earlier claim with the same `claim_id`, and the projects with jobs for this claim.

    The attempts are given by job and fence; there are none without an earlier claim. Concurrent claims with the same
    `claim_id` run one after the other.
    """
    if claim_id is None:
        return [], turns_of(tx.run(queries.turns, queries.of_turns))
    token_id = tx.principal.token_id
    tx.lock(f"claim {token_id} {claim_id}")
    before, rows = tx.run_together(
        (_CLAIMED_BEFORE, {"token": token_id, "claim": claim_id}), (queries.turns, queries.of_turns)
    )
    return [(row.job_id, row.fence) for row in before], turns_of(rows)


def _leases_again(
    tx: Transaction, claim_id: str, places: Sequence[tuple[str, int]], policy: QueuePolicy
) -> list[Lease]:
    """Renew and return the leases of an earlier claim that are still held.

    Raises `LeaseLostProblem` if all of them have ended.
    """
    renewed = update(job).where(HELD).values(**_renewed(tx, policy)).returning(*_LEASE_COLUMNS)
    rows = sorted(tx.execute(renewed, held_parameters(places)).all(), key=_pick_order)
    if not rows:
        raise LeaseLostProblem("All leases of this claim have ended. Claim jobs with a new `claim_id`.")
    return _leases(tx, rows, [_issue_token(tx, claim_id, row) for row in rows], policy)


def _issue_token(tx: Transaction, claim_id: str | None, row: Row[Any]) -> IssuedToken:
    """Return a new token for an attempt.

    A claim with a `claim_id` may be repeated. So its token is derived from the caller's token, the `claim_id` and the
    attempt: a repetition gets the same token, although the server stores no secret.
    """
    if claim_id is None:
        return issue_attempt_token()
    return derive_attempt_token(tx.principal.token_key, claim_id, row.id, row.fence)


def heartbeat(
    tx: Transaction, job_id: str, fence: int, request: Heartbeat, policy: QueuePolicy = DEFAULT_POLICY
) -> HeartbeatAnswer:
    """Extend the lease of an attempt, and store the progress that the worker reports.

    After a cancellation, or at the time limit of the job, the lease is extended only to the end of a grace period. An
    expired lease is extended, too, unless the job was reclaimed. Raises `LeaseLostProblem` if the attempt no longer
    holds the job.
    """
    require_attempt(tx.principal, job_id, fence)
    values: dict[str, Any] = {**_renewed(tx, policy), **COUNT_ATTEMPT}
    if request.progress is not None:
        values["progress"] = request.progress.model_dump(mode="json")
    columns = (job.c.lease_expires_us, job.c.cancel_requested_us, job.c.deadline_us)
    row = tx.execute(update(job).where(held(job_id, fence)).values(**values).returning(*columns)).one_or_none()
    if row is None:
        raise lease_lost(job_id, fence)
    return HeartbeatAnswer(
        lease_ttl_s=max(0, row.lease_expires_us - tx.now_us) / SECOND_US,
        cancel_requested=row.cancel_requested_us is not None,
        deadline_s=max(0, row.deadline_us - tx.now_us) / SECOND_US,
    )


def _renewed(tx: Transaction, policy: QueuePolicy) -> dict[str, Any]:
    """Return the values of the columns of a job that renew its lease.

    If the lease has expired, the time since then does not count towards the time limit of the job, because the clock of
    the database may have jumped. Workers stop at the limit by their own clocks; the server's limit is only for workers
    that do not stop.
    """
    late = and_(job.c.lease_expires_us < tx.now_us, job.c.cancel_requested_us.is_(None))
    deadline_us = job.c.deadline_us + case((late, tx.now_us - job.c.lease_expires_us), else_=0)
    return {
        "deadline_us": deadline_us,
        "lease_expires_us": earlier(deadline_us + policy.end_grace_us, tx.now_us + policy.lease_ttl_us),
    }


# -- the claim in one statement ----------------------------------------------------------------------------------------


_LEASE_COLUMNS = (
    job.c.id,
    job.c.project_id,
    select(project.c.name).where(project.c.id == job.c.project_id).scalar_subquery().label("project_name"),
    job.c.kind,
    job.c.params,
    job.c.inputs,
    job.c.into_path,
    job.c.seed,
    job.c.parent_id,
    job.c.position,
    job.c.size,
    job.c.time_limit_s,
    job.c.memory_limit_mb,
    job.c.fence,
    (job.c.attempt + UNCOUNTED).label("attempt"),
    job.c.priority,
    job.c.run_at_us,
    job.c.environment,
)


def _claim_statement(*, one_job: bool) -> ReturningUpdate[*tuple[Any, ...]]:
    """Return the statement that claims jobs of one project; with `one_job`, only the job that a claim names."""
    pick = _pick(one_job=one_job)
    now_us = bindparam("now_us", type_=BigInteger)
    deadline_us = now_us + cast(job.c.time_limit_s, BigInteger) * SECOND_US
    return (
        update(job)
        .where(job.c.id == pick.c.id)
        .values(
            state="running",
            fence=job.c.fence + 1,
            lease_expires_us=earlier(deadline_us + bindparam("end_grace"), now_us + bindparam("lease_ttl")),
            deadline_us=deadline_us,
            started_us=func.coalesce(job.c.started_us, now_us),
            progress=None,
            rev=job.c.rev + 1,
        )
        .returning(*_LEASE_COLUMNS)
    )


def _pick(*, one_job: bool) -> CTE:
    """Return the query for the ids of the jobs to claim.

    Of the jobs with the same concurrency key, the query selects at most one, and none while a job with this key runs.
    """

    def claimable(candidate: FromClause) -> ColumnElement[bool]:
        conditions = [candidate.c.project_id == bindparam("of_project"), is_claimable(candidate)]
        if one_job:
            conditions.append(candidate.c.id == bindparam("one_job"))
        return and_(*conditions)

    rival = job.alias("rival")
    same_key = and_(rival.c.project_id == job.c.project_id, rival.c.concurrency_key == job.c.concurrency_key)
    rival_runs = exists().where(same_key, rival.c.state == RUNNING)
    first_of_key = (
        select(rival.c.id).where(same_key, claimable(rival)).order_by(*claim_order(rival)).limit(1).scalar_subquery()
    )
    return (
        select(job.c.id)
        .where(claimable(job), or_(job.c.concurrency_key.is_(None), and_(~rival_runs, job.c.id == first_of_key)))
        .order_by(*claim_order(job))
        .limit(bindparam("most"))
        .with_for_update(skip_locked=True)
        .cte("pick")
    )


def _pick_order(row: Row[Any]) -> tuple[Any, ...]:
    return -row.priority, row.run_at_us, row.id


_CLAIM_STATEMENTS = {one_job: Prepared(_claim_statement(one_job=one_job)) for one_job in (False, True)}


class _ClaimQueries(NamedTuple):
    """Statements that find projects with jobs for a claim (`turns`) and claim jobs (`claim`), with their parameters."""

    turns: Prepared
    of_turns: Mapping[str, Any]
    claim: Prepared
    of_claim: Mapping[str, Any]


def _claim_queries(tx: Transaction, request: ClaimRequest, scopes: Sequence[str], policy: QueuePolicy) -> _ClaimQueries:
    caller = tx.principal
    own_projects = caller.kind == "user" and not caller.administrator
    restriction = Restriction(request.job is not None, "work" not in scopes, own_projects)
    jobs: dict[str, Any] = {
        "now_us": tx.now_us,
        "kinds": list(request.kinds),
        "label_keys": keys_within(request.labels),
    }
    if restriction.one_job:
        jobs["one_job"] = named_job(tx, request)
    projects: dict[str, Any] = {}
    if restriction.named_projects:
        projects["project_names"] = [scope.partition("=")[2] for scope in scopes]
    if restriction.own_projects:
        projects["user"] = caller.user_id
    lease = {"lease_ttl": policy.lease_ttl_us, "end_grace": policy.end_grace_us}
    return _ClaimQueries(
        statement_of_turns(restriction), jobs | projects, _CLAIM_STATEMENTS[restriction.one_job], jobs | lease
    )


def _claim_in_turn(tx: Transaction, queries: _ClaimQueries, turns: Sequence[Turn], most: int) -> list[Row[Any]]:
    """Claim up to `most` jobs, from each project as many as `next_projects` gives to it; return the rows of the jobs.

    If a project has fewer jobs, the remaining ones are taken from the other projects.
    """
    rows: list[Row[Any]] = []
    served: set[Turn] = set()
    remaining = list(turns)
    while shares := Counter(next_projects(remaining, most - len(rows))):
        for turn, share in shares.items():

            def take(number: int, turn: Turn = turn) -> list[Row[Any]]:
                return tx.run(queries.claim, {**queries.of_claim, "of_project": turn.project_id, "most": number})

            taken = take_within_limit(tx, turn, share, take, may_wait=not rows)
            rows += taken
            turn.running += len(taken)
            if taken:
                served.add(turn)
            if len(taken) < share:  # it has no more jobs for this claim
                remaining.remove(turn)
    note_served(tx, turns, served)
    return sorted(rows, key=_pick_order)


# -- answers ----------------------------------------------------------------------------------------------------------


def _leases(
    tx: Transaction, rows: Sequence[Row[Any]], tokens: Sequence[IssuedToken], policy: QueuePolicy
) -> list[Lease]:
    sizes, seal_key = _sizes(tx, rows), read_seal_key(tx)
    all_inputs = lease_inputs(tx, ((row.kind, row.inputs) for row in rows))
    return [
        _lease(
            row,
            inputs,
            sizes.get(row.parent_id, row.size),
            sealed(token, seal_key),
            policy,
            _trace(tx, row),
        )
        for row, inputs, token in zip(rows, all_inputs, tokens, strict=True)
    ]


def _sizes(tx: Transaction, rows: Sequence[Row[Any]]) -> dict[str, int]:
    """Return the numbers of tasks of the parent jobs of the given tasks, by the id of the parent job."""
    parents = {row.parent_id for row in rows if row.parent_id is not None}
    if not parents:
        return {}
    return {one.id: one.size for one in tx.execute(select(job.c.id, job.c.size).where(job.c.id.in_(parents)))}


def _trace(tx: Transaction, row: Row[Any]) -> JobTrace | None:
    """Return the trace of a job, or None without a trace; it contains how long the job was ready before the claim."""
    header = trace_header(row.environment)
    return None if header is None else JobTrace(traceparent=header, waited_s=_delay_s(tx, row))


def _delay_s(tx: Transaction, row: Row[Any]) -> float:
    return max(0, tx.now_us - row.run_at_us) / SECOND_US


def _lease(
    row: Row[Any],
    inputs: Mapping[str, Any],
    size: int | None,
    token: str,
    policy: QueuePolicy,
    trace: JobTrace | None,
) -> Lease:
    return Lease(
        job=row.id,
        project=row.project_name,
        kind=row.kind,
        params=row.params,
        inputs={name: tuple(PinnedInput(**pin) for pin in pins) for name, pins in inputs.items()},
        into=row.into_path,
        seed=row.seed,
        position=row.position,
        size=size,
        resources=Resources(time_limit_s=row.time_limit_s, memory_limit_mb=row.memory_limit_mb),
        fence=row.fence,
        attempt=row.attempt,
        attempt_token=token,
        lease_ttl_s=policy.lease_ttl_s,
        heartbeat_s=policy.heartbeat_s,
        trace=trace,
    )
