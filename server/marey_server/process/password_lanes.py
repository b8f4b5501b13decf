"""Threads that hash passwords, and the addresses by which sign-ins are limited.

A hash takes 0.1 s and 32 MiB, so few hashes are computed at once, and never in the threads of the database or of other
computations. One thread is for users at addresses from which they have signed in before; the other is for all other
sign-ins. So these other sign-ins do not delay known users, and use at most one processor.
"""

from __future__ import annotations

import asyncio
import ipaddress
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from marey_schemas.lru import LruCache
from marey_server.errors import TooManyRequestsProblem, UnavailableProblem
from marey_server.store.credentials.sign_ins import LimitScope, SignInTry, too_many_sign_ins
from marey_server.store.database.lanes import SERVER, Lane

P = ParamSpec("P")
T = TypeVar("T")

PLACES = 16
"""Greatest number of requests in a lane, including the one whose password is being hashed."""
PLACES_PER_ADDRESS = 4
"""Greatest number of requests in a lane from one address."""
IPV6_NETWORK_BITS = 64
"""Length of the IPv6 prefix that a provider assigns to one customer, who can use all addresses with this prefix."""
REFUSALS_REMEMBERED = 10_000


def limited_address(text: str) -> str:
    """Return the address by which sign-ins of a client are limited: its address, or for IPv6 its /64 network."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:  # a Unix socket has none
        return text
    if isinstance(address, ipaddress.IPv4Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((int(address), IPV6_NETWORK_BITS), strict=False))


class PasswordLane:
    """Thread that hashes passwords, for a limited number of requests at the same time."""

    def __init__(self, name: str) -> None:
        self._thread = Lane(f"marey-password-{name}", 1)
        self._places: Counter[str] = Counter()

    def __len__(self) -> int:
        return self._places.total()

    @contextmanager
    def place(self, address: str) -> Iterator[None]:
        """Occupy a place in this lane for a request from an address, while the `with` block runs.

        Raises `TooManyRequestsProblem` if the address already has too many requests in this lane, and
        `UnavailableProblem` if there are too many in total.
        """
        if self._places[address] >= PLACES_PER_ADDRESS:
            raise TooManyRequestsProblem(
                f"{PLACES_PER_ADDRESS} requests from your address are checking or setting passwords now, which is the "
                "limit; try again in a second.",
                code="too-many-sign-ins",
                headers={"Retry-After": "1"},
            )
        if len(self) >= PLACES:
            raise UnavailableProblem(
                f"The server is already checking {PLACES} passwords, the maximum; try again in 2 s.",
                code="too-many-passwords",
                headers={"Retry-After": "2"},
            )
        self._places[address] += 1
        try:
            yield
        finally:
            self._places[address] -= 1
            self._places += Counter()  # drops addresses without a place

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run `function`, which hashes a password, in the thread of the lane, and return its result.

        Raises `StoppingProblem` if the server stops before the function has begun.
        """
        return await asyncio.wrap_future(self._thread.submit(SERVER, function, *args, **kwargs))

    def close(self) -> None:
        """Stop the thread after its current hash; the waiting hashes fail. Does not wait for the thread."""
        self._thread.close(wait=False)


class RefusedTries:
    """Addresses and accounts whose sign-ins are refused at the moment, with the time until which they are refused.

    They are kept in memory, so that repeated tries do not reach the database.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._until: LruCache[tuple[str | None, str], tuple[float, LimitScope]] = LruCache(
            max_entries=REFUSALS_REMEMBERED
        )

    def check(self, attempt: SignInTry) -> None:
        """Raise `TooManyRequestsProblem` while a limit applies to this address, or to this account and address."""
        for key in ((None, attempt.address), (attempt.name, attempt.address)):
            until_s, limit = self._until.get(key) or (0.0, "address")
            wait_s = math.ceil(until_s - self._clock())
            if wait_s > 0:
                raise too_many_sign_ins(limit, wait_s)

    def note(self, attempt: SignInTry, refusal: TooManyRequestsProblem) -> None:
        """Remember a refusal of a try, and the time until which further tries are refused.

        Depending on the exceeded limit, either all tries from this address are refused, or only those for this name.
        """
        limit: LimitScope = refusal.context["limit"]
        name = None if limit == "address" else attempt.name
        self._until.put((name, attempt.address), (self._clock() + refusal.context["wait_s"], limit))
