"""Simulation of the queue, compared with formulas of queueing theory and with the rules of the real queue."""

import itertools
import math
import random
import statistics
from dataclasses import replace

import pytest
import scipy.stats

from marey_server.capacity.simulation import (
    FREE,
    FailureRates,
    QueueCosts,
    RequestCosts,
    SimulatedJob,
    SimulatedRun,
    simulate,
)
from marey_server.store.jobs.policy import DEFAULT_POLICY

ANY = frozenset[str]()
NO_COSTS = QueueCosts()
REPLICATES, JOBS = 20, 4000


def poisson_jobs(rate: float, mean_work_s: float, seed: int) -> list[SimulatedJob]:
    draw = random.Random(seed)
    now_s, jobs = 0.0, []
    for _ in range(JOBS):
        now_s += draw.expovariate(rate)
        jobs.append(SimulatedJob(now_s, draw.expovariate(1 / mean_work_s)))
    return jobs


def waits_s(jobs: list[SimulatedJob], run: SimulatedRun) -> list[float]:
    return [one.starts_s[0] - job.submitted_s for job, one in zip(jobs, run.jobs, strict=True)]


def require_mean(means: list[float], expected: float) -> None:
    """Require that the 99.9 % confidence interval of the mean of replicates contains a value, and is narrow."""
    middle, error = statistics.fmean(means), scipy.stats.sem(means)
    low, high = scipy.stats.t.interval(0.999, len(means) - 1, middle, error)
    assert low <= expected <= high, (low, expected, high)
    assert high - low < 0.5 * expected


@pytest.mark.every_nth(3)
@pytest.mark.parametrize(("workers", "load"), [(1, 0.5), (2, 0.7), (8, 0.8)])
def test_the_mean_wait_is_that_of_erlang_c(workers: int, load: float) -> None:
    offered = workers * load
    blocked = offered**workers / math.factorial(workers) / (1 - load)
    delayed = blocked / (sum(offered**k / math.factorial(k) for k in range(workers)) + blocked)
    expected = delayed / (workers * (1 - load))
    means = []
    for seed in range(REPLICATES):
        jobs = poisson_jobs(offered, 1.0, seed)
        means.append(statistics.fmean(waits_s(jobs, simulate(jobs, [ANY] * workers, NO_COSTS, seed=seed))))
    require_mean(means, expected)


@pytest.mark.soak
def test_waits_by_priority_are_those_of_cobham() -> None:
    means: dict[int, list[float]] = {0: [], 1: []}
    for seed in range(REPLICATES):
        jobs = [replace(job, priority=number % 2) for number, job in enumerate(poisson_jobs(0.7, 1.0, seed))]
        draw = random.Random(1000 + seed)
        jobs = [replace(job, priority=draw.randrange(2)) for job in jobs]
        found = waits_s(jobs, simulate(jobs, [ANY], NO_COSTS))
        for priority, of in means.items():
            of.append(statistics.fmean(w for w, job in zip(found, jobs, strict=True) if job.priority == priority))
    residual = 0.7  # rate times half the second moment of the work, 2 s²
    require_mean(means[1], residual / (1 - 0.35))
    require_mean(means[0], residual / ((1 - 0.35) * (1 - 0.7)))


def test_a_saturated_server_limits_the_jobs_per_second_and_few_workers_limit_them_earlier() -> None:
    costs = QueueCosts(RequestCosts(0.002, 0.003), RequestCosts(0.001, 0.004))
    jobs = [SimulatedJob(0.0, 0.0)] * 2000
    assert simulate(jobs, [ANY], costs).per_s == pytest.approx(1 / 0.010, rel=0.01)
    assert simulate(jobs, [ANY] * 2, costs).per_s == pytest.approx(2 / 0.010, rel=0.05)
    crowded = simulate(jobs, [ANY] * 32, costs)
    assert crowded.per_s == pytest.approx(1 / 0.003, rel=0.01)
    assert crowded.busy_share == pytest.approx(1.0, abs=0.01)
    twice = simulate(jobs, [ANY] * 32, replace(costs, stations=2))
    assert twice.per_s == pytest.approx(2 / 0.003, rel=0.02)


def test_equal_seeds_give_equal_runs() -> None:
    jobs = poisson_jobs(1.0, 1.0, 5)[:200]
    sad = FailureRates(failure=0.2, death=0.1)
    runs = [simulate(jobs, [ANY] * 3, NO_COSTS, seed=seed, failure_rates=sad) for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


def test_jobs_of_one_concurrency_key_never_overlap() -> None:
    jobs = [SimulatedJob(0.0, 1.0 + number % 3, concurrency_key="gpu") for number in range(20)]
    run = simulate(jobs, [ANY] * 4, NO_COSTS, failure_rates=FailureRates(failure=0.3), seed=4)
    times = sorted(
        (start_s, start_s + job.work_s) for job, one in zip(jobs, run.jobs, strict=True) for start_s in one.starts_s
    )
    assert all(end_s <= start_s + 1e-9 for (_, end_s), (start_s, _) in itertools.pairwise(times))
    assert len(times) > len(jobs)


def test_a_job_waits_for_a_worker_with_its_labels() -> None:
    gpu = frozenset({"gpu"})
    jobs = [SimulatedJob(0.0, 5.0), SimulatedJob(0.0, 1.0, labels=gpu), SimulatedJob(0.0, 1.0, labels=gpu | {"x"})]
    run = simulate(jobs, [ANY, gpu], NO_COSTS)
    assert [one.starts_s for one in run.jobs] == [[0.0], [0.0], []]


def test_a_dead_worker_is_noticed_at_the_end_of_the_lease() -> None:
    run = simulate([SimulatedJob(0.0, 0.5, max_attempts=2)], [ANY], NO_COSTS, failure_rates=FailureRates(death=1.0))
    (one,) = run.jobs
    ttl_s = DEFAULT_POLICY.lease_ttl_s
    assert one.starts_s == pytest.approx([ttl_s * number for number in range(DEFAULT_POLICY.max_unstarted + 1)])
    assert (one.failed, one.end_s, one.attempts) == (True, None, 0)


def test_an_attempt_with_a_heartbeat_counts_and_renews_its_lease() -> None:
    rates = FailureRates(death=1.0)
    run = simulate([SimulatedJob(0.0, 1e4, max_attempts=2)], [ANY], NO_COSTS, failure_rates=rates, seed=3)
    (one,) = run.jobs
    assert (one.failed, one.attempts, len(one.starts_s)) == (True, 2, 2)
    assert one.starts_s[1] > DEFAULT_POLICY.lease_ttl_s


def test_a_failed_attempt_is_repeated_after_the_backoff() -> None:
    run = simulate([SimulatedJob(0.0, 1.0, max_attempts=3)], [ANY], NO_COSTS, failure_rates=FailureRates(failure=1.0))
    (one,) = run.jobs
    pauses_s = [later - earlier - 1.0 for earlier, later in zip(one.starts_s, one.starts_s[1:], strict=False)]
    assert (one.failed, one.failures) == (True, 3)
    assert 7.5 <= pauses_s[0] <= 10.0
    assert 30.0 <= pauses_s[1] <= 40.0


def test_heartbeats_occupy_the_server() -> None:
    costs = QueueCosts(FREE, FREE, heartbeat=RequestCosts(0.5))
    run = simulate([SimulatedJob(0.0, 40.0)], [ANY], costs)
    assert run.busy_share * run.seconds == pytest.approx(0.5 * 3)


def test_requests_that_wait_together_share_one_commit() -> None:
    costs = QueueCosts(RequestCosts(0.001), RequestCosts(0.001), batch_s=0.004)
    jobs = [SimulatedJob(0.0, 0.0)] * 2000
    for workers in (2, 8, 16):  # while one half shares a commit, the other half waits for the next
        per_job_s = 2 * 0.001 + 2 * 0.004 * 2 / workers
        assert simulate(jobs, [ANY] * workers, costs).per_s == pytest.approx(1 / per_job_s, rel=0.02)


def test_varying_times_keep_their_mean_and_slow_down_workers_who_wait_for_each_other() -> None:
    even = QueueCosts(RequestCosts(0.002, 0.002), RequestCosts(0.002, 0.002))
    jobs = [SimulatedJob(0.0, 0.0)] * 4000
    uneven = replace(even, variation=1.0)
    assert simulate(jobs, [ANY], uneven).per_s == pytest.approx(1 / 0.008, rel=0.05)
    assert simulate(jobs, [ANY] * 2, uneven).per_s < 0.85 * simulate(jobs, [ANY] * 2, even).per_s
