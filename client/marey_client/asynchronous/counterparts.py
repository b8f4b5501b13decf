"""Basis of the classes of the async client, each of which is the counterpart of a class of the SDK."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from inspect import isawaitable
from types import TracebackType
from typing import Any, ClassVar, ParamSpec, Self, TypeVar

import httpx

from marey_client.asynchronous.calls import MOST_THREADS, Calls
from marey_client.asynchronous.interruption import current_call, leave_call, stop_if_interrupted
from marey_client.asynchronous.sockets import InterruptibleConnections
from marey_client.credentials import TokenFile
from marey_client.marey import Marey
from marey_client.progress import ignore_progress
from marey_client.retries import Retries

P = ParamSpec("P")
T = TypeVar("T")
CounterpartClass = TypeVar("CounterpartClass", bound="type[Counterpart]")

COUNTERPARTS: dict[type[Any], type[Counterpart]] = {}
"""Class of the async client for each class of the SDK; only classes of loaded modules are in it."""


class Counterpart:
    """Counterpart of an object of the SDK; its methods run the methods of this object in threads."""

    _sync: Any
    _calls: Calls

    # A counterpart has no length and is no container: `len` and `in` cannot wait for an answer.
    __contains__: ClassVar[None] = None
    __iter__: ClassVar[None] = None

    def __init__(self, sync: Any, calls: Calls) -> None:
        self._sync = sync
        self._calls = calls

    @classmethod
    def _of(cls, sync: Any, calls: Calls) -> Counterpart:
        return cls(sync, calls)

    def __repr__(self) -> str:
        return _named_async(repr(self._sync))

    def __str__(self) -> str:
        return _named_async(str(self._sync))

    async def _run(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a method of the SDK in a thread; its arguments and its result are not converted."""
        return await self._calls.run(function, *args, **kwargs)

    async def _exchange(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Run a method of the SDK in a thread; convert its arguments by `_as_sync`, and its result by `_as_async`."""
        given, named = self._given(args, kwargs)
        return self._as_async(await self._calls.run(function, *given, **named))

    def _now(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the SDK that sends no request, without a thread; convert its arguments and its result."""
        given, named = self._given(args, kwargs)
        return self._as_async(function(*given, **named))

    async def _each(self, function: Callable[..., Iterator[Any]], /, *args: Any, **kwargs: Any) -> AsyncIterator[Any]:
        """Yield what a method of the SDK yields, with counterparts in place of objects of the SDK."""
        given, named = self._given(args, kwargs)
        async for one in self._calls.each(function, *given, **named):
            yield self._as_async(one)

    def _given(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[list[Any], dict[str, Any]]:
        return [self._as_sync(one) for one in args], {name: self._as_sync(one) for name, one in kwargs.items()}

    def _as_sync(self, given: Any) -> Any:
        """Return an argument with objects of the SDK in place of counterparts; functions run in the event loop."""
        if isinstance(given, Counterpart):
            return given._sync
        if isinstance(given, (list, tuple)) and any(isinstance(one, Counterpart) for one in given):
            return [self._as_sync(one) for one in given]
        if callable(given) and not isinstance(given, type) and given is not ignore_progress:
            return self._in_loop(given)
        return given

    def _in_loop(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function for threads that calls `function` in this event loop, and waits for its result."""
        loop = asyncio.get_running_loop()

        async def run(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            leave_call()  # the function may start tasks, which go on when the call has ended
            result = function(*map(self._as_async, args), **{name: self._as_async(one) for name, one in kwargs.items()})
            return self._as_sync(await result if isawaitable(result) else result)

        def called(*args: Any, **kwargs: Any) -> Any:
            stop_if_interrupted()
            future = asyncio.run_coroutine_threadsafe(run(args, kwargs), loop)
            call = current_call()
            if call is None:  # a thread that a function of the user started
                return future.result()
            with call.waiting(), call.ending_by(future.cancel):  # the function may use the client
                return future.result()

        return called

    def _as_async(self, found: Any) -> Any:
        """Return a result with counterparts in place of objects of the SDK."""
        counterpart = COUNTERPARTS.get(type(found))
        if counterpart is not None:
            return counterpart._of(found, self._calls)
        return [self._as_async(one) for one in found] if type(found) is list else found


class ModelCounterpart(Counterpart):
    """Counterpart of a pydantic model with methods: it has the fields of the model."""

    @classmethod
    def _of(cls, sync: Any, calls: Calls) -> Counterpart:
        counterpart: Counterpart = cls.model_construct(sync.model_fields_set, **dict(sync))  # pyrefly: ignore[missing-attribute]
        counterpart._sync, counterpart._calls = sync, calls
        return counterpart


class Connection(Counterpart):
    """Basis of `AsyncMarey`: opening, closing, and calls of functions that have no counterpart."""

    _sync: Marey

    def __init__(
        self,
        url: str | None = None,
        token: str | TokenFile | None = None,
        *,
        retries: Retries | None = None,
        timeout_s: float = 60.0,
        concurrency: int = 16,
        http: httpx.BaseTransport | None = None,
    ) -> None:
        calls = Calls(concurrency)
        connections = http or InterruptibleConnections(
            httpx.Limits(max_connections=MOST_THREADS, max_keepalive_connections=concurrency)
        )
        super().__init__(Marey(url, token, retries=retries, timeout_s=timeout_s, http=connections), calls)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close every connection. Calls that have not ended raise `ConnectionClosed`."""
        await self._calls.close(self._sync.close)

    async def call(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Run a function that uses the synchronous SDK in a thread, and return its result.

        Async handles among the arguments are replaced by handles of the SDK, and handles in the result by async
        handles. The requests of the function end if the task is cancelled.
        """
        return await self._exchange(function, *args, **kwargs)


def _named_async(text: str) -> str:
    return f"<async {text[1:]}" if text.startswith("<") else text


def counterpart_of(sync: type[Any]) -> Callable[[CounterpartClass], CounterpartClass]:
    """Register a class as the counterpart of a class of the SDK."""

    def register(counterpart: CounterpartClass) -> CounterpartClass:
        COUNTERPARTS[sync] = counterpart
        return counterpart

    return register
