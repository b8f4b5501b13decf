"""Counterparts of `marey_client.imports` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from marey_client.asynchronous.blobs import AsyncBlobs
from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.asynchronous.jobs import AsyncJobs
from marey_client.imports import FoundFiles, Imports, LocalFile
from marey_schemas.imports import ImportEntry, ImportFile
from marey_schemas.options.imports import ImportOptions

AsyncNotice = Callable[[str, int, int], Awaitable[None] | None]


@counterpart_of(Imports)
class AsyncImports(Counterpart):
    """Imports of motion files into a project: search, upload, import, and restoring of exported clips."""

    _sync: Imports

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def blobs(self) -> AsyncBlobs:
        exchanged: AsyncBlobs = self._as_async(self._sync.blobs)
        return exchanged

    @property
    def jobs(self) -> AsyncJobs:
        exchanged: AsyncJobs = self._as_async(self._sync.jobs)
        return exchanged

    async def upload(
        self, files: Sequence[LocalFile], options: ImportOptions | None = None, *, notice: AsyncNotice | None = None
    ) -> list[ImportEntry]:
        """Import files; return one entry for each file, in order. A refused file does not affect the other files."""
        exchanged: list[ImportEntry] = await self._exchange(self._sync.upload, files, options, notice=notice)
        return exchanged

    async def restore(
        self, found: FoundFiles, entries: Sequence[ImportEntry], *, notice: AsyncNotice | None = None
    ) -> int:
        """Give imported clips the take records and tags that they had when they were exported.

        `entries` are the results of the import of `found`. A value that a clip has already is kept. Return the number
        of clips that were changed.
        """
        exchanged: int = await self._exchange(self._sync.restore, found, entries, notice=notice)
        return exchanged

    async def run(self, files: tuple[ImportFile, ...], options: ImportOptions | None = None) -> tuple[ImportEntry, ...]:
        """Import up to 1000 files whose bytes the server has; if the server imports them in a job, wait for the job."""
        return await self._run(self._sync.run, files, options)

    async def send(self, files: Sequence[LocalFile], *, notice: AsyncNotice | None = None) -> tuple[ImportFile, ...]:
        """Upload the bytes that the server does not have; return the files as an import request names them.

        Raises `BadFileName` if a name cannot be sent.
        """
        exchanged: tuple[ImportFile, ...] = await self._exchange(self._sync.send, files, notice=notice)
        return exchanged
