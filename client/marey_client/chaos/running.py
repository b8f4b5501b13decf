"""Run of a fault injection: jobs, faults in a random order, and the check that each job has one visible result."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from marey_client.chaos.hostile_attempts import HOSTILE_CASES, HostileAttempt
from marey_client.chaos.worker_processes import WORKER_FAULTS, WorkerProcesses, worker_processes
from marey_client.errors import MareyError, WaitedTooLong
from marey_client.load.calling import connection
from marey_client.load.scratch import Scratch, scratch_project
from marey_client.marey import Marey
from marey_schemas.kinds import Kind
from marey_schemas.queue.jobs import Job, JobState
from marey_schemas.wording import counted

T = TypeVar("T")

HEALTHY_WORKERS = 2
FAULT_S = 120.0
"""Longest wait in seconds until a worker process has claimed a job and killed or stopped itself."""
END_S = 900.0
"""Longest wait in seconds for the end of all jobs, which includes the end of the leases of dead workers."""
LATE_S = 5.0
"""Seconds in which resumed workers may try to publish results of lost attempts, which the server must refuse."""
MAX_ATTEMPTS = 20
"""Number of attempts after which a job fails; large, because several faults can affect the same job."""

OnStep = Callable[[str, float, float | None], None]
"""Function called with a text on the present activity, the number of steps done, and their total, None if unknown."""


@dataclass(frozen=True)
class ChaosFinding:
    """Result for one injected fault or one job; `fault` is empty if the server behaved correctly."""

    check: str
    fault: str
    detail: str


def run_chaos(marey: Marey, seed: int, faults: int, on_step: OnStep) -> Iterator[ChaosFinding]:
    """Inject each kind of fault at least once in a scratch project; yield a finding for each fault and for each job.

    `faults` is the total number of faults; it is exceeded if there are more kinds. Faults in addition to one of each
    kind are random: half of them faulty requests, half of them killed or paused workers. Equal seeds give the same
    faults in the same order, but not the same timing of requests. The scratch project and all processes of the test
    are removed at the end, also after an error or Ctrl-C.
    """
    draw = random.Random(seed)  # noqa: S311 - faults of a test, not secrets
    further = max(0, faults - len(HOSTILE_CASES) - len(WORKER_FAULTS))
    hostile = _drawn(list(HOSTILE_CASES), further // 2, draw)
    killed = _drawn(list(WORKER_FAULTS), further - further // 2, draw)
    with scratch_project(marey) as scratch, worker_processes(scratch) as processes:
        expected: dict[str, Kind] = {}
        for number, name in enumerate(hostile):
            on_step(name, number, len(hostile))
            job = _submit(scratch, f"hostile-{number}")
            expected[job] = Kind.SKELETON
            yield _attempt(scratch, job, name, draw)
        jobs = [_submit(scratch, f"imported-{number}") for number in range(len(killed) + HEALTHY_WORKERS)]
        expected |= dict.fromkeys(jobs, Kind.CLIP)
        paused = []
        for number, fault in enumerate(killed):
            on_step(str(fault), number, len(killed))
            worker = processes.start(fault)
            paused.append(worker)
            reached = worker.wait_for_fault(FAULT_S)
            yield ChaosFinding(str(fault), "" if reached else f"not reached in {FAULT_S:g} s", "happened")
        yield from _await_results(scratch, processes, jobs, on_step)
        for worker in paused:
            worker.resume()
        time.sleep(LATE_S)
        yield from (_check(scratch, job, kind) for job, kind in expected.items())


def _drawn(cases: Sequence[T], further: int, draw: random.Random) -> list[T]:
    """Return the cases in random order: each once, and `further` randomly chosen repetitions."""
    chosen = [*cases, *(draw.choice(cases) for _ in range(further))]
    draw.shuffle(chosen)
    return chosen


def _submit(scratch: Scratch, folder: str) -> str:
    request = scratch.job(own_workers=True, into=folder) | {"max_attempts": MAX_ATTEMPTS}
    with connection(scratch.url, scratch.token) as caller:
        answer = caller.post(f"/projects/{scratch.project.name}/jobs", request)
    if answer.code:
        raise MareyError(f"the server refused a job: {answer.document.get('detail', answer.code)}")
    return str(answer.document["id"])


def _attempt(scratch: Scratch, job: str, name: str, draw: random.Random) -> ChaosFinding:
    with connection(scratch.url, scratch.token) as caller:
        try:
            HOSTILE_CASES[name](HostileAttempt(scratch, caller, job, draw))
        except MareyError as error:
            return ChaosFinding(name, str(error), "")
    return ChaosFinding(name, "", "the server answered correctly")


def _await_results(
    scratch: Scratch, processes: WorkerProcesses, jobs: Sequence[str], on_step: OnStep
) -> Iterator[ChaosFinding]:
    """Let healthy workers run the jobs, and wait for their end; yield a finding for each job that has not ended."""
    for _ in range(HEALTHY_WORKERS):
        processes.start()
    deadline = time.monotonic() + END_S
    for number, job in enumerate(jobs):
        on_step("jobs of dead workers run again", number, len(jobs))
        try:
            scratch.marey.jobs.wait(job, timeout_s=max(1.0, deadline - time.monotonic()), require_success=False)
        except WaitedTooLong as error:
            yield ChaosFinding(f"job {job}", str(error), "")


def _check(scratch: Scratch, job_id: str, kind: Kind) -> ChaosFinding:
    """Check that a job has succeeded in exactly one attempt, and that its result is visible exactly once."""
    job = scratch.marey.jobs.get(job_id)
    wrong = list(_faults_of(scratch, job, kind))
    attempts = len(list(scratch.marey.jobs.attempts(job_id)))
    return ChaosFinding(
        f"job in {job.into}", "; ".join(wrong), f"one visible result after {counted(attempts, 'attempt')}"
    )


def _faults_of(scratch: Scratch, job: Job, kind: Kind) -> Iterator[str]:
    if job.state is not JobState.SUCCEEDED:
        yield f"the job is {job.state}" + (f": {job.failure.detail}" if job.failure else "")
    ended = [one.outcome for one in scratch.marey.jobs.attempts(job.id)]
    if ended.count("succeeded") != 1:
        yield f"{ended.count('succeeded')} attempts succeeded"
    project = scratch.project
    listed = (project.skeletons if kind is Kind.SKELETON else project.clips).list(collection=job.into)
    visible = [one.item for one in listed]
    if len(visible) != 1 or visible[0].revision != 1:
        shown = ", ".join(f"{one.path}@{one.revision}" for one in visible) or "nothing"
        yield f"the folder {job.into} has {shown} instead of one item with one revision"
    if not any(one.kind is kind for one in scratch.marey.jobs.outputs(job.id)):
        yield f"the job lists no {kind} as its output"
