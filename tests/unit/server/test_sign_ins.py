"""Limits on wrong passwords: shared by all servers, deleted when they end, and harmless to owners of accounts."""

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import Connection, func, select
from tests.support.database_fixtures import AdjustableClock

from marey_server.access.principal import ANONYMOUS, SYSTEM
from marey_server.errors import TooManyRequestsProblem, UnavailableProblem
from marey_server.http.exchange import forwarded_address
from marey_server.process import password_lanes
from marey_server.process.password_lanes import PLACES, PLACES_PER_ADDRESS, PasswordLane, RefusedTries, limited_address
from marey_server.store import rate_limits
from marey_server.store.credentials import sign_ins
from marey_server.store.credentials.sign_ins import MORE_FOR_MANY, SignInTry, too_many_sign_ins
from marey_server.store.database.connections import Database
from marey_server.store.tables import sign_in_limit

pytestmark = pytest.mark.every_database

PER_MINUTE = 10


class StoppedClock(AdjustableClock):
    """Clock that only a test sets forward."""

    def __init__(self) -> None:
        super().__init__()
        self._start_us = time.time_ns() // 1000

    def now_us(self, connection: Connection) -> int:
        return self._start_us + self._ahead_us


@pytest.fixture
def clock() -> AdjustableClock:
    """The clock of `database`, which stands still, so that limits do not expire by themselves."""
    return StoppedClock()


def guess(database: Database, name: str = "ann", address: str = "10.0.0.1") -> str | None:
    """Count a try to sign in; return which limit refuses the try, or None."""
    try:
        database.write(ANONYMOUS, sign_ins.count, SignInTry(name, address, PER_MINUTE))
    except TooManyRequestsProblem as refusal:
        return str(refusal.context["limit"])
    return None


def rows(database: Database) -> int:
    return database.read(SYSTEM, lambda tx: tx.execute(select(func.count()).select_from(sign_in_limit)).scalar_one())


def test_wrong_passwords_are_limited_by_account_and_address_and_come_back_with_time(
    database: Database, clock: AdjustableClock
) -> None:
    assert [guess(database) for _ in range(PER_MINUTE)] == [None] * PER_MINUTE
    with pytest.raises(TooManyRequestsProblem) as refused:
        database.write(ANONYMOUS, sign_ins.count, SignInTry("ann", "10.0.0.1", PER_MINUTE))
    assert refused.value.headers["Retry-After"] == "6"
    assert "your address" in refused.value.detail
    clock.advance(6)
    assert guess(database) is None
    assert guess(database) == "account-at-address"


def test_guesses_of_a_stranger_never_keep_the_owner_out(database: Database) -> None:
    while guess(database, address="203.0.113.7") is None:
        pass
    assert guess(database, address="198.51.100.1") is None


def test_strangers_at_many_addresses_do_not_keep_the_owner_out_of_a_known_address(
    database: Database, clock: AdjustableClock
) -> None:
    home = SignInTry("ann", "198.51.100.1", PER_MINUTE)
    database.write(ANONYMOUS, sign_ins.count, home)
    database.write(ANONYMOUS, sign_ins.record_success, home)
    refusals = [guess(database, address=f"203.0.113.{number}") for number in range(MORE_FOR_MANY * PER_MINUTE + 1)]
    assert refusals == [None] * MORE_FOR_MANY * PER_MINUTE + ["account"]
    assert guess(database, address="192.0.2.1") == "account"
    assert guess(database, address=home.address) is None
    clock.advance(sign_ins.KNOWN_FOR_US / 1e6)
    assert not database.read(ANONYMOUS, sign_ins.is_known, home)


def test_an_address_may_not_guess_at_any_number_of_names(database: Database) -> None:
    names = [f"user{number}" for number in range(MORE_FOR_MANY * PER_MINUTE + 1)]
    assert [guess(database, name) for name in names] == [None] * (len(names) - 1) + ["address"]


def test_a_refused_try_counts_nowhere(database: Database, clock: AdjustableClock) -> None:
    for _ in range(3 * PER_MINUTE):
        guess(database)
    assert [guess(database, f"user{number}") for number in range((MORE_FOR_MANY - 1) * PER_MINUTE)].count(None) == 90
    clock.advance(60)
    assert guess(database) is None


def test_right_passwords_use_nothing_up(database: Database) -> None:
    attempt = SignInTry("ann", "10.0.0.1", PER_MINUTE)
    for _ in range(3 * PER_MINUTE):
        database.write(ANONYMOUS, sign_ins.count, attempt)
        database.write(ANONYMOUS, sign_ins.record_success, attempt)
    assert guess(database) is None


def test_servers_share_the_limits_and_count_each_try_once(open_database: Callable[[], Database]) -> None:
    servers = [open_database() for _ in range(2)]
    with ThreadPoolExecutor(8) as threads:
        refusals = list(threads.map(lambda number: guess(servers[number % 2]), range(3 * PER_MINUTE)))
    assert refusals.count(None) == PER_MINUTE


def test_limits_that_have_ended_are_deleted(database: Database, clock: AdjustableClock) -> None:
    for number in range(50):
        guess(database, f"user{number}", f"10.0.0.{number}")
    assert rows(database) == 150
    assert database.write(SYSTEM, rate_limits.forget_ended) == 0
    clock.advance(7)
    assert database.write(SYSTEM, rate_limits.forget_ended) == 150
    assert rows(database) == 0


def test_no_name_and_no_address_is_stored(database: Database) -> None:
    guess(database, "secretive", "203.0.113.77")
    stored = database.read(SYSTEM, lambda tx: str(tx.execute(select(sign_in_limit)).all()))
    assert "secretive" not in stored
    assert "203.0.113" not in stored


@pytest.mark.parametrize(
    ("address", "limited"),
    [
        ("203.0.113.7", "203.0.113.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2:ffff::1", "2001:db8:1:2::/64"),
        ("::ffff:203.0.113.7", "203.0.113.7"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", ""),
    ],
)
def test_a_network_of_ipv6_counts_as_one_address(address: str, limited: str) -> None:
    assert limited_address(address) == limited


@pytest.mark.parametrize(
    ("header", "hops", "address"),
    [
        ("203.0.113.7", 1, "203.0.113.7"),
        ("6.6.6.6, 203.0.113.7", 1, "203.0.113.7"),
        ("6.6.6.6, 203.0.113.7, 10.0.0.2", 2, "203.0.113.7"),
        ("203.0.113.7", 2, None),
        ("6.6.6.6, unknown", 1, None),
        ("", 1, None),
    ],
)
def test_a_forwarded_address_is_the_one_that_a_trusted_proxy_added(header: str, hops: int, address: str) -> None:
    assert forwarded_address(header, hops) == address


def test_a_lane_is_bounded_and_one_address_takes_a_part_of_it() -> None:
    lane = PasswordLane("test")
    held = [lane.place("10.0.0.1") for _ in range(PLACES_PER_ADDRESS)]
    for place in held:
        place.__enter__()
    with pytest.raises(TooManyRequestsProblem) as refused, lane.place("10.0.0.1"):
        pass
    assert refused.value.headers["Retry-After"] == "1"
    more = [lane.place(f"10.0.1.{number}") for number in range(PLACES - PLACES_PER_ADDRESS)]
    for place in more:
        place.__enter__()
    with pytest.raises(UnavailableProblem) as full, lane.place("10.0.0.2"):
        pass
    assert full.value.error_code == "too-many-passwords"
    for place in (*held, *more):
        place.__exit__(None, None, None)
    assert len(lane) == 0
    with lane.place("10.0.0.1"):
        assert asyncio.run(lane.run(sum, [1, 2])) == 3
    lane.close()


def test_a_refusal_is_repeated_without_the_database_until_its_time() -> None:
    now = [0.0]
    refused = RefusedTries(clock=lambda: now[0])
    attempt, other_name, other_address = (SignInTry(*two, 10) for two in (("a", "1"), ("b", "1"), ("a", "2")))
    refused.note(attempt, too_many_sign_ins("account-at-address", 6))
    for allowed in (other_name, other_address):
        refused.check(allowed)
    with pytest.raises(TooManyRequestsProblem) as again:
        refused.check(attempt)
    assert again.value.headers["Retry-After"] == "6"
    now[0] = 6.0
    refused.check(attempt)
    refused.note(attempt, too_many_sign_ins("address", 6))
    with pytest.raises(TooManyRequestsProblem):
        refused.check(other_name)
    for number in range(password_lanes.REFUSALS_REMEMBERED + 10):
        refused.note(SignInTry("a", str(number), 10), too_many_sign_ins("address", 6))
    assert len(refused._until) == password_lanes.REFUSALS_REMEMBERED
