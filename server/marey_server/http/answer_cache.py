"""Bodies of answers that never change, kept so that reading the same document again only copies bytes to the socket.

Whether the caller may read a document is not kept: the store is asked on every request, before anything is taken from
here.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

LARGEST_SHARE = 8
"""What is larger than this part of the cache is not kept: it would push out everything else."""
ENTRY_BYTES = 512
"""What an entry takes besides its body."""

Key = tuple[str, str]
"""Digest of a document, and the form it is sent in."""


class AnswerCache:
    """The bodies used last, as many as fit into `max_bytes`. Any thread may use it."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._held_bytes = 0
        self._bodies: OrderedDict[Key, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Key, make: Callable[[], bytes]) -> bytes:
        """The body of a key; `make` gives it where it is not here."""
        with self._lock:
            body = self._bodies.get(key)
            if body is not None:
                self._bodies.move_to_end(key)
                return body
        body = make()
        if len(body) + ENTRY_BYTES <= self._max_bytes // LARGEST_SHARE:
            self._keep(key, body)
        return body

    def _keep(self, key: Key, body: bytes) -> None:
        with self._lock:
            if key in self._bodies:  # another thread was faster
                return
            self._bodies[key] = body
            self._held_bytes += len(body) + ENTRY_BYTES
            while self._held_bytes > self._max_bytes:
                _, oldest = self._bodies.popitem(last=False)
                self._held_bytes -= len(oldest) + ENTRY_BYTES
