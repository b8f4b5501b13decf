"""State of one server process that every handler may use: database, threads, caches, limits on sign-in."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from marey_schemas.lru import LruCache
from marey_server.access.principal import SYSTEM, Principal
from marey_server.access.secret_tokens import hash_secret
from marey_server.errors import TooManyRequestsProblem, UnavailableProblem
from marey_server.motions.models import UsableModel
from marey_server.motions.models import size_bytes as model_bytes
from marey_server.motions.searching import Searchable, SearchableKey
from marey_server.motions.searching import size_bytes as searchable_bytes
from marey_server.process.computing import ComputeThreads
from marey_server.process.memory import RequestMemory
from marey_server.process.observe import Metrics
from marey_server.process.settings import Settings
from marey_server.store import events, tokens
from marey_server.store.database.connections import Database
from marey_server.store.jobs.policy import QueuePolicy
from marey_server.store.jobs.reaper import StartGrace

NAMES_REMEMBERED = 10_000
SIGN_INS_AT_ONCE = 2
"""Greatest number of passwords checked at once; each check needs 32 MiB and 0.1 s."""
LARGEST_ANSWER_SHARE = 8
"""Largest part of the cache of answers that one body may take; larger bodies would displace all others."""
ANSWER_ENTRY_BYTES = 512
"""Memory in bytes of an entry in the cache of answers, in addition to its body."""
MODEL_CACHE_BYTES = 64 << 20
"""Greatest size of the cache of parsed models; models with search trees have a cache of the same size."""
TOKENS_REMEMBERED = 10_000
ADMISSIONS_REMEMBERED = 10_000


class TryLimit:
    """Limit of tries per minute and key (token bucket).

    Only the latest `NAMES_REMEMBERED` keys are stored, so that guesses at many names do not fill the memory.
    """

    def __init__(self, per_minute: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_minute = per_minute
        self._clock = clock
        self._buckets: LruCache[str, tuple[float, float]] = LruCache(max_entries=NAMES_REMEMBERED)

    def take(self, key: str) -> None:
        """Count one try. Raises `TooManyRequestsProblem`, which says when the next try is allowed."""
        now = self._clock()
        left, since = self._buckets.get(key) or (float(self._per_minute), now)
        left = min(float(self._per_minute), left + (now - since) * self._per_minute / 60)
        if left < 1:
            self._buckets.put(key, (left, now))
            wait_s = math.ceil((1 - left) * 60 / self._per_minute)
            raise TooManyRequestsProblem(f"Too many attempts; wait {wait_s} s.", headers={"Retry-After": str(wait_s)})
        self._buckets.put(key, (left - 1, now))


@dataclass(frozen=True)
class Description:
    """Description of the API as bytes: the OpenAPI document, the HTML page, and the entity tag of both."""

    document: bytes
    page: bytes
    tag: str


class Services:
    """Database, threads, metrics and the state of a server that is starting, serving or draining."""

    def __init__(self, settings: Settings, database: Database, description: Callable[[], Description]) -> None:
        self.settings = settings
        self.database = database
        self.description = description
        self.metrics = Metrics()
        self.answers: LruCache[tuple[str, str], bytes] = LruCache(
            max_bytes=settings.answer_cache_bytes,
            largest_bytes=settings.answer_cache_bytes // LARGEST_ANSWER_SHARE,
            size_of=lambda body: len(body) + ANSWER_ENTRY_BYTES,
        )
        self.models: LruCache[str, UsableModel] = LruCache(max_bytes=MODEL_CACHE_BYTES, size_of=model_bytes)
        self.searchables: LruCache[SearchableKey, Searchable] = LruCache(
            max_bytes=MODEL_CACHE_BYTES, size_of=searchable_bytes
        )
        self.admitted: LruCache[Hashable, float] = LruCache(max_entries=ADMISSIONS_REMEMBERED)
        """Times at which callers were admitted, by what the admission depends on."""
        self.draining = asyncio.Event()
        self.in_flight: set[Any] = set()
        self.metrics.in_flight.set_function(lambda: len(self.in_flight))
        self.sign_in_places = asyncio.Semaphore(SIGN_INS_AT_ONCE)
        self.compute_threads = ComputeThreads()
        self.memory = RequestMemory(settings.request_memory_bytes)
        self._tries_by_name = TryLimit(settings.login_tries_per_minute)
        self._tries_by_address = TryLimit(10 * settings.login_tries_per_minute)
        self._tokens_noted: LruCache[str, float] = LruCache(max_entries=TOKENS_REMEMBERED)
        self._tokens_known: LruCache[str, bool] = LruCache(max_entries=TOKENS_REMEMBERED)
        self.queue_policy = QueuePolicy(settings.lease_ttl_s, settings.heartbeat_s, settings.cancel_grace_s)
        self.start_grace = StartGrace(self.queue_policy)

    def limit_sign_in(self, name: str, address: str) -> None:
        """Count one attempt to sign in. Raises `TooManyRequestsProblem`."""
        self._tries_by_address.take(address)
        self._tries_by_name.take(name)

    def knows(self, token: str) -> bool:
        """Return whether a request with this token was accepted before, so that its caller has lines of its own."""
        return self._tokens_known.get(hash_secret(token)) is not None

    def note_use(self, token: str, principal: Principal) -> None:
        """Record the use of a token, in the database at most once in `NOTE_USE_EVERY_S` for each."""
        self._tokens_known.put(hash_secret(token), True)
        token_id, now = principal.token_id, time.monotonic()
        if token_id is None:
            return
        noted = self._tokens_noted.get(token_id)
        if noted is not None and now - noted < tokens.NOTE_USE_EVERY_S:
            return
        self._tokens_noted.put(token_id, now)
        with suppress(UnavailableProblem):  # too many writes wait: a later use is recorded
            self.database.submit_write(SYSTEM, tokens.note_use, token_id)

    async def number_events(self) -> None:
        """Make all events that are committed by now visible in the feed; SQLite does so by itself."""
        numbered = 0 if self.database.is_sqlite else events.NUMBERED_AT_ONCE
        while numbered == events.NUMBERED_AT_ONCE:
            numbered = await asyncio.wrap_future(self.database.submit_write(SYSTEM, events.number_events))

    def close(self) -> None:
        """Wait for running transactions, then close everything."""
        self.compute_threads.close()
        self.database.close()
