"""Counterparts of `marey_client.handles.jobs` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

from marey_client.asynchronous.counterparts import ModelCounterpart, counterpart_of
from marey_client.asynchronous.jobs import AsyncOnProgress
from marey_client.handles.jobs import JobHandle
from marey_schemas.queue.jobs import Job


@counterpart_of(JobHandle)
class AsyncJobHandle(ModelCounterpart, Job):
    """Job in the state in which it was read; its methods send requests."""

    _sync: JobHandle

    async def refresh(self) -> AsyncJobHandle:
        """Read the job again; return a handle of its present state."""
        exchanged: AsyncJobHandle = await self._exchange(self._sync.refresh)
        return exchanged

    async def wait(
        self,
        *,
        timeout_s: float | None = None,
        shown: bool | None = None,
        on_progress: AsyncOnProgress | None = None,
        require_success: bool = True,
    ) -> AsyncJobHandle:
        """Wait until the job has ended; return a handle of its final state.

        A progress bar is shown on terminals and in notebooks; `shown` overrides this. Interrupting the wait does not
        stop the job. Raises the errors of `Jobs.wait`.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.wait, timeout_s=timeout_s, shown=shown, on_progress=on_progress, require_success=require_success
        )
        return exchanged

    def outputs(self) -> AsyncIterator[Any]:
        """Yield handles of the items that the job created, such as `ClipHandle`, at their newest revisions.

        Items that have been purged are left out.
        """
        return self._each(self._sync.outputs)

    def log(self, *, follow: bool = False) -> AsyncIterator[bytes]:
        """Yield the log of the job's attempts, piece by piece; with `follow`, continue until the job has ended."""
        return self._each(self._sync.log, follow=follow)

    async def cancel(self) -> AsyncJobHandle:
        """Ask the job to stop; a job that does not run yet is cancelled at once."""
        exchanged: AsyncJobHandle = await self._exchange(self._sync.cancel)
        return exchanged
