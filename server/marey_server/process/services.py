"""State of one server process that every handler may use: database, threads, caches."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Hashable, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from typing import Any

from marey_schemas.lru import LruCache
from marey_schemas.tracing.export import Tracer
from marey_server.access import scopes
from marey_server.access.principal import SYSTEM, Principal
from marey_server.access.secret_tokens import is_sealed, token_hash
from marey_server.errors import ApiProblem, UnavailableProblem
from marey_server.motions.child import Message
from marey_server.motions.searching import SearchableKey
from marey_server.process.child_starting import LOADED_FIRST, MODULES_FIRST
from marey_server.process.children import Children
from marey_server.process.computing import ComputeThreads
from marey_server.process.data_folder import INDEX_COPIES
from marey_server.process.disk_space import DiskSpace
from marey_server.process.identity_provider import IdentityProvider
from marey_server.process.memory import RequestMemory
from marey_server.process.observe import Metrics
from marey_server.process.password_lanes import PasswordLane, RefusedTries
from marey_server.process.refusal_brake import RefusalBrake
from marey_server.process.settings import Settings
from marey_server.process.turns import Turns
from marey_server.process.upload_hashes import UploadHashes
from marey_server.store import events
from marey_server.store.credentials import tokens
from marey_server.store.credentials.server_key import read_seal_key
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import SERVER
from marey_server.store.jobs.failure import end_for_lost_author
from marey_server.store.jobs.policy import QueuePolicy
from marey_server.store.jobs.reaper import StartGrace
from marey_server.store.monitoring.figures import read_figures
from marey_server.store.monitoring.workers import WorkerMemory
from marey_server.store.motion_indexes import IndexFiles

log = logging.getLogger(__name__)

LARGEST_ANSWER_SHARE = 8
"""Size of the cache of answers divided by the size of the largest body in it; larger bodies are not cached."""
ANSWER_ENTRY_BYTES = 512
"""Memory in bytes of an entry in the cache of answers, in addition to its body."""
MODEL_CACHE_BYTES = 64 << 20
"""Greatest size of the cache of models' documents, in bytes."""
FIGURES_WAIT_S = 0.5
"""Greatest number of seconds that a request for metrics waits for the first numbers from the database."""
TOKENS_REMEMBERED = 10_000
ADMISSIONS_REMEMBERED = 10_000


class Description(Message):
    """Description of the API as bytes: the OpenAPI document, the HTML page, and the entity tag of both."""

    document: bytes
    page: bytes
    tag: str


def _answer_cache(most_bytes: int) -> LruCache[tuple[str, str], bytes]:
    return LruCache(
        max_bytes=most_bytes,
        largest_bytes=most_bytes // LARGEST_ANSWER_SHARE,
        size_of=lambda body: len(body) + ANSWER_ENTRY_BYTES,
    )


class Services:
    """Shared parts of a server process: database, threads, metrics, and whether the server is draining."""

    lingering = False
    """True if the process accepts no more connections; then its answers ask clients to close their connections."""
    tracer: Tracer | None
    """Sender of the spans of requests; None if no collector is configured."""

    def __init__(
        self,
        settings: Settings,
        database: Database,
        children: Children | None = None,
    ) -> None:
        self.settings = settings
        self.database = database
        self.description: Description | None = None
        """Description of the API; None until a request for it has computed it."""
        self.describing = asyncio.Lock()
        self.tracer = settings.open_tracer()
        self.metrics = Metrics()
        self.answers = _answer_cache(settings.answer_cache_bytes)
        self.models: LruCache[SearchableKey, bytes] = LruCache(max_bytes=MODEL_CACHE_BYTES, size_of=len)
        """Packed models for child processes: documents and, for searches, search trees and joint mappings."""
        self.admitted: LruCache[Hashable, float] = LruCache(max_entries=ADMISSIONS_REMEMBERED)
        """Time at which a caller was last allowed to send a body, by the value that `admission_of` returns."""
        self.followers: Counter[str] = Counter()
        """Number of open connections that follow events, by the id of the user."""
        self.draining = asyncio.Event()
        self.in_flight: set[Any] = set()
        self.password_lane = PasswordLane("known")
        """Lane for signed-in users, and for sign-ins from addresses from which the user has signed in before."""
        self.unknown_lane = PasswordLane("unknown")
        """Lane for all other sign-ins."""
        self.refused_tries = RefusedTries()
        self.identity_provider = None if settings.oidc_issuer is None else IdentityProvider(settings)
        self.refusal_brake = RefusalBrake()
        self.turns = Turns()
        self.compute_threads = ComputeThreads()
        self.children = children or Children(settings.child_limits, LOADED_FIRST if settings.warm_up else MODULES_FIRST)
        self.disk = DiskSpace(settings.data, settings.min_free_bytes)
        self.memory = RequestMemory(settings.request_memory_bytes)
        self.index_files = IndexFiles(settings.data / INDEX_COPIES)
        self.upload_hashes = UploadHashes(database)
        self._faults: list[str] = []
        self._tokens_noted: LruCache[str, float] = LruCache(max_entries=TOKENS_REMEMBERED)
        self._client_keys: LruCache[str, str] = LruCache(max_entries=TOKENS_REMEMBERED)
        """Keys that `client_key` returns, by `token_hash`; "" if the token was refused."""
        self._seal_key = database.read(SYSTEM, read_seal_key)
        self.queue_policy = QueuePolicy(settings.lease_ttl_s, settings.heartbeat_s, settings.cancel_grace_s)
        self.start_grace = StartGrace(self.queue_policy)
        self.worker_memory = WorkerMemory(most_of_user=settings.user_workers)
        self._reading_figures: asyncio.Task[None] | None = None
        self._watch()

    def _watch(self) -> None:
        """Let the metrics show the sizes of queues and pools."""
        passwords = {"passwords": self.password_lane, "passwords-unknown": self.unknown_lane}
        self.metrics.watch({**self.database.lanes, **self.compute_threads.lanes, **passwords})
        self.database.observer = self.metrics.operator
        self.metrics.operator.watch_disk(self.settings.data, self.settings.min_free_bytes)
        self.metrics.children.set_function(lambda: self.children.sizes[0])
        self.metrics.waiting.labels("children").set_function(lambda: self.children.sizes[1])
        self.metrics.in_flight.set_function(lambda: len(self.in_flight))
        self.metrics.request_memory.set_function(lambda: self.memory.held_bytes)
        self.metrics.database_connections.set_function(lambda: self.database.connections_in_use)

    def note_faults(self, faults: Sequence[str]) -> None:
        """Log whether the server is ready, if this or the reasons have changed since the last call.

        `faults` are the reasons why the server is not ready; empty: it is ready.
        """
        if list(faults) != self._faults:
            self._faults = list(faults)
            if faults:
                log.warning("not ready: %s", "; ".join(faults))
            else:
                log.info("ready again")

    def client_key(self, token: str) -> str | None:
        """Return the key of the client to which a token belongs, or None if the token is not known.

        A token is known if a request with it was accepted before. All tokens of a user belong to one client, so that
        nobody gets more than one share by creating tokens. Each worker and each attempt is a client of its own. The
        token of an attempt is known before its first request, because its seal shows that a server has issued it.
        """
        hashed = token_hash(token)
        key = self._client_keys.get(hashed)
        if key is None and is_sealed(token, self._seal_key):
            return hashed
        return key or None

    def forget_client(self, token: str) -> None:
        """Treat a token that is no longer valid as unknown, until a request with it is accepted again."""
        if self.client_key(token) is not None:  # invented tokens must not displace others
            self._client_keys.put(token_hash(token), "")

    def note_use(self, token: str, principal: Principal) -> None:
        """Record the use of a token; each token is updated in the database at most once per `NOTE_USE_EVERY_S`."""
        hashed = token_hash(token)
        user_id = None if scopes.only_work(principal.scopes) else principal.user_id
        self._client_keys.put(hashed, user_id or hashed)
        token_id, now = principal.token_id, time.monotonic()
        if token_id is None or principal.kind == "pod":  # the token of a pod has no row
            return
        noted = self._tokens_noted.get(token_id)
        if noted is not None and now - noted < tokens.NOTE_USE_EVERY_S:
            return
        self._tokens_noted.put(token_id, now)
        with suppress(UnavailableProblem):  # too many writes wait: a later use is recorded
            self.database.submit_write(SYSTEM, tokens.note_use, token_id)

    async def refresh_figures(self) -> None:
        """Begin to read the numbers about the queue and stored data for the metrics, unless they were read recently.

        The method does not wait for the result, which later requests for metrics show. But if no numbers have been read
        yet, it waits, at most `FIGURES_WAIT_S` seconds.
        """
        if (self._reading_figures is None or self._reading_figures.done()) and self.metrics.operator.is_due:
            self._reading_figures = asyncio.create_task(self._read_figures())
        if self._reading_figures is not None and not self.metrics.operator.has_figures:
            await asyncio.wait({self._reading_figures}, timeout=FIGURES_WAIT_S)

    async def _read_figures(self) -> None:
        shown, begun_s = self.metrics.operator, time.monotonic()
        run = partial(read_figures, heard=self.worker_memory.heard(), version=version("marey"))
        try:
            shown.show(await asyncio.wrap_future(self.database.queue_read(SERVER, SYSTEM, run)), self.settings.blobs)
        except ApiProblem as error:
            log.warning("the numbers for metrics cannot be read: %s", error.detail)
        shown.rest(time.monotonic() - begun_s)

    async def number_events(self) -> None:
        """Give numbers to all committed events, so that they can be read. On SQLite, each commit does this itself."""
        numbered = 0 if self.database.is_sqlite else events.NUMBERED_AT_ONCE
        while numbered == events.NUMBERED_AT_ONCE:
            numbered = await asyncio.wrap_future(self.database.submit_write(SYSTEM, events.number_events))

    def end_attempt(self, job_id: str, fence: int) -> None:
        """End the job of an attempt whose author may no longer run jobs; if this fails, the job ends with its lease."""
        with suppress(UnavailableProblem):
            self.database.submit_write(SYSTEM, end_for_lost_author, job_id, fence)

    def close(self) -> None:
        """Stop child processes and threads, wait for running transactions, and close the database."""
        self.children.close()
        self.compute_threads.close()
        self.password_lane.close()
        self.unknown_lane.close()
        self.database.close()
        if self.tracer is not None:
            self.tracer.close()
