"""Explanations of the state of a job, as sentences for people."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

from marey_client.errors import Forbidden, Unauthenticated
from marey_schemas.access import RunningJobs
from marey_schemas.queue.jobs import Attempt, Job, JobState
from marey_schemas.queue.own_pods import GPUS_LABEL, OWN_POD_LABEL
from marey_schemas.queue.scripts import SCRIPT
from marey_schemas.queue.workers import Worker

if TYPE_CHECKING:
    from marey_client.marey import Marey


def explain_job(marey: Marey, job_id: str) -> list[str]:
    """Explain what a job waits for, which worker runs it, or how it ended; the main reason comes first."""
    job = marey.jobs.get(job_id)
    attempts = list(marey.jobs.attempts(job_id))
    running = list(marey.jobs.list(job.project, filters={"state": JobState.RUNNING.value}))
    workers = _alive_workers(marey) if job.state is JobState.QUEUED else None
    return explain(job, attempts, running, datetime.now(UTC), workers, _limit_of(marey, job))


def _limit_of(marey: Marey, job: Job) -> RunningJobs | None:
    """Return the number of running jobs of the project and its limit; None if unknown, or if the job is not queued."""
    if job.state is not JobState.QUEUED:
        return None
    try:
        return marey.project(job.project).quotas().running_jobs
    except (Forbidden, Unauthenticated):
        return None


def _alive_workers(marey: Marey) -> list[Worker] | None:
    """Return the workers that are alive, or None if the caller may not list workers."""
    try:
        return [worker for worker in marey.workers() if worker.alive]
    except Forbidden:
        return None


def explain(
    job: Job,
    attempts: list[Attempt],
    running: list[Job],
    now: datetime,
    workers: list[Worker] | None = None,
    limit: RunningJobs | None = None,
) -> list[str]:
    """Return sentences that explain the state of a job, the main reason first.

    `running` are the running jobs of the project. `workers` are the workers that are alive, None if unknown. `limit` is
    the number of running jobs of the project with its limit, None if unknown.
    """
    if job.size is not None and not job.state.terminal and job.children != {"succeeded": job.size}:
        counts = ", ".join(f"{count} {state}" for state, count in sorted(job.children.items()))
        return [f"{job.state}: it gathers {job.size} tasks, of which {counts or 'none has begun'}."]
    reasons = {
        JobState.WAITING: [_why_waiting(job)],
        JobState.QUEUED: [_why_queued(job, running, now, workers, limit)],
        JobState.RUNNING: _why_running(job, attempts),
        JobState.SUCCEEDED: ["succeeded" + (f": its result is that of {job.cached_from}." if job.cached_from else ".")],
        JobState.FAILED: [_why_failed(job)],
        JobState.CANCELLED: ["cancelled."],
    }[job.state]
    return reasons + [_outcome_text(attempt) for attempt in attempts if attempt.outcome not in (None, "succeeded")]


def _why_waiting(job: Job) -> str:
    if job.cached_from:
        return f"waiting: {job.cached_from} computes the same result, which this job will reuse."
    makers = {entry["job"] for entries in job.inputs.values() for entry in entries if "job" in entry}
    waited_for = [f"{one}, which makes its inputs" if one in makers else one for one in job.after]
    return f"waiting: it depends on {' and '.join(waited_for) or 'other jobs'}; not all of these have succeeded."


def _why_queued(
    job: Job, running: list[Job], now: datetime, workers: list[Worker] | None, limit: RunningJobs | None
) -> str:
    wait_s = (job.run_at - now).total_seconds()
    refused = job.progress.note if OWN_POD_LABEL in job.labels and job.progress is not None else ""
    if wait_s > 0 and refused:
        return f"queued: {refused}. The server starts its next pod in {wait_s:.0f} s at the earliest."
    if wait_s > 0:
        return (
            f"queued: the next attempt starts in {wait_s:.0f} s at the earliest, after attempt {job.attempt} of "
            f"{job.max_attempts}."
        )
    if limit is not None and limit.allowed == 0:
        return (
            "queued: no job of the project can start, because its limit of running jobs is 0. An administrator can "
            "change the limit (`marey project quota`)."
        )
    if limit is not None and limit.allowed is not None and limit.used >= limit.allowed:
        return (
            f"queued: the project runs {limit.used} jobs, and its limit is {limit.allowed}; the job can start when "
            "fewer of them run. An administrator can change the limit (`marey project quota`)."
        )
    if OWN_POD_LABEL in job.labels:
        return (
            f"queued: it runs in a pod of its own, {_why_own_pod(job)}. The server starts this pod in its cluster; "
            "other workers never claim the job. If no pod starts, the log of the server says why."
            + (f" Earlier, {refused}." if refused else "")
        )
    shown = " ".join(f"{name}={value}" for name, value in sorted(job.labels.items()))
    wanted = f"jobs of the kind {job.kind}" + (f" and has the labels {shown}" if shown else "")
    if workers and not any(_may_fit(worker, job) for worker in workers):
        return f"queued: it needs a worker that runs {wanted}; of the workers that are alive, none does."
    if running:
        return f"queued: the project's workers are busy with {len(running)} running jobs."
    if shown:
        return f"queued: no worker that runs {wanted} has asked for a job of this project."
    return (
        f"queued: no worker that can run jobs of the kind {job.kind} in this project has asked for one; is "
        "`marey worker` running?"
    )


def _why_own_pod(job: Job) -> str:
    image = (job.params.get("declaration") or {}).get("image") if job.kind == SCRIPT else None
    if image is not None:
        return f"because its script names the image {image}"
    if (gpus := job.labels.get(GPUS_LABEL)) is not None:
        return f"because it needs {gpus} graphics processors"
    return "because of its memory limit or its expected duration"


def _may_fit(worker: Worker, job: Job) -> bool:
    """Return whether a worker may run the job: the worker's kinds and labels fit, or they are unknown."""
    if worker.kinds is None or worker.labels is None:
        return True
    return job.kind in worker.kinds and job.labels.items() <= worker.labels.items()


def _why_running(job: Job, attempts: list[Attempt]) -> list[str]:
    current = next((attempt for attempt in attempts if attempt.fence == job.fence), None)
    who = current.worker if current else "a worker"
    stopping = " The job was cancelled and will stop." if job.cancel_requested else ""
    return [f"running: {who} works on it, attempt {job.attempt} of {job.max_attempts}.{stopping}"]


def _why_failed(job: Job) -> str:
    if job.failure is None:
        return "failed."
    return f"failed ({job.failure.reason}, {job.failure.code}): {job.failure.detail}"


def _outcome_text(attempt: Attempt) -> str:
    detail = f": {attempt.detail.strip().splitlines()[-1]}" if attempt.detail else ""
    return f"attempt {attempt.fence} on {attempt.worker} was {attempt.outcome}{detail}"
