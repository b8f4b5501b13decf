"""One run at one rate: threads that submit jobs at planned times, and simulated workers that claim and complete them.

Jobs are submitted at random times (a Poisson process), whether earlier requests were answered or not. The delay of a
job counts from its planned time. So a server that answers slowly cannot hide its delays by slowing down the test.
"""

from __future__ import annotations

import itertools
import random
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from marey_client.errors import MareyError
from marey_client.load.calling import NO_ANSWER, LoadAnswer, LoadConnection, connection
from marey_client.load.figures import Replicate
from marey_client.load.scratch import KIND, Scratch

SUBMITTERS = 8
CLAIM_WAIT_S = 1.0
PAUSE_AFTER_ERROR_S = 0.1
DRAIN_S = 30.0
"""Longest time for which a run waits for its jobs to end after the last submission."""
TICK_EVERY_S = 0.2
JOBS_PER_BATCH = 200

Tick = Callable[[float], None]
"""Function that is called several times a second with the seconds since the start of the run."""


class OfferedLoad:
    """Jobs of one run of a load test: planned and actual times, by the monotonic clock, and numbers of errors."""

    def __init__(self, scratch: Scratch, *, own_workers: bool) -> None:
        self._scratch = scratch
        self._path = f"/projects/{scratch.project.name}/jobs"
        self._job = scratch.job(own_workers=own_workers)
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._failures: list[BaseException] = []
        self.planned: dict[str, float] = {}
        self.started: dict[str, float] = {}
        self.completed: dict[str, float] = {}
        self.errors: Counter[str] = Counter()
        self.durations_s: dict[str, list[float]] = {"submit": [], "claim": [], "complete": []}

    def offer(self, times_s: Sequence[float], tick: Tick) -> None:
        """Submit a job at each of the given times, in seconds from now; return after the last answer."""
        begun = time.monotonic()
        planned = iter([begun + after_s for after_s in times_s])
        submitting = [self._thread(self._submit, planned) for _ in range(SUBMITTERS)]
        self._follow(lambda: not any(thread.is_alive() for thread in submitting), begun, tick)

    def submit_backlog(self, count: int) -> None:
        """Submit `count` jobs in batches, before workers start. Raises `MareyError` if the server refuses them."""
        left = count
        with connection(self._scratch.url, self._scratch.token) as caller:
            while left:
                portion = min(left, JOBS_PER_BATCH)
                reply = caller.post(f"{self._path}/batch", {"jobs": [self._job] * portion})
                if reply.code:
                    raise MareyError(f"the server refused a batch of jobs: {reply.document.get('detail', reply.code)}")
                now = time.monotonic()
                self.planned |= {job["id"]: now for job in reply.document["jobs"]}
                left -= portion

    def await_end(self, seconds: float, begun: float, tick: Tick) -> None:
        """Wait until all jobs are completed, at most for the given number of seconds."""
        deadline = time.monotonic() + seconds
        self._follow(lambda: len(self.completed) >= len(self.planned) or time.monotonic() >= deadline, begun, tick)

    def _follow(self, done: Callable[[], bool], begun: float, tick: Tick) -> None:
        while not done():
            if self._failures:
                raise self._failures[0]
            tick(time.monotonic() - begun)
            self._stop.wait(TICK_EVERY_S)

    @contextmanager
    def workers(self, count: int, work_s: float) -> Iterator[None]:
        """Run `count` simulated workers while the `with` block runs; each works `work_s` seconds on a job."""
        for number in range(count):
            self._thread(self._work, f"simulated-{number}", work_s)
        try:
            yield
        finally:
            self._stop.set()
            for thread in self._threads:
                thread.join()

    def _thread(self, function: Callable[..., None], *arguments: object) -> threading.Thread:
        """Run a function in a thread; `_follow`, which waits for the run, raises an exception of the function again."""

        def work() -> None:
            try:
                function(*arguments)
            except BaseException as failure:  # noqa: BLE001 - raised again by the thread that waits
                self._failures.append(failure)

        thread = threading.Thread(target=work, daemon=True)
        self._threads.append(thread)
        thread.start()
        return thread

    def _submit(self, planned: Iterator[float]) -> None:
        with connection(self._scratch.url, self._scratch.token) as caller:
            while not self._stop.is_set():
                with self._lock:
                    due = next(planned, None)
                if due is None:
                    return
                if self._stop.wait(max(0.0, due - time.monotonic())):
                    return
                reply = self._timed("submit", lambda: caller.post(self._path, self._job))
                if self._accepted("submit", reply):
                    self.planned[reply.document["id"]] = due

    def _work(self, name: str, work_s: float) -> None:
        wanted = {"worker": name, "kinds": [KIND], "labels": self._scratch.labels, "wait_s": CLAIM_WAIT_S}
        with connection(self._scratch.url, self._scratch.token) as caller:
            while not self._stop.is_set():
                claim = {**wanted, "claim_id": secrets.token_hex(16)}
                reply = self._timed("claim", lambda claim=claim: caller.post("/leases", claim))
                if not self._accepted("claim", reply):
                    self._stop.wait(PAUSE_AFTER_ERROR_S)
                    continue
                for lease in reply.document["leases"]:
                    self.started[lease["job"]] = time.monotonic()
                    if work_s:
                        time.sleep(work_s)
                    self._complete(caller, lease)

    def _complete(self, caller: LoadConnection, lease: dict[str, object]) -> None:
        path = f"/jobs/{lease['job']}/attempts/{lease['fence']}/complete"
        body = {"write_id": secrets.token_hex(16)}
        reply = self._timed("complete", lambda: caller.post(path, body, token=str(lease["attempt_token"])))
        if reply.code == NO_ANSWER:  # it may have arrived; the same id gets the same answer
            self._accepted("complete", reply)
            reply = caller.post(path, body, token=str(lease["attempt_token"]))
        if self._accepted("complete", reply):
            self.completed[str(lease["job"])] = time.monotonic()

    def _timed(self, what: str, send: Callable[[], LoadAnswer]) -> LoadAnswer:
        begun = time.monotonic()
        reply = send()
        self.durations_s[what].append(time.monotonic() - begun)
        return reply

    def _accepted(self, what: str, reply: LoadAnswer) -> bool:
        """Return whether a request succeeded; if it failed, count the error."""
        if not reply.code:
            return True
        with self._lock:
            self.errors[f"{what}: {reply.code}"] += 1
        return False

    def ends_on_server(self) -> dict[str, tuple[float, float | None]]:
        """Return start and end of each started job, by id, in seconds after its submission; the end may be None.

        Both times are by the server's clock, because workers of other processes run the jobs.
        """
        found = {}
        for job in self._scratch.project.jobs():
            if job.id in self.planned and job.started_at is not None:
                end_s = None if job.finished_at is None else (job.finished_at - job.created_at).total_seconds()
                found[job.id] = (job.started_at - job.created_at).total_seconds(), end_s
        return found


def arrival_times(rate: float, seconds: float, seed: int) -> list[float]:
    """Return the times, up to `seconds`, of a Poisson process with `rate` events per second; the seed fixes them."""
    draw = random.Random(seed)  # noqa: S311 - times of a test, not secrets
    gaps = (draw.expovariate(rate) for _ in itertools.count())
    return list(itertools.takewhile(lambda time_s: time_s < seconds, itertools.accumulate(gaps)))


def run_with_own_workers(
    scratch: Scratch, times_s: Sequence[float], seconds: float, *, workers: int, work_s: float, tick: Tick
) -> Replicate:
    """Submit jobs at the given times, run the jobs with simulated workers, and return the measurements."""
    run = OfferedLoad(scratch, own_workers=True)
    begun = time.monotonic()
    with run.workers(workers, work_s):
        run.offer(times_s, tick)
        run.await_end(DRAIN_S, begun, tick)
    last = max(run.completed.values(), default=begun)
    starts_s = [run.started[job] - due for job, due in run.planned.items() if job in run.started]
    return Replicate(max(seconds, last - begun), len(run.planned), len(run.completed), starts_s, dict(run.errors))


def run_with_other_workers(scratch: Scratch, times_s: Sequence[float], seconds: float, *, tick: Tick) -> Replicate:
    """Submit jobs at the given times, wait until the workers of the server have run them, and return the figures."""
    run = OfferedLoad(scratch, own_workers=False)
    begun = time.monotonic()
    with run.workers(0, 0.0):
        run.offer(times_s, tick)
        deadline = time.monotonic() + DRAIN_S
        while time.monotonic() < deadline:
            ends = run.ends_on_server()
            if len([one for one in ends.values() if one[1] is not None]) >= len(run.planned):
                break
            tick(time.monotonic() - begun)
            time.sleep(1.0)
        ends = run.ends_on_server()
    completed = [end_s for _, end_s in ends.values() if end_s is not None]
    lasted = time.monotonic() - begun
    starts_s = [start_s for start_s, _ in ends.values()]
    return Replicate(max(seconds, lasted), len(run.planned), len(completed), starts_s, dict(run.errors))
