"""Execution of one attempt of a job.

A child process computes. This process, the supervisor, watches the child and answers its requests.
"""

from __future__ import annotations

import logging
import platform
import signal
import threading
import time
import uuid
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from itertools import accumulate
from typing import Any

from marey_client.errors import (
    BlobTooLarge,
    Conflict,
    Forbidden,
    Invalid,
    LeaseLost,
    MareyError,
    NotFound,
    ServerFailed,
    TooLarge,
)
from marey_schemas.encoding.codecs import CodecError
from marey_schemas.items import PartPlace
from marey_schemas.processes.child_process import BadMessage, ChildProcess
from marey_schemas.queue.job_kinds import find_kind
from marey_schemas.queue.worker_protocol import (
    LONGEST_CODE,
    LONGEST_DETAIL,
    LONGEST_SIGNATURE,
    CompleteRequest,
    FailRequest,
    Lease,
)
from marey_schemas.sizes import MIB
from marey_schemas.tracing.declared import COMPLETE, COMPUTE
from marey_schemas.tracing.export import Tracer
from marey_worker import faults, signatures
from marey_worker.attempt_api import AttemptApi
from marey_worker.attempt_limits import LogUploader, Stop, Watch
from marey_worker.attempt_trace import AttemptTrace
from marey_worker.heartbeats import LeaseKeeper
from marey_worker.job_io.input_cache import InputCache
from marey_worker.messages import (
    BAD_RESULT,
    UNPACKABLE,
    ChildReply,
    Done,
    Failed,
    FindItems,
    ProgressMade,
    PutFile,
    ReadBlob,
    ReadItem,
    ReadJudgements,
    ReadParts,
    ReadResults,
    Request,
    Run,
    Stage,
    pack,
    unpack,
)
from marey_worker.scratch import ScratchFolder
from marey_worker.texts import storable

LIBRARIES = ("marey", "numpy", "scipy", "numba")
log = logging.getLogger(__name__)
WATCH_EVERY_S = 0.1
LOG_EVERY_S = 2.0
STOPPING_S = 2.0
"""Longest time in seconds between the SIGTERM that ended a child process and the SIGTERM that stops the worker."""
ANSWER_LIMIT_BYTES = 32 * MIB
MOST_BLOB_BYTES = 1 << 30
"""Greatest size in bytes of a blob that a job may read; this process, which has no memory limit, holds the blob."""
_REFUSED = (Conflict, Forbidden, Invalid, NotFound, TooLarge)
"""Error answers of the server after which results cannot be published."""
MEMORY_PER_BLOB = 4
"""Least ratio of a job's memory limit to the size of a blob; the child needs several times the size of a file."""
TRANSFERS_AT_ONCE = 4


@cache
def environment() -> dict[str, str]:
    """Return the versions of the interpreter and of the libraries that affect numeric results, by name."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            found[library] = "absent"
    return found


class RunningAttempt:
    """One attempt of a job, from the claim to the report of its end.

    `server` is the address of the server, which is part of the keys in the cache. `stopping` is set when the worker is
    asked to stop.
    """

    def __init__(
        self,
        api: AttemptApi,
        lease: Lease,
        cache: InputCache,
        server: str,
        stopping: threading.Event,
        *,
        threads: int,
        tracer: Tracer | None = None,
    ) -> None:
        self._api = api
        self._lease = lease
        self._cache = cache
        self._server = server
        self._threads = threads
        self._trace = AttemptTrace(lease, tracer)
        self._scratch = ScratchFolder()
        self._job_log = LogUploader(api, self._scratch.path / "log")
        self._keeper = LeaseKeeper(api, lease)
        self._watch = Watch(lease, self._keeper, stopping, self._job_log, time.monotonic())
        self._log_due = time.monotonic() + LOG_EVERY_S
        self._transfers = ThreadPoolExecutor(TRANSFERS_AT_ONCE, thread_name_prefix="marey-transfer")
        self._log_sender = ThreadPoolExecutor(1, thread_name_prefix="marey-log")
        self._log_sending: Future[None] | None = None
        self._staging: list[Future[ChildReply | None]] = []

    def run(self, child: ChildProcess) -> Done | Failed | Stop:
        """Run the job in `child`; return its result, its failure, or the reason why it was stopped.

        Afterwards, the child is idle or has ended, and the caller must call `finish`.
        """
        try:
            with self._trace.stage(COMPUTE):
                child.send(pack(self._order()))
                end = self._attend(child)
            if isinstance(end, Stop):
                child.kill()
        except BaseException:
            self._close()
            raise
        return end

    def finish(self, end: Done | Failed | Stop) -> Done | Failed | Stop:
        """Wait until all results are stored, and report the end of the job to the server.

        `end` is the result of `run`. The child may run the next job in the meantime. If results cannot be stored, a
        failure or a stop is reported instead of a success. Return the end of the job, even if it cannot be reported.
        """
        try:
            with self._trace.stage(COMPLETE):
                if isinstance(end, Done):
                    end = self._when_staged(end)
                end = self._report(end)
        except LeaseLost as error:
            log.warning("%s: attempt abandoned: %s", self._lease.job, error)
        except MareyError as error:
            log.error("%s: the end of the attempt could not be reported: %s", self._lease.job, error)
        finally:
            self._trace.end(end)
            self._close()
        return end

    def _close(self) -> None:
        self._keeper.stop()
        for threads in (self._transfers, self._log_sender):
            threads.shutdown(wait=False, cancel_futures=True)
        try:
            self._scratch.remove()
        except OSError as error:
            log.warning("%s: the folder %s cannot be removed: %s", self._lease.job, self._scratch.path, error)

    def _order(self) -> Run:
        lease = self._lease
        return Run(
            lease.job, lease.kind, lease.params, lease.inputs, lease.seed,
            lease.resources.memory_limit_mb * MIB, self._job_log.path, self._scratch.path, self._threads,
            lease.position, lease.size, lease.into,
        )  # fmt: skip

    # -- while the child computes --

    def _attend(self, child: ChildProcess) -> Done | Failed | Stop:
        """Answer the requests of the child until it reports its result or failure, and return this message.

        Return a failure if the child dies, and the reason to stop if the job must be stopped.
        """
        while True:
            try:
                data = child.receive(WATCH_EVERY_S)
                message = None if data is None else unpack(data)
            except EOFError:
                return self._end_of_child(child)
            except (BadMessage, OSError) as error:
                child.kill(grace_s=0.0)
                return Failed("bad-message", str(error), "bad-message", retryable=True)
            if isinstance(message, Done | Failed):
                return message
            if isinstance(message, ProgressMade):
                self._keeper.set_progress(message.progress)
            elif message is not None:
                self._serve(message, child)
            if (stop := self._check(child)) is not None:
                return stop

    def _check(self, child: ChildProcess | None) -> Stop | None:
        """Return the reason to stop the attempt now, or None if there is none.

        Also start to send new output to the job's log, at most every `LOG_EVERY_S` seconds. A separate thread sends it,
        so that inputs and results are not delayed if the server does not answer.
        """
        sent = self._log_sending is None or self._log_sending.done()
        if sent and time.monotonic() > self._log_due:
            self._log_sending = self._log_sender.submit(self._try_to_send_log)
            self._log_due = time.monotonic() + LOG_EVERY_S
        return self._watch.reason_to_stop(child)

    def _serve(self, request: Request, child: ChildProcess) -> None:
        """Carry out one request of the child in a separate thread, and answer it."""
        carrying_out = self._transfers.submit(self._reply_to, request)
        if isinstance(request, Stage):
            self._staging = [*filter(_not_stored, self._staging), carrying_out]
        # A child that runs the next job may take long to read this reply: `carrying_out` is done before it is sent.
        carrying_out.add_done_callback(partial(send_reply, child))

    def _reply_to(self, request: Request) -> ChildReply | None:
        """Carry out one request of the child; return the reply, or None if the lease was lost."""
        try:
            with self._trace.transfer(request):
                return ChildReply(request.request, self._carried_out(request))
        except LeaseLost:
            self._keeper.lost.set()
            return None
        except Exception as error:  # noqa: BLE001 - whatever happened, the child waits for an answer
            missing, too_large = isinstance(error, NotFound), isinstance(error, BlobTooLarge)
            return ChildReply(request.request, refusal=str(error), missing=missing, too_large=too_large)

    def _carried_out(self, request: Request) -> Any:
        match request:
            case ReadParts(_, places):
                return self._read_parts(places)
            case ReadItem(_, kind, item):
                return self._api.read_item(kind, item)
            case FindItems(_, kind, name, collection):
                return self._api.find_items(kind, name, collection)
            case ReadBlob(_, digest):
                return self._read_blob(digest)
            case ReadJudgements(_, item, revision):
                return self._api.read_judgements(item, revision)
            case ReadResults():
                return self._api.read_results()
            case PutFile(_, path):
                digest = self._api.put_file(path)
                faults.point("worker.after_blob")
                return digest
            case Stage(_, body):
                self._api.stage(body)
                faults.point("worker.after_blob")
                return None

    def _read_blob(self, digest: str) -> bytes:
        """Return a blob from the cache or the server. Raises `BlobTooLarge` if the job's memory is too small for it."""
        most_bytes = min(MOST_BLOB_BYTES, self._lease.resources.memory_limit_mb * MIB // MEMORY_PER_BLOB)
        data = self._cache.get(self._cache_key(digest), lambda: self._api.read_blob(digest, most_bytes))
        if len(data) > most_bytes:  # another job with a higher memory limit has read it
            raise BlobTooLarge(digest, len(data), most_bytes)
        return data

    def _read_parts(self, places: Sequence[PartPlace]) -> list[bytes | None]:
        """Return encoded documents from the cache or the server, and None for a document that does not exist.

        If the documents together exceed `ANSWER_LIMIT_BYTES`, documents at the end are omitted, but never the first
        one.
        """
        keys = [self._cache_key(f"{place.item}@{place.revision}/{place.part}") for place in places]
        found = self._cache.get_many(keys, lambda missing: self._api.read_parts([places[index] for index in missing]))
        sizes = accumulate(len(data or b"") for data in found)
        return found[: max(1, sum(size <= ANSWER_LIMIT_BYTES for size in sizes))]

    def _cache_key(self, name: str) -> str:
        """Return the key of a blob or a part in the cache: server, project and name.

        Names of parts are unique only on one server and in one project.
        """
        return f"{self._server} {self._lease.project} {name}"

    def _end_of_child(self, child: ChildProcess) -> Failed | Stop:
        status = child.wait()
        # An engine such as Slurm sends SIGTERM to all processes of a worker at once; the child may end first.
        if status == -signal.SIGTERM and self._watch.stopping.wait(STOPPING_S):
            return Stop.INTERRUPTED
        detail = signatures.describe_exit(status)
        return Failed("worker-process-died", detail, signatures.of_exit(status), retryable=True)

    # -- at the end --

    def _when_staged(self, done: Done) -> Done | Failed | Stop:
        """Wait until the server has stored all results; return `done`, or the reason why the job has not succeeded."""
        while wait(self._staging, WATCH_EVERY_S).not_done:
            if (stop := self._check(None)) is not None:
                return stop
        for reply in [staged.result() for staged in self._staging]:
            if reply is None:
                return Stop.LEASE_LOST
            if reply.refusal is not None:
                detail = f"the results could not be stored: {reply.refusal}"
                return Failed("exception", detail, signatures.STAGING, retryable=not reply.missing)
        return done

    def _report(self, end: Done | Failed | Stop) -> Done | Failed | Stop:
        """Report the end of the job to the server, and return the end that was reported.

        If the results of a success cannot be published, a failure is reported and returned instead. Heartbeats continue
        in the meantime, because the server may be unreachable for a while.
        """
        if end is Stop.LEASE_LOST:
            log.warning("%s: %s", self._lease.job, self._watch.explain(end))
            return end
        self._keeper.confirm(patiently=isinstance(end, Done))
        self._try_to_send_log()
        if isinstance(end, Done):
            try:
                self._complete(end)
            except LeaseLost:
                raise
            except _REFUSED as error:  # such as a quota that is exceeded; to compute the results again would not help
                end = Failed(error.code, f"the results cannot be published: {error}", None, retryable=False)
            except CodecError as error:
                end = Failed(BAD_RESULT, f"the result cannot be sent: {error}", None, retryable=False)
            except ServerFailed as error:
                end = Failed(error.code, f"the results could not be published: {error}", None, retryable=True)
        if not isinstance(end, Done):
            self._api.fail(self._failure(end))
        return end

    def _complete(self, done: Done) -> None:
        request = CompleteRequest(
            write_id=uuid.uuid4().hex,
            result=done.result,
            code_version=find_kind(self._lease.kind).code_version,
            environment=environment(),
            **({} if done.shareable else {"shareable": False}),  # servers of earlier versions do not know the field
        )
        faults.point("worker.before_complete")
        self._api.complete(request)
        faults.point("worker.after_complete")

    def _failure(self, end: Failed | Stop) -> FailRequest:
        if isinstance(end, Failed):
            code, detail, signature, retryable = end.code, end.detail, end.signature, end.retryable
        else:
            code, detail, retryable = end.value, self._watch.explain(end), end is not Stop.LOG
            signature = end.value if end in (Stop.MEMORY, Stop.LOG) else None
        return FailRequest(
            write_id=uuid.uuid4().hex,
            code=storable(code, LONGEST_CODE) or "exception",
            detail=storable(detail, LONGEST_DETAIL),
            signature=None if signature is None else storable(signature, LONGEST_SIGNATURE),
            retryable=retryable,
            interrupted=end is Stop.INTERRUPTED,
        )

    def _try_to_send_log(self) -> None:
        """Send new output to the job's log; if this fails, only log the failure, so that no result is lost."""
        try:
            self._job_log.send()
        except LeaseLost:
            self._keeper.lost.set()
        except (MareyError, OSError) as error:
            log.warning("%s: its log could not be sent: %s", self._lease.job, error)


def _not_stored(staging: Future[ChildReply | None]) -> bool:
    """Return whether staged results are not stored yet, or could not be stored."""
    reply = staging.result() if staging.done() else None
    return reply is None or reply.refusal is not None


def send_reply(child: ChildProcess, carried_out: Future[ChildReply | None]) -> None:
    """Send the child the reply to its request, or a refusal if the reply cannot be encoded."""
    if carried_out.cancelled() or (reply := carried_out.result()) is None:
        return
    try:
        data = pack(reply)
    except UNPACKABLE as error:  # the child waits for an answer, whatever happened
        data = pack(ChildReply(reply.request, refusal=f"the answer cannot be sent to the child process: {error}"))
    child.send(data)
