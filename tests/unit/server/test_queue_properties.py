"""The queue, compared with a model. Submitters, workers and the check for expired leases act in random order."""

from __future__ import annotations

import itertools
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test
from sqlalchemy import Connection, delete, func, select
from tests.support.queue_desk import Desk
from tests.support.queue_model import TERMINAL, ModelJob, ModelQueue
from tests.support.tiers import examples, steps

from marey_schemas.queue.worker_protocol import Lease
from marey_server.access.principal import SYSTEM
from marey_server.errors import ConflictProblem, LeaseLostProblem
from marey_server.store import tables
from marey_server.store.jobs import layout, retrying
from marey_server.store.jobs.reaper import share_waiting
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

ERRANDS = ("errand",)
CHAINED = ("sum", "square", "survey")


class StillClock:
    """Clock that shows the same time until it is set forward."""

    def __init__(self) -> None:
        self.us = 1_800_000_000_000_000

    def now_us(self, _connection: Connection) -> int:
        return self.us

    def catch_up(self, stored_us: int) -> None:
        """Do nothing: there is one process."""


def _forget_jobs(tx: Transaction) -> None:
    for table in (
        tables.staged_output,
        tables.job_log,
        tables.attempt,
        tables.job_dependency,
        tables.lineage,
        tables.job_item,
        tables.job,
    ):
        tx.execute(delete(table) if table is not tables.job else delete(table).where(table.c.parent_id.is_not(None)))
    tx.execute(delete(tables.job))
    tx.execute(delete(tables.event))


class QueueMachine(RuleBasedStateMachine):
    """State machine: jobs without connections must equal the jobs of the model; others must meet general conditions."""

    def __init__(self, desk: Desk, clock: StillClock) -> None:
        super().__init__()
        self.desk = desk
        self.clock = clock
        self.model = ModelQueue()
        self.leases: list[Lease] = []
        self.claims: dict[str, list[Lease]] = {}
        self.said: list[tuple[str, Lease, str]] = []
        self.ended: dict[str, tuple[str, int]] = {}
        desk.database.write(SYSTEM, _forget_jobs)

    # -- submitting ----------------------------------------------------------------------------------------------------

    @rule(
        priority=st.integers(-1, 1),
        key=st.sampled_from([None, None, "a", "b"]),
        max_attempts=st.integers(1, 3),
        time_limit_s=st.sampled_from([20, 40, 3600]),
        on_failure=st.sampled_from(["fail", "skip"]),
        data=st.data(),
    )
    def submit(
        self, priority: int, key: str | None, max_attempts: int, time_limit_s: int, on_failure: str, data: st.DataObject
    ) -> None:
        self._tick()
        known = sorted(self.model.jobs)
        after = data.draw(st.lists(st.sampled_from(known), max_size=2, unique=True)) if known else []
        job_id = self.desk.submit(
            priority=priority,
            concurrency_key=key,
            max_attempts=max_attempts,
            resources={"time_limit_s": time_limit_s},
            on_failure=on_failure,
            after=after,
        )
        self.model.submit(
            ModelJob(
                job_id,
                priority,
                self.clock.us,
                max_attempts,
                key,
                time_limit_s * 1_000_000,
                on_failure,
                frozenset(after),
            )
        )

    @rule(number=st.integers(0, 1), into=st.sampled_from(["x", "y"]), cache=st.sampled_from(["use", "use", "refresh"]))
    def submit_sum(self, number: int, into: str, cache: str) -> None:
        self._tick()
        self.desk.submit("sum", params={"number": number}, into=into, cache=cache)

    @rule(seed=st.integers(0, 1), wait=st.booleans())
    def submit_squares(self, seed: int, wait: bool) -> None:
        self._tick()
        unfinished = [job.id for job in self.model.jobs.values() if job.state not in TERMINAL]
        after = unfinished[:1] if wait else []
        self.desk.submit("square", inputs={"things": {"collection": "raw"}}, seed=seed, after=after)

    @rule(tasks=st.integers(1, 3), wait=st.booleans(), into=st.sampled_from(["x", "y"]))
    def submit_survey(self, tasks: int, wait: bool, into: str) -> None:
        self._tick()
        unfinished = [job.id for job in self.model.jobs.values() if job.state not in TERMINAL]
        inputs = {"things": {"collection": "raw"}}
        self.desk.submit("survey", inputs=inputs, params={"number": tasks}, into=into, after=unfinished[:1] * wait)

    @rule(data=st.data(), kind=st.sampled_from(["square", "survey"]), into=st.sampled_from(["x", "y"]))
    def submit_for_what_others_make(self, data: st.DataObject, kind: str, into: str) -> None:
        self._tick()
        chained = sorted(row.id for row in self._rows() if row.kind in CHAINED and row.parent_id is None)
        if chained:
            makers = data.draw(st.lists(st.sampled_from(chained), min_size=1, max_size=2, unique=True))
            inputs = {"things": [{"job": maker} for maker in makers]}
            self.desk.submit(kind, inputs=inputs, params={"number": 2}, into=into)

    @rule(data=st.data())
    def try_again(self, data: st.DataObject) -> None:
        """Retry a job that is connected to others; the model contains only jobs without connections and retries."""
        self._tick()
        lost = {row.id for row in self._rows() if row.kind in CHAINED and row.state in ("failed", "cancelled")}
        again = sorted(job for job in lost if self._is_head(job) and not self._needs_an_errand(job))
        if again:
            job_id = data.draw(st.sampled_from(again))
            made = self.desk.database.write(self.desk.user, retrying.retry_job, job_id)
            assert made.retry_of == job_id

    # -- working -------------------------------------------------------------------------------------------------------

    @rule(most=st.integers(1, 4))
    def claim(self, most: int) -> None:
        self._tick()
        claim_id = f"claim of errands {self.clock.us}"
        leases = self.desk.claim_many(most, ERRANDS, claim_id=claim_id)
        assert [lease.job for lease in leases] == self.model.claim(self.clock.us, most)
        self.leases += leases
        if leases:
            self.claims[claim_id] = leases

    @precondition(lambda self: self.claims)
    @rule(data=st.data(), most=st.integers(1, 4))
    def claim_again(self, data: st.DataObject, most: int) -> None:
        """Repeat a claim, as if its answer was lost; the new answer must contain the leases that are still held."""
        claim_id = data.draw(st.sampled_from(sorted(self.claims)))
        held = [lease for lease in self.claims[claim_id] if self._holds(lease)]
        if not held:
            with pytest.raises(LeaseLostProblem):
                self.desk.claim_many(most, ERRANDS, claim_id=claim_id)
            return
        again = self.desk.claim_many(most, ERRANDS, claim_id=claim_id)
        assert again == held
        for lease in again:
            self.model.renew(lease.job, self.clock.us)

    @rule(most=st.integers(1, 4))
    def claim_chained(self, most: int) -> None:
        self._tick()
        self.leases += self.desk.claim_many(most, CHAINED)

    @precondition(lambda self: self.leases)
    @rule(data=st.data())
    def heartbeat(self, data: st.DataObject) -> None:
        lease = self._some_lease(data)
        if self._holds(lease):
            self.desk.heartbeat(lease)
            if lease.kind in ERRANDS:
                self.model.heartbeat(lease.job, self.clock.us)
        else:
            with pytest.raises(LeaseLostProblem):
                self.desk.heartbeat(lease)

    @precondition(lambda self: self.leases)
    @rule(data=st.data(), name=st.sampled_from(["p", "q"]))
    def stage(self, data: st.DataObject, name: str) -> None:
        lease = self._some_lease(data)
        if self._holds(lease):
            self.desk.stage(lease, name)
            if lease.kind in ERRANDS:
                self.model.write(lease.job)
        else:
            with pytest.raises(LeaseLostProblem):
                self.desk.stage(lease, name)

    @precondition(lambda self: self.leases)
    @rule(data=st.data())
    def complete(self, data: st.DataObject) -> None:
        lease, write_id = self._some_lease(data), self.desk.write_id()
        if self._holds(lease):
            cancelled = next(row.cancel_requested_us is not None for row in self._rows() if row.id == lease.job)
            state = self.desk.complete(lease, write_id=write_id).state
            assert state == ("cancelled" if cancelled else "succeeded")
            self.said.append(("complete", lease, write_id))
            if lease.kind in ERRANDS:
                assert self.model.complete(lease.job, lease.fence, write_id) == state
        else:
            with pytest.raises(LeaseLostProblem):
                self.desk.complete(lease, write_id=write_id)

    @precondition(lambda self: self.leases)
    @rule(
        data=st.data(),
        retryable=st.booleans(),
        interrupted=st.booleans(),
        signature=st.sampled_from([None, "exit:9"]),
    )
    def fail(self, data: st.DataObject, retryable: bool, interrupted: bool, signature: str | None) -> None:
        lease, write_id = self._some_lease(data), self.desk.write_id()
        how: dict[str, Any] = {"retryable": retryable, "interrupted": interrupted, "signature": signature}
        if self._holds(lease):
            answer = self.desk.fail(lease, write_id=write_id, **how)
            self.said.append(("fail", lease, write_id))
            if lease.kind in ERRANDS:
                self.model.fail(lease.job, lease.fence, write_id, self.clock.us, **how)
                assert answer.state == self.model.jobs[lease.job].answers[lease.fence, write_id]
        else:
            with pytest.raises(LeaseLostProblem):
                self.desk.fail(lease, write_id=write_id, **how)

    @precondition(lambda self: self.said)
    @rule(data=st.data())
    def say_again(self, data: st.DataObject) -> None:
        """Repeat a request that was answered, perhaps long ago; the repetition must change nothing."""
        what, lease, write_id = data.draw(st.sampled_from(self.said))
        before = self._rows()
        answer = (
            self.desk.complete(lease, write_id=write_id)
            if what == "complete"
            else self.desk.fail(lease, write_id=write_id)
        )
        if lease.kind in ERRANDS:
            assert answer.state == self.model.jobs[lease.job].answers[lease.fence, write_id]
        assert self._rows() == before

    # -- time, reaper, cancellation ------------------------------------------------------------------------------------

    @rule(seconds=st.sampled_from([1, 11, 45, 61, 200]))
    def time_passes(self, seconds: int) -> None:
        self.clock.us += seconds * 1_000_000

    @rule()
    def reap(self) -> None:
        self.desk.reap()
        self.model.reap(self.clock.us)

    @precondition(lambda self: self.model.jobs)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        job_id = data.draw(st.sampled_from(sorted(self.model.jobs)))
        if self.model.jobs[job_id].state in ("succeeded", "failed"):
            with pytest.raises(ConflictProblem):
                self.desk.cancel(job_id)
        else:
            self.desk.cancel(job_id)
            self.model.cancel(job_id, self.clock.us)

    @rule(data=st.data())
    def cancel_chained(self, data: st.DataObject) -> None:
        chained = [row.id for row in self._rows() if row.kind in CHAINED and row.state not in TERMINAL]
        if chained:
            self.desk.cancel(data.draw(st.sampled_from(sorted(chained))))

    # -- what must always be so ----------------------------------------------------------------------------------------

    @invariant()
    def errands_stand_as_the_model_says(self) -> None:
        errands = {
            row.id: (row.state, row.fence, row.attempt, row.interruptions, row.unstarted)
            for row in self._rows()
            if row.kind in ERRANDS
        }
        assert errands == self.model.states()

    @invariant()
    def nothing_that_ended_changes(self) -> None:
        for row in self._rows():
            if row.state in TERMINAL:
                now = (row.state, row.fence)
                assert self.ended.setdefault(row.id, now) == now

    @invariant()
    def gathering_jobs_count_their_tasks(self) -> None:
        rows = self._rows()
        for head in rows:
            if head.size is not None:
                tasks = [row for row in rows if row.parent_id == head.id]
                assert len(tasks) == head.size
                left = sum(task.state not in TERMINAL for task in tasks)
                if head.state == "running" and head.lease_expires_us is None:
                    assert head.dependencies_left == left > 0
                elif head.state in ("queued", "running"):
                    assert head.gathers
                    assert {task.state for task in tasks} == {"succeeded"}
                elif head.state in TERMINAL:
                    assert left == 0

    @invariant()
    def a_job_that_goes_on_has_its_inputs(self) -> None:
        for row in self._rows():
            late = any("job" in entry for entries in row.inputs.values() for entry in entries)
            assert row.unbound == late
            assert not late or row.state in ("waiting", "failed", "cancelled")
            assert not late or row.size is None

    @invariant()
    def only_leased_jobs_run(self) -> None:
        for row in self._rows():
            has_tasks_at_work = row.size is not None and row.dependencies_left > 0
            assert (row.lease_expires_us is not None) == (row.state == "running" and not has_tasks_at_work)

    def teardown(self) -> None:
        """Check that all remaining jobs can be completed, and that every result exists once."""
        for _ in range(200):
            self.clock.us += 1000 * 1_000_000
            self.desk.reap()
            while self.desk.database.write(SYSTEM, share_waiting):
                pass
            leases = self.desk.claim_many()
            for lease in leases:
                self.desk.stage(lease, "r")
                self.desk.complete(lease)
            if not leases and all(row.state in TERMINAL for row in self._rows()):
                break
        stuck = [(row.kind, row.state) for row in self._rows() if row.state not in TERMINAL]
        assert stuck == []
        assert self.desk.database.read(SYSTEM, _successes_told_twice) == []

    # -- helpers of the rules ------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        self.clock.us += 1000

    def _some_lease(self, data: st.DataObject) -> Lease:
        return data.draw(st.sampled_from(self.leases))

    def _holds(self, lease: Lease) -> bool:
        if lease.kind in ERRANDS:
            return self.model.holds(lease.job, lease.fence)
        return any(row.id == lease.job and row.state == "running" and row.fence == lease.fence for row in self._rows())

    def _is_head(self, job_id: str) -> bool:
        return any(row.id == job_id and row.parent_id is None for row in self._rows())

    def _needs_an_errand(self, job_id: str) -> bool:
        """Return whether a job depends on a job of the kind `errand`: directly, or through jobs and retries."""
        after = self.desk.job(job_id).after
        return any(other in self.model.jobs or self._needs_an_errand(other) for other in after)

    def _rows(self) -> list[Any]:
        return self.desk.database.read(SYSTEM, _all_jobs)


def _all_jobs(tx: Transaction) -> list[Any]:
    return list(tx.execute(select(tables.job).order_by(tables.job.c.id)).all())


def _successes_told_twice(tx: Transaction) -> list[Any]:
    statement = (
        select(tables.event.c.subject)
        .where(tables.event.c.kind.in_([f"job.{state}" for state in TERMINAL]))
        .group_by(tables.event.c.subject)
        .having(func.count() > 1)
    )
    return list(tx.execute(statement).scalars())


def run_machine(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the state machine with a clock that stands still and with numbers as ids, so that a run can be repeated."""
    clock = StillClock()
    numbers = itertools.count(1)
    for module in (layout, retrying):
        monkeypatch.setattr(module, "new_id", lambda prefix: f"{prefix}_{next(numbers):08}")
    desk.database.clock = cast(Any, clock)
    desk.things(4)
    run_state_machine_as_test(
        cast(Any, lambda: QueueMachine(desk, clock)),
        settings=settings(
            max_examples=examples(6, soak=15),
            stateful_step_count=steps(40),
            deadline=None,
            suppress_health_check=list(HealthCheck),
            print_blob=True,
            phases=(Phase.explicit, Phase.reuse, Phase.generate),
        ),
    )


@pytest.mark.timeout(3600)
def test_the_queue_behaves_as_its_model(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    run_machine(desk, monkeypatch)
