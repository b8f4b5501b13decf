"""Copy of the Jobs and pods of a pool: regular lists of the cluster replace it, and watches update it in between."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from marey_schemas.backoff import Backoff
from marey_server.launchers.kubernetes.cluster import Cluster, Kind, VersionGone
from marey_server.launchers.kubernetes.manifests import Manifest
from marey_server.launchers.launcher import EngineError

log = logging.getLogger(__name__)

KINDS: tuple[Kind, ...] = ("jobs", "pods")
PAUSES = Backoff(first_s=0.5, longest_s=15.0)
MOST_DELETED = 1024
"""Number of deleted Jobs whose ids are remembered, so that a list that began before does not add them again."""
SHORT_WATCH_S = 1.0
"""Duration in seconds below which a watch counts as failed, so that a pause follows before the next request."""


class ClusterView:
    """Copy of the Jobs and pods of a pool.

    The objects are listed every `relist_s` seconds. A watch reports changes between two lists; if the watch fails, the
    changes become visible with the next list.
    """

    def __init__(self, cluster: Cluster, selector: str, *, relist_s: int, timeout_s: float) -> None:
        self._cluster = cluster
        self._selector = selector
        self._relist_s = relist_s
        self._stale_s = 2 * (relist_s + timeout_s)
        self._objects: dict[Kind, dict[str, Manifest]] = {"jobs": {}, "pods": {}}
        self._listed_at: dict[Kind, float] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._changing: list[_Changed] = []
        self._deleted: deque[str] = deque(maxlen=MOST_DELETED)

    async def refresh(self) -> None:
        """Follow the cluster, and list objects again if their copy is too old.

        Raises `EngineError` if the cluster does not answer.
        """
        if not self._tasks:
            self._tasks = [asyncio.create_task(self._follow(kind)) for kind in KINDS]
        for kind in KINDS:
            if time.monotonic() - self._listed_at.get(kind, float("-inf")) > self._stale_s:
                await self._list(kind)

    async def list_now(self) -> None:
        """List all Jobs and pods, and replace the copies. Raises `EngineError` if the cluster does not answer."""
        for kind in KINDS:
            await self._list(kind)

    @property
    def jobs(self) -> dict[str, Manifest]:
        """The Jobs, by their names."""
        return self._objects["jobs"]

    @property
    def pods(self) -> dict[str, Manifest]:
        """The pods, by their names."""
        return self._objects["pods"]

    def put_job(self, job: Manifest) -> None:
        """Add a Job that was just created; a list that was requested before its creation does not remove it."""
        self._put("jobs", job["metadata"]["name"], job)

    def drop_job(self, name: str) -> None:
        """Remove a Job that was just deleted; no list or watch that began before its deletion adds it again."""
        if (job := self.jobs.get(name)) is not None:
            self._deleted.append(job["metadata"]["uid"])
        self._put("jobs", name, None)

    async def close(self) -> None:
        """Stop following the cluster."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks = []

    async def _list(self, kind: Kind) -> str:
        """Replace the copies of the objects of a kind by a new list; return the version of the list."""
        with self._noting_changes() as changed:
            listed = await self._cluster.list(kind, self._selector)
        self._objects[kind] = {name: one for name, one in listed.objects.items() if not self._is_deleted(one)}
        for of_kind, name, document in changed:
            if of_kind == kind:
                self._apply(kind, name, document)
        self._listed_at[kind] = time.monotonic()
        return listed.version

    async def _follow(self, kind: Kind) -> None:
        """Keep the copies of one kind of objects up to date until the task is cancelled.

        Log each failure, and pause after it.
        """
        failures = 0
        while True:
            began = time.monotonic()
            try:
                version = await self._list(kind)
                began = time.monotonic()
                async for change in self._cluster.watch(kind, self._selector, version, self._relist_s):
                    metadata = change.document["metadata"]
                    self._put(kind, metadata["name"], None if change.deleted else change.document)
                failures = failures + 1 if time.monotonic() - began < SHORT_WATCH_S else 0
            except VersionGone:
                failures = failures + 1 if time.monotonic() - began < SHORT_WATCH_S else 1
            except EngineError as error:
                failures += 1
                log.warning("the %s of workers cannot be followed: %s", kind, error)
            except Exception:
                failures += 1
                log.exception("the %s of workers cannot be followed", kind)
            if failures:
                await asyncio.sleep(PAUSES.delay_s(failures))

    def _put(self, kind: Kind, name: str, document: Manifest | None) -> None:
        self._apply(kind, name, document)
        for changed in self._changing:
            changed.append((kind, name, document))

    def _apply(self, kind: Kind, name: str, document: Manifest | None) -> None:
        if document is None or self._is_deleted(document):
            self._objects[kind].pop(name, None)
        else:
            self._objects[kind][name] = document

    def _is_deleted(self, document: Manifest) -> bool:
        return document["metadata"]["uid"] in self._deleted

    @contextmanager
    def _noting_changes(self) -> Iterator[_Changed]:
        """Collect the changes that watches report while a list is requested; they are newer than the list."""
        changed: _Changed = []
        self._changing.append(changed)
        try:
            yield changed
        finally:
            self._changing = [other for other in self._changing if other is not changed]


_Changed = list[tuple[Kind, str, Manifest | None]]
