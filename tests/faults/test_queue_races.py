"""Two concurrent transactions on one job, at every step of the job: in any order of commits, the job ends once."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import pytest
from sqlalchemy import ColumnElement, func, select, true
from tests.support.interleaving import Abandoned, Step, interleave
from tests.support.queue_desk import Desk, output

from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.worker_protocol import ClaimRequest, CompleteRequest, FailRequest, Heartbeat, Lease
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ApiProblem, ConflictProblem, LeaseLostProblem
from marey_server.store import leader, projects
from marey_server.store.database.connections import Database
from marey_server.store.jobs import completion, exports, fencing, logs, queue, reading, staging, submission
from marey_server.store.jobs.reaper import reap_page, share_waiting
from marey_server.store.jobs.result_cache import SHARED_AT_ONCE
from marey_server.store.tables import attempt, event, job, project
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

TERMINAL = ("succeeded", "failed", "cancelled")


def _ends_told(tx: Transaction, job_id: str) -> int:
    kinds = [f"job.{state}" for state in TERMINAL]
    statement = select(func.count()).select_from(event).where(event.c.subject == job_id, event.c.kind.in_(kinds))
    return int(tx.execute(statement).scalar_one())


class Bout:
    """A claimed job whose lease is about to expire, and the writes that can concern this job."""

    def __init__(self, desk: Desk, other: Database) -> None:
        self.desk = desk
        self.other = other
        self.job = desk.submit(max_attempts=5)
        self.dependant = desk.submit(after=[self.job])
        self.lease = desk.claim(job=self.job)
        self.worker = desk._attempt_of(self.lease)
        desk.stage(self.lease, "result")

    def does(self, name: str, database: Database) -> Step:
        """Return the step with this name, to be run with connections of `database`."""
        actions: dict[str, tuple[Principal, Callable[[Transaction], object]]] = {
            "complete": (
                self.worker,
                lambda tx: completion.complete(tx, *self._place, CompleteRequest(write_id="write-one")),
            ),
            "fail": (
                self.worker,
                lambda tx: completion.fail(tx, *self._place, FailRequest(write_id="write-two", code="x")),
            ),
            "heartbeat": (self.worker, lambda tx: queue.heartbeat(tx, *self._place, Heartbeat())),
            "log": (self.worker, lambda tx: logs.append_log(tx, *self._place, 0, b"hello")),
            "stage": (
                self.worker,
                lambda tx: staging.stage(tx, *self._place, [staging.prepare_output(output("more"))]),
            ),
            "cancel": (self.desk.user, lambda tx: reading.cancel_job(tx, self.job)),
            "reap": (SYSTEM, reap_page),
            "claim": (SYSTEM, lambda tx: queue.claim(tx, ClaimRequest(worker="v", kinds=("errand",), job=self.job))),
        }
        principal, action = actions[name]
        return Step(database, principal, action)

    @property
    def _place(self) -> tuple[str, int]:
        return self.lease.job, self.lease.fence

    def assert_sound(self) -> None:
        """Check that the job has ended at most once, with one event, and that this end has had all of its effects."""
        job = self.desk.job(self.job)
        told = self.desk.database.read(SYSTEM, _ends_told, self.job)
        assert told == (1 if job.state.terminal else 0)
        expected = {"succeeded": "queued", "failed": "failed", "cancelled": "failed"}.get(job.state, "waiting")
        assert self.desk.state(self.dependant) == expected
        names = [one.name for one in self.desk.outputs(self.job)]
        assert names in ([["result"], ["result", "more"]] if job.state == "succeeded" else [[]])


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again with other connections."""
    return open_database()


STEPS = ("complete", "fail", "heartbeat", "log", "stage", "cancel", "reap", "claim")


@pytest.mark.parametrize("second", STEPS)
@pytest.mark.parametrize("first", STEPS)
def test_a_job_has_one_end_whichever_of_two_comes_first(desk: Desk, other: Database, first: str, second: str) -> None:
    bout = Bout(desk, other)
    desk.clock.advance(61)
    one, two = interleave(bout.does(first, desk.database), bout.does(second, other))
    for outcome in (one, two):
        assert not isinstance(outcome, ApiProblem) or isinstance(outcome, ConflictProblem), outcome
    if {first, second} == {"complete", "reap"}:
        completed = one if first == "complete" else two
        assert isinstance(completed, LeaseLostProblem) == (desk.state(bout.job) == "queued")
    bout.assert_sound()


@pytest.mark.parametrize("second", ["complete", "cancel", "reap"])
@pytest.mark.parametrize("first", ["complete", "cancel", "reap"])
def test_what_was_rolled_back_leaves_the_way_free_for_the_other(
    desk: Desk, other: Database, first: str, second: str
) -> None:
    bout = Bout(desk, other)
    desk.clock.advance(61)
    one, two = interleave(bout.does(first, desk.database), bout.does(second, other), commit=False)
    assert isinstance(one, Abandoned)
    if first == second == "complete":
        assert not isinstance(two, ApiProblem)
    bout.assert_sound()


def test_the_first_of_complete_and_cancel_to_commit_decides(desk: Desk, other: Database) -> None:
    bout = Bout(desk, other)
    _, cancelled = interleave(bout.does("complete", desk.database), bout.does("cancel", other))
    assert isinstance(cancelled, ConflictProblem)
    assert desk.state(bout.job) == "succeeded"
    bout = Bout(desk, other)
    _, completed = interleave(bout.does("cancel", desk.database), bout.does("complete", other))
    assert completed.state == "cancelled"
    assert desk.state(bout.job) == "cancelled"


def test_a_claim_that_arrives_twice_at_once_claims_once(desk: Desk, other: Database) -> None:
    desk.submit_many(*[JobCreate(kind="errand")] * 6)
    request = ClaimRequest(worker="w", kinds=("errand",), max=2, claim_id="the same claim twice")
    one, two = (Step(database, desk.user, lambda tx: queue.claim(tx, request)) for database in (desk.database, other))
    first, second = interleave(one, two)
    assert first == second
    assert len(desk.claim_many()) == 4


def test_a_dependant_submitted_while_its_job_completes_is_not_left_waiting(desk: Desk, other: Database) -> None:
    for order in ("complete first", "submit first"):
        bout = Bout(desk, other)
        late = Step(
            other,
            desk.user,
            lambda tx, upstream=bout.job: submission.submit(tx, "lab", [JobCreate(kind="errand", after=(upstream,))]),
        )
        done = bout.does("complete", desk.database)
        made = interleave(done, late)[1] if order == "complete first" else interleave(late, done)[0]
        assert desk.state(made[0].id) == "queued", order


def test_an_identical_job_submitted_while_the_first_completes_shares_its_result(desk: Desk, other: Database) -> None:
    for number, order in enumerate(("complete first", "submit first")):
        wanted = JobCreate(kind="sum", params={"number": number})
        desk.submit_many(wanted)
        lease = desk.claim(kinds=("sum",))
        worker = desk._attempt_of(lease)
        done = Step(
            desk.database,
            worker,
            lambda tx, lease=lease: completion.complete(
                tx, lease.job, lease.fence, CompleteRequest(write_id="write-one")
            ),
        )
        again = Step(other, desk.user, lambda tx, wanted=wanted: submission.submit(tx, "lab", [wanted]))
        made = interleave(done, again)[1] if order == "complete first" else interleave(again, done)[0]
        assert desk.state(made[0].id) == "succeeded", order


def test_two_identical_jobs_submitted_at_once_are_computed_once(desk: Desk, other: Database) -> None:
    one, two = (
        Step(database, desk.user, lambda tx: submission.submit(tx, "lab", [JobCreate(kind="sum")]))
        for database in (desk.database, other)
    )
    interleave(one, two)
    assert len(desk.claim_many()) == 1


def test_a_result_that_is_released_while_it_is_shared_is_shared_whole_or_not_at_all(
    desk: Desk, other: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.things(1)
    gate = desk.submit()
    fields: dict[str, Any] = {"params": {"number": 2}, "inputs": {"things": {"collection": "raw"}}, "after": [gate]}
    surveys = [desk.submit("survey", into=f"place{number}", **fields) for number in range(SHARED_AT_ONCE + 2)]
    desk.complete(desk.claim(job=gate))
    for number, lease in enumerate(desk.claim_many()):
        desk.stage(lease, f"piece{number}")
        desk.complete(lease)
    (late,) = [one for one in surveys if desk.job(one).children == {"waiting": 2}]
    gathering = next(lease for lease in desk.claim_many() if lease.job == surveys[0])
    released = threading.Event()
    may_share = exports.may_share

    def may_share_after_release(*arguments: Any) -> bool:
        released.wait(5)
        return may_share(*arguments)

    def complete(tx: Transaction) -> None:
        completion.complete(tx, gathering.job, gathering.fence, CompleteRequest(write_id="write-one"))
        tx.after_commit(released.set)

    monkeypatch.setattr(exports, "may_share", may_share_after_release)
    interleave(Step(desk.database, desk._attempt_of(gathering), complete), Step(other, SYSTEM, share_waiting))
    tasks = desk.database.read(desk.user, reading.list_jobs, "lab", reading.JobFilters(parent=late)).items
    ended = [task.id for task in tasks if task.state == "succeeded"]
    assert [len(desk.outputs(task)) for task in ended] == [1] * len(ended)


def test_the_last_two_tasks_end_at_once_and_the_whole_ends_once(desk: Desk, other: Database) -> None:
    desk.things(4)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}})
    steps = [
        Step(
            database,
            desk._attempt_of(lease),
            lambda tx, lease=lease: completion.complete(
                tx, lease.job, lease.fence, CompleteRequest(write_id="write-one")
            ),
        )
        for lease, database in zip(desk.claim_many(), (desk.database, other), strict=True)
    ]
    interleave(*steps)
    assert desk.state(job) == "succeeded"
    assert desk.database.read(SYSTEM, _ends_told, job) == 1


def test_cancelling_the_whole_while_a_task_completes_ends_both(desk: Desk, other: Database) -> None:
    desk.things(4)
    for seed, order in enumerate(("complete first", "cancel first")):
        head = desk.submit("square", inputs={"things": {"collection": "raw"}}, seed=seed)
        lease, rest = desk.claim_many()
        done = Step(
            desk.database,
            desk._attempt_of(lease),
            lambda tx, lease=lease: completion.complete(
                tx, lease.job, lease.fence, CompleteRequest(write_id="write-one")
            ),
        )
        stop = Step(other, desk.user, lambda tx, head=head: reading.cancel_job(tx, head))
        interleave(*((done, stop) if order == "complete first" else (stop, done)))
        desk.fail(rest, "cancelled")
        assert desk.state(head) == "cancelled"
        assert desk.database.read(SYSTEM, _ends_told, head) == 1


# -- many at once ------------------------------------------------------------------------------------------------------


def test_eight_claimers_get_every_job_once_and_never_two_of_one_key(desk: Desk, other: Database) -> None:
    keyed = [JobCreate(kind="errand", concurrency_key=f"key{n % 3}", priority=n % 2) for n in range(60)]
    desk.submit_many(*keyed, *(JobCreate(kind="errand") for _ in range(60)))
    claimed: Counter[str] = Counter()
    lock = threading.Lock()

    def work(number: int) -> None:
        database = (desk.database, other)[number % 2]
        request = ClaimRequest(worker=f"w{number}", kinds=("errand",), max=5)
        while leases := database.write(desk.user, queue.claim, request):
            running = database.read(SYSTEM, _running_keys)
            assert max(Counter(running).values(), default=0) <= 1
            for lease in leases:
                database.write(
                    desk._attempt_of(lease),
                    completion.complete,
                    lease.job,
                    lease.fence,
                    CompleteRequest(write_id="write-one"),
                )
            with lock:
                claimed.update(lease.job for lease in leases)

    with ThreadPoolExecutor(8) as pool:
        for _ in range(30):
            list(pool.map(work, range(8)))
            if claimed.total() == 120:
                break
    assert (len(claimed), claimed.total()) == (120, 120)


def _running_keys(tx: Transaction) -> list[str]:
    statement = select(job.c.concurrency_key).where(job.c.state == "running", job.c.concurrency_key.is_not(None))
    return list(tx.execute(statement).scalars())


def test_two_reapers_at_once_take_a_job_back_once(desk: Desk, other: Database) -> None:
    for _ in range(20):
        desk.submit(max_attempts=5)
    for lease in desk.claim_many():
        desk.heartbeat(lease)
    desk.clock.advance(61)
    interleave(Step(desk.database, SYSTEM, reap_page), Step(other, SYSTEM, reap_page))
    again = desk.claim_many()
    assert {lease.attempt for lease in again} == {2}
    lost = desk.database.read(
        SYSTEM, lambda tx: tx.execute(select(func.count()).where(attempt.c.outcome == "lost")).scalar_one()
    )
    assert lost == 20


def test_of_two_leaders_the_one_whose_lease_ran_out_leads_no_more(desk: Desk, other: Database) -> None:
    minute_us = 60_000_000
    first = desk.database.write(SYSTEM, leader.take_lead, "reaper", "one", minute_us)
    assert first is not None
    assert other.write(SYSTEM, leader.take_lead, "reaper", "two", minute_us) is None
    assert desk.database.write(SYSTEM, leader.take_lead, "reaper", "one", minute_us) == first

    desk.clock.advance(61)
    second = other.write(SYSTEM, leader.take_lead, "reaper", "two", minute_us)
    assert second == first + 1
    assert desk.database.write(SYSTEM, leader.take_lead, "reaper", "one", minute_us) is None

    other.write(SYSTEM, leader.give_up_lead, "reaper", "two")
    assert desk.database.write(SYSTEM, leader.take_lead, "reaper", "one", minute_us) == second + 1


def test_two_that_want_to_lead_at_once_make_one_leader(desk: Desk, other: Database) -> None:
    one, two = (
        Step(database, SYSTEM, lambda tx, holder=holder: leader.take_lead(tx, "reaper", holder, 60_000_000))
        for database, holder in ((desk.database, "one"), (other, "two"))
    )
    assert interleave(one, two) == (1, None)


# -- the fence, and what happens without it ----------------------------------------------------------------------------


def stale_worker_story(desk: Desk, act: Callable[[Desk, Lease], object]) -> None:
    """Let a worker lose its lease to another worker; check that the request `act` of the first worker is refused."""
    job = desk.submit()
    slept = desk.claim()
    desk.clock.advance(61)
    assert desk.reap() == 1
    awake = desk.claim()
    with pytest.raises(LeaseLostProblem):
        act(desk, slept)
    assert desk.state(job) == "running"
    desk.stage(awake, "second")
    desk.complete(awake)
    assert [one.name for one in desk.outputs(job)] == ["second"]


STALE_ACTS: dict[str, Callable[[Desk, Lease], object]] = {
    "heartbeat": lambda desk, lease: desk.heartbeat(lease),
    "stage": lambda desk, lease: desk.stage(lease, "first"),
    "complete": lambda desk, lease: desk.complete(lease),
    "fail": lambda desk, lease: desk.fail(lease),
    "log": lambda desk, lease: desk.database.write(
        desk._attempt_of(lease), logs.append_log, lease.job, lease.fence, 0, b"late"
    ),
}


@pytest.mark.parametrize("act", STALE_ACTS)
def test_a_worker_that_slept_through_its_lease_is_refused_everywhere(desk: Desk, act: str) -> None:
    stale_worker_story(desk, STALE_ACTS[act])


@pytest.mark.parametrize("act", STALE_ACTS)
def test_without_the_fence_the_stale_worker_gets_through(desk: Desk, act: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the test above would fail if statements did not compare the fence."""

    def no_fence(_fence: int) -> ColumnElement[bool]:
        return true()

    def any_fence(attempts: Collection[tuple[str, int]]) -> dict[str, Any]:
        return fencing.held_parameters([(job, fence) for job, _ in attempts for fence in range(10)])

    monkeypatch.setattr(fencing, "same_fence", no_fence)
    monkeypatch.setattr(completion, "held_parameters", any_fence)
    with pytest.raises((pytest.fail.Exception, AssertionError, LookupError, ApiProblem)):
        stale_worker_story(desk, STALE_ACTS[act])


def _claims(database: Database, desk: Desk, most: int) -> Step:
    request = ClaimRequest(worker="w", kinds=("errand",), max=most)
    return Step(database, desk.user, lambda tx: queue.claim(tx, request))


def test_two_claims_at_once_never_exceed_the_limit_of_a_project(desk: Desk, other: Database) -> None:
    desk.submit_many(*[JobCreate(kind="errand")] * 6)
    desk.limit_running(3)
    one, two = interleave(_claims(desk.database, desk, 2), _claims(other, desk, 2))
    assert (len(one), len(two)) == (2, 1)
    assert desk.claim_many() == []


def test_without_the_lock_two_claims_at_once_exceed_the_limit(
    desk: Desk, other: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the lock, the test above must fail on Postgres; SQLite has only one writer at a time."""
    desk.submit_many(*[JobCreate(kind="errand")] * 6)
    desk.limit_running(3)
    monkeypatch.setattr(queue, "take_within_limit", lambda tx, turn, most, take, **_: take(most))
    one, two = interleave(_claims(desk.database, desk, 2), _claims(other, desk, 2))
    assert len(one) + len(two) == (3 if desk.database.is_sqlite else 4)


def test_eight_claimers_never_exceed_the_limits_of_two_projects(
    desk: Desk, open_database: Callable[[], Database]
) -> None:
    second = replace(desk, project="second")
    desk.database.write(desk.user, projects.create_project, ProjectCreate(name="second"))
    desks = {one.project: one for one in (desk, second)}
    for one in desks.values():
        one.submit_many(*[JobCreate(kind="errand")] * 30)
        one.limit_running(3)
    most: Counter[str] = Counter()
    done: Counter[str] = Counter()

    def work(database: Database) -> None:
        while True:
            leases = database.write(desk.user, queue.claim, ClaimRequest(worker="w", kinds=("errand",), max=2))
            for name, number in database.read(SYSTEM, _running_by_project).items():
                most[name] = max(most[name], number)
            for lease in leases:
                request = CompleteRequest(write_id="write-one")
                database.write(
                    desks[lease.project]._attempt_of(lease), completion.complete, lease.job, lease.fence, request
                )
                done[lease.project] += 1
            if not leases and not desk.database.read(SYSTEM, _left):
                return

    with ThreadPoolExecutor(8) as pool:
        for future in [pool.submit(work, database) for database in [open_database() for _ in range(8)]]:
            future.result(120)
    assert done == {"lab": 30, "second": 30}
    assert 1 <= min(most.values()) <= max(most.values()) <= 3


def _running_by_project(tx: Transaction) -> dict[str, int]:
    counted = select(project.c.name, func.count().label("jobs")).join(job, job.c.project_id == project.c.id)
    rows = tx.execute(counted.where(job.c.state == "running").group_by(project.c.name))
    return {row.name: row.jobs for row in rows}


def _left(tx: Transaction) -> int:
    return int(tx.execute(select(func.count()).where(job.c.state.in_(["queued", "running"]))).scalar_one())
