"""Limits on how often something may happen, shared by all servers.

A limit is a row with one time (the generic cell rate algorithm). Each event moves the time into the future by an
interval. An event that would move the time too far is refused and not counted. So a limit always ends after the time
that its refusal states. Rows whose time has passed have no effect, and are deleted. Keys are hashes, so that a stolen
database does not show the names and addresses in them.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import BigInteger, Table, bindparam, case, delete, select, update
from sqlalchemy.dialects import postgresql, sqlite

from marey_schemas.encoding.canonical import canonical_json
from marey_server.store.database.clock import DAY_US
from marey_server.store.database.prepared import Prepared
from marey_server.store.tables import sign_in_limit
from marey_server.store.transaction import Transaction

FORGOTTEN_AT_ONCE = 10_000
"""Greatest number of rows deleted in one transaction."""


@dataclass(frozen=True, slots=True)
class RateLimit:
    """Limit on events with the same key: at most `burst` at once, and then one in each `interval_us` microseconds."""

    key: str
    burst: int
    interval_us: int

    def latest_us(self, now_us: int) -> int:
        """Return the greatest stored time (`until_us`) with which another event is still allowed at `now_us`."""
        return now_us + (self.burst - 1) * self.interval_us


@dataclass(frozen=True, slots=True)
class DailyAmount(RateLimit):
    """Limit on an amount per day, such as bytes, for one event that uses up a part of it.

    `interval_us` is the time in microseconds after which this part is free again.
    """

    @classmethod
    def part(cls, key: str, amount: int, most: int) -> DailyAmount:
        """Return the limit for an event that uses up `amount`; `most` is the amount per day."""
        return cls(key, burst=1, interval_us=max(1, amount * DAY_US // most))

    def latest_us(self, now_us: int) -> int:
        """Return the greatest stored time (`until_us`) with which the event is still allowed at `now_us`."""
        return now_us + DAY_US - self.interval_us


def key_of(*parts: str) -> str:
    """Return the key of a limit, a hash of its name and of the names or addresses to which it applies."""
    return hashlib.sha256(canonical_json(list(parts))).hexdigest()


def wait_s(tx: Transaction, limit: RateLimit) -> int:
    """Return the seconds until another event is allowed, 0 if it is allowed now."""
    until_us = tx.execute(select(sign_in_limit.c.until_us).where(sign_in_limit.c.key == limit.key)).scalar() or 0
    return max(0, math.ceil((until_us - limit.latest_us(tx.now_us)) / 1_000_000))


def count(tx: Transaction, limit: RateLimit) -> int:
    """Count an event and return 0; if the limit is reached, count nothing and return the seconds to wait."""
    now_us = tx.now_us
    given = {"of_key": limit.key, "now": now_us, "interval": limit.interval_us, "latest": limit.latest_us(now_us)}
    return 0 if tx.run(_COUNT[tx.is_postgres], given) else wait_s(tx, limit)


def _counting(insert: Callable[[Table], sqlite.Insert | postgresql.Insert]) -> Prepared:
    """Return the statement that counts an event, and gives a row unless the limit is reached."""
    until = sign_in_limit.c.until_us
    now_us, interval_us, latest_us = (bindparam(name, type_=BigInteger) for name in ("now", "interval", "latest"))
    return Prepared(
        insert(sign_in_limit)
        .values(key=bindparam("of_key"), until_us=now_us + interval_us)
        .on_conflict_do_update(
            index_elements=["key"],
            set_={"until_us": case((until > now_us, until), else_=now_us) + interval_us},
            where=until <= latest_us,
        )
        .returning(until)
    )


_COUNT = {True: _counting(postgresql.insert), False: _counting(sqlite.insert)}
"""Prepared statements of `count`: on Postgres, and on SQLite."""


def uncount(tx: Transaction, limit: RateLimit) -> None:
    """Undo the count of one event, so that it does not use up the limit."""
    values = {"until_us": sign_in_limit.c.until_us - limit.interval_us}
    tx.execute(update(sign_in_limit).where(sign_in_limit.c.key == limit.key).values(**values))


def forget_ended(tx: Transaction) -> int:
    """Delete rows that no longer have an effect, at most `FORGOTTEN_AT_ONCE`; return their number."""
    ended = select(sign_in_limit.c.key).where(sign_in_limit.c.until_us <= tx.now_us).limit(FORGOTTEN_AT_ONCE)
    if tx.is_postgres:
        ended = ended.with_for_update(skip_locked=True)
    return tx.execute(delete(sign_in_limit).where(sign_in_limit.c.key.in_(ended))).rowcount
