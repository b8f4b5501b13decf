"""Limits on wrong passwords, shared by all servers; a stranger cannot use them to lock out the owner of an account.

Every try counts in three limits until its password turns out to be right: a limit for the account from this address, a
limit for the address, and a limit for the account from all addresses from which nobody has signed in to it. The last
limit does not apply to known addresses, so guesses from other addresses never lock out the owner
(docs/decisions/0020-sign-in-limits.md).

A limit is a row with one time (the generic cell rate algorithm): each try moves it into the future by an interval, and
a try that would move it too far is refused. Rows whose time has passed have no effect, and are deleted.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import case, delete, select, update

from marey_schemas.encoding.canonical import canonical_json
from marey_server.errors import TooManyRequestsProblem
from marey_server.store.database.clock import DAY_US
from marey_server.store.tables import sign_in_limit
from marey_server.store.transaction import Transaction

MORE_FOR_MANY = 10
"""How many times as many tries an address has for all accounts, and all unknown addresses at once for an account."""
KNOWN_FOR_US = 90 * DAY_US
"""Time for which an address is known after a sign-in."""
LimitScope = Literal["account-at-address", "address", "account"]
_IN_WORDS: dict[LimitScope, str] = {
    "account-at-address": "user name from your address",
    "address": "address of yours",
    "account": "user name from addresses where it never signed in",
}
_MINUTE_US = 60_000_000
FORGOTTEN_AT_ONCE = 10_000
"""Greatest number of rows deleted in one transaction."""


@dataclass(frozen=True, slots=True)
class SignInTry:
    """A try to sign in: the name of the account, which may not exist, and the client's address or network."""

    name: str
    address: str
    per_minute: int
    """Number of tries per minute for an account from one address."""


@dataclass(frozen=True, slots=True)
class _TryLimit:
    """Limit of tries: at most `burst` at once, and then one each `interval_us`."""

    scope: LimitScope
    key: str
    burst: int
    interval_us: int


def is_known(tx: Transaction, attempt: SignInTry) -> bool:
    """Return whether somebody has signed in to the account from this address in the last `KNOWN_FOR_US`."""
    statement = select(sign_in_limit.c.until_us).where(sign_in_limit.c.key == _known_key(attempt))
    return int(tx.execute(statement).scalar() or 0) > tx.now_us


def count(tx: Transaction, attempt: SignInTry) -> None:
    """Count a try before its password is checked.

    If a limit is exceeded, raises `TooManyRequestsProblem` and does not count the try.
    """
    for limit in _limits(attempt, known=is_known(tx, attempt)):
        _count_one(tx, limit)


def forgive(tx: Transaction, attempt: SignInTry) -> None:
    """Remove a try with the right password from the counts, and remember its address as known."""
    for limit in _limits(attempt, known=is_known(tx, attempt)):
        values = {"until_us": sign_in_limit.c.until_us - limit.interval_us}
        tx.execute(update(sign_in_limit).where(sign_in_limit.c.key == limit.key).values(**values))
    row = {"key": _known_key(attempt), "until_us": tx.now_us + KNOWN_FOR_US}
    remembered = tx.insert_into(sign_in_limit, row)
    tx.execute(remembered.on_conflict_do_update(index_elements=["key"], set_={"until_us": row["until_us"]}))


def forget_ended(tx: Transaction) -> int:
    """Delete rows that no longer have an effect, at most `FORGOTTEN_AT_ONCE`; return their number."""
    ended = select(sign_in_limit.c.key).where(sign_in_limit.c.until_us <= tx.now_us).limit(FORGOTTEN_AT_ONCE)
    if tx.is_postgres:
        ended = ended.with_for_update(skip_locked=True)
    return tx.execute(delete(sign_in_limit).where(sign_in_limit.c.key.in_(ended))).rowcount


def _limits(attempt: SignInTry, *, known: bool) -> Iterator[_TryLimit]:
    """Yield the limits of a try, in the order in which every transaction locks their rows."""
    few, many = attempt.per_minute, MORE_FOR_MANY * attempt.per_minute
    limits = [
        _TryLimit("account-at-address", _key("pair", attempt.name, attempt.address), few, _MINUTE_US // few),
        _TryLimit("address", _key("address", attempt.address), many, _MINUTE_US // many),
    ]
    if not known:
        limits.append(_TryLimit("account", _key("account", attempt.name), many, _MINUTE_US // few))
    yield from sorted(limits, key=lambda limit: limit.key)


def _count_one(tx: Transaction, limit: _TryLimit) -> None:
    until, now_us = sign_in_limit.c.until_us, tx.now_us
    latest_us = now_us + (limit.burst - 1) * limit.interval_us
    counted = tx.insert_into(sign_in_limit, {"key": limit.key, "until_us": now_us + limit.interval_us})
    counted = counted.on_conflict_do_update(
        index_elements=["key"],
        set_={"until_us": case((until > now_us, until), else_=now_us) + limit.interval_us},
        where=until <= latest_us,
    )
    if tx.execute(counted.returning(until)).first() is not None:
        return
    stored = tx.execute(select(until).where(sign_in_limit.c.key == limit.key)).scalar_one()
    wait_s = math.ceil((stored - latest_us) / 1_000_000)
    raise too_many_sign_ins(limit.scope, wait_s)


def too_many_sign_ins(limit: LimitScope, wait_s: int) -> TooManyRequestsProblem:
    """Return the error for a try that exceeds a limit, whether or not the account exists."""
    return TooManyRequestsProblem(
        f"Too many wrong passwords for this {_IN_WORDS[limit]}; wait {wait_s} s.",
        code="too-many-sign-ins",
        context={"limit": limit, "wait_s": wait_s},
        headers={"Retry-After": str(wait_s)},
    )


def _known_key(attempt: SignInTry) -> str:
    return _key("known", attempt.name, attempt.address)


def _key(*parts: str) -> str:
    return hashlib.sha256(canonical_json(list(parts))).hexdigest()
