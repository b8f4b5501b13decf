"""Mixed jobs of a trial, and their outcomes in a form that is the same in every project and on every server."""

from __future__ import annotations

import contextlib
import json
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from marey_client import Marey
from marey_client.blobs import Blobs
from marey_client.errors import Conflict
from marey_client.imports import find_files
from marey_client.load.scratch import CLIP, UNIT_SCALE_M
from marey_client.project import ProjectHandle
from marey_schemas.access import ProjectCreate
from marey_schemas.items import Event
from marey_schemas.queue.jobs import Job, JobCreate, JobState

MAX_ATTEMPTS = 20
"""Number of attempts of each job: the greatest that the server allows, because many faults can meet the same job."""
ENDS = {"job.succeeded", "job.failed", "job.cancelled"}
ON_SCHEDULE = {"a": 4711, "b": 0}
SAME = ("sum", "seen", "seed")
"""Members of results that are the same in every run; others contain ids of items or processes."""


@dataclass
class Ends:
    """Outcomes of the jobs of a project."""

    jobs: dict[str, str]
    """State, failure and result of each job, by its label."""
    contents: dict[str, str]
    """Kind and digests of the parts of every item, by its path."""
    faults: list[str]
    """Rules that were broken: jobs that ended twice, succeeded with an old fence, or were made twice."""
    attempts: Counter[str]


@dataclass
class Workload:
    """Jobs whose results go to one folder of a project. The same numbers give the same jobs in every folder."""

    marey: Marey
    lab: ProjectHandle
    folder: str
    clips: list[str]
    rig: str
    slow_s: float
    """Duration of the jobs that draw a skeleton, in seconds."""
    kinds: tuple[str, ...]
    """Kinds of jobs; each call of `submit` takes the next kind."""
    submitted: dict[str, str] = field(default_factory=dict)
    """Ids of the jobs by label."""
    cancelled: set[str] = field(default_factory=set)
    """Labels of jobs whose cancellation the server has confirmed."""
    earlier: set[str] = field(default_factory=set)
    """Ids of the jobs of earlier workloads in the project."""

    def submit(self, number: int) -> None:
        """Submit the next jobs: one, or several that depend on each other."""
        KINDS[self.kinds[number % len(self.kinds)]](self, number)

    def beside(self, folder: str) -> Workload:
        """Return the same workload for another folder."""
        return replace(self, folder=folder, submitted={}, cancelled=set(), earlier=self.earlier | set(self._ids()))

    def add(self, label: str, kind: str, **request: Any) -> str:
        """Submit a job and return its id. Its results are stored in a folder of its own."""
        wanted = {
            "cache": "off",
            "max_attempts": MAX_ATTEMPTS,
            **request,
            "kind": kind,
            "into": f"{self.folder}/{label}",
        }
        self.submitted[label] = self.lab.submit(JobCreate.model_validate(wanted)).id
        return self.submitted[label]

    def clip(self, number: int) -> dict[str, str]:
        """Return a clip as input."""
        return {"item": self.clips[number % len(self.clips)]}

    def await_end(self, seconds: float) -> list[str]:
        """Wait until all jobs have ended; return those that have not."""
        deadline = time.monotonic() + seconds
        while True:
            going = [job for job in self._listed() if not job.state.terminal]
            if not going or time.monotonic() > deadline:
                return [f"{job.id} ({job.kind}) is still {job.state} after {seconds:.0f} s" for job in going]
            time.sleep(1)

    def ends(self) -> Ends:
        """Return the outcomes of the jobs, and the rules that were broken."""
        faults: list[str] = []
        labels = {job: label for label, job in self.submitted.items()}
        listed = {job.id: job for job in self._listed()}
        tasks = [task for job in listed.values() if job.size for task in self._listed(parent=job.id)]
        faults += [f"the job {job} ({label}) is not listed" for job, label in labels.items() if job not in listed]
        for job in listed.values():
            if job.id not in labels and job.params != ON_SCHEDULE:
                faults.append(f"the job {job.id} ({job.kind}) was made, but never requested")
        attempts: Counter[str] = Counter()
        for job in (*listed.values(), *tasks):
            faults += self._faults_of(job, attempts)
        faults += self._ended_twice({job.id for job in (*listed.values(), *tasks)})
        for label in self.cancelled:
            if (state := listed[self.submitted[label]].state) is not JobState.CANCELLED:
                faults.append(f"the job {label} is {state}, although its cancellation was confirmed")
        told = {label: _told(listed[job]) for label, job in self.submitted.items() if job in listed}
        return Ends(told, self._contents(), faults, attempts)

    def _listed(self, **filters: Any) -> list[Job]:
        listed = self.marey.jobs.list(self.lab.name, limit=1000, filters=filters)
        return [job for job in listed if job.id not in self.earlier]

    def _ids(self) -> Iterator[str]:
        return (job.id for job in self._listed())

    def _faults_of(self, job: Job, attempts: Counter[str]) -> Iterator[str]:
        tries = list(self.marey.jobs.attempts(job.id)) if job.size is None else []
        attempts.update(one.outcome or "open" for one in tries)
        won = [one.fence for one in tries if one.outcome == "succeeded"]
        if job.state is JobState.SUCCEEDED and job.size is None and job.cached_from is None and won != [job.fence]:
            yield f"the job {job.id} ({job.kind}) has the fence {job.fence}, but the attempts {won} succeeded"
        if job.state is not JobState.SUCCEEDED and won:
            yield f"the job {job.id} ({job.kind}) is {job.state}, but the attempts {won} succeeded"
        if any(one.outcome is None for one in tries):
            yield f"an attempt of the job {job.id} ({job.kind}) has no end"

    def _ended_twice(self, jobs: set[str]) -> Iterator[str]:
        ended: Counter[str] = Counter()
        after = 0
        while found := list(_events(self.marey, self.lab.name, after)):
            ended.update(one.subject for one in found if one.kind in ENDS)
            after = found[-1].seq
        for job in jobs:
            if ended[job] != 1:
                yield f"{ended[job]} events tell the end of the job {job}"

    def _contents(self) -> dict[str, str]:
        """Commit the items of the folder to a dataset, whose digests are the same on every server."""
        dataset = self.lab.datasets.create(self.folder, collection=self.folder)
        dataset.commit("after all jobs")
        return {f"{one.path} ({one.kind})": json.dumps(one.parts, sort_keys=True) for one in dataset.entries()}


def _events(marey: Marey, project: str, after: int) -> Iterator[Event]:
    answer = marey.transport.send("GET", f"/projects/{project}/events", params={"after": after, "limit": 1000})
    return (Event.model_validate(one) for one in answer.json()["items"])


def _told(job: Job) -> str:
    failure = f" ({job.failure.reason}: {job.failure.code})" if job.failure else ""
    result = {name: value for name, value in (job.result or {}).items() if name in SAME}
    return f"{job.state}{failure} {json.dumps(result, sort_keys=True)}"


# -- the jobs ---------------------------------------------------------------------------------------------------------


def _import(work: Workload, number: int) -> str:
    text = CLIP.replace("0 90 1", f"0 90 {number % 50}.{number}").encode()
    blob = Blobs(work.marey.transport).put(text)
    files = [{"name": f"clip-{number}.bvh", "blob": blob}]
    return work.add(f"import-{number}", "import", params={"files": files, "unit_scale_m": UNIT_SCALE_M})


def _import_and_retarget(work: Workload, number: int) -> None:
    imported = _import(work, number)
    work.add(
        f"annotate-imported-{number}", "annotate", inputs={"clips": [{"job": imported}]},
        params={"proposal": {"method": "velocity_minima"}},
    )  # fmt: skip


def _retarget(work: Workload, number: int) -> None:
    inputs = {"clips": [work.clip(number)], "skeleton": {"item": work.rig}}
    work.add(f"retarget-{number}", "retarget", inputs=inputs)


def _retarget_many(work: Workload, number: int) -> None:
    inputs = {"clips": [work.clip(each) for each in range(len(work.clips))], "skeleton": {"item": work.rig}}
    work.add(f"retarget-many-{number}", "retarget", inputs=inputs)


def _annotate_and_cut(work: Workload, number: int) -> None:
    clips = [work.clip(number)]
    steps = work.add(
        f"annotate-{number}", "annotate", inputs={"clips": clips}, params={"proposal": {"method": "steps"}}
    )
    work.add(f"cut-{number}", "cut", inputs={"annotations": [{"job": steps}], "clips": clips})


def _align(work: Workload, number: int) -> None:
    clips = [work.clip(number), work.clip(number + 1)]
    work.add(f"align-{number}", "align", inputs={"clips": clips}, params={"rate_hz": 15})


def _draw(work: Workload, number: int) -> str:
    params = {"name": f"drawn-{number}", "seed": number, "seconds": work.slow_s}
    return work.add(f"draw-{number}", "draw", params=params)


def _draw_then_add(work: Workload, number: int) -> None:
    work.add(f"add-{number}", "add", params={"a": number, "b": 1}, after=[_draw(work, number)])


def _tally(work: Workload, number: int) -> None:
    work.add(f"tally-{number}", "tally", params={"tasks": 4})


def _refuse(work: Workload, number: int) -> None:
    refused = work.add(f"refuse-{number}", "misbehave", params={"how": "refuse"})
    work.add(f"skipped-{number}", "add", params={"a": 1, "b": 1}, after=[refused], on_failure="skip")
    work.add(f"dragged-{number}", "add", params={"a": 1, "b": 1}, after=[refused], on_failure="fail")


def _cancel(work: Workload, number: int) -> None:
    label = f"cancelled-{number}"
    job = work.add(label, "misbehave", params={"how": "sleep", "seconds": 120})
    with contextlib.suppress(Conflict):  # an earlier try was carried out, but its answer was lost
        work.marey.jobs.cancel(job)
    work.cancelled.add(label)


KINDS: dict[str, Callable[[Workload, int], object]] = {
    "import, then annotate": _import_and_retarget,
    "retarget": _retarget,
    "draw": _draw,
    "annotate, then cut": _annotate_and_cut,
    "tally in four tasks": _tally,
    "draw, then add": _draw_then_add,
    "cancel": _cancel,
    "retarget in a fan-out": _retarget_many,
    "refuse, with two that depend on it": _refuse,
    "align": _align,
}
"""Functions that submit jobs, by the kind of work of these jobs; a trial calls them in turn."""


def new_workload(
    marey: Marey, folder: str, takes: Path, *, slow_s: float = 0.0, kinds: Collection[str] = ()
) -> Workload:
    """Create the project `lab` with clips and a skeleton from files, and with a schedule that adds every minute."""
    lab = marey.create_project(ProjectCreate(name="lab"))
    [rig] = lab.imports.upload(find_files([takes.parent / "game.bvh"]).files)
    entries = lab.imports.upload(find_files([takes]).files)
    assert rig.skeleton is not None
    lab.schedules.create(
        "every-minute", "* * * * *", JobCreate(kind="add", params=ON_SCHEDULE, cache="off", max_attempts=MAX_ATTEMPTS)
    )
    files = [{"name": "first.bvh", "blob": Blobs(marey.transport).put(CLIP.encode())}]
    first = JobCreate(kind="import", params={"files": files, "unit_scale_m": UNIT_SCALE_M})
    marey.jobs.wait(lab.submit(first).id)  # later imports use its skeleton, whichever folder they go to
    work = Workload(
        marey, lab, folder, [entry.item or "" for entry in entries], rig.skeleton, slow_s, tuple(kinds or KINDS)
    )
    work.earlier |= {job.id for job in marey.jobs.list(lab.name)}
    return work
