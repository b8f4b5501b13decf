"""Dispatcher: starts a pod of its own for each job that needs one, and deletes the pods of jobs that have ended.

The dispatcher stores only the time until which a job waits, and the reason, both in the job. It reads from the cluster
which pods it has started, and computes the names of Kubernetes Jobs and the tokens of pods from the ids of jobs. So a
server may end at any moment: the next server finds all pods.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from marey_schemas.queue.own_pods import IMAGE_VARIABLE, is_allowed_image
from marey_schemas.queue.scripts import REPOSITORIES_VARIABLE, SCRIPT
from marey_schemas.sizes import MIB
from marey_server.access.own_pods import gpus_of
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem
from marey_server.launchers.kubernetes.dispatch_plan import DispatchPlan, Started
from marey_server.launchers.kubernetes.manifests import Manifest, Pool
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.kubernetes.own_pod_jobs import (
    OWN_PODS,
    is_split,
    job_of,
    own_pod_job,
    own_pod_labels,
    places_of,
    pods_of,
)
from marey_server.launchers.kubernetes.states import end_of, group_pods, is_over, stuck_jobs, worker_names
from marey_server.launchers.kubernetes.worker_jobs import WorkerJobs
from marey_server.launchers.launcher import EngineError, WorkerRequest, read_options
from marey_server.launchers.rounds import ServerLead, ask, repeat
from marey_server.process.settings import Settings
from marey_server.process.worker_pools import OwnPods
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import SERVER
from marey_server.store.jobs.claiming.own_pods import WaitingJob, postpone, read_unfinished, read_waiting
from marey_server.store.jobs.claiming.rights import pod_token, read_pod_key
from marey_server.store.transaction import Transaction

log = logging.getLogger(__name__)
T = TypeVar("T")

ROUND_S = 2.0
RENEW_LEAD_S = 15.0
"""Seconds after which this process renews its lease as the leader; so not every round writes to the database."""
WORKER_MB = 512
"""Memory of a pod in MiB in addition to the memory limit of its job, for the process that talks to the server."""
AFTER_REFUSAL_S = 60.0
"""Seconds after which a job of the queue is started again if the cluster has refused its Job."""
DELETE_AFTER_S = 10.0
"""Seconds from the end of a job to the deletion of its pods; pods that end by themselves before keep their logs."""


class Dispatcher:
    """Task that starts and deletes the pods of jobs that need a pod of their own.

    Workers reach the server at `url`. `clock_s` is a monotonic clock in seconds.
    """

    def __init__(
        self, settings: Settings, database: Database, url: str, *, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        assert settings.own_pods is not None
        self._rules: OwnPods = settings.own_pods
        given = {**settings.launcher_options, **self._rules.options}
        self._options = read_options(ClusterOptions, given, "kubernetes")
        self._settings = settings
        self._database = database
        self._url = url
        self._clock_s = clock_s
        self._lead = ServerLead(database, "own pods")
        self._lead_until_s = float("-inf")
        key = database.read(SYSTEM, read_pod_key)
        self._jobs = WorkerJobs(self._options, own_pod_labels(self._options), lambda job: pod_token(key, job_of(job)))
        self._plan = DispatchPlan(self._rules.most, self._rules.most_of_project, self._rules.patience_s)
        self._ended_at_s: dict[str, float] = {}
        """Time at which this process first saw that the job of a Job has ended, by the name of the Job."""
        self._explained: set[str] | None = None
        """Names of the Jobs whose ends need not be logged again; None: those of all Jobs that have already ended."""
        self._refused: set[str] = set()

    async def keep(self) -> None:
        """Start and delete pods every `ROUND_S` seconds, until the task is cancelled."""
        await repeat("own pods", self.adjust, ROUND_S)

    async def close(self) -> None:
        """Close the connections, and give up the lead, so that another server can dispatch; the pods continue."""
        try:
            await self._jobs.close()
            await self._lead.give_up()
        except (EngineError, ApiProblem) as error:
            log.warning("own pods: %s", getattr(error, "detail", error))

    async def adjust(self) -> None:
        """Start and delete pods once, if this process is the leader.

        Raises `EngineError` if the cluster refuses a request, and `ApiProblem` if the database cannot be used.
        """
        if not await self._leads():
            self._explained = None
            return
        await ask(self._jobs.refresh())
        self._explain_ends()
        await self._delete_finished()
        await self._start_waiting()
        await self._step_back()

    async def _leads(self) -> bool:
        now_s = self._clock_s()
        if now_s >= self._lead_until_s:
            leads = await self._lead.take()
            self._lead_until_s = now_s + RENEW_LEAD_S if leads else float("-inf")
        return now_s < self._lead_until_s

    # -- starts --

    async def _start_waiting(self) -> None:
        jobs = self._jobs.view.jobs
        served = [place.job for job in jobs.values() if not is_split(job) for place in places_of(job)]
        split = {job_of(job): pods_of(job) for job in jobs.values() if is_split(job) and not is_over(job)}
        limit = self._rules.most + len(jobs) + len(self._refused)  # so that refused jobs keep none of the others out
        waiting = await self._read(lambda tx: read_waiting(tx, limit, served, split))
        starts = self._plan.decide(self._clock_s(), list(filter(self._is_allowed, waiting)), jobs)
        if not starts:
            return
        asked = {job["metadata"]["name"]: job for job in map(self._job, starts)}
        made, refused = await ask(self._jobs.create_allowed(asked.values()))
        if made:
            log.info("own pods: started %s", ", ".join(job["metadata"]["name"] for job in made))
        for name, reason in refused.items():
            await self._postpone(asked[name], f"the cluster refused the pod: {reason}", AFTER_REFUSAL_S)

    async def _step_back(self) -> None:
        """Delete pods that have long waited for a node if other jobs need pods; the jobs of these pods start later."""
        jobs = dict(self._jobs.view.jobs)
        stuck = stuck_jobs(jobs, self._jobs.view.pods.values())
        pause_s = self._rules.patience_s
        for name in self._plan.step_back(self._clock_s(), {name: jobs[name] for name in stuck}):
            reason = f"no node ran the pod within {pause_s} s, so it was deleted in favour of other jobs: {stuck[name]}"
            if await self._postpone(jobs[name], reason, pause_s):
                await ask(self._jobs.delete(name))

    async def _postpone(self, job: Manifest, reason: str, pause_s: float) -> bool:
        """Delay the next start of a Kubernetes Job's queue job, or of its tasks, by at least `pause_s` seconds.

        Return False if none of these jobs is queued.
        """
        of_job = partial(postpone, job_id=job_of(job), reason=reason, pause_s=pause_s, tasks=is_split(job))
        postponed = await asyncio.wrap_future(self._database.submit_write(SYSTEM, of_job))
        if postponed:
            log.warning("own pods: %s starts in %d s at the earliest: %s", job_of(job), pause_s, reason)
        return postponed

    def _is_allowed(self, one: WaitingJob) -> bool:
        """Return whether the settings still allow the image of a job; if not, log this once for each job."""
        if one.image is None or is_allowed_image(one.image, self._rules.images):
            return True
        if one.id not in self._refused:
            self._refused.add(one.id)
            log.warning("%s cannot start: `images` of `own_pods` no longer allows %s", one.id, one.image)
        return False

    def _job(self, start: Started) -> Manifest:
        one = start.job
        request = WorkerRequest(
            labels=one.labels, kinds=(one.kind,), cpus=self._rules.cpus, gpus=gpus_of(one.labels),
            memory_bytes=(one.memory_limit_mb + WORKER_MB) * MIB,
        )  # fmt: skip
        changes: dict[str, Any] = {"node_selector": self._nodes_for(one)}
        if one.image is not None:
            changes["image"] = one.image
        options = self._options.model_copy(update=changes)
        settings = self._settings
        pool = Pool(OWN_PODS, self._url, options, request, settings.log_form, settings.log_level)
        variables = {}
        if one.kind == SCRIPT:
            variables[REPOSITORIES_VARIABLE] = json.dumps(settings.script_repositories)
        if one.image is not None:
            variables[IMAGE_VARIABLE] = one.image
        return own_pod_job(pool, start.dispatch, time_limit_s=one.time_limit_s, environment=variables)

    def _nodes_for(self, one: WaitingJob) -> dict[str, str]:
        """Return the labels that a node must have to run a job, from the options and the labels of the job."""
        selector = dict(self._options.node_selector)
        for name, text in one.labels.items():
            selector |= self._rules.labels.get(f"{name}={text}", {})
        return selector

    # -- ends --

    async def _delete_finished(self) -> None:
        """Delete the unfinished Kubernetes Jobs whose queue job has ended or was purged.

        A Kubernetes Job with pods is deleted only `DELETE_AFTER_S` seconds after the end of its queue job was noticed.
        """
        alive = {name: job_of(job) for name, job in self._jobs.view.jobs.items() if not is_over(job)}
        unfinished = await self._read(lambda tx: read_unfinished(tx, sorted(set(alive.values()))))
        over = [name for name, job_id in alive.items() if job_id not in unfinished]
        now_s = self._clock_s()
        self._ended_at_s = {name: self._ended_at_s.get(name, now_s) for name in over}
        running = group_pods(self._jobs.view.pods.values())
        late = [
            name for name, since_s in self._ended_at_s.items()
            if now_s - since_s >= DELETE_AFTER_S or not any(map(running.get, worker_names(self._jobs.view.jobs[name])))
        ]  # fmt: skip
        if late:
            await ask(self._jobs.all(self._jobs.delete(name) for name in late))
            log.info("own pods: deleted %s, whose jobs have ended", ", ".join(late))

    def _explain_ends(self) -> None:
        """Log why Kubernetes Jobs have failed since the last round."""
        over = {name: job for name, job in self._jobs.view.jobs.items() if is_over(job)}
        pods = group_pods(self._jobs.view.pods.values())
        for name in sorted(over.keys() - (over.keys() if self._explained is None else self._explained)):
            of_job = [pod for worker in worker_names(over[name]) for pod in pods.get(worker, ())]
            end = end_of(over[name], of_job)
            if end is not None and end.reason != "finished":
                log.warning("pod of %s ended: %s, status %s. %s", name, end.reason, end.status, end.detail)
        self._explained = set(over)

    async def _read(self, function: Callable[[Transaction], T]) -> T:
        return await asyncio.wrap_future(self._database.queue_read(SERVER, SYSTEM, function))
