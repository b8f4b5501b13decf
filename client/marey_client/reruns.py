"""Repetition of jobs from their records, and comparison of the results."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from marey_client.errors import NotFound
from marey_client.project import ProjectHandle
from marey_schemas.documents.differences import Difference
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_kinds import job_kinds
from marey_schemas.queue.jobs import ItemInput, Job, JobCreate, JobKind, JobOutput, JobState

RERUNS = "reruns"
"""Folder for the results of repeated jobs; each job has a subfolder, whose name is the job's id."""

Agreement = Literal["identical", "other bytes", "missing", "deleted"]
"""Result of the comparison of an output of a job with the same output of its repetition.

identical: both have the same bytes; other bytes: the bytes differ; missing: only one of the two jobs has this output;
deleted: one of the two items was deleted, so the outputs cannot be compared. An output that refers to another output of
its job always has other bytes, because the ids differ.
"""


class CannotRerun(ValueError):
    """A job cannot be repeated; the text gives the reason."""


@dataclass(frozen=True)
class ComparedOutput:
    """Output of a job (`first`), and the output with the same name of the repetition (`second`); None if missing."""

    name: str
    agreement: Agreement
    first: JobOutput | None
    second: JobOutput | None
    difference: Difference | None = None
    """Difference of the content if the bytes differ; it is empty if only references to other outputs differ."""


def rerun_request(job: Job, kind: JobKind, tasks: Iterable[Job] = (), *, into: str | None = None) -> JobCreate:
    """Return the request that repeats a job with the same revisions, parameters and seed, without cached results.

    `tasks` are the tasks of the job; if an input was distributed over tasks, the items of the input are read from the
    records of the tasks. The results are stored in the folder `into`, by default `reruns/ID` with the id of the job.
    Raises `CannotRerun` for a job that has not succeeded, for a task of another job, and for a job that wrote new
    revisions of its inputs.
    """
    if job.state is not JobState.SUCCEEDED:
        raise CannotRerun(f"the job {job.id} has no result to repeat; its state is {job.state.value}")
    if job.parent is not None:
        raise CannotRerun(f"{job.id} is a task of the job {job.parent}; repeat that job")
    declared = job_kinds().get(job.kind)
    if declared is not None and declared.in_place and job.params.get(declared.in_place):
        raise CannotRerun(f"the job {job.id} wrote new revisions of its inputs (--in-place), so it cannot be repeated")
    in_order = sorted(tasks, key=lambda task: task.position or 0)
    inputs = {
        name: [pin for task in in_order for pin in task.inputs[name]] if isinstance(recorded, Mapping) else recorded
        for name, recorded in job.inputs.items()
    }
    return JobCreate(
        kind=job.kind,
        inputs={name: _inputs(pins, many=kind.inputs[name].many) for name, pins in inputs.items()},
        params=job.params,
        seed=job.seed,
        into=f"{RERUNS}/{job.id}" if into is None else into,
        cache="off",
        message=f"Repeats the job {job.id}",
    )


def _inputs(pins: Sequence[Mapping[str, Any]], *, many: bool) -> Any:
    found = tuple(ItemInput(item=pin["item"], revision=pin["revision"]) for pin in pins)
    return found if many else found[0]


def compare_outputs(
    project: ProjectHandle, first: Sequence[JobOutput], second: Sequence[JobOutput]
) -> Iterator[ComparedOutput]:
    """Compare each output of a job with the output of the same kind and name from the repetition."""
    left: dict[tuple[Kind, str], list[JobOutput]] = {}
    for one in second:
        left.setdefault((one.kind, one.name), []).append(one)
    for one in first:
        others = left.get((one.kind, one.name))
        yield _compared(project, one, others.pop(0)) if others else ComparedOutput(one.name, "missing", one, None)
    yield from (ComparedOutput(one.name, "missing", None, one) for others in left.values() for one in others)


def _compared(project: ProjectHandle, first: JobOutput, second: JobOutput) -> ComparedOutput:
    items = project.items(first.kind)
    try:
        before, after = items.get(first.item), items.get(second.item)
    except NotFound:
        return ComparedOutput(first.name, "deleted", first, second)
    parts = [
        {name: part.document for name, part in item.revision(output.revision).parts.items()}
        for item, output in ((before, first), (after, second))
    ]
    if parts[0] == parts[1]:
        return ComparedOutput(first.name, "identical", first, second)
    difference = before.difference(first.revision, second.revision, other=after)
    return ComparedOutput(first.name, "other bytes", first, second, difference)
