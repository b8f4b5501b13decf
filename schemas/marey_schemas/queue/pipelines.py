"""Pipelines: jobs that are submitted together and use each other's results as inputs."""

from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Any, Self

from pydantic import Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.names import Message, ReceivingPath, form
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.jobs import CacheMode, Job, JobCreate, JobInput, JobOutputsInput, Resources
from marey_schemas.sizes import SEEDS

MOST_STEPS = 32

_STEP = form(
    r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$",
    "have at most 64 letters, digits, dots, - and _, and begin with a letter or digit",
)
StepName = Annotated[str, StringConstraints(pattern=_STEP)]


class StepOutputsInput(Request):
    """Outputs of another step: all items whose kind the input accepts.

    The step with this input waits for the other step.
    """

    step: StepName


StepInput = JobInput | StepOutputsInput


class PipelineStep(Request):
    """Job of a pipeline. `into` and the fields declared after it default to the values of the pipeline."""

    kind: str = Field(min_length=1, max_length=64)
    inputs: dict[str, StepInput | tuple[StepInput, ...]] = Field(default_factory=dict)
    params: dict[str, Any] = Field(default_factory=dict)
    after: tuple[StepName, ...] = Field(
        (),
        max_length=MOST_STEPS,
        description="Steps that must succeed first, in addition to the steps that make the inputs of this step.",
    )

    into: ReceivingPath | None = None
    priority: int | None = Field(None, ge=-100, le=100)
    cache: CacheMode | None = None
    seed: int | None = Field(None, ge=0, lt=SEEDS)
    max_attempts: int | None = Field(None, ge=1, le=20)
    labels: dict[str, str] | None = None
    resources: Resources | None = None
    message: Message | None = None
    commit: OutputsCommit | None = None


class PipelineCreate(Request):
    """Request to submit jobs that depend on each other, all or none."""

    steps: dict[StepName, PipelineStep] = Field(min_length=1, max_length=MOST_STEPS)
    into: ReceivingPath = Field("", description="The collection that receives the results.")
    priority: int = Field(0, ge=-100, le=100)
    cache: CacheMode = "use"
    seed: int = Field(0, ge=0, lt=SEEDS)
    max_attempts: int = Field(3, ge=1, le=20)
    labels: dict[str, str] = Field(default_factory=dict, description="Labels that a worker must have to run the steps.")
    resources: Resources = Resources()
    message: Message = ""
    commit: OutputsCommit | None = Field(
        None, description="Commit that each step makes of its outputs when it succeeds, if its kind makes items."
    )


class Pipeline(Answer):
    """Jobs of a pipeline by the names of its steps; each job comes after the jobs that it depends on."""

    jobs: dict[str, Job]


class PipelineError(ValueError):
    """The steps of a pipeline are not valid together.

    `code` names the error for programs; `pointer` is the place of the error in the request.
    """

    def __init__(self, pointer: str, code: str, detail: str) -> None:
        super().__init__(detail)
        self.pointer = pointer
        self.code = code

    @classmethod
    def unknown_step(cls, pointer: str, name: str, pipeline: PipelineCreate) -> Self:
        """Return the error for a reference, at `pointer` in the request, to a step that does not exist."""
        return cls(pointer, "unknown-step", f"There is no step {name!r}; the steps are {', '.join(pipeline.steps)}.")


def order_steps(pipeline: PipelineCreate) -> tuple[str, ...]:
    """Sort the names of the steps so that each step comes after its dependencies.

    First come the steps without dependencies, then those that depend only on these, and so on. In each of these groups,
    the steps keep the given order. Raises `PipelineError` for a step that does not exist, and for circular
    dependencies.
    """
    places = {name: dict(_needed(name, step)) for name, step in pipeline.steps.items()}
    for needed in places.values():
        for pointer, other in needed.items():
            if other not in pipeline.steps:
                raise PipelineError.unknown_step(pointer, other, pipeline)
    sorter = TopologicalSorter({name: sorted(set(needed.values())) for name, needed in places.items()})
    try:
        sorter.prepare()
    except CycleError as error:
        circle: list[str] = error.args[1]
        pointer = next(place for place, other in places[circle[1]].items() if other == circle[0])
        detail = f"These steps wait for each other: {' -> '.join(circle)}."
        raise PipelineError(pointer, "cycle", detail) from error
    order: list[str] = []
    given = list(pipeline.steps)
    while sorter.is_active():
        ready = sorted(sorter.get_ready(), key=given.index)
        order += ready
        sorter.done(*ready)
    return tuple(order)


def job_of_step(pipeline: PipelineCreate, name: str, ids: Mapping[str, str]) -> JobCreate:
    """Return the job request of a step; `ids` contains the job ids of the steps on which it depends, by step name."""
    step = pipeline.steps[name]

    def resolved(choice: StepInput) -> JobInput:
        return JobOutputsInput(job=ids[choice.step]) if isinstance(choice, StepOutputsInput) else choice

    shared = pipeline.model_dump(exclude={"steps"})
    own = step.model_dump(exclude={"kind", "inputs", "params", "after"}, exclude_none=True)
    inputs = {
        role: tuple(map(resolved, choices)) if isinstance(choices, tuple) else resolved(choices)
        for role, choices in step.inputs.items()
    }
    after = tuple(ids[other] for other in step.after)
    return JobCreate(kind=step.kind, inputs=inputs, params=step.params, after=after, **(shared | own))


def _needed(name: str, step: PipelineStep) -> Iterator[tuple[str, str]]:
    """Yield the references of a step to other steps: the JSON Pointer to each, and the other step's name."""
    for index, other in enumerate(step.after):
        yield f"/steps/{name}/after/{index}", other
    for role, choices in step.inputs.items():
        place = f"/steps/{name}/inputs/{role.replace('~', '~0').replace('/', '~1')}"
        many = isinstance(choices, tuple)
        for index, choice in enumerate(choices if isinstance(choices, tuple) else (choices,)):
            if isinstance(choice, StepOutputsInput):
                yield (f"{place}/{index}/step" if many else f"{place}/step"), choice.step
