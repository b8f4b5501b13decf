"""Calls of the SDK in threads: how many run at a time, their cancellation, and their end when the client is closed."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from threading import Lock
from typing import Any, ParamSpec, TypeVar

from marey_client.asynchronous.interruption import Interrupted, RunningCall, current_call, run_as
from marey_client.errors import BadArgument, ConnectionClosed

P = ParamSpec("P")
T = TypeVar("T")

MOST_CONCURRENT = 64
MOST_THREADS = 4096
"""Greatest number of threads of a client: calls that run, and calls that wait, for example for the end of a job.

It is far above the number of jobs for which programs wait, because if all threads wait, no further call can begin.
"""
GRACE_S = 1.0
"""Longest time in seconds for which a cancelled task waits for its thread to stop."""


class _ThreadCall(RunningCall):
    """Call with the future of its result."""

    def __init__(self, calls: Calls, work: Callable[[], Any]) -> None:
        super().__init__()
        self.future: Future[Any] = Future()
        self._calls = calls
        self._work = partial(copy_context().run, run_as, self, work)

    def perform(self) -> None:
        """Run the call in this thread, unless it was cancelled before."""
        begun = self.future.set_running_or_notify_cancel()
        result, error = self._outcome() if begun else (None, None)
        self._calls.leave(self)  # before the task continues
        if error is not None:
            self.future.set_exception(error)
        elif begun:
            self.future.set_result(result)

    def _outcome(self) -> tuple[Any, BaseException | None]:
        try:
            return self._work(), None
        except StopIteration as error:
            ended = RuntimeError("the function raised StopIteration, which a task cannot raise")
            ended.__cause__ = error
            return None, ended
        except BaseException as error:  # noqa: BLE001 - the task that awaits the result raises it
            return None, error

    def wait_begins(self) -> None:
        self._calls.free_place()

    def wait_ends(self) -> None:
        self._calls.take_place()


class Calls:
    """Calls of one client, in threads that they share. Any event loops may use them.

    Parameters
    ----------
    concurrency : number of calls that run at a time; further calls begin in the order in which they were made. Calls
        that wait, for example for the end of a job, are not counted
    """

    def __init__(self, concurrency: int) -> None:
        if not 1 <= concurrency <= MOST_CONCURRENT:
            raise BadArgument(f"concurrency: give a number from 1 to {MOST_CONCURRENT}, not {concurrency}")
        self._concurrency = concurrency
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        self._process = os.getpid()
        self._threads = ThreadPoolExecutor(MOST_THREADS, thread_name_prefix="marey-async")
        self._lock = Lock()
        self._running = 0
        self._queue: deque[_ThreadCall] = deque()
        self._live: set[_ThreadCall] = set()

    def _begin_again_if_forked(self) -> None:
        """In a forked process, forget the threads and the calls of the parent process, which do not exist there."""
        if self._process != os.getpid():
            self._begin()

    async def run(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a function in a thread, and return its result.

        If the task is cancelled, the call is interrupted, and the task ends when the thread has stopped, at the latest
        after `GRACE_S`. A thread that still computes then continues, but sends no more requests.
        """
        call = _ThreadCall(self, partial(function, *args, **kwargs))
        self._add(call)
        answer: asyncio.Future[T] = asyncio.wrap_future(call.future)
        try:
            await asyncio.wait((answer,))
        except asyncio.CancelledError:
            answer.add_done_callback(_ignore)
            call.interrupt()
            call.future.cancel()  # succeeds only if the call has not begun
            await asyncio.wait((answer,), timeout=GRACE_S)
            raise
        try:
            return answer.result()
        except Interrupted:
            raise ConnectionClosed from None

    async def each(self, function: Callable[..., Iterator[T]], /, *args: Any, **kwargs: Any) -> AsyncIterator[T]:
        """Yield what an iterator of the SDK yields. Entries that came in one answer are read in one call."""
        iterator: Iterator[T] | None = None

        def more() -> list[T]:
            nonlocal iterator
            if iterator is None:
                iterator = iter(function(*args, **kwargs))
            return list(_at_hand(iterator))

        while found := await self.run(more):
            for one in found:
                yield one

    async def close(self, last: Callable[[], None]) -> None:
        """Interrupt all calls, which then raise `ConnectionClosed`, wait for their threads, and call `last`."""
        self._begin_again_if_forked()
        with self._lock:
            self._closed = True
            queued, live = tuple(self._queue), tuple(self._live)
            self._queue.clear()
        for call in queued:
            if call.future.set_running_or_notify_cancel():
                call.future.set_exception(ConnectionClosed())
        for call in live:
            call.interrupt()
        await asyncio.to_thread(self._end, last)

    def leave(self, call: _ThreadCall) -> None:
        """Forget a call that has ended, and begin the next one."""
        with self._lock:
            self._live.discard(call)
        self.free_place()

    def free_place(self) -> None:
        """Begin the next call in place of one that has ended or waits."""
        with self._lock:
            self._running -= 1
            following = self._queue.popleft() if self._queue and self._running < self._concurrency else None
            self._running += following is not None
        if following is not None:
            self._threads.submit(following.perform)

    def take_place(self) -> None:
        """Count a call that waits no longer; it continues at once, even if too many calls run."""
        with self._lock:
            self._running += 1

    def _add(self, call: _ThreadCall) -> None:
        self._begin_again_if_forked()
        with self._lock:
            if self._closed:
                raise ConnectionClosed
            self._live.add(call)
            if self._running >= self._concurrency:
                self._queue.append(call)
                return
            self._running += 1
            self._threads.submit(call.perform)  # under the lock: otherwise another thread may close the client before

    def _end(self, last: Callable[[], None]) -> None:
        self._threads.shutdown()
        last()


def _at_hand(iterator: Iterator[T]) -> Iterator[T]:
    """Yield the next entry, and all further entries that need no request."""
    call = current_call()
    assert call is not None
    for one in iterator:
        yield one
        if not call.at_hand:
            return


def _ignore(answer: asyncio.Future[Any]) -> None:
    """Mark the error of a cancelled call as seen."""
    if not answer.cancelled():
        answer.exception()
