"""Pipelines: several jobs, submitted and followed together, that read each other's outputs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from types import MappingProxyType

from marey_client.arguments import checks_arguments
from marey_client.asynchronous.interruption import pause
from marey_client.errors import Conflict, JobUnsuccessful, WaitedTooLong
from marey_client.jobs import LONGEST_WAIT_S, Jobs
from marey_client.transport import Transport
from marey_schemas.queue.jobs import FailureReason, Job, JobOutput, JobState
from marey_schemas.queue.pipelines import Pipeline, PipelineCreate

OnProgress = Callable[[Mapping[str, Job]], None]

LOOK_EVERY_S = 1.0
SHORTEST_PAUSE_S = 0.2
"""Shortest time in seconds from one request for the state of the jobs to the next."""


@checks_arguments
class PipelineRun:
    """Jobs of a pipeline by the names of its steps, in the states that the last request returned."""

    def __init__(self, transport: Transport, jobs: Mapping[str, Job]) -> None:
        self._jobs = Jobs(transport)
        self._steps = dict(jobs)

    def __repr__(self) -> str:
        return f"<pipeline {', '.join(f'{name} {job.state}' for name, job in self._steps.items())}>"

    @property
    def steps(self) -> Mapping[str, Job]:
        """The jobs by the name of their step; each job comes after the jobs on which it depends."""
        return MappingProxyType(self._steps)

    @property
    def ended(self) -> bool:
        """Whether every job has ended."""
        return all(job.state.terminal for job in self._steps.values())

    def refresh(self) -> dict[str, Job]:
        """Request the states of the jobs; return the jobs by step."""
        return dict(self._look(wait_s=0.0))

    def wait(self, *, timeout_s: float | None = None, on_progress: OnProgress | None = None) -> Mapping[str, Job]:
        """Wait until every job has ended; `on_progress` is called with all jobs about once a second.

        Raises `JobUnsuccessful` for the first unsuccessful step; steps that failed only because another step failed
        come last. Raises `WaitedTooLong` after `timeout_s`; the jobs then continue on the server.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            if on_progress is not None:
                on_progress(self.steps)
            if self.ended:
                return self._successful()
            left_s = LONGEST_WAIT_S if deadline is None else deadline - time.monotonic()
            if left_s <= 0:
                unfinished = ", ".join(name for name, job in self._steps.items() if not job.state.terminal)
                raise WaitedTooLong(
                    f"after {timeout_s:g} s these steps have not ended: {unfinished}; they continue on the server"
                )
            asked = time.monotonic()
            self._look(wait_s=min(left_s, LOOK_EVERY_S if on_progress else LONGEST_WAIT_S))
            if not self.ended:
                pause(max(0.0, min(left_s, asked + SHORTEST_PAUSE_S - time.monotonic())))

    def outputs(self, step: str) -> Iterator[JobOutput]:
        """Return the revisions that the job of a step created."""
        return self._jobs.outputs(self._steps[step].id)

    def cancel(self) -> Mapping[str, Job]:
        """Cancel every job that has not ended, and return all jobs by step.

        The last jobs are cancelled first, so that no job fails because of a missing input.
        """
        for job in reversed(self.refresh().values()):
            if not job.state.terminal:
                with suppress(Conflict):  # it has ended since
                    self._jobs.cancel(job.id)
        return self.refresh()

    def _look(self, wait_s: float) -> Mapping[str, Job]:
        """Request the state of each unfinished job; return all jobs by the names of their steps.

        The request for the first unfinished job waits up to `wait_s` seconds for the end of this job.
        """
        for name, known in self._steps.items():
            if not known.state.terminal:
                self._steps[name] = self._jobs.get(known.id, wait_s=wait_s)
                wait_s = 0.0
        return self.steps

    def _successful(self) -> Mapping[str, Job]:
        missed = {name: job for name, job in self._steps.items() if job.state is not JobState.SUCCEEDED}
        if not missed:
            return self.steps
        guilty = {name: job for name, job in missed.items() if not _only_followed(job)}
        name, job = next(iter((guilty or missed).items()))
        if job.failure is None:
            raise JobUnsuccessful(f"step {name} ({job.id}) was cancelled", job)
        raise JobUnsuccessful(f"step {name} ({job.id}) failed ({job.failure.code}): {job.failure.detail}", job)


def _only_followed(job: Job) -> bool:
    """Return whether a job failed only because a job on which it depends failed."""
    return job.failure is not None and job.failure.reason is FailureReason.DEPENDENCY_FAILED


def submit_pipeline(transport: Transport, project: str, pipeline: PipelineCreate) -> PipelineRun:
    """Submit a pipeline: all of its jobs, or none."""
    answer = transport.post(Pipeline, f"/projects/{project}/pipelines", pipeline)
    return PipelineRun(transport, answer.jobs)
