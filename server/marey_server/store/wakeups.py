"""Wakes request handlers of this process that wait for an event, such as the end of a job.

A wake-up is a hint: the handler reads the database again. Changes by other processes are found by polling from time
to time.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class Wakeups:
    """Topics that threads announce and coroutines await."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: dict[str, set[Listener]] = {}

    @contextmanager
    def listen(self, topics: Iterable[str]) -> Iterator[Listener]:
        """Hear of `topics` from now on. Listen first and look second, so that nothing falls between."""
        listener = Listener(asyncio.get_running_loop())
        topics = frozenset(topics)
        with self._lock:
            for topic in topics:
                self._listeners.setdefault(topic, set()).add(listener)
        try:
            yield listener
        finally:
            with self._lock:
                for topic in topics:
                    listeners = self._listeners[topic]
                    listeners.discard(listener)
                    if not listeners:
                        del self._listeners[topic]

    def announce(self, topics: Iterable[str]) -> None:
        """Wake everybody who listens to any of `topics`. May be called from any thread."""
        with self._lock:
            woken = {listener for topic in topics for listener in self._listeners.get(topic, ())}
        for listener in woken:
            listener.wake()

    def wake_everybody(self) -> None:
        """Wake every listener: the server is about to stop."""
        with self._lock:
            topics = list(self._listeners)
        self.announce(topics)


class Listener:
    """A waiting coroutine and the topics that wake it."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._event = asyncio.Event()

    def wake(self) -> None:
        """Let `wait` return; from any thread."""
        try:
            self._loop.call_soon_threadsafe(self._event.set)
        except RuntimeError:  # the loop has ended, and with it whoever waited
            return

    async def wait(self, timeout_s: float) -> bool:
        """Wait for a wake-up, at most `timeout_s`; whether there was one."""
        try:
            await asyncio.wait_for(self._event.wait(), timeout_s)
        except TimeoutError:
            return False
        self._event.clear()
        return True


wakeups = Wakeups()
"""Of this process. Topics: `work:<kind>` when a job of the kind can be claimed, `job:<id>` when a job has ended."""
