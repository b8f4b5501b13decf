"""Lanes: groups of threads with a limited queue, in which clients take turns.

A client that sends many requests delays only its own requests: the queue alternates between known and unknown clients,
and between the clients within each group. A client is known if the server has accepted its token before, or if the
token was issued to an attempt of a job. The length of a queue is limited, for each of the two groups and for each
client.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, ParamSpec, TypeVar

from marey_server.errors import ClientGoneProblem, StoppingProblem, UnavailableProblem, forget_origin

P = ParamSpec("P")
T = TypeVar("T")

MOST_WAITING = 512
"""Greatest number of waiting calls of known clients in a line; the same limit applies to unknown clients."""
MOST_WAITING_EACH = 256
"""Greatest number of waiting calls of one client in a line."""
RETRY_AFTER_S = 2


@dataclass(frozen=True, slots=True)
class Client:
    """Owner of a call: a user, worker or attempt whose token is known, or an unknown client's address."""

    key: str
    known: bool = True
    """Whether the client's token was accepted before or issued to an attempt; false for clients often refused."""
    is_gone: Callable[[], bool] = bool
    """Function that returns whether the client has closed the connection.

    If so, queued calls of the client do not begin, and running reads stop before their next statement.
    """

    def require_present(self) -> None:
        """Raise `ClientGoneProblem` if the client has closed the connection."""
        if self.is_gone():
            raise ClientGoneProblem("The client closed the connection before the server could answer.")


SERVER = Client("server")
"""Client for calls that the server makes itself, such as housekeeping."""


def begin(pool: ThreadPoolExecutor, run: Callable[[], None], future: Future[Any]) -> None:
    """Run a function in a thread of the pool; the function must finish `future`, and may finish other futures, too.

    If the pool is stopped, cancels the future and raises `StoppingProblem`, unless another thread already computes the
    future.
    """
    try:
        pool.submit(run)
    except RuntimeError:  # so says a pool whose threads were stopped
        if future.cancel():
            raise StoppingProblem from None


@dataclass(frozen=True, slots=True)
class _QueuedCall:
    """Queued call of a function for a client, and the future of its result."""

    client: Client
    function: Callable[[], Any]
    future: Future[Any]

    def run(self) -> None:
        """Set the future to the result of the function, or to an error if the client has closed the connection.

        Does nothing if the future was cancelled.
        """
        if self.future.set_running_or_notify_cancel():
            finish(self.future, self._call)

    def _call(self) -> Any:
        self.client.require_present()
        return self.function()


def finish(future: Future[Any], function: Callable[[], Any]) -> None:
    """Set a future to the result or the error of a function.

    A future cannot hold a `StopIteration`: the request that waits for the future would never end. So a `RuntimeError`
    replaces this error.
    """
    try:
        result = function()
    except StopIteration as error:
        fault = RuntimeError("a function ended with StopIteration")
        fault.__cause__ = error
        future.set_exception(fault)
    except BaseException as error:  # noqa: BLE001 - for whoever waits
        forget_origin(error)
        future.set_exception(error)
    else:
        future.set_result(result)


class FairLine(Generic[T]):
    """Queue in which clients take turns. It is not thread-safe."""

    def __init__(self, most_waiting: int = MOST_WAITING, most_each: int = MOST_WAITING_EACH) -> None:
        self._most_waiting = most_waiting
        self._most_each = most_each
        self._groups: dict[bool, OrderedDict[str, deque[tuple[Client, T]]]] = {
            True: OrderedDict(), False: OrderedDict()
        }  # fmt: skip
        self._lengths: Counter[bool] = Counter()
        self._next_group = True

    def __len__(self) -> int:
        return self._lengths.total()

    def put(self, client: Client, one: T) -> None:
        """Add an element to the queue of a client. Raises `UnavailableProblem` if the queue is full."""
        own = self._groups[client.known].get(client.key, ())
        if self._lengths[client.known] >= self._most_waiting or len(own) >= self._most_each:
            raise UnavailableProblem(
                f"{len(self)} requests are already waiting for the database, {len(own)} of them yours; try "
                "again in a few seconds.",
                code="busy",
                headers={"Retry-After": str(RETRY_AFTER_S)},
            )
        self._groups[client.known].setdefault(client.key, deque()).append((client, one))
        self._lengths[client.known] += 1

    def take(self, may_run: Callable[[Client], bool] = lambda _client: True) -> T | None:
        """Remove and return the next element of a client for whom `may_run` is true; None without such a client."""
        for group in (self._next_group, not self._next_group):
            for key, line in self._groups[group].items():
                client, one = line[0]
                if may_run(client):
                    line.popleft()
                    self._lengths[group] -= 1
                    del self._groups[group][key]
                    if line:
                        self._groups[group][key] = line  # at the end: it is the turn of the others
                    self._next_group = not group
                    return one
        return None


class Lane:
    """Threads that run the calls of a `FairLine`.

    `most_each` limits how many calls run at the same time for one client, and for all unknown clients together. Calls
    of the server itself are not limited.
    """

    def __init__(self, name: str, threads: int, *, most_each: int | None = None) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix=name)
        self._most_each = most_each or threads
        self._idle = threads
        self._line: FairLine[_QueuedCall] = FairLine()
        self._running: Counter[str] = Counter()
        self._running_unknown = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._line)

    def submit(self, client: Client, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Queue a call for a client, and return the future of its result.

        Raises `UnavailableProblem` if the queue is full, and `StoppingProblem` if the lane is closed.
        """
        future: Future[T] = Future()
        with self._lock:
            self._line.put(client, _QueuedCall(client, partial(function, *args, **kwargs), future))
            start = self._idle > 0
            self._idle -= start
        if start:
            begin(self._pool, self._run_waiting, future)
        return future

    def close(self, *, wait: bool = True) -> None:
        """Accept no further calls. With `wait`, finish the queued calls first; otherwise they fail.

        The error of the calls that fail is `StoppingProblem`.
        """
        dropped: list[_QueuedCall] = []
        if not wait:
            with self._lock:
                while (call := self._line.take()) is not None:
                    dropped.append(call)
        self._pool.shutdown(wait=wait, cancel_futures=not wait)
        for call in dropped:  # not cancelled: whoever waits could not distinguish this from its own cancellation
            if call.future.set_running_or_notify_cancel():
                call.future.set_exception(StoppingProblem())

    def _run_waiting(self) -> None:
        call = self._begin_next()
        while call is not None:
            call.run()
            call = self._begin_next(ended=call.client)

    def _begin_next(self, ended: Client | None = None) -> _QueuedCall | None:
        with self._lock:
            if ended is not None:
                self._running[ended.key] -= 1
                if not self._running[ended.key]:
                    del self._running[ended.key]
                self._running_unknown -= not ended.known
            call = self._line.take(self._may_run)
            if call is None:
                self._idle += 1
                return None
            self._running[call.client.key] += 1
            self._running_unknown += not call.client.known
            return call

    def _may_run(self, client: Client) -> bool:
        if client.key == SERVER.key:
            return True
        if not client.known and self._running_unknown >= self._most_each:
            return False
        return self._running[client.key] < self._most_each
