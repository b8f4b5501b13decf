"""Wake-ups for request handlers of this process that wait for an event, such as the end of a job.

A wake-up is only a hint: the handler then reads the database. `process.feed` announces what other processes changed.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

COMMITTED_EVENTS = "committed events"
"""Topic that is announced whenever a transaction with events was committed, in this process or in another."""

OUTPUTS_TO_COMMIT = "outputs to commit"
"""Topic that is announced when the tasks of a job have ended and the server must commit their many outputs."""

ENDS_TO_PROPAGATE = "ends to propagate"
"""Topic that is announced when a transaction has left the ends of some jobs to later transactions."""

NUMBERED_EVENTS = "numbered events"
"""Topic that is announced when new events can be read. On Postgres, this is when their numbers are assigned."""


def events_topic(project_id: str) -> str:
    """Return the topic of new events of a project."""
    return f"events:{project_id}"


def job_topic(job_id: str) -> str:
    """Return the topic of the end of a job."""
    return f"job:{job_id}"


def work_topic(kind: str) -> str:
    """Return the topic that is announced when a job of this kind can be claimed."""
    return f"work:{kind}"


class Wakeups:
    """Wake-ups by topic: any thread can announce a topic, and coroutines wait until it is announced."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: dict[str, set[Listener]] = {}

    @contextmanager
    def listen(self, topics: Iterable[str]) -> Iterator[Listener]:
        """Listen to `topics` from now on. Call it before reading the database, so that no change is missed."""
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
        """Wake every listener to any of `topics`; may be called from any thread."""
        with self._lock:
            woken = {listener for topic in topics for listener in self._listeners.get(topic, ())}
        for listener in woken:
            listener.wake()

    def wake_everybody(self) -> None:
        """Wake every listener because the server is about to stop."""
        with self._lock:
            topics = list(self._listeners)
        self.announce(topics)


class Listener:
    """Wait of one coroutine: `wait` suspends the coroutine, and `wake` resumes it."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._event = asyncio.Event()

    def wake(self) -> None:
        """Make `wait` return; may be called from any thread."""
        try:
            self._loop.call_soon_threadsafe(self._event.set)
        except RuntimeError:  # the loop has ended, and with it whoever waited
            return

    async def wait(self, timeout_s: float) -> bool:
        """Wait for a wake-up for at most `timeout_s`; return whether there was one."""
        try:
            async with asyncio.timeout(timeout_s):  # `wait_for` loses a cancellation that comes with a wake-up
                await self._event.wait()
        except TimeoutError:
            return False
        self._event.clear()
        return True


wakeups = Wakeups()
"""Wake-ups of this process."""
