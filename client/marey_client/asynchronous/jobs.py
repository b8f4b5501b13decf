"""Counterparts of `marey_client.jobs` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.jobs import Jobs
from marey_client.transport import Params
from marey_schemas.queue.jobs import Attempt, Job, JobCreate, JobKind, JobOutput

AsyncOnProgress = Callable[[Job], Awaitable[None] | None]


@counterpart_of(Jobs)
class AsyncJobs(Counterpart):
    """Jobs of a server, which are named by their ids; methods submit, read, await and cancel them."""

    _sync: Jobs

    def kinds(self) -> AsyncIterator[JobKind]:
        """List the kinds of jobs, with their inputs and parameters."""
        return self._each(self._sync.kinds)

    async def submit(self, project: str, job: JobCreate) -> Job:
        """Submit a job to a project; return the job in its present state, without waiting for it."""
        return await self._run(self._sync.submit, project, job)

    async def run(self, project: str, job: JobCreate, *, on_progress: AsyncOnProgress | None = None) -> Job:
        """Submit a job and wait until it has ended. Raises `JobUnsuccessful` if the job failed or was cancelled."""
        exchanged: Job = await self._exchange(self._sync.run, project, job, on_progress=on_progress)
        return exchanged

    def list(self, project: str, *, limit: int = 100, filters: Params | None = None) -> AsyncIterator[Job]:
        """List the jobs of a project, newest first."""
        return self._each(self._sync.list, project, limit=limit, filters=filters)

    async def get(self, job_id: str, *, wait_s: float = 0.0) -> Job:
        """Wait up to `wait_s` seconds for the end of a job, and return its current state."""
        return await self._run(self._sync.get, job_id, wait_s=wait_s)

    async def wait(
        self,
        job_id: str,
        *,
        timeout_s: float | None = None,
        on_progress: AsyncOnProgress | None = None,
        require_success: bool = True,
    ) -> Job:
        """Wait until a job has ended; `on_progress` is called with the job about once a second.

        Raises `JobUnsuccessful` if the job failed or was cancelled, unless `require_success` is false, and
        `WaitedTooLong` after `timeout_s`.
        """
        exchanged: Job = await self._exchange(
            self._sync.wait, job_id, timeout_s=timeout_s, on_progress=on_progress, require_success=require_success
        )
        return exchanged

    async def cancel(self, job_id: str) -> Job:
        """Ask a job to stop; a job that does not run yet is cancelled at once."""
        return await self._run(self._sync.cancel, job_id)

    async def retry(self, job_id: str, *, dependants: bool = True) -> Job:
        """Submit a failed or cancelled job again; return the new job.

        Unsuccessful jobs on which it depends are retried, too. With `dependants`, so are jobs that ended only because
        this job did not succeed.
        """
        return await self._run(self._sync.retry, job_id, dependants=dependants)

    def attempts(self, job_id: str) -> AsyncIterator[Attempt]:
        """List the attempts to run a job, oldest first."""
        return self._each(self._sync.attempts, job_id)

    def outputs(self, job_id: str) -> AsyncIterator[JobOutput]:
        """List the revisions that a job created."""
        return self._each(self._sync.outputs, job_id)

    def log(self, job_id: str, *, follow: bool = False) -> AsyncIterator[bytes]:
        """Yield the log of the job's attempts, piece by piece; with `follow`, continue until the job has ended."""
        return self._each(self._sync.log, job_id, follow=follow)
