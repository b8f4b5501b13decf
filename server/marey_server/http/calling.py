"""Base class of handlers: calls the store, and computes in threads and child processes, on behalf of a caller."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from contextlib import asynccontextmanager, suppress
from functools import cached_property, partial
from typing import Any, Concatenate, ParamSpec, TypeVar

from marey_server.access.principal import ANONYMOUS, Principal
from marey_server.errors import ClientGoneProblem, LeaseLostProblem, UnauthenticatedProblem
from marey_server.http.calls import Caller, run_plain
from marey_server.http.declarations import Operation
from marey_server.http.exchange import Exchange, log_fault
from marey_server.http.negotiation import bearer_token
from marey_server.process.children import ChildTask
from marey_server.process.memory import UNKNOWN_CLIENTS, Holding
from marey_server.process.password_lanes import limited_address
from marey_server.store.database.lanes import Client
from marey_server.store.transaction import Transaction

P = ParamSpec("P")
T = TypeVar("T")

_TOKEN_ENDED = (UnauthenticatedProblem, LeaseLostProblem)
"""Errors which show that the token of a request is perhaps not valid any more."""
CLIENT_GONE = "The client closed the connection before the answer was computed."


class CallingExchange(Exchange):
    """HTTP request that uses threads, child processes and memory; each caller gets only a share of these."""

    operation: Operation
    caller: Caller

    def initialize(self) -> None:
        """Set up the state of one request."""
        super().initialize()
        self._in_children: set[ChildTask[Any]] = set()

    @property
    def principal(self) -> Principal | None:
        """The principal of the request; None until the caller is authenticated."""
        caller: Caller | None = getattr(self, "caller", None)  # absent where the request was refused before
        return caller.principal if caller is not None else None

    @property
    def trace_id(self) -> str | None:
        """The id of the trace to which the request belongs; None if the server sends no traces."""
        return None if self.trace is None else self.trace.place(self.principal).shown_trace

    async def look_up(self, function: Callable[Concatenate[Transaction, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run `function(tx, ...)` on behalf of the caller in a read-only transaction and return its result."""
        return await self._read(partial(run_plain, self.caller, lambda tx: function(tx, *args, **kwargs)))

    async def change(self, function: Callable[Concatenate[Transaction, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run `function(tx, ...)` on behalf of the caller, commit, and return its result."""
        return await self._write(partial(run_plain, self.caller, lambda tx: function(tx, *args, **kwargs)))

    async def _read(self, function: Callable[[Transaction], T]) -> T:
        return await asyncio.wrap_future(self._queued(self.services.database.queue_read, function, writes=False))

    async def _write(self, function: Callable[[Transaction], T]) -> T:
        future = self._queued(self.services.database.queue_write, function, writes=True)
        try:
            return await asyncio.wrap_future(future)
        finally:
            self.may_have_written = self.may_have_written or not future.cancelled()

    def _queued(
        self, queue: Callable[..., Future[T]], function: Callable[[Transaction], T], *, writes: bool
    ) -> Future[T]:
        reserved = self.operation.reserved
        if self.trace is None:
            return queue(self.client, ANONYMOUS, function, reserved=reserved)
        system = "sqlite" if self.services.database.is_sqlite else "postgresql"
        call = self.trace.transaction(function, system, writes=writes)
        return call.recorded(queue(self.client, ANONYMOUS, call, reserved=reserved))

    @cached_property
    def holding(self) -> Holding:
        """Memory that is counted for this request: the bytes of its body and of its answer."""
        return Holding(self.services.memory, self.client, reserved=self.operation.reserved)

    @cached_property
    def client(self) -> Client:
        """Client for which this request waits in queues: the owner of its token, or else the client's address.

        The owner of a token counts only if the token is known: accepted before, or issued to an attempt of a job.
        """
        token = None
        with suppress(UnauthenticatedProblem):
            token = bearer_token(self.request.headers.get("Authorization"))
        if token is not None and (key := self.services.client_key(token)) is not None:
            return Client(key, known=not self.services.refusal_brake.is_often_refused(key), is_gone=self.client_gone)
        return Client(limited_address(self.client_address), known=False, is_gone=self.client_gone)

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:  # noqa: ARG002
        """Log an internal error with its traceback; errors that refuse a request (`ApiProblem`) are not logged."""
        log_fault(value, self.request_id, self.request.method or "", self.template(), trace_id=self.trace_id)

    def _write_problem(self, error: BaseException) -> None:
        super()._write_problem(error)
        caller: Caller | None = getattr(self, "caller", None)
        if caller is not None and caller.token is not None and isinstance(error, _TOKEN_ENDED):
            self.services.forget_client(caller.token)

    async def compute(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run `function` in a thread, away from the event loop, and return its result."""
        future = self.services.compute_threads.submit_for(self.client, function, *args, **kwargs)
        return await asyncio.wrap_future(future)

    @asynccontextmanager
    async def using_children(self) -> AsyncIterator[None]:
        """Count this request among those that use child processes, while the `async with` block runs.

        Raises `UnavailableProblem` if too many requests use child processes or wait for one.
        """
        if self.principal is None:  # children are shared among users, not among their tokens
            await self.look_up(_identify)
        guest = self.client.key if self._child_user == UNKNOWN_CLIENTS else ""
        with self.services.children.request(self._child_user, guest):
            yield

    async def compute_in_child(self, function: str, make: Callable[[], bytes], read: Callable[[bytes], T]) -> T:
        """Call `function` (`module:name`) in a child process, and return its result.

        `make()` returns the argument of the function as bytes; `read` converts the returned bytes to the result. If the
        client closes the connection, the child is killed and `ClientGoneProblem` is raised.
        """
        if self.client_gone.value:
            raise ClientGoneProblem(CLIENT_GONE)
        count_stop = self.services.metrics.count_stopped_child
        task = self.services.children.submit(self._child_user, function, make, read, count_stop)
        self._in_children.add(task)
        if self.trace is not None:
            self.trace.record_child(function, task.future)
        try:
            return await asyncio.wrap_future(task.future)
        except asyncio.CancelledError:
            task.abandon()
            if self.client_gone.value:
                raise ClientGoneProblem(CLIENT_GONE) from None
            raise
        finally:
            self._in_children.discard(task)

    async def compute_apart(self, function: str, make: Callable[[], bytes], read: Callable[[bytes], T]) -> T:
        """Call a function in a child process as `compute_in_child` does, and count this request as a user of children.

        `make` runs in a thread. Raises `UnavailableProblem` if too many requests use child processes or wait for one.
        """
        async with self.using_children():
            order = await self.compute(make)
            self.holding.grow(len(order))
            return await self.compute_in_child(function, lambda: order, read)

    @property
    def _child_user(self) -> str:
        """User whose share of child processes this request uses; all callers without a user count as one user."""
        user = self.principal.user_id if self.principal is not None else None
        return user or UNKNOWN_CLIENTS

    def on_connection_close(self) -> None:
        """Stop child processes, because the client has closed the connection."""
        super().on_connection_close()
        for task in list(self._in_children):
            task.abandon()


def _identify(_tx: Transaction) -> None:
    """Do nothing; called only to start a transaction, because every transaction identifies the caller."""
