"""Kinds of jobs with their inputs, parameters and outputs, declared once for server, client and worker.

The server checks submissions against these declarations and publishes their JSON Schema; only the worker imports the
function that computes a job. Other distributions add kinds with an entry point of the group `marey.job_kinds` that
names a `KindDeclaration`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any, Literal

from marey_schemas.base import Request
from marey_schemas.consents import ConsentOverride
from marey_schemas.documents.evaluations import REMOVAL_FACETS, USAGE_FACETS
from marey_schemas.formats import IMPORTED
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.queue import job_params
from marey_schemas.queue.facets import require_facet_names
from marey_schemas.queue.jobs import InputSpec, JobKind

ENTRY_POINT_GROUP = "marey.job_kinds"
MOST_TASKS = 1000
"""Greatest number of tasks of a job, if the parameters of the job determine the number."""


@dataclass(frozen=True)
class KindDeclaration:
    """A kind of job.

    `version` changes whenever the same inputs, parameters and seed may give other results; cached results of another
    version are not used. `implementation` names the worker's function `run(context, params)` as `module:function`.

    A job is split into tasks in one of two ways:

    * With `fan_out`, which names an input, each task gets `batch_size` items of that input. The result of the job
      combines the results of its tasks: numbers are added, lists are concatenated, and objects are merged.
    * With `task_count`, a function that returns the number of tasks for given parameters, each task gets all inputs.
      `context.task` says which task it is. When all tasks have succeeded, a worker calls
      `gather(context, params, results)`, the function that `gathering` names, with their results in order. If there is
      only one task, a single job runs both `run` and `gather`.

    A job reuses the results of an identical job. Jobs are identical if they have the same parameters, the same seed,
    and as inputs the same items with the same names, places and contents. A kind can declare further facts that must be
    the same:

    * `place_counts`: whether the path of the collection that receives the results must be the same.
    * `newest_of`: parameters that contain the id of an item, or null; the item must have the same newest revision.

    Some jobs never reuse results. A kind declares them with these fields:

    * `never_cached_for`: function of the parameters, which returns whether the job looks up names while it runs.
    * `never_cached_without`: inputs. If one of these inputs is not given, the job looks up names while it runs.
    * `in_place`: parameter. If it is true, each result replaces its source, provided that the source is still the
      newest revision.

    `facets` contains the meaning of each facet, a number that the job publishes about its inputs, by name.

    `named_after` is the input whose items determine the names and relative collections of the results; the parameter
    `suffix` is appended to the names. `unclear_place` is a function of the parameters and a collection; it returns why
    these do not determine the place of the results, or None if they do.

    `exports` is the input whose clips the job writes to files. Its parameters then extend `ConsentOverride`. Unless
    `allow_expired_consent` is true, the job must refuse the clips of this input that have `consent_ended`. In any case,
    it must list the ids of these clips as `consent_ended` in its result. The results of an identical job are reused
    only if the consent has ended for the same clips.
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
    task_count: Callable[[Any], int] | None = None
    gathering: str | None = None
    deterministic: bool = True
    place_counts: bool = False
    newest_of: tuple[str, ...] = ()
    in_place: str | None = None
    never_cached_without: tuple[str, ...] = ()
    never_cached_for: Callable[[Mapping[str, Any]], bool] | None = None
    named_after: str | None = None
    unclear_place: Callable[[Any, str], str | None] | None = None
    exports: str | None = None

    def __post_init__(self) -> None:
        if self.fan_out is not None and not (self.fan_out in self.inputs and self.inputs[self.fan_out].many):
            raise ValueError(
                f"job kind {self.name}: fan_out names {self.fan_out!r}, which must be an input that takes many items"
            )
        for name in (*self.never_cached_without, *filter(None, [self.named_after, self.exports])):
            if name not in self.inputs:
                raise ValueError(
                    f"job kind {self.name}: never_cached_without, named_after and exports must name inputs of the "
                    f"kind, and {name!r} is none of them"
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


_RIG = InputSpec(
    kind=Kind.SKELETON,
    required=False,
    description="The revision of the clips' skeleton whose joint mapping is used; needed only if the mapping was "
    "edited after the import of the clips.",
)
_RIGS = InputSpec(
    kind=Kind.SKELETON,
    many=True,
    required=False,
    description="The revisions of the clips' skeletons whose joint mappings are used; needed only for mappings that "
    "were edited after the import of the clips.",
)


def _may_hold_graphs(params: Mapping[str, Any]) -> bool:
    """Return whether one of the files to import may be a graph of motion models, judging by its name.

    The import of a graph looks up its models by name, so such jobs have no cached results.
    """
    rows = [row for row in IMPORTED if "graph" in row.reads]
    return any(row.names(file["name"]) for file in params["files"] for row in rows)


IMPORT = KindDeclaration(
    name="import",
    description="Imports clips, skeletons, models and graphs from files that the server has stored.",
    params=job_params.ImportParams,
    implementation="marey_worker.kinds.imports:run",
    version=3,
    outputs={"clips": Kind.CLIP, "skeletons": Kind.SKELETON, "models": Kind.MODEL, "graphs": Kind.GRAPH},
    newest_of=("skeleton",),
    never_cached_for=_may_hold_graphs,
)

RETARGET = KindDeclaration(
    name="retarget",
    description="Transfers the motion of clips to another skeleton.",
    params=job_params.RetargetParams,
    implementation="marey_worker.kinds.retarget:run",
    version=2,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to retarget."),
        "skeleton": InputSpec(kind=Kind.SKELETON, description="The skeleton to retarget to."),
        "rigs": _RIGS,
    },
    outputs={"clips": Kind.CLIP},
    fan_out="clips",
    batch_size=16,
    place_counts=True,
    named_after="clips",
)

EXPORT = KindDeclaration(
    name="export",
    description="Exports clips as files of one format in one archive.",
    params=job_params.ExportParams,
    implementation="marey_worker.kinds.export:run",
    version=4,
    inputs={"clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to export.")},
    outputs={"archive": "file"},
    exports="clips",
)

EVALUATE = KindDeclaration(
    name="evaluate",
    description="Measures the quality of a set of locomotion clips by simulated motion matching.",
    params=job_params.EvaluateParams,
    implementation="marey_worker.kinds.evaluate:run",
    gathering="marey_worker.kinds.evaluate:gather",
    task_count=job_params.count_evaluation_tasks,
    version=3,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to evaluate, all of one skeleton."),
        "rig": _RIG,
        "normaliser": InputSpec(
            kind=Kind.EVALUATION,
            required=False,
            description="The evaluation whose normaliser (scaling of features) is used, so that the results of "
            "both evaluations can be compared.",
        ),
    },
    outputs={"evaluation": Kind.EVALUATION},
    facets=USAGE_FACETS,
)

COMPARE = KindDeclaration(
    name="compare",
    description="Compares two evaluations trial by trial, with confidence intervals of the changes.",
    params=job_params.CompareParams,
    implementation="marey_worker.kinds.compare:run",
    version=1,
    inputs={
        "before": InputSpec(kind=Kind.EVALUATION, description="The evaluation before the change."),
        "after": InputSpec(
            kind=Kind.EVALUATION,
            description="The evaluation after the change, with the same trials and the same normaliser.",
        ),
    },
    outputs={"document": "file", "report": "file"},
)

_EVALUATED = InputSpec(
    kind=Kind.EVALUATION, description="The evaluation; its clips are read at the revisions that it used."
)
_CANDIDATES = InputSpec(
    kind=Kind.CLIP,
    many=True,
    required=False,
    description="Clips that may be added; those of the evaluated set are ignored.",
)

SUGGEST = KindDeclaration(
    name="suggest",
    description="Finds the clips of an evaluated set that can be removed, and other clips that would fill gaps in its "
    "coverage.",
    params=job_params.SuggestParams,
    implementation="marey_worker.kinds.suggest:run",
    version=2,
    inputs={"evaluation": _EVALUATED, "candidates": _CANDIDATES},
    outputs={"document": "file"},
    facets=REMOVAL_FACETS,
)

OPTIMISE = KindDeclaration(
    name="optimise",
    description="Removes clips from an evaluated set and adds others, step by step, as long as the set improves.",
    params=job_params.OptimiseParams,
    implementation="marey_worker.kinds.optimise:run",
    version=1,
    inputs={"evaluation": _EVALUATED, "candidates": _CANDIDATES},
    outputs={"document": "file"},
)

SWEEP = KindDeclaration(
    name="sweep",
    description="Evaluates a set again with other weights of the features, and ranks the features by their effect.",
    params=job_params.SweepParams,
    implementation="marey_worker.kinds.sweep:run",
    gathering="marey_worker.kinds.sweep:gather",
    task_count=job_params.count_sweep_tasks,
    version=1,
    inputs={"evaluation": _EVALUATED},
    outputs={"document": "file"},
)

EDIT = KindDeclaration(
    name="edit",
    description="Applies the commands of an edit to clips: trims, joins, smooths, places and repairs them.",
    params=job_params.EditParams,
    implementation="marey_worker.kinds.edit:run",
    version=3,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to edit."),
        "edit": InputSpec(
            kind=Kind.EDIT,
            required=False,
            description="The edit whose commands are applied; alternatively, give the parameter `commands`.",
        ),
        "sources": InputSpec(
            kind=Kind.CLIP, many=True, required=False, description="Other clips that the commands refer to by id."
        ),
        "rigs": _RIGS,
    },
    outputs={"clips": Kind.CLIP},
    fan_out="clips",
    batch_size=16,
    place_counts=True,
    in_place="in_place",
    named_after="clips",
    unclear_place=job_params.EditParams.unclear_place,
)

ANNOTATE = KindDeclaration(
    name="annotate",
    description="Proposes segments and keyframes of clips: steps, pauses, or reaches of a hand.",
    params=job_params.AnnotateParams,
    implementation="marey_worker.kinds.annotate:run",
    version=1,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to annotate."),
        "rigs": _RIGS,
    },
    outputs={"annotations": Kind.ANNOTATION},
    fan_out="clips",
    batch_size=16,
    named_after="clips",
)

CUT = KindDeclaration(
    name="cut",
    description="Cuts clips along the segments of their annotations, and keeps the keyframes of each piece.",
    params=job_params.CutParams,
    implementation="marey_worker.kinds.cut:run",
    version=2,
    inputs={
        "annotations": InputSpec(
            kind=Kind.ANNOTATION, many=True, description="The annotations; each refers to a clip and its revision."
        ),
        "clips": InputSpec(
            kind=Kind.CLIP,
            many=True,
            required=False,
            description="The annotated clips, at the revisions to which the annotations refer. If they are given, the "
            "history of the pieces lists them.",
        ),
    },
    outputs={"clips": Kind.CLIP, "annotations": Kind.ANNOTATION},
    place_counts=True,
    never_cached_without=("clips",),
)

ALIGN = KindDeclaration(
    name="align",
    description="Aligns examples of one action with each other, in space and in time.",
    params=job_params.AlignParams,
    implementation="marey_worker.kinds.align:run",
    version=1,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The examples, all of one skeleton."),
        "annotations": InputSpec(
            kind=Kind.ANNOTATION,
            many=True,
            required=False,
            description="Annotations of these clips; their segments and keyframes cut the clips into parts, "
            "which are aligned one by one.",
        ),
        "rig": _RIG,
    },
    outputs={"processed": Kind.PROCESSED},
    named_after="clips",
)

MODEL = KindDeclaration(
    name="model",
    description="Learns a generative model of one action from aligned clips.",
    params=job_params.ModelParams,
    implementation="marey_worker.kinds.model:run",
    version=1,
    inputs={
        "aligned": InputSpec(
            kind=Kind.PROCESSED, many=True, description="Clips of one action that were aligned with each other."
        )
    },
    outputs={"model": Kind.MODEL},
)

TREE = KindDeclaration(
    name="tree",
    description="Draws samples of a model and groups them in a tree, which speeds up searches for "
    "motions that meet constraints.",
    params=job_params.TreeParams,
    implementation="marey_worker.kinds.tree:run",
    version=1,
    inputs={
        "model": InputSpec(
            kind=Kind.MODEL, parts=("model",), description="The model to which the tree is added as a part."
        )
    },
    outputs={"model": Kind.MODEL},
    place_counts=True,
    named_after="model",
    unclear_place=job_params.TreeParams.unclear_place,
)

BUILT_IN = (
    IMPORT, RETARGET, EXPORT, EVALUATE, COMPARE, SUGGEST, OPTIMISE, SWEEP, EDIT, ANNOTATE, CUT, ALIGN, MODEL, TREE,
)  # fmt: skip


class UnknownKindError(LookupError):
    """No kind of job has this name."""


@cache
def job_kinds() -> Mapping[str, KindDeclaration]:
    """Return every kind by name: the built-in ones and those of installed distributions.

    Raises `TypeError` if an entry point is not a `KindDeclaration`, and `ValueError` if two kinds have the same name.
    """
    kinds = {kind.name: kind for kind in BUILT_IN}
    for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: entry.name):
        kind = entry.load()
        if not isinstance(kind, KindDeclaration):
            raise TypeError(f"the entry point {entry.value} in the group {ENTRY_POINT_GROUP} must be a KindDeclaration")
        if kind.name in kinds:
            raise ValueError(
                f"the entry point {entry.value} declares the job kind {kind.name!r}, but another one "
                "has this name already"
            )
        kinds[kind.name] = kind
    return MappingProxyType(kinds)


def find_kind(name: str) -> KindDeclaration:
    """Return the kind called `name`. Raises `UnknownKindError` if there is none."""
    try:
        return job_kinds()[name]
    except KeyError:
        raise UnknownKindError(f"there is no job kind {name!r}; the job kinds are {', '.join(job_kinds())}") from None
