"""Model in memory of the queue of jobs; property tests compare the real queue with this model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

SECOND_US = 1_000_000
TTL_US = 60 * SECOND_US
GRACE_US = 30 * SECOND_US
TERMINAL = ("succeeded", "failed", "cancelled")


@dataclass
class ModelJob:
    """Expected state of one job."""

    id: str
    priority: int
    run_at_us: int
    max_attempts: int
    key: str | None
    time_limit_us: int
    on_failure: str
    after: frozenset[str]
    state: str = "queued"
    fence: int = 0
    attempt: int = 0
    interruptions: int = 0
    unstarted: int = 0
    started: bool = False
    """Whether the attempt that holds the job has written anything."""
    lease_expires_us: int = 0
    deadline_us: int = 0
    cancel_requested: bool = False
    signatures: set[str] = field(default_factory=set)
    answers: dict[tuple[int, str], str] = field(default_factory=dict)
    """Answers to the requests `complete` and `fail` (the new state of the job), by fence and write id."""


@dataclass
class ModelQueue:
    """All jobs of the model, and the operations on jobs. Callers pass the present time."""

    jobs: dict[str, ModelJob] = field(default_factory=dict)

    def submit(self, job: ModelJob) -> None:
        """Add a job; its state depends on the states of its dependencies."""
        self.jobs[job.id] = job
        upstream = [self.jobs[other].state for other in job.after]
        if any(state in ("failed", "cancelled") for state in upstream):
            self._end(job, "cancelled" if job.on_failure == "skip" else "failed")
        elif any(state != "succeeded" for state in upstream):
            job.state = "waiting"

    def claim(self, now_us: int, most: int) -> list[str]:
        """Return the ids of the jobs that a claim gets, in the order in which it gets them."""
        taken: list[str] = []
        busy = {job.key for job in self.jobs.values() if job.state == "running" and job.key is not None}
        queued = [job for job in self.jobs.values() if job.state == "queued" and job.run_at_us <= now_us]
        for job in sorted(queued, key=lambda job: (-job.priority, job.run_at_us, job.id)):
            if len(taken) == most or (job.key is not None and job.key in busy):
                continue
            busy.add(job.key) if job.key is not None else None
            job.state = "running"
            job.fence += 1
            job.started = False
            job.deadline_us = now_us + job.time_limit_us
            job.lease_expires_us = min(now_us + TTL_US, job.deadline_us + GRACE_US)
            taken.append(job.id)
        return taken

    def holds(self, job_id: str, fence: int) -> bool:
        """Return whether an attempt holds its job."""
        job = self.jobs[job_id]
        return job.state == "running" and job.fence == fence

    def renew(self, job_id: str, now_us: int) -> None:
        """Extend a lease that is held, as a repeated claim does.

        The time since the end of an expired lease does not count towards the time limit: the clock may have jumped.
        """
        job = self.jobs[job_id]
        if job.lease_expires_us < now_us and not job.cancel_requested:
            job.deadline_us += now_us - job.lease_expires_us
        job.lease_expires_us = min(now_us + TTL_US, job.deadline_us + GRACE_US)

    def write(self, job_id: str) -> None:
        """Count the attempt that holds a running job towards the limit of attempts, if this is its first write."""
        job = self.jobs[job_id]
        job.attempt += not job.started
        job.started = True

    def heartbeat(self, job_id: str, now_us: int) -> None:
        """Extend the lease of a running job."""
        self.write(job_id)
        self.renew(job_id, now_us)

    def complete(self, job_id: str, fence: int, write_id: str) -> str:
        """Complete a job that an attempt holds; return the new state, `succeeded` or `cancelled`."""
        job = self.jobs[job_id]
        state = "cancelled" if job.cancel_requested else "succeeded"
        if not job.cancel_requested:
            self.write(job_id)
        job.answers[fence, write_id] = state
        self._end(job, state)
        return state

    def fail(
        self,
        job_id: str,
        fence: int,
        write_id: str,
        now_us: int,
        *,
        retryable: bool,
        interrupted: bool,
        signature: str | None,
    ) -> None:
        """End the attempt that holds a job, without success."""
        self.write(job_id)
        job = self.jobs[job_id]
        state = self._after_failure(job, now_us, retryable, interrupted, signature)
        if signature is not None:
            job.signatures.add(signature)
        job.answers[fence, write_id] = state
        self._end(job, state) if state != "queued" else None

    def _after_failure(
        self, job: ModelJob, now_us: int, retryable: bool, interrupted: bool, signature: str | None
    ) -> str:
        if job.cancel_requested:
            return "cancelled"
        if interrupted:
            if job.interruptions >= 20:
                return "failed"
            job.interruptions += 1
            job.attempt -= 1
            return self._queue(job, now_us)
        if signature in job.signatures or not retryable or job.attempt >= job.max_attempts:
            return "failed"
        return self._queue(job, now_us + min(900, 10 * 4 ** (job.attempt - 1)) * SECOND_US)

    def _queue(self, job: ModelJob, run_at_us: int) -> str:
        job.state = "queued"
        job.run_at_us = run_at_us
        return "queued"

    def reap(self, now_us: int) -> None:
        """Return jobs with expired leases to the queue, or end them."""
        for job in list(self.jobs.values()):
            if job.state != "running" or job.lease_expires_us > now_us:
                continue
            job.fence += 1
            if job.cancel_requested:
                self._end(job, "cancelled")
            elif not job.started and job.unstarted < 10:
                job.unstarted += 1
                self._queue(job, now_us)
            elif (
                not job.started or job.lease_expires_us >= job.deadline_us + GRACE_US or job.attempt >= job.max_attempts
            ):
                self._end(job, "failed")
            else:
                self._queue(job, now_us)

    @staticmethod
    def _is_over(job: ModelJob) -> bool:
        return job.lease_expires_us >= job.deadline_us + GRACE_US or job.attempt >= job.max_attempts

    def cancel(self, job_id: str, now_us: int) -> None:
        """Cancel a job that has not ended."""
        job = self.jobs[job_id]
        if job.state == "running":
            job.cancel_requested = True
            job.deadline_us = min(job.deadline_us, now_us)
            job.lease_expires_us = min(job.lease_expires_us, now_us + GRACE_US)
        elif job.state not in TERMINAL:
            self._end(job, "cancelled")

    def _end(self, job: ModelJob, state: str) -> None:
        job.state = state
        for other in self._dependants(job.id):
            if state != "succeeded":
                self._end(other, "cancelled" if other.on_failure == "skip" else "failed")
            elif all(self.jobs[one].state == "succeeded" for one in other.after):
                other.state = "queued"

    def _dependants(self, job_id: str) -> Sequence[ModelJob]:
        return [job for job in self.jobs.values() if job_id in job.after and job.state == "waiting"]

    def states(self) -> dict[str, tuple[str, int, int, int, int]]:
        """Return state, fence, attempts, interruptions and unstarted claims of every job."""
        return {
            job.id: (job.state, job.fence, job.attempt, job.interruptions, job.unstarted) for job in self.jobs.values()
        }

    def ids(self) -> Iterable[str]:
        """Return the ids of all jobs."""
        return self.jobs
