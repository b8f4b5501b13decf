"""Launcher that runs each worker as a Job of a Kubernetes cluster, or workers that start together as an Indexed Job."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Iterable, Sequence

from marey_server.launchers.kubernetes.cluster import NoSuchObject
from marey_server.launchers.kubernetes.manifests import Manifest, Pool, job_labels, worker_job
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.kubernetes.states import (
    end_of,
    group_pods,
    has_ended,
    has_terminated,
    launched_workers,
    worker_names,
    worker_of,
)
from marey_server.launchers.kubernetes.worker_jobs import WorkerJobs
from marey_server.launchers.launcher import (
    EngineError,
    LaunchContext,
    LaunchedWorker,
    WorkerEnd,
    WorkerRequest,
    read_options,
)

log = logging.getLogger(__name__)

MOST_REMEMBERED = 1024
"""Number of stopped workers that are remembered."""


def make_kubernetes_launcher(context: LaunchContext) -> KubernetesLauncher:
    """Return the launcher of a pool. Raises `LauncherUnusable` if an option is invalid."""
    return KubernetesLauncher(context, read_options(ClusterOptions, context.options, "kubernetes"))


class KubernetesLauncher:
    """Launcher that runs workers as pods of a cluster. The pods continue when the server ends."""

    outlives_server = True

    def __init__(self, context: LaunchContext, options: ClusterOptions) -> None:
        self._context = context
        self._options = options
        self._jobs = WorkerJobs(options, job_labels(context.pool, options), lambda _: context.token)
        self._view, self._cluster = self._jobs.view, self._jobs.cluster
        self._stopped: dict[str, None] = {}

    async def start(self, request: WorkerRequest, count: int, *, key: str) -> tuple[str, ...]:
        """Create the Jobs of `count` workers. If a Job with the same name exists already, it is left unchanged."""
        context = self._context
        pool = Pool(context.pool, context.url, self._options, request, context.log_form, context.log_level)
        base = f"{self._options.instance}-{context.pool}-{key}"
        if self._options.indexed and count > 1:
            jobs = [worker_job(pool, base, count=count)]
        else:
            jobs = [worker_job(pool, f"{base}-{number}") for number in range(count)]
        made = await self._jobs.create(jobs)
        return tuple(name for job in made for name in worker_names(job))

    async def list(self) -> tuple[LaunchedWorker, ...]:
        """Return the workers of all Jobs of the pool; ended workers stay until the cluster deletes their Jobs."""
        await self._jobs.refresh()
        return tuple(launched_workers(self._view.jobs.values(), self._view.pods.values()))

    async def stop(self, names: tuple[str, ...]) -> None:
        """Delete the Jobs of workers, or their pods if other workers of an Indexed Job continue.

        Raises `EngineError` for workers of such an Indexed Job that have no pods yet.
        """
        await self._view.refresh()
        wanted = set(names)
        deletions: list[Awaitable[None]] = []
        without_pod: list[str] = []
        for job in list(self._view.jobs.values()):
            active = {name for name in worker_names(job) if not has_ended(job, name)}
            if not active & wanted:
                continue
            if active <= wanted:
                deletions.append(self._delete_job(job["metadata"]["name"], active))
                continue
            pods = {worker_of(pod): pod["metadata"]["name"] for pod in self._view.pods.values()}
            for name in active & wanted:
                if name in pods:
                    deletions.append(self._delete_pod(pods[name], name))
                else:
                    without_pod.append(name)
        await self._jobs.all(deletions)
        if without_pod:
            listed = ", ".join(sorted(without_pod))
            raise EngineError(
                f"these workers of an Indexed Job cannot be stopped yet, because they have no pods: {listed}"
            )

    async def why_ended(self, name: str) -> WorkerEnd | None:
        """Return why a worker ended, according to its pod or its Job.

        The result is None if the worker has not ended, and has the reason `unknown` if the cluster has deleted both.
        """
        await self._view.refresh()
        if name in self._stopped:
            return WorkerEnd("stopped")
        if not any(map(has_terminated, self._pods_of(name))):
            await self._view.list_now()  # the copy of the pods may be older than that of the Jobs
        pods = self._pods_of(name)
        job = next((job for job in self._view.jobs.values() if name in worker_names(job)), None)
        end = end_of(job, pods)
        if end is None and job is None:
            return WorkerEnd("unknown", detail="the cluster has no Job of this worker")
        if end is not None and end.reason == "failed" and pods:
            return await self._with_log(end, pods[-1]["metadata"]["name"])
        return end

    async def close(self) -> None:
        """Close the connections; the workers continue."""
        await self._jobs.close()

    # -- Jobs --

    async def _delete_job(self, job: str, workers: Iterable[str]) -> None:
        if await self._jobs.delete(job):
            self._remember_stopped(workers)

    async def _delete_pod(self, pod: str, worker: str) -> None:
        try:
            await self._cluster.delete_pod(pod)
        except NoSuchObject:
            log.debug("the pod %s has been deleted already", pod)
        else:
            self._remember_stopped([worker])

    def _remember_stopped(self, workers: Iterable[str]) -> None:
        self._stopped |= dict.fromkeys(workers)
        for name in list(self._stopped)[:-MOST_REMEMBERED]:
            del self._stopped[name]

    # -- ends --

    def _pods_of(self, worker: str) -> Sequence[Manifest]:
        """Return the pods of a worker, the newest last."""
        return group_pods(self._view.pods.values()).get(worker, [])

    async def _with_log(self, end: WorkerEnd, pod: str) -> WorkerEnd:
        """Add the last lines of the pod's log to the end of a worker, if the cluster still has them."""
        try:
            lines = await self._cluster.read_log(pod)
        except EngineError as error:
            log.debug("the log of the pod %s cannot be read: %s", pod, error)
            return end
        return WorkerEnd(end.reason, end.status, f"{end.detail}\n{lines}".strip())
