"""Concurrent transactions on late inputs (outputs of other jobs): a job gets all its inputs once, or it ends."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.support.interleaving import Step, interleave
from tests.support.queue_desk import Desk

from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.worker_protocol import CompleteRequest, Lease
from marey_server.errors import ApiProblem
from marey_server.store.database.connections import Database
from marey_server.store.jobs import completion, reading, submission
from marey_server.store.jobs.retrying import retry_job

pytestmark = pytest.mark.every_database


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again with other connections."""
    return open_database()


def squares_of(*makers: str, **fields: object) -> JobCreate:
    inputs = {"things": [{"job": maker} for maker in makers]}
    return JobCreate.model_validate({"kind": "square", "inputs": inputs, "into": "squared"} | fields)


def completes(desk: Desk, database: Database, lease: Lease) -> Step:
    place = (lease.job, lease.fence)
    request = CompleteRequest(write_id=desk.write_id())
    return Step(database, desk._attempt_of(lease), lambda tx: completion.complete(tx, *place, request))


def claimed_maker(desk: Desk, number: int = 0, made: int = 3) -> Lease:
    """Claim a job of the kind `sum`, and upload its results without publishing them; return the lease."""
    lease = desk.claim(job=desk.submit("sum", params={"number": number}, into=f"made{number}"))
    desk.stage(lease, *(f"thing{n}" for n in range(made)))
    return lease


def work_off(desk: Desk) -> list[str]:
    """Complete all jobs that can be claimed; return the paths of the inputs of these jobs, sorted."""
    seen: list[str] = []
    while leases := desk.claim_many():
        for lease in leases:
            seen += [f"{pin.collection}/{pin.name}" for pin in lease.inputs["things"]]
            desk.complete(lease)
    return sorted(seen)


@pytest.mark.parametrize("order", ["complete first", "cancel first"])
@pytest.mark.parametrize("made", [1, 3])
def test_a_job_that_is_cancelled_while_it_gets_its_inputs_ends_with_its_tasks(
    desk: Desk, other: Database, order: str, made: int
) -> None:
    lease = claimed_maker(desk, made=made)
    (job,) = desk.submit_many(squares_of(lease.job))
    done = completes(desk, desk.database, lease)
    cancel = Step(other, desk.user, lambda tx: reading.cancel_job(tx, job))
    outcomes = interleave(done, cancel) if order == "complete first" else interleave(cancel, done)
    assert not any(isinstance(outcome, ApiProblem) for outcome in outcomes), outcomes
    assert desk.state(lease.job) == "succeeded"
    assert desk.state(job) == "cancelled"
    assert set(desk.job(job).children) <= {"cancelled"}
    assert desk.claim_many() == []


def test_a_job_of_two_makers_that_succeed_at_once_gets_what_both_made(desk: Desk, other: Database) -> None:
    first, second = claimed_maker(desk, 0), claimed_maker(desk, 1)
    (job,) = desk.submit_many(squares_of(first.job, second.job))
    interleave(completes(desk, desk.database, first), completes(desk, other, second))
    assert desk.job(job).size == 3
    assert work_off(desk) == [f"made{place}/thing{n}" for place in range(2) for n in range(3)]
    assert desk.state(job) == "succeeded"


@pytest.mark.parametrize("order", ["complete first", "submit first"])
def test_a_job_submitted_while_its_maker_completes_gets_its_inputs(desk: Desk, other: Database, order: str) -> None:
    lease = claimed_maker(desk)
    late = Step(other, desk.user, lambda tx: submission.submit(tx, "lab", [squares_of(lease.job)]))
    done = completes(desk, desk.database, lease)
    made = interleave(done, late)[1] if order == "complete first" else interleave(late, done)[0]
    assert desk.job(made[0].id).size == 2
    assert len(work_off(desk)) == 3


def test_identical_jobs_that_get_their_inputs_side_by_side_are_computed_once(desk: Desk, other: Database) -> None:
    """Two source jobs complete at the same time.

    Two identical jobs wait for their items, and only one of the two is computed.
    """
    first, second = claimed_maker(desk, 0, made=1), claimed_maker(desk, 1, made=1)
    (one,) = desk.submit_many(squares_of(first.job))
    (two,) = desk.submit_many(squares_of(second.job))
    (both,) = desk.submit_many(squares_of(first.job, second.job))
    (again,) = desk.submit_many(squares_of(first.job, second.job, into="elsewhere"))
    interleave(completes(desk, desk.database, first), completes(desk, other, second))
    assert len(work_off(desk)) == 1 + 1 + 2
    assert {desk.state(job) for job in (one, two, both, again)} == {"succeeded"}


def test_two_tries_of_what_failed_with_a_job_do_not_hinder_each_other(desk: Desk, other: Database) -> None:
    lease = claimed_maker(desk)
    (job,) = desk.submit_many(squares_of(lease.job))
    desk.fail(lease, retryable=False)
    of_maker = Step(desk.database, desk.user, lambda tx: retry_job(tx, lease.job))
    of_job = Step(other, desk.user, lambda tx: retry_job(tx, job))
    outcomes = interleave(of_maker, of_job)
    assert not any(isinstance(outcome, ApiProblem) for outcome in outcomes), outcomes
    maker = desk.claim()
    desk.stage(maker, "thing")
    desk.complete(maker)
    assert work_off(desk) == ["made0/thing"]
    assert {desk.state(outcome.id) for outcome in outcomes} == {"succeeded"}
