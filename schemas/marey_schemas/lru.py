"""A bounded cache that drops the least recently used values first."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class LruCache(Generic[Key, Value]):
    """Cache of the most recently used values, limited by number, by bytes, or by both. It is thread-safe.

    Parameters
    ----------
    max_entries : largest number of values; None for no limit
    max_bytes : largest sum of `size_of` over all values; None for no limit. The newest value is kept even if it alone
        exceeds this limit, unless it exceeds `largest_bytes`.
    largest_bytes : values larger than this are not stored, so that a single value does not displace all others
    size_of : bytes of a value; needed only with a bound in bytes
    """

    def __init__(
        self,
        *,
        max_entries: int | None = None,
        max_bytes: int | None = None,
        largest_bytes: int | None = None,
        size_of: Callable[[Value], int] = lambda _: 0,
    ) -> None:
        self._max_entries = max_entries
        self._max_bytes = max_bytes
        self._largest_bytes = largest_bytes
        self._size_of = size_of
        self._entries: OrderedDict[Key, tuple[Value, int]] = OrderedDict()
        self._held_bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, key: Key) -> Value | None:
        """Return the value of `key`, or None."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                return None
            self._entries.move_to_end(key)
            return entry[0]

    def put(self, key: Key, value: Value) -> None:
        """Store a value under `key`, replacing an earlier one."""
        size = self._size_of(value)
        if self._largest_bytes is not None and size > self._largest_bytes:
            return
        with self._lock:
            if key in self._entries:
                self._held_bytes -= self._entries.pop(key)[1]
            self._entries[key] = (value, size)
            self._held_bytes += size
            while self._is_over():
                self._drop_oldest()

    def get_or_make(self, key: Key, make: Callable[[], Value]) -> Value:
        """Return the value of `key`; if there is none, call `make` and store its result.

        `make` runs without the lock: if two threads find no value at the same time, both call `make`. Room for one
        entry is freed before `make` runs, because values may be large.
        """
        found = self.get(key)
        if found is not None:
            return found
        with self._lock:
            while self._max_entries is not None and len(self._entries) >= self._max_entries:
                self._drop_oldest()
        value = make()
        self.put(key, value)
        return value

    def items(self) -> list[tuple[Key, Value]]:
        """Return all pairs of key and value, the least recently used first."""
        with self._lock:
            return [(key, value) for key, (value, _) in self._entries.items()]

    def pop(self, key: Key) -> Value | None:
        """Remove the value of `key` and return it, or None."""
        with self._lock:
            value, size = self._entries.pop(key, (None, 0))
            self._held_bytes -= size
            return value

    def _is_over(self) -> bool:
        if self._max_entries is not None and len(self._entries) > self._max_entries:
            return True
        return self._max_bytes is not None and self._held_bytes > self._max_bytes and len(self._entries) > 1

    def _drop_oldest(self) -> None:
        _, (_, size) = self._entries.popitem(last=False)
        self._held_bytes -= size
