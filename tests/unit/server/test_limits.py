"""Limit of sign-in attempts."""

import pytest

from marey_server.errors import TooManyRequestsProblem
from marey_server.process.services import NAMES_REMEMBERED, TryLimit


def test_tries_are_limited_by_key_and_come_back_with_time() -> None:
    now = [0.0]
    limit = TryLimit(3, clock=lambda: now[0])
    for _ in range(3):
        limit.take("ann")
    with pytest.raises(TooManyRequestsProblem) as refusal:
        limit.take("ann")
    assert refusal.value.headers["Retry-After"] == "20"
    limit.take("ben")
    now[0] += 20
    limit.take("ann")
    with pytest.raises(TooManyRequestsProblem):
        limit.take("ann")


def test_guesses_at_many_names_do_not_fill_the_memory() -> None:
    limit = TryLimit(1)
    for number in range(NAMES_REMEMBERED + 100):
        limit.take(str(number))
    assert len(limit._buckets) == NAMES_REMEMBERED
