"""Counterparts of `marey_client.handles.pipelines` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.pipelines import PipelineRun
from marey_schemas.queue.jobs import Job, JobOutput

AsyncOnProgress = Callable[[Mapping[str, Job]], Awaitable[None] | None]


@counterpart_of(PipelineRun)
class AsyncPipelineRun(Counterpart):
    """Jobs of a pipeline by the names of its steps, in the states that the last request returned."""

    _sync: PipelineRun

    @property
    def steps(self) -> Mapping[str, Job]:
        """The jobs by the name of their step; each job comes after the jobs on which it depends."""
        return self._sync.steps

    @property
    def ended(self) -> bool:
        """Whether every job has ended."""
        return self._sync.ended

    async def refresh(self) -> dict[str, Job]:
        """Request the states of the jobs; return the jobs by step."""
        return await self._run(self._sync.refresh)

    async def wait(
        self, *, timeout_s: float | None = None, on_progress: AsyncOnProgress | None = None
    ) -> Mapping[str, Job]:
        """Wait until every job has ended; `on_progress` is called with all jobs about once a second.

        Raises `JobUnsuccessful` for the first unsuccessful step; steps that failed only because another step failed
        come last. Raises `WaitedTooLong` after `timeout_s`; the jobs then continue on the server.
        """
        exchanged: Mapping[str, Job] = await self._exchange(
            self._sync.wait, timeout_s=timeout_s, on_progress=on_progress
        )
        return exchanged

    def outputs(self, step: str) -> AsyncIterator[JobOutput]:
        """Return the revisions that the job of a step created."""
        return self._each(self._sync.outputs, step)

    async def cancel(self) -> Mapping[str, Job]:
        """Cancel every job that has not ended, and return all jobs by step.

        The last jobs are cancelled first, so that no job fails because of a missing input.
        """
        return await self._run(self._sync.cancel)
