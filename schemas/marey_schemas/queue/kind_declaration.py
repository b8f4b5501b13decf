"""Declaration of a kind of job: inputs, parameters, outputs, division into tasks, and reuse of results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

from marey_schemas.base import Request
from marey_schemas.consents import ConsentOverride
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.queue.facets import require_facet_names
from marey_schemas.queue.jobs import InputSpec, JobKind

EVERY_INPUT = "*"
"""Value of `exports` that means all inputs of the job."""


@dataclass(frozen=True)
class KindDeclaration:
    """Declaration of a kind of job, from which server, client and worker derive everything about it.

    `version` changes whenever the same inputs, parameters and seed may give other results; cached results of another
    version are not used. `implementation` names the worker's function `run(context, params)` as `module:function`.

    A job is split into tasks in one of two ways:

    * With `fan_out`, which names an input, each task gets `batch_size` items of that input. The result of the job
      combines the results of its tasks: numbers are added, lists are concatenated, and objects are merged.
    * With `task_count`, a function that returns the number of tasks for given parameters, each task gets all inputs.
      `context.task` says which task it is. When all tasks have succeeded, a worker calls
      `gather(context, params, results)`, the function that `gathering` names, with their results in order. If there is
      only one task, a single job runs both `run` and `gather`. If `counted` names an input, the function gets the
      number of items of this input as its second argument.

    A job reuses the results of an identical job. Jobs are identical if they have the same parameters, the same seed,
    and as inputs the same items with the same names, places and contents. A kind can declare further facts that must be
    the same:

    * `place_counts`: whether the path of the collection that receives the results must be the same.
    * `newest_of`: parameters that contain the id of an item, or null; the item must have the same newest revision.

    A job that refuses some of its inputs succeeds. With `refusing_all_fails`, it fails if it refused all of them.

    With `reports_entries`, the result has an entry for each file (`ImportAnswer`), which the server completes with what
    it has published for the file.

    Some jobs never reuse results. A kind declares them with these fields:

    * `never_cached_for`: function of the parameters, which returns whether the job looks up names while it runs.
    * `never_cached_without`: inputs. If one of these inputs is not given, the job looks up names while it runs.
    * `in_place`: parameter. If it is true, each result replaces its source, provided that the source is still the
      newest revision.

    `facets` contains the meaning of each facet, a number that the job publishes about its inputs, by name.

    `named_after` is the input whose items determine the names and relative collections of the results; the parameter
    `suffix` is appended to the names. `unclear_place` is a function of the parameters and a collection; it returns why
    these do not determine the place of the results, or None if they do.

    `exports` is the input whose clips the job writes to files, or `EVERY_INPUT`. The parameters then extend
    `ConsentOverride`. Unless `allow_expired_consent` is true, the job must refuse the clips of this input that have
    `consent_ended`. In any case, the job must list the ids of these clips as `consent_ended` in its result. The results
    of an identical job are reused only if the consent has ended for the same clips.
    """

    name: str
    description: str
    params: type[Request]
    implementation: str
    version: int
    outputs: Mapping[str, Kind | Literal["file"]]
    inputs: Mapping[str, InputSpec] = field(default_factory=dict)
    facets: Mapping[str, str] = field(default_factory=dict)
    fan_out: str | None = None
    batch_size: int = 1
    task_count: Callable[..., int] | None = None
    counted: str | None = None
    gathering: str | None = None
    deterministic: bool = True
    place_counts: bool = False
    newest_of: tuple[str, ...] = ()
    in_place: str | None = None
    never_cached_without: tuple[str, ...] = ()
    never_cached_for: Callable[[Mapping[str, Any]], bool] | None = None
    named_after: str | None = None
    refusing_all_fails: bool = False
    reports_entries: bool = False
    unclear_place: Callable[[Any, str], str | None] | None = None
    exports: str | None = None

    def __post_init__(self) -> None:
        if self.fan_out is not None and not (self.fan_out in self.inputs and self.inputs[self.fan_out].many):
            raise ValueError(
                f"job kind {self.name}: fan_out names {self.fan_out!r}, which must be an input that takes many items"
            )
        for name in (*self.never_cached_without, *filter(None, [self.named_after, self.exports, self.counted])):
            if name not in self.inputs and name != EVERY_INPUT:
                raise ValueError(
                    f"job kind {self.name}: never_cached_without, named_after, exports and counted must name inputs of "
                    f"the kind, and {name!r} is none of them"
                )
        if self.exports is not None and not issubclass(self.params, ConsentOverride):
            raise ValueError(f"job kind {self.name}: the parameters of a kind with exports must extend ConsentOverride")
        for name in (*self.newest_of, *filter(None, [self.in_place])):
            if name not in self.params.model_fields:
                raise ValueError(
                    f"job kind {self.name}: newest_of and in_place must name parameters of the kind, "
                    f"and {name!r} is none of them"
                )
        for name, spec in self.inputs.items():
            if unknown := set(spec.parts) - PARTS[spec.kind].keys():
                raise ValueError(
                    f"job kind {self.name}: input {name!r}: an item of the kind {spec.kind} has no part "
                    f"{sorted(unknown)[0]!r}"
                )
        require_facet_names(self.name, self.facets)
        if self.batch_size < 1:
            raise ValueError(f"job kind {self.name}: batch_size must be at least 1, not {self.batch_size}")
        if (self.task_count is None) != (self.gathering is None):
            raise ValueError(f"job kind {self.name}: declare either both of task_count and gathering, or neither")
        if self.task_count is not None and self.fan_out is not None:
            raise ValueError(f"job kind {self.name}: declare fan_out or task_count, not both")

    def count_tasks(self, params: Any, inputs: Mapping[str, Sequence[Any]]) -> int:
        """Return the number of tasks that `task_count` gives for these parameters and inputs; without it, 1.

        The tasks into which `fan_out` divides a job are not counted.
        """
        if self.task_count is None:
            return 1
        return self.task_count(params, *([] if self.counted is None else [len(inputs.get(self.counted, ()))]))

    def is_exported(self, name: str) -> bool:
        """Return whether the job writes the clips of an input to files."""
        return self.exports in (name, EVERY_INPUT)

    @property
    def code_version(self) -> str:
        """Name and version under which results are cached and recorded."""
        return f"{self.name}@{self.version}"

    def document(self) -> JobKind:
        """Return the declaration as a document."""
        return JobKind(
            name=self.name,
            description=self.description,
            params_schema=_params_schema(self.params),
            inputs=dict(self.inputs),
            outputs=dict(self.outputs),
            facets=dict(self.facets),
            fan_out=self.fan_out,
            batch_size=self.batch_size,
            gathers=self.gathering is not None,
            deterministic=self.deterministic,
        )


@cache
def _params_schema(params: type[Request]) -> dict[str, Any]:
    return params.model_json_schema()
