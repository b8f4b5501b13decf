"""Demand for workers: the queued jobs that count, and the jobs that given workers run."""

from collections.abc import Mapping, Sequence
from functools import partial

import pytest
from tests.support.queue_desk import Desk

from marey_server.access.principal import SYSTEM
from marey_server.store.monitoring.demand import Demand, JobReach, read_demand

pytestmark = pytest.mark.every_database

GPU = {"gpu": "a100", "site": "lyon"}


def demand(
    desk: Desk,
    *,
    labels: Mapping[str, str] = GPU,
    kinds: Sequence[str] = (),
    workers: Sequence[str] = (),
    limit: int = 100,
    others: Sequence[JobReach] = (),
) -> Demand:
    read = partial(read_demand, reach=JobReach(labels, kinds), workers=workers, limit=limit, others=others)
    return desk.database.read(SYSTEM, read)


def test_jobs_that_a_worker_with_the_labels_could_claim_count(desk: Desk) -> None:
    for labels in ({}, {"gpu": "a100"}, GPU):
        desk.submit(labels=labels)
    for labels in ({"gpu": "h100"}, {**GPU, "room": "2"}):
        desk.submit(labels=labels)
    first = desk.submit("errand")
    desk.submit("errand", after=(first,))
    assert demand(desk).queued == 4
    assert demand(desk, kinds=("errand",)).queued == 4
    assert demand(desk, kinds=("sum",)).queued == 0
    assert demand(desk, limit=2).queued == 2


def test_a_job_that_waits_for_its_next_attempt_does_not_count_yet(desk: Desk) -> None:
    desk.submit()
    desk.fail(desk.claim(), retryable=True)
    assert demand(desk).queued == 0
    desk.clock.advance(3600)
    assert demand(desk).queued == 1


def test_the_jobs_of_the_given_workers_are_counted_until_their_leases_expire(desk: Desk) -> None:
    for _ in range(4):
        desk.submit()
    desk.claim_many(2, worker="gpu-k1-1")
    desk.claim(worker="gpu-k1-2")
    desk.claim(worker="other")
    assert demand(desk, workers=("gpu-k1-1", "gpu-k1-2", "gpu-k1-3")).running == {"gpu-k1-1": 2, "gpu-k1-2": 1}
    desk.clock.advance(61)
    assert demand(desk, workers=("gpu-k1-1",)).running == {}


def test_of_the_jobs_of_a_key_one_counts_and_none_while_one_runs(desk: Desk) -> None:
    for key in ("a", "a", "a", "b", None):
        desk.submit(concurrency_key=key)
    assert demand(desk).queued == 3
    assert demand(desk, limit=2).queued == 2
    running = desk.claim()
    assert demand(desk).queued == 2
    desk.complete(running)
    assert demand(desk).queued == 3


def test_jobs_count_up_to_the_limit_of_their_project(desk: Desk) -> None:
    for _ in range(5):
        desk.submit()
    desk.limit_running(3)
    assert demand(desk).queued == 3
    first = desk.claim()
    assert demand(desk).queued == 2
    desk.limit_running(0)
    assert demand(desk).queued == 0
    desk.complete(first)
    desk.limit_running(None)
    assert demand(desk).queued == 4


def test_a_job_counts_only_for_the_pools_with_the_fewest_labels_that_can_run_it(desk: Desk) -> None:
    for labels in ({}, {}, {"gpu": "a100"}, {"site": "lyon"}):
        desk.submit(labels=labels)
    desk.submit("sum")
    plain, gpu = JobReach({}), JobReach({"gpu": "a100"})
    assert demand(desk, labels={}, others=[JobReach(GPU), gpu]).queued == 3
    assert demand(desk, labels=gpu.labels, others=[JobReach(GPU), plain]).queued == 1
    assert demand(desk, labels=GPU, others=[gpu, plain]).queued == 1
    errands = JobReach({}, ("errand",))
    assert demand(desk, labels=GPU, others=[errands]).queued == 3
    assert demand(desk, labels=GPU, others=[JobReach({"gpu": "h100"})]).queued == 2
    assert demand(desk, labels=GPU, kinds=("errand",), others=[errands]).queued == 2
