"""Decision which jobs of the queue get pods now, from the jobs that wait and the Jobs of the cluster."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from marey_schemas.backoff import Backoff
from marey_server.launchers.kubernetes.own_pod_jobs import Dispatch, PodPlace, dispatch_of, job_of, places_of, pods_of
from marey_server.launchers.kubernetes.states import is_over
from marey_server.store.jobs.claiming.own_pods import WaitingJob

MOST_INDEXES = 10_000
"""Greatest number of tasks of one Indexed Job; each task of a larger job has a Job of its own."""
PAUSES = Backoff(first_s=5.0, longest_s=600.0, jitter=0.25)
"""Pauses before the next start for a job whose pods have ended without a claim."""


@dataclass(frozen=True)
class Started:
    """Job of the queue, described by a `WaitingJob` of it or of one of its tasks, and its start."""

    job: WaitingJob
    dispatch: Dispatch


@dataclass
class DispatchPlan:
    """Decisions of a dispatcher. It remembers only when it saw that pods ended without a claim."""

    most: int
    _next_s: dict[str, float] = field(default_factory=dict)
    """Time of the next start of a job, by the name of the Job that ended without a claim."""

    def decide(
        self, now_s: float, waiting: Sequence[WaitingJob], jobs: Mapping[str, Mapping[str, Any]]
    ) -> list[Started]:
        """Return the starts that are due.

        Parameters
        ----------
        now_s : time of a monotonic clock, in seconds
        waiting : jobs that wait for a pod, in the order of claims
        jobs : Jobs of the cluster, by name
        """
        served = {place for job in jobs.values() for place in places_of(job)}
        numbers = _newest_numbers(jobs.values())
        held = self._held_back(now_s, waiting, jobs)
        due = [one for one in waiting if one.id not in held and not served & {*_places_of(one)}]
        room = self.most - sum(map(pods_of, jobs.values()))
        starts: list[Started] = []
        for one, size in _grouped(due, numbers):
            if room <= 0:
                break
            parallel = 1 if size is None else min(size, room)
            job_id = one.id if size is None else str(one.parent)
            number = numbers.get(job_id, one.fence if size is None else 0) + 1
            starts.append(Started(one, Dispatch(job_id, number, one.fence, size, parallel)))
            room -= parallel
        return starts

    def _held_back(
        self, now_s: float, waiting: Sequence[WaitingJob], jobs: Mapping[str, Mapping[str, Any]]
    ) -> set[str]:
        """Return the ids of the jobs whose pods ended without a claim, and whose pause is not over yet."""
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
    """Yield the places in which a job may run: of its own, and among the tasks of its parent."""
    yield PodPlace(one.id)
    if one.parent is not None:
        yield PodPlace(one.parent, one.position)


def _newest_numbers(jobs: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    numbers: dict[str, int] = {}
    for job in jobs:
        numbers[job_of(job)] = max(numbers.get(job_of(job), 0), dispatch_of(job)[0])
    return numbers


def _grouped(due: Sequence[WaitingJob], numbers: Mapping[str, int]) -> Iterable[tuple[WaitingJob, int | None]]:
    """Yield the jobs to start, each with the number of its siblings if all of them start together.

    Tasks start together if none of them had a pod before, and at least two of them wait.
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
            yield one, None
        elif parent not in seen:
            seen.add(parent)
            yield one, one.siblings
