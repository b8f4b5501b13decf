"""Sizes of pools: growth after a short wait, shrinkage after a long one, and limits."""

from marey_server.launchers.pool_size import PoolLimits, PoolSize

LIMITS = PoolLimits(least=1, most=8, grow_after_s=10, shrink_after_s=100)


def sizes(size: PoolSize, present: int, *numbers: tuple[float, int, int]) -> list[int]:
    """Return the size decided at each time, given the queued and running jobs; the pool then has the decided size."""
    decided = []
    for at_s, queued, running in numbers:
        present = size.decide(at_s, queued=queued, running=running, present=present)
        decided.append(present)
    return decided


def test_a_pool_has_its_least_number_of_workers_at_once() -> None:
    assert PoolSize(LIMITS).decide(0, queued=0, running=0, present=0) == 1
    assert PoolSize(LIMITS).decide(0, queued=0, running=0, present=9) == 8


def test_a_burst_of_short_jobs_starts_no_worker_but_a_queue_that_stays_does() -> None:
    assert sizes(PoolSize(LIMITS), 1, (0, 0, 0), (10, 0, 0), (20, 5, 1), (25, 0, 0), (30, 5, 1), (35, 5, 1)) == [1] * 6
    assert sizes(PoolSize(LIMITS), 1, (0, 5, 1), (5, 5, 1), (9, 5, 1), (10, 5, 1)) == [1, 1, 1, 6]


def test_growth_stops_at_the_greatest_number() -> None:
    assert sizes(PoolSize(LIMITS), 1, (0, 500, 1), (10, 500, 1)) == [1, 8]


def test_a_pool_shrinks_to_the_greatest_need_of_the_last_minutes() -> None:
    size = PoolSize(LIMITS)
    assert sizes(size, 6, (0, 0, 6), (50, 0, 3), (99, 0, 0)) == [6, 6, 6]
    assert sizes(size, 6, (101, 0, 0)) == [3]
    assert sizes(size, 3, (149, 0, 0), (151, 0, 0)) == [3, 1]


def test_a_pool_whose_need_goes_up_and_down_keeps_its_size() -> None:
    steps = [(at_s, 0, 6 if at_s % 20 else 2) for at_s in range(0, 1000, 10)]
    assert set(sizes(PoolSize(LIMITS), 6, *steps)) == {6}


def test_a_worker_with_several_slots_counts_for_as_many_jobs() -> None:
    limits = PoolLimits(least=0, most=8, slots=4, grow_after_s=10, shrink_after_s=100)
    assert sizes(PoolSize(limits), 0, (0, 9, 0), (10, 9, 0)) == [0, 3]


def test_numbers_from_before_a_change_of_leader_do_not_count() -> None:
    size = PoolSize(LIMITS)
    assert sizes(size, 4, (0, 0, 0), (99, 0, 0)) == [4, 4]
    size.forget()
    assert sizes(size, 4, (101, 0, 0), (200, 0, 0)) == [4, 4]
    assert sizes(size, 4, (202, 0, 0)) == [1]
