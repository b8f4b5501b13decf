"""Leader election among servers: one leader at a time, and a fence number that grows when the leader changes."""

import pytest
from tests.support.database_fixtures import AdjustableClock

from marey_server.access.principal import SYSTEM
from marey_server.store.database.connections import Database
from marey_server.store.leader import give_up_lead, take_lead

pytestmark = pytest.mark.every_database

TERM_S = 60


def take(database: Database, holder: str) -> int | None:
    fence: int | None = database.write(SYSTEM, take_lead, "reaper", holder, TERM_S * 1_000_000)
    return fence


def test_the_lead_passes_when_its_term_ends_and_the_fence_grows(database: Database, clock: AdjustableClock) -> None:
    assert take(database, "a") == 1
    clock.advance(TERM_S - 1)
    assert take(database, "a") == 1
    clock.advance(TERM_S - 1)
    assert take(database, "b") is None
    clock.advance(1)
    assert take(database, "b") == 2
    assert take(database, "a") is None


def test_a_lead_that_is_given_up_can_be_taken_at_once(database: Database, clock: AdjustableClock) -> None:
    assert take(database, "a") == 1
    database.write(SYSTEM, give_up_lead, "reaper", "b")
    assert take(database, "b") is None
    database.write(SYSTEM, give_up_lead, "reaper", "a")
    assert take(database, "b") == 2
