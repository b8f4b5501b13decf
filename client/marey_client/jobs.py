"""Jobs of a server: submission, waiting, cancellation, repetition, and logs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from marey_client.arguments import checks_arguments
from marey_client.asynchronous.interruption import pause, waiting
from marey_client.errors import BadArgument, JobUnsuccessful, WaitedTooLong
from marey_client.paging import pages
from marey_client.transport import Params, Transport
from marey_schemas.base import Request
from marey_schemas.queue.jobs import Attempt, Job, JobCreate, JobInput, JobKind, JobOutput, JobState

OnProgress = Callable[[Job], None]

LONGEST_WAIT_S = 20.0
"""Longest time in seconds that one request waits for the end of a job."""

SHORTEST_PAUSE_S = 0.05
FOLLOW_EVERY_S = 0.5


def job_request(kind: str, inputs: Mapping[str, JobInput | Sequence[JobInput]], params: Request) -> JobCreate:
    """Return the request for a job; parameters that are not given get the server's defaults."""
    given = {name: tuple(one) if isinstance(one, Sequence) else one for name, one in inputs.items()}
    return JobCreate(kind=kind, inputs=given, params=params.model_dump(mode="json", exclude_unset=True))


@checks_arguments
@dataclass(frozen=True)
class Jobs:
    """Jobs of a server, which are named by their ids; methods submit, read, await and cancel them."""

    transport: Transport

    def kinds(self) -> Iterator[JobKind]:
        """List the kinds of jobs, with their inputs and parameters."""
        return pages(self.transport, JobKind, "/job-kinds")

    def submit(self, project: str, job: JobCreate) -> Job:
        """Submit a job to a project; return the job in its present state, without waiting for it."""
        return self.transport.post(Job, f"/projects/{project}/jobs", job)

    def run(self, project: str, job: JobCreate, *, on_progress: OnProgress | None = None) -> Job:
        """Submit a job and wait until it has ended. Raises `JobUnsuccessful` if the job failed or was cancelled."""
        return self.wait(self.submit(project, job).id, on_progress=on_progress)

    def list(self, project: str, *, limit: int = 100, filters: Params | None = None) -> Iterator[Job]:
        """List the jobs of a project, newest first."""
        params = {"limit": limit, **(filters or {})}
        return pages(self.transport, Job, f"/projects/{project}/jobs", params)

    def get(self, job_id: str, *, wait_s: float = 0.0) -> Job:
        """Wait up to `wait_s` seconds for the end of a job, and return its current state."""
        if wait_s <= 0:
            return self.transport.get(Job, _address(job_id))
        preferred = {"Prefer": f"wait={max(1, round(min(wait_s, LONGEST_WAIT_S)))}"}
        with waiting():
            return self.transport.get(Job, _address(job_id), headers=preferred)

    def wait(
        self,
        job_id: str,
        *,
        timeout_s: float | None = None,
        on_progress: OnProgress | None = None,
        require_success: bool = True,
    ) -> Job:
        """Wait until a job has ended; `on_progress` is called with the job about once a second.

        Raises `JobUnsuccessful` if the job failed or was cancelled, unless `require_success` is false, and
        `WaitedTooLong` after `timeout_s`.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        pause_s = SHORTEST_PAUSE_S
        while True:
            asked = time.monotonic()
            left_s = LONGEST_WAIT_S if deadline is None else deadline - asked
            job = self.get(job_id, wait_s=min(left_s, 1.0 if on_progress else LONGEST_WAIT_S))
            if on_progress is not None:
                on_progress(job)
            if job.state.terminal:
                return self._ended(job, require_success)
            if deadline is not None and time.monotonic() >= deadline:
                raise WaitedTooLong(
                    f"job {job_id} is still {job.state} after {timeout_s:g} s; it continues on the server"
                )
            if time.monotonic() - asked < pause_s:  # the server answered at once
                pause(pause_s)
                pause_s = min(2 * pause_s, 1.0)

    def cancel(self, job_id: str) -> Job:
        """Ask a job to stop; a job that does not run yet is cancelled at once."""
        return self.transport.post(Job, f"{_address(job_id)}/cancel")

    def retry(self, job_id: str, *, dependants: bool = True) -> Job:
        """Submit a failed or cancelled job again; return the new job.

        Unsuccessful jobs on which it depends are retried, too. With `dependants`, so are jobs that ended only because
        this job did not succeed.
        """
        return self.transport.post(
            Job, f"{_address(job_id)}/retry", params={"dependants": None if dependants else False}
        )

    def attempts(self, job_id: str) -> Iterator[Attempt]:
        """List the attempts to run a job, oldest first."""
        return pages(self.transport, Attempt, f"{_address(job_id)}/attempts")

    def outputs(self, job_id: str) -> Iterator[JobOutput]:
        """List the revisions that a job created."""
        return pages(self.transport, JobOutput, f"{_address(job_id)}/outputs")

    def log(self, job_id: str, *, follow: bool = False) -> Iterator[bytes]:
        """Yield the log of the job's attempts, piece by piece; with `follow`, continue until the job has ended."""
        offset = 0
        while True:
            response = self.transport.send(
                "GET", f"{_address(job_id)}/log", params={"offset": offset}, headers={"Accept": "text/plain"}
            )
            offset = int(response.headers["Log-Offset"])
            if response.content:
                yield response.content
            elif not follow or response.headers["Log-Sealed"] == "true":
                return
            else:
                pause(FOLLOW_EVERY_S)

    def _ended(self, job: Job, require_success: bool) -> Job:
        if not require_success or job.state is JobState.SUCCEEDED:
            return job
        if job.failure is None:
            raise JobUnsuccessful(f"job {job.id} was cancelled", job)
        raise JobUnsuccessful(f"job {job.id} failed ({job.failure.code}): {job.failure.detail}", job)


def _address(job_id: str) -> str:
    """Return the path of a job. Raises `BadArgument` for a text that cannot be the id of a job, such as a path."""
    if not job_id or "/" in job_id:
        raise BadArgument(f"job: {job_id!r} is not the id of a job; `marey job ls PROJECT` lists the ids")
    return f"/jobs/{job_id}"
