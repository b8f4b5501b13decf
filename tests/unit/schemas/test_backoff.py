"""Waiting times between tries."""

import pytest

from marey_schemas.backoff import Backoff, spread


def test_waits_grow_by_the_factor_up_to_the_longest() -> None:
    backoff = Backoff(first_s=10.0, longest_s=900.0, factor=4.0, random_unit=lambda: 0.0)
    assert [backoff.delay_s(failures) for failures in (1, 2, 3, 4, 5, 10_000)] == [
        10.0,
        40.0,
        160.0,
        640.0,
        900.0,
        900.0,
    ]


@pytest.mark.parametrize("jitter", [0.25, 0.5, 1.0])
def test_jitter_takes_off_no_more_than_its_share(jitter: float) -> None:
    waits = [Backoff(first_s=8.0, longest_s=8.0, jitter=jitter).delay_s(1) for _ in range(500)]
    assert 8.0 * (1 - jitter) <= min(waits) < max(waits) <= 8.0
    assert min(waits) < 8.0 * (1 - 0.8 * jitter)


def test_seconds_are_spread_downwards() -> None:
    assert spread(10.0, 0.2, lambda: 0.5) == pytest.approx(9.0)
