"""Repeated calls of functions that need bytes moved to or from object storage.

If a function needs such a move, its run ends with an error, the bytes are moved, and the function runs again.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, Generic, TypeVar

from marey_server.errors import StoppingProblem, UnavailableProblem
from marey_server.store.blob_backings import BlobBacking
from marey_server.store.database.lanes import Client, Lane
from marey_server.store.object_storage.awaiting import BytesAwaited, Carried
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.transaction import Transaction

T = TypeVar("T")
U = TypeVar("U")


def run_and_move(
    blobs: BlobBacking | ObjectBlobs,
    run: Callable[[Callable[[Transaction], T]], T],
    function: Callable[[Transaction], T],
) -> T:
    """Return the result of `run(function)`; if the function needs bytes moved, move them and repeat the call.

    The bytes are moved to or from object storage in the calling thread.
    """
    if not isinstance(blobs, ObjectBlobs):
        return run(function)
    carried = Carried()
    while True:
        try:
            return run(partial(_run_with, blobs, carried, function))
        except BytesAwaited as awaited:
            move = awaited.move
        move(carried)


def _run_with(blobs: ObjectBlobs, carried: Carried, function: Callable[[Transaction], T], tx: Transaction) -> T:
    tx.blobs = blobs.within(carried, lambda: tx.now_us)
    return function(tx)


class MovingCall(Generic[T]):
    """Queued call of a function; if the function needs bytes moved, they are moved and the function is queued again.

    `submit` queues the function in its lane. Another lane, `moving`, moves the bytes, so that transactions do not wait
    for a slow object storage.
    """

    def __init__(
        self,
        blobs: ObjectBlobs,
        moving: Lane,
        client: Client,
        function: Callable[[Transaction], T],
        submit: Callable[[Callable[[Transaction], T]], Future[T]],
    ) -> None:
        self._moving = moving
        self._client = client
        self._carried = Carried()
        self._run: Callable[[Transaction], T] = partial(_run_with, blobs, self._carried, function)
        self._submit = submit
        self._result: Future[T] = Future()

    def begin(self) -> Future[T]:
        """Queue the function, and return the future of its result. Raises `UnavailableProblem` if the queue is full."""
        running = self._submit(self._run)
        self._result.set_running_or_notify_cancel()
        running.add_done_callback(self._ended)
        return self._result

    def _ended(self, running: Future[T]) -> None:
        """Set the future to the result or error of the function; if the function needs bytes moved, move them."""
        error = _error_of(running)
        if error is None:
            self._result.set_result(running.result())
        elif isinstance(error, BytesAwaited):
            self._then(partial(self._moving.submit, self._client, error.move, self._carried), self._moved)
        else:
            self._result.set_exception(error)

    def _moved(self, moving: Future[None]) -> None:
        """Queue the function again after its bytes were moved; if the move failed, set the future to the error."""
        if (error := _error_of(moving)) is None:
            self._then(partial(self._submit, self._run), self._ended)
        else:
            self._result.set_exception(error)

    def _then(self, submit: Callable[[], Future[U]], go_on: Callable[[Future[U]], None]) -> None:
        try:
            submitted = submit()
        except UnavailableProblem as error:  # the queue is full, or the server is stopping
            self._result.set_exception(error)
        else:
            submitted.add_done_callback(go_on)


def _error_of(ended: Future[Any]) -> BaseException | None:
    return StoppingProblem() if ended.cancelled() else ended.exception()
