"""Kinds of jobs with their inputs, parameters and outputs, declared once for server, client and worker.

The server checks submissions against these declarations and publishes their JSON Schema; only the worker imports the
function that computes a job. Other distributions add kinds with an entry point of the group `marey.job_kinds` that
names a `KindDeclaration`.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any

from marey_schemas.formats import IMPORTED
from marey_schemas.kinds import Kind
from marey_schemas.queue import job_params
from marey_schemas.queue.jobs import InputSpec
from marey_schemas.queue.kind_declaration import EVERY_INPUT, KindDeclaration
from marey_schemas.queue.measuring_kinds import (
    COMPARE,
    DISTANCES,
    EVALUATE,
    METRIC,
    OPTIMISE,
    QUALITY,
    RIG,
    RIGS,
    SUGGEST,
    SWEEP,
)
from marey_schemas.queue.scripts import SCRIPT, ScriptDeclaration, ScriptParams
from marey_schemas.wording import suggestion

ENTRY_POINT_GROUP = "marey.job_kinds"
MOST_TASKS = 1000
"""Greatest number of tasks of a job, if the parameters of the job determine the number."""


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
    version=4,
    outputs={"clips": Kind.CLIP, "skeletons": Kind.SKELETON, "models": Kind.MODEL, "graphs": Kind.GRAPH},
    newest_of=("skeleton",),
    never_cached_for=_may_hold_graphs,
    reports_entries=True,
)

RETARGET = KindDeclaration(
    name="retarget",
    description="Transfers the motion of clips to another skeleton.",
    params=job_params.RetargetParams,
    implementation="marey_worker.kinds.retarget:run",
    version=5,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to retarget."),
        "skeleton": InputSpec(kind=Kind.SKELETON, description="The skeleton to retarget to."),
        "rigs": RIGS,
    },
    outputs={"clips": Kind.CLIP},
    fan_out="clips",
    batch_size=16,
    place_counts=True,
    named_after="clips",
    refusing_all_fails=True,
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

EDIT = KindDeclaration(
    name="edit",
    description="Applies the commands of an edit to clips: trims, joins, smooths, places and repairs them.",
    params=job_params.EditParams,
    implementation="marey_worker.kinds.edit:run",
    version=6,
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
        "rigs": RIGS,
    },
    outputs={"clips": Kind.CLIP},
    fan_out="clips",
    batch_size=16,
    place_counts=True,
    in_place="in_place",
    named_after="clips",
    refusing_all_fails=True,
    unclear_place=job_params.EditParams.unclear_place,
)

ANNOTATE = KindDeclaration(
    name="annotate",
    description="Proposes segments and keyframes of clips: steps, pauses, or reaches of a hand.",
    params=job_params.AnnotateParams,
    implementation="marey_worker.kinds.annotate:run",
    version=2,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to annotate."),
        "rigs": RIGS,
    },
    outputs={"annotations": Kind.ANNOTATION},
    fan_out="clips",
    batch_size=16,
    named_after="clips",
    refusing_all_fails=True,
)

CUT = KindDeclaration(
    name="cut",
    description="Cuts clips along the segments of their annotations, and keeps the keyframes of each piece.",
    params=job_params.CutParams,
    implementation="marey_worker.kinds.cut:run",
    version=3,
    inputs={
        "annotations": InputSpec(
            kind=Kind.ANNOTATION,
            many=True,
            description="The annotations; each annotation refers to a revision of a clip.",
        ),
        "clips": InputSpec(
            kind=Kind.CLIP,
            many=True,
            required=False,
            description="The annotated clips, at the revisions to which the annotations refer. If the clips are "
            "given, they are recorded as inputs of the pieces.",
        ),
    },
    outputs={"clips": Kind.CLIP, "annotations": Kind.ANNOTATION},
    place_counts=True,
    never_cached_without=("clips",),
    refusing_all_fails=True,
)

ALIGN = KindDeclaration(
    name="align",
    description="Aligns examples of one action with each other, in space and in time.",
    params=job_params.AlignParams,
    implementation="marey_worker.kinds.align:run",
    version=2,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The examples, all of one skeleton."),
        "annotations": InputSpec(
            kind=Kind.ANNOTATION,
            many=True,
            required=False,
            description="Annotations of these clips; their segments and keyframes cut the clips into parts, "
            "which are aligned one by one.",
        ),
        "metric": METRIC,
        "rig": RIG,
    },
    outputs={"processed": Kind.PROCESSED},
    named_after="clips",
)

MODEL = KindDeclaration(
    name="model",
    description="Learns a generative model of one action from aligned clips.",
    params=job_params.ModelParams,
    implementation="marey_worker.kinds.model:run",
    version=4,
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


def _reads_answers(_params: Mapping[str, Any]) -> bool:
    """Return True, because the job reads answers of participants while it runs, which may change between two jobs."""
    return True


ANALYSE_STUDY = KindDeclaration(
    name="analyse_study",
    description="Analyses a study: computes the differences that its participants perceived, the order and the "
    "groups of its motions, and metrics that are fitted to these differences. Only maintainers may submit such "
    "jobs.",
    params=job_params.AnalyseStudyParams,
    implementation="marey_worker.kinds.analyse_study:run",
    version=2,
    inputs={"study": InputSpec(kind=Kind.STUDY, description="The study, at the revision that its participants saw.")},
    outputs={"document": "file", "report": "file", "fitted": "file"},
    never_cached_for=_reads_answers,
)

INDEX = KindDeclaration(
    name="index",
    description="Builds or updates an index of the poses of clips, with which moments that resemble an example are "
    "found.",
    params=job_params.IndexParams,
    implementation="marey_worker.kinds.index:run",
    version=1,
    inputs={
        "clips": InputSpec(
            kind=Kind.CLIP, many=True, parts=("motion",), description="The clips that the index will contain."
        ),
        "index": InputSpec(
            kind=Kind.INDEX,
            required=False,
            description="The index to update. Poses of clips that this index contains at the same revision are not "
            "computed again.",
        ),
    },
    outputs={"index": Kind.INDEX},
    place_counts=True,
)

RUN_SCRIPT = KindDeclaration(
    name=SCRIPT,
    description="Runs a registered script: a command of a pinned Git commit. The script declares the inputs and "
    "outputs of the job.",
    params=ScriptParams,
    implementation="marey_worker.kinds.script:run",
    version=1,
    outputs={"clips": Kind.CLIP, "skeletons": Kind.SKELETON, "files": "file"},
    deterministic=False,
    exports=EVERY_INPUT,
)


def script_kind(declared: ScriptDeclaration) -> KindDeclaration:
    """Return the job kind `script` with the inputs that a script declares."""
    return replace(RUN_SCRIPT, inputs=declared.input_specs())


def kind_of_job(name: str, params: Mapping[str, Any]) -> KindDeclaration:
    """Return the kind of a submitted job, with the inputs of its script if it runs one.

    Raises `UnknownKindError` if there is no such kind, and `ValidationError` if its script is not valid any more.
    """
    if name == SCRIPT:
        return script_kind(ScriptDeclaration.model_validate(params["declaration"]))
    return find_kind(name)


BUILT_IN = (
    IMPORT, RETARGET, EXPORT, EVALUATE, COMPARE, DISTANCES, QUALITY, SUGGEST, OPTIMISE, SWEEP, EDIT, ANNOTATE, CUT,
    ALIGN, MODEL, TREE, ANALYSE_STUDY, INDEX, RUN_SCRIPT,
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
                f"the entry point {entry.value} declares the job kind {kind.name!r}, but another job kind has "
                "this name already; rename one of them"
            )
        kinds[kind.name] = kind
    return MappingProxyType(kinds)


def find_kind(name: str) -> KindDeclaration:
    """Return the kind called `name`. Raises `UnknownKindError` if there is none."""
    try:
        return job_kinds()[name]
    except KeyError:
        raise UnknownKindError(f"there is no job kind {name!r}; {suggestion(name, job_kinds(), 'job kinds')}") from None
