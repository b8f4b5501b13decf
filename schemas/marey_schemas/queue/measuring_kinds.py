"""Kinds of jobs that measure clips and sets of clips; `job_kinds` lists them with all others."""

from marey_schemas.documents.evaluations import MOST_EVALUATIONS_COMPARED, REMOVAL_FACETS, USAGE_FACETS
from marey_schemas.documents.quality import QUALITY_FACETS
from marey_schemas.kinds import Kind
from marey_schemas.queue import job_params
from marey_schemas.queue.jobs import InputSpec
from marey_schemas.queue.kind_declaration import KindDeclaration

RIG = InputSpec(
    kind=Kind.SKELETON,
    required=False,
    description="The revision of the clips' skeleton whose joint mapping is used; needed only if the mapping was "
    "edited after the import of the clips.",
)
RIGS = InputSpec(
    kind=Kind.SKELETON,
    many=True,
    required=False,
    description="The revisions of the clips' skeletons whose joint mappings are used; needed only for mappings that "
    "were edited after the import of the clips.",
)


METRIC = InputSpec(
    kind=Kind.METRIC,
    required=False,
    description="A stored perceptual metric; alternatively, the parameter `metric` names a built-in one.",
)

EVALUATE = KindDeclaration(
    name="evaluate",
    description="Measures the quality of a set of locomotion clips by simulated motion matching.",
    params=job_params.EvaluateParams,
    implementation="marey_worker.kinds.evaluate:run",
    gathering="marey_worker.kinds.evaluate:gather",
    task_count=job_params.count_evaluation_tasks,
    version=7,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to evaluate, all of one skeleton."),
        "rig": RIG,
        "normaliser": InputSpec(
            kind=Kind.EVALUATION,
            required=False,
            description="The evaluation whose normaliser (scaling of features) is used, so that the results of "
            "both evaluations can be compared.",
        ),
        "metric": METRIC,
    },
    outputs={"evaluation": Kind.EVALUATION},
    facets=USAGE_FACETS,
)

COMPARE = KindDeclaration(
    name="compare",
    description="Compares two evaluations trial by trial, with confidence intervals of the changes. Further "
    "evaluations are compared with the first one.",
    params=job_params.CompareParams,
    implementation="marey_worker.kinds.compare:run",
    version=5,
    inputs={
        "before": InputSpec(
            kind=Kind.EVALUATION,
            description="The evaluation before the change, or the one with which all others are compared.",
        ),
        "after": InputSpec(
            kind=Kind.EVALUATION,
            description="The evaluation after the change, with the same trials and the same normaliser.",
        ),
        "others": InputSpec(
            kind=Kind.EVALUATION,
            many=True,
            required=False,
            description=f"Further evaluations to compare with `before`, at most {MOST_EVALUATIONS_COMPARED - 2}, with "
            "the same trials and the same normaliser.",
        ),
    },
    outputs={"document": "file", "report": "file"},
)

DISTANCES = KindDeclaration(
    name="distances",
    description="Measures how different clips look to people: perceptual distances of all pairs, motion maps, and "
    "registration curves.",
    params=job_params.DistancesParams,
    implementation="marey_worker.kinds.distances:run",
    gathering="marey_worker.kinds.distances:gather",
    task_count=job_params.count_distance_tasks,
    counted="clips",
    version=2,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to compare, all of one skeleton."),
        "metric": METRIC,
        "rig": RIG,
    },
    outputs={"document": "file", "maps": "file", "report": "file"},
)

QUALITY = KindDeclaration(
    name="quality",
    description="Measures defects of any clips: foot skate, inconsistent contacts, penetration of the floor, jitter, "
    "exceeded joint limits; also speed and turn rate.",
    params=job_params.QualityParams,
    implementation="marey_worker.kinds.quality:run",
    version=2,
    inputs={
        "clips": InputSpec(kind=Kind.CLIP, many=True, description="The clips to measure, of any skeletons."),
        "reference": InputSpec(
            kind=Kind.CLIP,
            many=True,
            required=False,
            description="Recorded clips (ground truth), which are measured in the same way and shown beside the clips.",
        ),
        "contacts": InputSpec(
            kind=Kind.ANNOTATION,
            many=True,
            required=False,
            description="Annotations of all clips with segments labelled contact_left, contact_right or contact_both; "
            "without them, contacts are detected by speed.",
        ),
        "rigs": RIGS,
    },
    outputs={"document": "file", "table": "file", "report": "file"},
    facets=QUALITY_FACETS,
)

_EVALUATED = InputSpec(
    kind=Kind.EVALUATION,
    description="The evaluation to improve. Its clips are read at the revisions that the evaluation used.",
)
_CANDIDATES = InputSpec(
    kind=Kind.CLIP,
    many=True,
    required=False,
    description="Clips that may be added; clips that the evaluated set already has are ignored.",
)

SUGGEST = KindDeclaration(
    name="suggest",
    description="Finds the clips of an evaluated set that can be removed, and other clips that would fill gaps in its "
    "coverage.",
    params=job_params.SuggestParams,
    implementation="marey_worker.kinds.suggest:run",
    version=9,
    inputs={"evaluation": _EVALUATED, "candidates": _CANDIDATES, "metric": METRIC},
    outputs={"document": "file", "report": "file"},
    facets=REMOVAL_FACETS,
)

OPTIMISE = KindDeclaration(
    name="optimise",
    description="Removes clips from an evaluated set and adds others, step by step, as long as the set improves.",
    params=job_params.OptimiseParams,
    implementation="marey_worker.kinds.optimise:run",
    version=5,
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
    version=6,
    inputs={"evaluation": _EVALUATED},
    outputs={"document": "file"},
)
