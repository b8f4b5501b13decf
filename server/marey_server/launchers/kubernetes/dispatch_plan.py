"""Decisions on which waiting jobs get pods of their own now, and which waiting pods are deleted again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from marey_schemas.backoff import Backoff
from marey_server.launchers.kubernetes.own_pod_jobs import (
    Dispatch,
    PodPlace,
    dispatch_of,
    job_of,
    places_of,
    pods_of,
    project_of,
)
from marey_server.launchers.kubernetes.states import is_over
from marey_server.store.jobs.claiming.own_pods import WaitingJob

MOST_INDEXES = 10_000
"""Greatest number of tasks of one Indexed Job; each task of a larger job has a Job of its own."""
PAUSES = Backoff(first_s=5.0, longest_s=600.0, jitter=0.25)
"""Pauses before the next start for a job whose pods have ended without a claim."""


@dataclass(frozen=True)
class Started:
    """Start of pods for a job of the queue.

    `job` is one of the waiting jobs to start; if these are tasks of a parent job, it is the first of them.
    """

    job: WaitingJob
    dispatch: Dispatch


@dataclass
class _StartGroup:
    """Single job, or tasks of a parent job that start together in one Kubernetes Job.

    `job` is the single job, or the first of the tasks. `size` is the number of all tasks of the parent job, and None
    for a single job. The group can use at most `most` pods; `places` counts the pods that it gets.
    """

    job: WaitingJob
    size: int | None
    most: int
    places: int = 0


@dataclass
class DispatchPlan:
    """Plan of a dispatcher: decides which jobs get pods, and which pods are deleted.

    At most `most` pods exist at the same time, and at most `most_of_project` pods of each project. If no node runs a
    pod for `patience_s` seconds, and other jobs wait for a pod, the pod is deleted. The plan remembers since when such
    pods have waited, and when the next pod of a job may start after pods ended without a claim.
    """

    most: int
    most_of_project: int | None = None
    patience_s: float = float("inf")
    _lacking: int = 0
    """Number of starts that the last decision postponed, without those in `_lacking_of`."""
    _lacking_of: dict[str, int] = field(default_factory=dict)
    """Number of starts that the last decision postponed, for each project that has its greatest number of pods.

    Such a start is possible only after pods of the same project were deleted or have ended.
    """
    _stuck_since_s: dict[str, float] = field(default_factory=dict)
    _next_s: dict[str, float] = field(default_factory=dict)
    """Time of the next start of a job, by the name of the Job that ended without a claim."""

    def decide(
        self, now_s: float, waiting: Sequence[WaitingJob], jobs: Mapping[str, Mapping[str, Any]]
    ) -> list[Started]:
        """Return the starts of pods that are due now.

        Parameters
        ----------
        now_s : time of a monotonic clock, in seconds
        waiting : jobs of the queue that wait for a pod, in the order of claims
        jobs : Kubernetes Jobs that the cluster has, by name
        """
        served = {place for job in jobs.values() for place in places_of(job)}
        numbers = _newest_numbers(jobs.values())
        held = self._held_back(now_s, waiting, jobs)
        due = [one for one in waiting if one.id not in held and not served & {*_places_of(one)}]
        return [_start(group, numbers) for group in self._share(_grouped(due, numbers), jobs.values())]

    def step_back(self, now_s: float, stuck: Mapping[str, Mapping[str, Any]]) -> list[str]:
        """Return the names of Kubernetes Jobs to delete, longest stuck first, so that other waiting jobs can get pods.

        `stuck` contains the Kubernetes Jobs whose pods no node runs, by name. Only Jobs that have been stuck for
        `patience_s` seconds are deleted, and at most one for each start that the last call of `decide` postponed.
        """
        self._stuck_since_s = {name: self._stuck_since_s.get(name, now_s) for name in stuck}
        late = [name for name, since_s in self._stuck_since_s.items() if now_s - since_s >= self.patience_s]
        chosen: list[str] = []
        for name in sorted(late, key=self._stuck_since_s.__getitem__):
            project = project_of(stuck[name])
            if self._lacking_of.get(project, 0) > 0:
                self._lacking_of[project] -= 1
            elif self._lacking > 0:
                self._lacking -= 1
            else:
                continue
            chosen.append(name)
        return chosen

    def _share(self, groups: Iterable[_StartGroup], jobs: Iterable[Mapping[str, Any]]) -> list[_StartGroup]:
        """Give each free place to the project that has the fewest pods; return the groups that got a place."""
        pods: Counter[str] = Counter()
        for job in jobs:
            pods[project_of(job)] += pods_of(job)
        room = self.most - pods.total()
        queues: dict[str, list[_StartGroup]] = {}
        for group in groups:
            queues.setdefault(group.job.project, []).append(group)
        share = self.most if self.most_of_project is None else self.most_of_project
        started: list[_StartGroup] = []
        while open_ := [one for one in queues if queues[one] and pods[one] < share]:
            if room <= 0:
                break
            project = min(open_, key=pods.__getitem__)
            group = queues[project][0]
            group.places += 1
            pods[project] += 1
            room -= 1
            if group.places == 1:
                started.append(group)
            if group.places == group.most:
                queues[project].pop(0)
        left = {project: sum(group.places == 0 for group in queue) for project, queue in queues.items()}
        self._lacking_of = {project: count for project, count in left.items() if pods[project] >= share}
        self._lacking = sum(left.values()) - sum(self._lacking_of.values())
        return started

    def _held_back(
        self, now_s: float, waiting: Sequence[WaitingJob], jobs: Mapping[str, Mapping[str, Any]]
    ) -> set[str]:
        """Return the ids of jobs whose pods ended without a claim, and which must wait before their next pod."""
        fences = {one.id: one.fence for one in waiting}
        unclaimed: dict[str, list[str]] = {}
        for name, job in jobs.items():
            if is_over(job) and fences.get(job_of(job)) == dispatch_of(job)[1]:
                unclaimed.setdefault(job_of(job), []).append(name)
        self._next_s = {name: at_s for name, at_s in self._next_s.items() if name in jobs}
        for names in unclaimed.values():
            for name in names:
                self._next_s.setdefault(name, now_s + PAUSES.delay_s(len(names)))
        return {job_id for job_id, names in unclaimed.items() if any(now_s < self._next_s[name] for name in names)}


def _places_of(one: WaitingJob) -> Iterable[PodPlace]:
    """Yield the ways in which a pod can run a job: as a single job, or, for a task, as a task of its parent job."""
    yield PodPlace(one.id)
    if one.parent is not None:
        yield PodPlace(one.parent, one.position)


def _newest_numbers(jobs: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    numbers: dict[str, int] = {}
    for job in jobs:
        numbers[job_of(job)] = max(numbers.get(job_of(job), 0), dispatch_of(job)[0])
    return numbers


def _start(group: _StartGroup, numbers: Mapping[str, int]) -> Started:
    one = group.job
    job_id = one.id if group.size is None else str(one.parent)
    number = numbers.get(job_id, one.fence if group.size is None else 0) + 1
    return Started(one, Dispatch(job_id, number, one.fence, group.size, group.places, one.project))


def _grouped(due: Sequence[WaitingJob], numbers: Mapping[str, int]) -> Iterable[_StartGroup]:
    """Yield the groups to start: single jobs, and tasks that start together.

    Tasks start together if they had no pods before, and at least two tasks of the same parent wait. If their project
    has a limit of running jobs, a group gets only as many pods as it has tasks in `due`. These are the tasks that the
    limit lets run now; further pods would occupy nodes while they wait.
    """
    fresh = [one for one in due if one.parent is not None and one.fence == 0 and one.parent not in numbers]
    counts: dict[str, int] = {}
    for one in fresh:
        if one.siblings <= MOST_INDEXES:
            counts[str(one.parent)] = counts.get(str(one.parent), 0) + 1
    seen: set[str] = set()
    for one in due:
        parent = one.parent if one in fresh and counts.get(str(one.parent), 0) > 1 else None
        if parent is None:
            yield _StartGroup(one, None, 1)
        elif parent not in seen:
            seen.add(parent)
            yield _StartGroup(one, one.siblings, counts[parent] if one.limited else one.siblings)
