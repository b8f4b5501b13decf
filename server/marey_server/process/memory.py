"""Limit on the memory for requests: bodies count until they are decoded, and answers until they are sent."""

from __future__ import annotations

import threading
from collections import Counter

from marey_server.errors import UnavailableProblem
from marey_server.store.database.lanes import RETRY_AFTER_S, Client

CLIENT_SHARE = 0.75
"""Largest fraction of the memory for requests (`RequestMemory.total_bytes`) that one client may hold."""
UNKNOWN_SHARE = 0.25
"""Largest fraction of the memory for requests that all clients without a known token together may hold."""
UNKNOWN_SHARE_EACH = UNKNOWN_SHARE / 2
"""Largest fraction of the memory for requests that one address without a known token may hold."""
RESERVED_SHARE = 0.125
"""Additional memory for reserved operations, such as heartbeats, as a fraction of the memory for other requests."""
UNKNOWN_CLIENTS = "unknown-clients"
"""Owner of the memory that all clients without a known token hold together."""


class RequestMemory:
    """Count of the bytes that all requests hold, limited to `total_bytes`; any thread may use it.

    While no other request holds bytes, a request may exceed `total_bytes`; the limits on the size of a single request
    still apply.
    """

    def __init__(self, total_bytes: int) -> None:
        self.total_bytes = total_bytes
        self.held_bytes = 0
        self._by_owner: Counter[str] = Counter()
        self._lock = threading.Lock()

    def take(self, client: Client, bytes_now: int, more: int, *, reserved: bool) -> None:
        """Count `more` bytes for `client`, whose request already holds `bytes_now` bytes.

        For a reserved operation, such as a heartbeat, the share of the client is not limited. All requests together may
        then hold more: `total_bytes * (1 + RESERVED_SHARE)`. Raises `UnavailableProblem` if a limit would be exceeded.
        """
        with self._lock:
            others = self.held_bytes > bytes_now
            exceeds_share = not reserved and any(
                self._by_owner[owner] + more > share * self.total_bytes for owner, share in _shares(client).items()
            )
            total = self.total_bytes * (1 + RESERVED_SHARE * reserved)
            if others and (exceeds_share or self.held_bytes + more > total):
                whose = "your requests" if exceeds_share else "all requests together"
                raise UnavailableProblem(
                    f"The memory that is reserved for {whose} is full; try again in a few seconds, "
                    "with fewer requests at once.",
                    code="memory",
                    headers={"Retry-After": str(RETRY_AFTER_S)},
                )
            self._count(client, more)

    def give_back(self, client: Client, held: int) -> None:
        """Subtract `held` bytes, which a request of the client has released, from the counted bytes."""
        with self._lock:
            self._count(client, -held)

    def _count(self, client: Client, more: int) -> None:
        self.held_bytes += more
        for owner in _shares(client):
            self._by_owner[owner] += more
            if not self._by_owner[owner]:
                del self._by_owner[owner]


def _shares(client: Client) -> dict[str, float]:
    """Return the keys under which a client's bytes are counted, each with its greatest share of the memory.

    A known client has one key. An unknown client has two: one of its own, and one that all unknown clients share.
    """
    if client.known:
        return {client.key: CLIENT_SHARE}
    # A user who is often refused is unknown for a while; bytes that the user held before must not count in this share.
    return {f"unknown {client.key}": UNKNOWN_SHARE_EACH, UNKNOWN_CLIENTS: UNKNOWN_SHARE}


class Holding:
    """Bytes that one request holds, counted for its client."""

    def __init__(self, memory: RequestMemory, client: Client, *, reserved: bool) -> None:
        self._memory = memory
        self._client = client
        self._reserved = reserved
        self._bytes = 0

    def grow(self, more: int) -> None:
        """Count more bytes of the request.

        Raises `UnavailableProblem` if all requests together, or all requests of the client, would hold too many bytes.
        """
        self._memory.take(self._client, self._bytes, more, reserved=self._reserved)
        self._bytes += more

    def shrink(self, less: int) -> None:
        """Reduce the memory that this request holds by `less` bytes."""
        if less:
            self._bytes -= less
            self._memory.give_back(self._client, less)

    def release(self) -> None:
        """Release all bytes that the request holds; may be called several times."""
        held, self._bytes = self._bytes, 0
        if held:
            self._memory.give_back(self._client, held)
