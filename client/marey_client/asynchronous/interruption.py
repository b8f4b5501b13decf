"""Interruption of calls: the async client runs each call of the SDK in a thread, and interrupts cancelled calls.

Calls of synchronous programs are never interrupted: outside of the async client, there is no current call.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar, copy_context
from threading import Event, Lock
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Interrupted(BaseException):
    """The call was interrupted. It is no `Exception`, so that code that handles errors does not continue the call."""


class RunningCall:
    """One call of the SDK in a thread; any thread may interrupt it."""

    def __init__(self) -> None:
        self.at_hand = 0
        """Number of entries of a list that the call can return without another request."""
        self._interrupted = Event()
        self._lock = Lock()
        self._endings: list[Callable[[], object]] = []
        self._waits = 0

    @property
    def interrupted(self) -> bool:
        """Whether the call was interrupted."""
        return self._interrupted.is_set()

    def interrupt(self) -> None:
        """End what the call waits for at present. From now on, the call sends no request."""
        with self._lock:
            self._interrupted.set()
            # Under the lock: a connection that has been given back may already serve another call.
            for end in self._endings:
                end()

    @contextmanager
    def ending_by(self, end: Callable[[], object]) -> Iterator[None]:
        """Call `end` if the call is interrupted during the `with` block; raise `Interrupted` after the block.

        Raises `Interrupted` before the block if the call was interrupted earlier.
        """
        with self._lock:
            self.stop_if_interrupted()
            self._endings.append(end)
        try:
            yield
        finally:
            with self._lock:
                self._endings.remove(end)
            self.stop_if_interrupted()

    def stop_if_interrupted(self) -> None:
        """Raise `Interrupted` if the call was interrupted."""
        if self.interrupted:
            raise Interrupted

    def pause(self, seconds: float) -> None:
        """Wait. Raises `Interrupted` as soon as the call is interrupted."""
        self._interrupted.wait(seconds)
        self.stop_if_interrupted()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Mark the call as waiting during the `with` block; several of its threads may do this together."""
        with self._lock:
            self._waits += 1
            begins = self._waits == 1
        if begins:
            self.wait_begins()
        try:
            yield
        finally:
            with self._lock:
                self._waits -= 1
                ends = self._waits == 0
            if ends:
                self.wait_ends()

    def wait_begins(self) -> None:
        """Do something when the call begins to wait; subclasses define it."""

    def wait_ends(self) -> None:
        """Do something when the call waits no longer; subclasses define it."""


_current: ContextVar[RunningCall | None] = ContextVar("marey_call", default=None)


def current_call() -> RunningCall | None:
    """Return the call that runs in this thread; None in a synchronous program."""
    return _current.get()


def run_as(call: RunningCall, function: Callable[[], T]) -> T:
    """Run a function as part of a call."""
    token = _current.set(call)
    try:
        return function()
    finally:
        _current.reset(token)


def leave_call() -> None:
    """Separate this context from its call, so that nothing interrupts the code that runs in it from now on."""
    _current.set(None)


class CallPool(ThreadPoolExecutor):
    """Threads for one call: each function belongs to the call, and to the trace, of the thread that submits it."""

    def submit(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run a function in a thread; if the call is interrupted before, the future raises `Interrupted`."""
        context = copy_context()

        def run() -> T:
            context.run(stop_if_interrupted)
            return context.run(function, *args, **kwargs)

        return super().submit(run)


def stop_if_interrupted() -> None:
    """Raise `Interrupted` if the call that runs in this thread was interrupted."""
    call = current_call()
    if call is not None:
        call.stop_if_interrupted()


def pause(seconds: float) -> None:
    """Wait. Raises `Interrupted` as soon as the call that runs in this thread is interrupted."""
    call = current_call()
    if call is None:
        time.sleep(seconds)
        return
    with call.waiting():
        call.pause(seconds)


@contextmanager
def waiting() -> Iterator[None]:
    """Mark the call that runs in this thread as waiting during the `with` block, so that other calls can run."""
    call = current_call()
    with nullcontext() if call is None else call.waiting():
        yield


def note_at_hand(entries: int) -> None:
    """Record how many further entries the call that runs in this thread can return without another request."""
    call = current_call()
    if call is not None:
        call.at_hand = entries
