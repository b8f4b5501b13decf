"""Reception of request bodies: collected on the event loop, hashed and written in threads."""

from __future__ import annotations

import asyncio

from marey_schemas.sizes import KIB, MIB
from marey_server.errors import StorageFullProblem
from marey_server.process.services import Services
from marey_server.store.blobs import Spool

BATCH_BYTES = MIB
WRITTEN_AT_ONCE_BYTES = 64 * KIB
"""Size up to which the rest of a body is written on the event loop; a longer rest is written in a thread."""


class Receiver:
    """Receiver that writes a stream of bytes to a `Spool` in a thread; at most `BATCH_BYTES` wait in memory."""

    def __init__(self, services: Services) -> None:
        self.spool = Spool()
        self._services = services
        self._pending = bytearray()

    async def write(self, data: bytes) -> None:
        """Add the next bytes; waits while a batch is being written."""
        self._pending += data
        if len(self._pending) >= BATCH_BYTES:
            await self._flush()

    async def finish(self) -> Spool:
        """Return the received body with its digest. The caller must close it."""
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
                f"The server has no disk space to receive the request body: {error.strerror}."
            ) from error
