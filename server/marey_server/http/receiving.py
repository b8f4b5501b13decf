"""Reception of request bodies: collected on the event loop, hashed and written in threads."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from marey_schemas.sizes import KIB, MIB
from marey_server.errors import StorageFullProblem
from marey_server.process.services import Services
from marey_server.store.blob_backings import Spool

BATCH_BYTES = MIB
WRITTEN_AT_ONCE_BYTES = 64 * KIB
"""Size up to which the rest of a body is written on the event loop; a longer rest is written in a thread."""


class PauseLimit:
    """Time limit for pauses in a body that a client is sending.

    Parameters
    ----------
    limit_s : longest pause in seconds
    close : called if the client has sent nothing for `limit_s` seconds
    """

    def __init__(self, limit_s: float, close: Callable[[], None]) -> None:
        self._limit_s = limit_s
        self._close = close
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Start the time limit for the next bytes."""
        self._timer = asyncio.get_running_loop().call_later(self._limit_s, self._close)

    def stop(self) -> None:
        """Stop the time limit."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Stop the time limit while the `with` block processes bytes, because the client may have to wait for this."""
        started = self._timer is not None
        self.stop()
        try:
            yield
        finally:
            if started:
                self.start()


class Receiver:
    """Receiver that writes a stream of bytes to a `Spool` in a thread; at most `BATCH_BYTES` wait in memory."""

    def __init__(self, services: Services) -> None:
        self.spool = Spool()
        self._services = services
        self._pending = bytearray()

    async def write(self, data: bytes) -> None:
        """Add the next bytes of the body; wait first if a batch is being written."""
        self._pending += data
        if len(self._pending) >= BATCH_BYTES:
            await self._flush()

    async def finish(self) -> Spool:
        """Return the received body with its digest, as a `Spool` that the caller must close."""
        if len(self._pending) <= WRITTEN_AT_ONCE_BYTES:
            self._write(bytes(self._pending))
            self._pending.clear()
        else:
            await self._flush()
        return self.spool

    async def _flush(self) -> None:
        batch, self._pending = bytes(self._pending), bytearray()
        await asyncio.wrap_future(self._services.compute_threads.submit(self._write, batch))

    def _write(self, batch: bytes) -> None:
        try:
            self.spool.write(batch)
        except OSError as error:
            raise StorageFullProblem(
                f"The server cannot store the request body on its disk: {error.strerror}."
            ) from error
