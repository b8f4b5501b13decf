"""Limits on tries with wrong passwords or invitation codes, shared by all servers.

Every try with a wrong password counts towards two limits: one for this account from this address, and one for this
address with all accounts. An address is unknown if nobody has signed in to the account from this address in the last
90 days. A try from an unknown address also counts towards a third limit: one for this account from all unknown
addresses together. The third limit does not apply to known addresses. So guesses from elsewhere never lock out an owner
who signs in from a known address (docs/decisions/0020-sign-in-limits.md). For the code of an invitation, the prefix of
the code takes the place of the account.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import select

from marey_server.errors import TooManyRequestsProblem
from marey_server.store import rate_limits
from marey_server.store.database.clock import DAY_US
from marey_server.store.rate_limits import RateLimit, key_of
from marey_server.store.tables import sign_in_limit
from marey_server.store.transaction import Transaction

MORE_FOR_MANY = 10
"""Number by which `per_minute` is multiplied for the limit of one address with all accounts.

The limit of one account from all unknown addresses together allows the same number of tries at once, and then
`per_minute` tries a minute.
"""
KNOWN_FOR_US = 90 * DAY_US
"""Time for which an address is known after a sign-in."""
LimitScope = Literal["account-at-address", "address", "account"]
_IN_WORDS: dict[LimitScope, str] = {
    "account-at-address": "user name or code from your address",
    "address": "address of yours",
    "account": "user name or code from unknown addresses",
}
MINUTE_US = 60_000_000


@dataclass(frozen=True, slots=True)
class SignInTry:
    """A try to sign in or to use a code: the account, which may not exist, and the client's address or network."""

    name: str
    """Name of the account. For an invitation code: `invitation <prefix>`; names of accounts contain no spaces."""
    address: str
    per_minute: int
    """Number of tries per minute for an account from one address."""


def is_known(tx: Transaction, attempt: SignInTry) -> bool:
    """Return whether somebody signed in to the account from this address in the last `KNOWN_FOR_US` microseconds."""
    statement = select(sign_in_limit.c.until_us).where(sign_in_limit.c.key == _known_key(attempt))
    return int(tx.execute(statement).scalar() or 0) > tx.now_us


def count(tx: Transaction, attempt: SignInTry) -> None:
    """Count a try before its password is checked.

    If a limit is exceeded, raises `TooManyRequestsProblem` and does not count the try.
    """
    for limit, scope in _limits(attempt, known=is_known(tx, attempt)):
        if wait_s := rate_limits.count(tx, limit):
            raise too_many_sign_ins(scope, wait_s)


def record_success(tx: Transaction, attempt: SignInTry) -> None:
    """Remove a try with the right password from the counts, and remember the client's address as known."""
    uncount(tx, attempt)
    row = {"key": _known_key(attempt), "until_us": tx.now_us + KNOWN_FOR_US}
    remembered = tx.insert_into(sign_in_limit, row)
    tx.execute(remembered.on_conflict_do_update(index_elements=["key"], set_={"until_us": row["until_us"]}))


def uncount(tx: Transaction, attempt: SignInTry) -> None:
    """Remove a try from the counts, because its password or code was right."""
    for limit, _scope in _limits(attempt, known=is_known(tx, attempt)):
        rate_limits.uncount(tx, limit)


def _limits(attempt: SignInTry, *, known: bool) -> Iterator[tuple[RateLimit, LimitScope]]:
    """Yield the limits of a try, sorted by key, so that all transactions lock the rows of limits in the same order."""
    few, many = attempt.per_minute, MORE_FOR_MANY * attempt.per_minute
    pair, address = key_of("pair", attempt.name, attempt.address), key_of("address", attempt.address)
    limits: list[tuple[RateLimit, LimitScope]] = [
        (RateLimit(pair, few, MINUTE_US // few), "account-at-address"),
        (RateLimit(address, many, MINUTE_US // many), "address"),
    ]
    if not known:
        limits.append((RateLimit(key_of("account", attempt.name), many, MINUTE_US // few), "account"))
    yield from sorted(limits, key=lambda limit: limit[0].key)


def too_many_sign_ins(limit: LimitScope, wait_s: int) -> TooManyRequestsProblem:
    """Return the error for a try that exceeds a limit; the error does not show whether the account exists."""
    return TooManyRequestsProblem(
        f"Too many wrong passwords or invitation codes for this {_IN_WORDS[limit]}; wait {wait_s} s.",
        code="too-many-sign-ins",
        context={"limit": limit, "wait_s": wait_s},
        headers={"Retry-After": str(wait_s)},
    )


def _known_key(attempt: SignInTry) -> str:
    return key_of("known", attempt.name, attempt.address)
