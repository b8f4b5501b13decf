"""Worker that runs one job, in a pod that was started for this job.

A cluster may start several pods for one job. While another worker holds the job's lease, this worker waits. If that
lease expires, this worker claims the job with a newer fence. It ends when the job has ended, whichever worker ran the
job.
"""

from __future__ import annotations

import logging
import threading
import uuid
from dataclasses import dataclass
from importlib.metadata import version

from marey_client.errors import Forbidden, Invalid, LeaseLost, MareyError, NotFound, Unauthenticated
from marey_client.retries import ONCE
from marey_client.transport import Transport
from marey_schemas.processes.child_process import ChildBroken, ChildProcess
from marey_schemas.queue.own_pods import REFUSED_STATUS
from marey_schemas.queue.worker_protocol import INTERRUPTED_STATUS, ClaimRequest, Lease
from marey_schemas.tracing.export import Tracer
from marey_worker import faults
from marey_worker.attempt import RunningAttempt
from marey_worker.attempt_api import AttemptApi, claim_from
from marey_worker.attempt_limits import Stop
from marey_worker.job_io.input_cache import InputCache
from marey_worker.messages import Done, Failed
from marey_worker.supervisor import CHILD_MODULE, FAILED_STATUS, PAUSES, WorkerOptions

log = logging.getLogger(__name__)

STAND_BY_S = 5.0
"""Seconds that a claim waits for the job; short, so that a waiting worker soon knows that the job has ended."""


@dataclass(frozen=True)
class NamedJob:
    """Job for which a worker was started: the job `id`, or, if `task` is given, its task with this position."""

    id: str
    task: int | None = None


class OneJobWorker:
    """Worker that claims nothing but one job, and ends afterwards."""

    def __init__(
        self, transport: Transport, options: WorkerOptions, wanted: NamedJob, tracer: Tracer | None = None
    ) -> None:
        self._transport = transport
        self._claims = transport.with_retries(ONCE)
        self._options = options
        self._wanted = wanted
        self._tracer = tracer
        self._cache = InputCache(options.cache, options.cache_bytes)
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Stop the worker: if it runs the job, the job returns to the queue; then `run` returns."""
        self._stopping.set()

    def run(self) -> int:
        """Run the job, or wait until another worker has ended it; return the exit status of the worker.

        * 0: the job has ended, or the attempt has succeeded or was cancelled.
        * `FAILED_STATUS`: the attempt has failed, and the queue decides about a retry; or no process for jobs started.
        * `INTERRUPTED_STATUS`: the worker was stopped, even without the job, so that the pod is not a success.
        * `REFUSED_STATUS`: the server refuses this worker, and will refuse the next one.
        """
        log.info("%s works on %s for %s", self._options.name, self._wanted.id, self._transport.url)
        child = ChildProcess(CHILD_MODULE, self._options.kinds, threads=self._options.threads_of_a_slot)
        try:
            child.wait_until_ready()
            while not self._stopping.is_set():
                lease = self._obtain()
                if lease is None:
                    break
                end = self._attempt(lease, child)
                if end is not Stop.LEASE_LOST:
                    return _status_of(end)
                child.kill(grace_s=0.0)
                child = ChildProcess(CHILD_MODULE, self._options.kinds, threads=self._options.threads_of_a_slot)
                child.wait_until_ready()
        except (Unauthenticated, Forbidden, Invalid, NotFound) as error:
            log.error("the server refuses this worker: %s", error)
            return REFUSED_STATUS
        except ChildBroken as error:
            log.error("the child process did not start: %s", error)
            return FAILED_STATUS
        finally:
            child.kill(grace_s=0.0)
        return INTERRUPTED_STATUS if self._stopping.is_set() else 0

    def _obtain(self) -> Lease | None:
        """Wait until this worker gets the lease of the job; None if the job has ended or the worker was stopped."""
        failures, claim_id = 0, uuid.uuid4().hex
        while not self._stopping.is_set():
            try:
                answer = claim_from(self._claims, self._request(claim_id))
            except (Unauthenticated, Forbidden, Invalid, NotFound):
                raise
            except MareyError as error:
                failures += 1
                if isinstance(error, LeaseLost):  # the answer was lost for too long; the server answers again
                    failures, claim_id = 1, uuid.uuid4().hex
                log.warning("no answer to the claim: %s", error)
                self._stopping.wait(PAUSES.delay_s(failures))
                continue
            failures, claim_id = 0, uuid.uuid4().hex
            if answer.leases:
                return answer.leases[0]
            if answer.state is not None and answer.state.terminal:
                log.info("%s is %s already", self._wanted.id, answer.state)
                return None
        return None

    def _request(self, claim_id: str) -> ClaimRequest:
        task = {} if self._wanted.task is None else {"task": self._wanted.task}
        return ClaimRequest(
            worker=self._options.name,
            kinds=self._options.kinds,
            labels=dict(self._options.labels),
            max=1,
            wait_s=STAND_BY_S,
            claim_id=claim_id,
            version=version("marey"),
            job=self._wanted.id,
            **task,
        )

    def _attempt(self, lease: Lease, child: ChildProcess) -> Done | Failed | Stop:
        faults.point("worker.after_claim")
        log.info("%s: %s, attempt %d", lease.job, lease.kind, lease.attempt)
        api = AttemptApi(self._transport, lease)
        attempt = RunningAttempt(
            api, lease, self._cache, self._transport.url, self._stopping,
            threads=self._options.threads_of_a_slot, tracer=self._tracer,
        )  # fmt: skip
        return attempt.finish(attempt.run(child))


def _status_of(end: Done | Failed | Stop) -> int:
    if isinstance(end, Done) or end is Stop.CANCELLED:
        return 0
    return INTERRUPTED_STATUS if end is Stop.INTERRUPTED else FAILED_STATUS
