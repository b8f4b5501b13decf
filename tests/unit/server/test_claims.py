"""Claims that are repeated because their answer was lost, and attempts that count from their first write."""

from collections.abc import Callable

import pytest
from sqlalchemy import select
from tests.support.queue_desk import Desk

from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.worker_protocol import Lease
from marey_server.access.principal import SYSTEM
from marey_server.errors import LeaseLostProblem, UnauthenticatedProblem
from marey_server.store.jobs import logs
from marey_server.store.jobs.policy import DEFAULT_POLICY
from marey_server.store.tables import attempt

pytestmark = pytest.mark.every_database

CLAIM = "a claim of this test"


def test_a_repeated_claim_gets_the_same_answer_and_claims_nothing_more(desk: Desk) -> None:
    desk.submit_many(*[JobCreate(kind="errand", priority=n % 2) for n in range(5)])
    first = desk.claim_many(3, claim_id=CLAIM)
    desk.clock.advance(50)
    assert desk.claim_many(3, claim_id=CLAIM) == first
    desk.clock.advance(50)  # the repeated claim renewed the leases
    assert desk.reap() == 0
    assert desk.attempt(first[0]).job_id == first[0].job
    desk.complete(first[1])
    assert desk.claim_many(3, claim_id=CLAIM) == [first[0], first[2]]
    assert len(desk.claim_many(5, claim_id="another claim of it")) == 2


def test_a_claim_id_is_never_used_for_other_jobs(desk: Desk) -> None:
    job = desk.submit()
    desk.claim_many(claim_id=CLAIM)
    desk.clock.advance(61)
    desk.reap()
    with pytest.raises(LeaseLostProblem):
        desk.claim_many(claim_id=CLAIM)
    assert desk.state(job) == "queued"


def test_a_claim_id_belongs_to_one_token(desk: Desk) -> None:
    desk.submit_many(*[JobCreate(kind="errand")] * 2)
    (mine,) = desk.claim_many(1, claim_id=CLAIM)
    ann, desk.user = desk.user, desk.replaced_token()
    (other,) = desk.claim_many(1, claim_id=CLAIM)
    assert (ann.token_id, other.job) != (desk.user.token_id, mine.job)
    assert other.attempt_token != mine.attempt_token


def test_a_token_of_a_claim_can_neither_be_read_from_the_database_nor_derived_from_it(desk: Desk) -> None:
    desk.submit()
    (lease,) = desk.claim_many(1, claim_id=CLAIM)
    (row,) = desk.database.read(SYSTEM, lambda tx: tx.execute(select(attempt)).all())
    secret = lease.attempt_token.partition("_")[2]
    assert secret not in str(row)
    guess = lease.model_copy(update={"attempt_token": f"mareyjob_{row.token_hash}"})
    with pytest.raises(UnauthenticatedProblem):
        desk.attempt(guess)


def test_lost_answers_to_claims_use_up_no_attempts(desk: Desk) -> None:
    job = desk.submit(max_attempts=1, resources={"time_limit_s": 20})
    for _ in range(3):
        assert desk.claim().attempt == 1
        desk.clock.advance(61)
        assert desk.reap() == 1
    assert (desk.state(job), desk.job(job).attempt) == ("queued", 0)
    assert desk.complete(desk.claim()).state == "succeeded"
    assert desk.job(job).attempt == 1


def test_a_job_that_kills_each_worker_before_its_first_heartbeat_ends(desk: Desk) -> None:
    job = desk.submit(max_attempts=1)
    for _ in range(DEFAULT_POLICY.max_unstarted + 1):
        assert desk.state(job) == "queued"
        desk.claim()
        desk.clock.advance(61)
        desk.reap()
    failure = desk.job(job).failure
    assert failure is not None
    assert (failure.reason, failure.code) == ("attempts_exhausted", "worker-lost")
    assert "11 workers" in failure.detail


def append_log(desk: Desk, lease: Lease) -> None:
    desk.database.write(desk.attempt(lease), logs.append_log, lease.job, lease.fence, 0, b"hello", desk.policy)


WRITES: dict[str, Callable[[Desk, Lease], object]] = {
    "heartbeat": lambda desk, lease: desk.heartbeat(lease),
    "log": append_log,
    "stage": lambda desk, lease: desk.stage(lease, "result"),
    "fail": lambda desk, lease: desk.fail(lease),
    "complete": lambda desk, lease: desk.complete(lease),
}


@pytest.mark.parametrize("write", WRITES)
def test_an_attempt_counts_once_from_its_first_write(desk: Desk, write: str) -> None:
    job = desk.submit()
    lease = desk.claim()
    assert desk.job(job).attempt == 1  # the attempt that begins
    WRITES[write](desk, lease)
    if write in ("heartbeat", "log", "stage"):
        desk.heartbeat(lease)
        desk.clock.advance(61)
        desk.reap()
        assert desk.state(job) == "queued"
    assert desk.job(job).attempt == 1
