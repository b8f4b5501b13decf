"""Fairness between projects, and limits of running jobs: claims are compared with a model that picks jobs singly."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import select
from tests.support.present import present
from tests.support.queue_desk import Desk
from tests.support.tiers import examples

from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.worker_protocol import ClaimRequest, Lease
from marey_server.access.principal import SYSTEM
from marey_server.store import events, projects
from marey_server.store.jobs import queue
from marey_server.store.jobs.claiming.turns import Turn
from marey_server.store.tables import event
from marey_server.store.wakeups import work_topic

pytestmark = pytest.mark.every_database

_NUMBERS = itertools.count()


@dataclass
class Share:
    """Expected state of one project in the queue."""

    desk: Desk
    queued: int = 0
    running: list[Lease] = field(default_factory=list)
    limit: int | None = None
    served: int = 0


def expected(shares: Sequence[Share], most: int, clock: Iterator[int]) -> Counter[int]:
    """Return how many jobs of each project a claim gets, by position of the project, and update the model."""
    got: Counter[int] = Counter()
    with_jobs = [at for at, share in enumerate(shares) if share.queued]
    for _ in range(most):
        running = {at: len(share.running) + got[at] for at, share in enumerate(shares)}
        able = [
            at
            for at, share in enumerate(shares)
            if share.queued > got[at] and (share.limit is None or running[at] < share.limit)
        ]
        if not able:
            break
        got[min(able, key=lambda at: (running[at], shares[at].served, at))] += 1
    last = sorted(got, key=lambda at: (len(shares[at].running) + got[at], shares[at].served, at))
    if len(with_jobs) > 1:
        for at in last:
            shares[at].served = next(clock)
    for at, number in got.items():
        shares[at].queued -= number
    return got


def play(desk: Desk, steps: Sequence[tuple[str, int, int]]) -> None:
    """Play steps with three new projects, and compare each claim with the model; at the end, no jobs are left."""
    wanted = [ProjectCreate(name=f"share{next(_NUMBERS)}") for _ in range(3)]
    made = [desk.database.write(desk.user, projects.create_project, one) for one in wanted]
    # Equals take turns in the order of their ids, which is random for projects of one millisecond.
    shares = [Share(replace(desk, project=one.name)) for one in sorted(made, key=lambda one: one.id)]
    clock = itertools.count(1)
    try:
        for what, at, number in steps:
            share = shares[at]
            if what == "submit":
                share.desk.submit_many(*[JobCreate(kind="errand")] * (number + 1))
                share.queued += number + 1
            elif what == "limit":
                share.limit = number if number < 4 else None
                share.desk.limit_running(share.limit)
            elif what == "end":
                for lease in share.running[:number]:
                    share.desk.complete(lease)
                del share.running[:number]
            else:
                claim(desk, shares, number + 1, clock)
    finally:
        clear(desk, shares)


def claim(desk: Desk, shares: Sequence[Share], most: int, clock: Iterator[int]) -> None:
    """Claim jobs, and compare the numbers of jobs of each project with the model."""
    names = [share.desk.project for share in shares]
    leases = desk.claim_many(most)
    got = Counter(names.index(lease.project) for lease in leases)
    wanted = expected(shares, most, clock)
    for lease in leases:
        shares[names.index(lease.project)].running.append(lease)
    assert got == wanted


def clear(desk: Desk, shares: Sequence[Share]) -> None:
    """End all jobs."""
    by_name = {share.desk.project: share.desk for share in shares}
    for share in shares:
        share.desk.limit_running(None)
        for lease in share.running:
            share.desk.complete(lease)
    while leases := desk.claim_many():
        for lease in leases:
            by_name[lease.project].complete(lease)


STEPS = st.lists(
    st.tuples(
        st.sampled_from(["submit", "submit", "claim", "claim", "claim", "end", "limit"]),
        st.integers(0, 2),
        st.integers(0, 5),
    ),
    min_size=4,
    max_size=16,
)


def test_claims_take_the_jobs_that_the_model_takes(desk: Desk) -> None:
    @settings(max_examples=examples(30), deadline=None, suppress_health_check=list(HealthCheck))
    @given(steps=STEPS)
    def run(steps: list[tuple[str, int, int]]) -> None:
        play(desk, steps)

    run()


ALTERNATING = [("submit", 0, 5), ("submit", 1, 5), *[("claim", 0, 0), ("end", 0, 1), ("end", 1, 1)] * 3]
LIMITED = [("submit", 0, 5), ("limit", 0, 2), ("claim", 0, 5), ("end", 0, 1), ("claim", 0, 5)]


@pytest.mark.parametrize(("steps", "fault"), [(ALTERNATING, "served"), (LIMITED, "limit")])
def test_the_model_notices_a_claim_without_turns_or_limits(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, steps: list[tuple[str, int, int]], fault: str
) -> None:
    play(desk, steps)
    if fault == "served":
        monkeypatch.setattr(queue, "note_served", lambda *_: None)
    else:
        monkeypatch.setattr(Turn, "places", property(lambda _: None))
        monkeypatch.setattr(queue, "take_within_limit", lambda tx, turn, most, take, **_: take(most))
    with pytest.raises(AssertionError):
        play(desk, steps)


def test_a_project_with_one_job_waits_for_no_more_than_the_jobs_that_run(desk: Desk) -> None:
    other = replace(desk, project="other")
    desk.database.write(desk.user, projects.create_project, ProjectCreate(name="other"))
    desk.submit_many(*[JobCreate(kind="errand", priority=9)] * 50)
    running = [*desk.claim_many(4), *desk.claim_many(1)]
    job = other.submit(priority=-9)
    desk.complete(running[0])
    assert desk.claim().job == job


def test_a_limit_holds_jobs_back_and_removing_it_lets_them_go(desk: Desk) -> None:
    desk.submit_many(*[JobCreate(kind="errand")] * 5)
    desk.limit_running(2)
    leases = desk.claim_many()
    assert len(leases) == 2
    assert desk.claim_many() == []
    desk.fail(leases[0], retryable=True)
    assert len(desk.claim_many()) == 1
    desk.limit_running(1)
    desk.complete(leases[1])
    assert desk.claim_many() == []
    desk.limit_running(None)
    assert len(desk.claim_many()) == 2


def test_the_limit_is_shown_and_recorded_and_changes_the_revision_of_the_project(desk: Desk) -> None:
    before = desk.database.read(desk.user, projects.read_project, desk.project)
    desk.limit_running(2)
    after = desk.database.read(desk.user, projects.read_project, desk.project)
    assert (before.most_running_jobs, after.most_running_jobs, after.rev) == (None, 2, before.rev + 1)
    desk.submit_many(*[JobCreate(kind="errand")] * 3)
    desk.claim_many()
    shown = desk.database.read(desk.user, projects.read_quotas, desk.project).running_jobs
    assert (present(shown).used, present(shown).allowed) == (2, 2)
    with desk.database.engine.connect() as connection:
        bodies = connection.execute(select(event.c.body).where(event.c.kind == "project.limited")).scalars().all()
    assert [body["limits"] for body in bodies] == [{"running_jobs": 2}]


def news(desk: Desk, after: int) -> frozenset[str]:
    """Return the topics that the events after the given number announce."""
    desk.database.write(SYSTEM, events.number_events)
    return desk.database.read(SYSTEM, events.read_news, after).topics


def test_the_end_of_a_job_wakes_workers_for_the_jobs_that_the_limit_held_back(desk: Desk) -> None:
    desk.submit()
    desk.limit_running(1)
    lease = desk.claim()
    desk.submit("sum")
    assert work_topic("sum") in news(desk, 0)
    seen = desk.database.read(SYSTEM, events.newest_number)
    desk.complete(lease)
    assert work_topic("sum") in news(desk, seen)
    desk.limit_running(None)
    assert work_topic("sum") not in news(desk, seen)


def test_tasks_count_towards_the_limit_but_not_their_parent(desk: Desk) -> None:
    desk.things(4)
    fields: dict[str, Any] = {"inputs": {"things": {"collection": "raw"}}}
    desk.submit("square", **fields)
    desk.limit_running(1)
    (first,) = desk.claim_many()
    desk.complete(first)
    assert len(desk.claim_many()) == 1


def test_a_claim_reads_the_jobs_of_a_project_by_index(desk: Desk) -> None:
    if not desk.database.is_sqlite:
        return  # Postgres chooses a plan by the sizes of tables, and small ones it reads whole
    desk.submit()
    run: list[str] = []

    def act(tx: Any) -> list[str]:
        driver = tx.connection.connection.driver_connection
        driver.set_trace_callback(run.append)
        queue.claim(tx, ClaimRequest(worker="w", kinds=("errand",)))
        driver.set_trace_callback(None)
        read = [text for text in run if "waiting" in text or "pick" in text]
        assert len(read) == 2
        return [str(step[3]) for text in read for step in driver.execute(f"EXPLAIN QUERY PLAN {text}")]

    plan = desk.database.write(desk.user, act)
    assert not [step for step in plan if step.startswith(("SCAN job", "SCAN first", "USE TEMP B-TREE"))]
    for name, index in (("first", "ix_job_claim"), ("candidate", "ix_job_claim"), ("leased", "ix_job_leased")):
        assert any(step.startswith(f"SEARCH {name} USING COVERING INDEX {index}") for step in plan), plan
