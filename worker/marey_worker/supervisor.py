"""Supervisor of a worker: claims jobs and runs them in slots, until the worker is stopped."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
import uuid
from collections.abc import Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Self

from marey_client.errors import Forbidden, Invalid, LeaseLost, MareyError, NotFound, Unauthenticated
from marey_client.retries import ONCE
from marey_client.transport import Transport
from marey_schemas.backoff import Backoff
from marey_schemas.processes.child_process import ChildBroken, ChildProcess
from marey_schemas.queue.job_kinds import job_kinds
from marey_schemas.queue.scripts import SCRIPT, read_repositories
from marey_schemas.queue.worker_protocol import INTERRUPTED_STATUS, ClaimRequest, Lease
from marey_schemas.tracing.export import Tracer
from marey_worker import faults
from marey_worker.attempt import RunningAttempt
from marey_worker.attempt_api import AttemptApi, claim_from
from marey_worker.attempt_limits import Stop
from marey_worker.job_io.input_cache import InputCache
from marey_worker.messages import Done, Failed

log = logging.getLogger(__name__)

CLAIM_WAIT_S = 20.0
PAUSES = Backoff(first_s=0.5, longest_s=15.0)
FAILED_STATUS = 1
JOBS_PER_CHILD = 1000
CHILD_MODULE = "marey_worker.child"


@dataclass(frozen=True)
class WorkerOptions:
    """Options of a worker.

    `kinds` and `labels` select the jobs that the worker claims; `slots` is the number of jobs that run at the same
    time. `threads` is the total number of threads of all slots. `cache` is the folder of cached inputs, and
    `cache_bytes` its greatest size.
    """

    name: str = field(default_factory=lambda: f"{socket.gethostname()}:{os.getpid()}")
    slots: int = 1
    kinds: tuple[str, ...] = field(default_factory=lambda: runnable_kinds(os.environ))
    labels: Mapping[str, str] = field(default_factory=dict)
    cache: Path = field(default_factory=lambda: default_cache(os.environ))
    cache_bytes: int = 2 << 30
    threads: int = field(default_factory=lambda: os.cpu_count() or 1)

    @property
    def threads_of_a_slot(self) -> int:
        """Return the number of threads that one job may use."""
        return max(1, self.threads // self.slots)


def runnable_kinds(environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the kinds that a worker runs by default; scripts only if the environment allows a repository.

    Raises `ValueError` if the list of repositories is malformed.
    """
    allowed = read_repositories(environment)
    return tuple(kind for kind in job_kinds() if kind != SCRIPT or allowed)


def default_cache(environment: Mapping[str, str]) -> Path:
    """Return the default folder of cached inputs, below `XDG_CACHE_HOME` or `~/.cache`."""
    return Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "marey" / "inputs"


class Supervisor:
    """Supervisor process of a worker, which communicates with the server on behalf of its child processes.

    The supervisor continues if a child process crashes.
    """

    def __init__(self, transport: Transport, options: WorkerOptions, tracer: Tracer | None = None) -> None:
        self._transport = transport
        self._tracer = tracer
        self._claims = transport.with_retries(ONCE)
        self._options = options
        self._cache = InputCache(options.cache, options.cache_bytes)
        self._stopping = threading.Event()
        self._running: set[tuple[str, int]] = set()
        self._interrupted = self._failed = False
        self._refusal: MareyError | None = None

    def stop(self) -> None:
        """Stop the worker: no more jobs are claimed, running jobs return to the queue, and `run` returns."""
        self._stopping.set()

    def run(self) -> int:
        """Run jobs until the worker is stopped, and return the exit status.

        The status is not 0 if a job was running at that time, if the worker failed, or if the server refused the
        worker.
        """
        slots = [threading.Thread(target=self._work, name=f"slot-{n}", daemon=True) for n in range(self._options.slots)]
        for slot in slots:
            slot.start()
        log.info("%s works for %s: %s", self._options.name, self._transport.url, ", ".join(self._options.kinds))
        self._stopping.wait()
        while self._running:  # slots that only wait for work hold nothing and may be left
            time.sleep(0.02)
        if self._refusal is not None:
            log.error("the server refuses this worker: %s", _explained(self._refusal, self._transport.url))
        if self._failed or self._refusal is not None:
            return FAILED_STATUS
        return INTERRUPTED_STATUS if self._interrupted else 0

    # -- one slot --

    def _work(self) -> None:
        """Claim and run jobs in one slot until the worker is stopped; an unexpected error stops the whole worker."""
        try:
            self._claim_and_run()
        except Exception:
            log.exception("a slot failed")
            self._failed = True
            self.stop()

    def _claim_and_run(self) -> None:
        failures = 0
        opened = self._open_claim()
        finishing: Future[None] | None = None
        with _SlotChild(self._options) as slot, ThreadPoolExecutor(1, thread_name_prefix="marey-finish") as finisher:
            while not self._stopping.is_set():
                try:
                    child = slot.child()
                    leases = self._claim(opened)
                except (Unauthenticated, Forbidden, Invalid) as error:
                    if not opened.transport.has_token_of(self._claims):  # the file of the token has changed
                        opened = self._open_claim()
                        continue
                    self._refusal = error
                    self.stop()
                    break
                except (MareyError, ChildBroken) as error:
                    failures += 1
                    if isinstance(error, LeaseLost):  # the answer was lost for too long; the server answers again
                        opened = self._open_claim()
                        failures = 1
                    log.warning("no work: %s", _explained(error, self._transport.url))
                    self._stopping.wait(PAUSES.delay_s(failures))
                    continue
                failures = 0
                opened = self._open_claim()
                for lease in leases:
                    earlier, finishing = finishing, self._attempt(lease, child, finisher)
                    if earlier is not None:
                        earlier.result()  # results of one earlier job at most are kept; raises what went wrong with it
            if finishing is not None:
                finishing.result()

    def _open_claim(self) -> _OpenClaim:
        return _OpenClaim(self._claims.with_present_token(), uuid.uuid4().hex)

    def _claim(self, opened: _OpenClaim) -> tuple[Lease, ...]:
        """Claim a job; return its lease, or an empty tuple if there is no job for this worker.

        If the answer to an earlier claim was lost, the same id is sent again, and the server returns the same job.
        """
        wanted = ClaimRequest(
            worker=self._options.name,
            kinds=self._options.kinds,
            labels=dict(self._options.labels),
            max=1,
            wait_s=CLAIM_WAIT_S,
            claim_id=opened.id,
            version=version("marey"),
        )
        return claim_from(opened.transport, wanted).leases

    def _attempt(self, lease: Lease, child: ChildProcess, finisher: Executor) -> Future[None]:
        """Run a job; return a future that ends when the results are stored and the end of the job is reported.

        After a success, this method returns before the future ends, so that the child can already run the next job.
        """
        place = (lease.job, lease.fence)  # a lost job may run again before its former attempt has ended
        self._running.add(place)
        try:
            faults.point("worker.after_claim")
            log.info("%s: %s, attempt %d", lease.job, lease.kind, lease.attempt)
            api = AttemptApi(self._transport, lease)
            attempt = RunningAttempt(
                api, lease, self._cache, self._transport.url, self._stopping,
                threads=self._options.threads_of_a_slot, tracer=self._tracer,
            )  # fmt: skip
            end = attempt.run(child)
        except BaseException:
            self._running.discard(place)
            raise
        finishing = finisher.submit(self._finish, attempt, end, place)
        if not isinstance(end, Done):
            finishing.result()
        return finishing

    def _finish(self, attempt: RunningAttempt, end: Done | Failed | Stop, place: tuple[str, int]) -> None:
        try:
            self._interrupted |= attempt.finish(end) is Stop.INTERRUPTED
        finally:
            self._running.discard(place)


@dataclass(frozen=True)
class _OpenClaim:
    """Claim that is sent with the same token and the same id until it is answered.

    The server repeats its answer only for the token with which the claim was first sent. So a repeated claim uses this
    token, even if the worker has a newer token by then.
    """

    transport: Transport
    id: str


class _SlotChild:
    """Child process of a slot, which is replaced after it has died and after a certain number of jobs."""

    def __init__(self, options: WorkerOptions) -> None:
        self._options = options
        self._child: ChildProcess | None = None
        self._jobs = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._child is not None:
            self._child.kill(grace_s=0.0)

    def child(self) -> ChildProcess:
        """Return a child that is ready for a job, started if necessary."""
        if self._child is not None and (not self._child.alive or self._jobs >= JOBS_PER_CHILD):
            self._child.kill(grace_s=0.0)
            self._child = None
        if self._child is None:
            self._child = ChildProcess(CHILD_MODULE, self._options.kinds, threads=self._options.threads_of_a_slot)
            self._jobs = 0
            self._child.wait_until_ready()
        self._jobs += 1
        return self._child


def _explained(error: Exception, url: str) -> str:
    """Return the text of an error that stopped a claim, with what to do about a wrong token or address."""
    if isinstance(error, Unauthenticated | Forbidden):
        return f"{error} Give it a token of `marey token create NAME --scope work` with --token-file."
    if isinstance(error, NotFound):
        return f"{url} has no queue of jobs; set MAREY_SERVER to the address of the server alone, without a path"
    return str(error)
