"""Jobs of a cluster that run workers, each with a Secret that contains the token of its workers."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from typing import TypeVar

from marey_server import faults
from marey_server.launchers.kubernetes.cluster import Cluster, NoSuchObject, ObjectExists, ObjectRefused
from marey_server.launchers.kubernetes.manifests import Manifest, token_secret
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.kubernetes.states import blocked_reason, launched_workers, worker_names, worker_of
from marey_server.launchers.kubernetes.view import ClusterView

log = logging.getLogger(__name__)
T = TypeVar("T")

REQUESTS_AT_ONCE = 8


class WorkerJobs:
    """Jobs with certain labels, and their Secrets. Methods raise `EngineError` if a request to the cluster fails.

    `token_of` returns the token of the workers of a Job. It must always return the same token for the same Job: if a
    server ends after it has created a Job, the next server creates the Secret of the Job.
    """

    def __init__(self, options: ClusterOptions, labels: Mapping[str, str], token_of: Callable[[Manifest], str]) -> None:
        self.cluster = Cluster(options)
        selector = ",".join(f"{name}={text}" for name, text in labels.items())
        self.view = ClusterView(self.cluster, selector, relist_s=options.relist_s, timeout_s=options.timeout_s)
        self._token_of = token_of
        self._with_token: set[str] = set()
        self._blocked: dict[str, str] = {}
        self._requests = asyncio.Semaphore(REQUESTS_AT_ONCE)

    async def refresh(self) -> None:
        """Update the copies of Jobs and pods if they are too old, and create missing Secrets of Jobs."""
        await self.view.refresh()
        await self._supply_tokens()
        self._log_blocked()

    async def create(self, jobs: Iterable[Manifest]) -> Sequence[Manifest]:
        """Create Jobs with their Secrets, and return them.

        A Job that exists already is returned. Raises `ObjectRefused` if the cluster refuses a Job, or if it has another
        Job with the same name.
        """
        return await self.all(self._create(job) for job in jobs)

    async def create_allowed(self, jobs: Iterable[Manifest]) -> tuple[list[Manifest], dict[str, str]]:
        """Create Jobs as `create` does, except those that the cluster refuses.

        Return the Jobs that exist now, and the reason for each refused Job by its name.
        """
        refused: dict[str, str] = {}

        async def create(job: Manifest) -> Manifest | None:
            try:
                return await self._create(job)
            except ObjectRefused as error:
                refused[job["metadata"]["name"]] = str(error)
                return None

        made = await self.all(map(create, jobs))
        return [job for job in made if job is not None], refused

    async def delete(self, job: str) -> bool:
        """Delete a Job with its pods and its Secret; return whether the Job existed."""
        existed = True
        try:
            await self.cluster.delete_job(job)
        except NoSuchObject:
            log.debug("the Job %s has been deleted already", job)
            existed = False
        self.view.drop_job(job)
        return existed

    async def close(self) -> None:
        """Close the connections; the workers continue."""
        await self.view.close()
        await self.cluster.close()

    async def all(self, calls: Iterable[Awaitable[T]]) -> Sequence[T]:
        """Run all calls, several at a time, and return their results; raise the first error after all have ended."""

        async def limited(call: Awaitable[T]) -> T:
            async with self._requests:
                return await call

        results = await asyncio.gather(*map(limited, calls), return_exceptions=True)
        for result in results:
            if isinstance(result, BaseException):
                raise result
        return [result for result in results if not isinstance(result, BaseException)]

    async def _create(self, job: Manifest) -> Manifest:
        name: str = job["metadata"]["name"]
        try:
            made = await self.cluster.create_job(job)
        except ObjectExists:
            made = await self.cluster.read_job(name)
            if not job["metadata"]["labels"].items() <= made["metadata"].get("labels", {}).items():
                raise ObjectRefused(
                    f"the cluster has another Job with the name {name}; delete it, or set another `instance`"
                ) from None
        self.view.put_job(made)
        faults.point("dispatch.before_token")
        await self._supply_token(made)
        return made

    async def _supply_tokens(self) -> None:
        """Create missing Secrets of Jobs.

        A server may have died after it created a Job and before it created the Secret.
        """
        jobs = self.view.jobs
        self._with_token &= jobs.keys()
        waiting = {worker.name for worker in launched_workers(jobs.values(), self.view.pods.values())
                   if worker.state == "starting"}  # fmt: skip
        missing = [job for name, job in jobs.items() if name not in self._with_token and waiting & {*worker_names(job)}]
        await self.all(self._supply_token(job) for job in missing)

    async def _supply_token(self, job: Manifest) -> None:
        """Create the Secret with the token of a Job's workers, unless it exists."""
        name = job["metadata"]["name"]
        if name in self._with_token:
            return
        try:
            await self.cluster.create_secret(token_secret(job, self._token_of(job)))
        except ObjectExists:
            log.debug("the Secret of the Job %s exists", name)
        except ObjectRefused:
            await self.delete(name)  # its pods could only wait
            raise
        self._with_token.add(name)

    def _log_blocked(self) -> None:
        """Log why workers cannot start, such as a missing image; once for each worker until it can start."""
        blocked = {name: reason for pod in self.view.pods.values()
                   if (reason := blocked_reason(pod)) is not None and (name := worker_of(pod)) is not None}  # fmt: skip
        for name, reason in blocked.items():
            if name not in self._blocked:
                log.warning("worker %s cannot start: %s", name, reason)
        self._blocked = blocked
