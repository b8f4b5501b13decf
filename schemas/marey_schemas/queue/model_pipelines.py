"""Pipeline from takes to a model of an action: import, retarget, annotate, cut, align, model, tree."""

from typing import Any, Self

from pydantic import Field, model_validator

from marey_schemas.base import Request
from marey_schemas.names import ItemName, ReceivingPath
from marey_schemas.queue.job_params import AlignParams, AnnotateParams, CutParams, ImportParams, ModelParams, TreeParams
from marey_schemas.queue.jobs import ExistingInput, ItemInput
from marey_schemas.queue.pipelines import PipelineCreate, PipelineStep

Inputs = tuple[ExistingInput, ...]


class ModelPlan(Request):
    """Plan of a model: the takes from which it is made, and the parameters of each step.

    Takes are files to import or existing clips. They are retargeted if a skeleton is given, cut into examples along
    proposed or existing annotations, and aligned; a model is trained on the examples, and a tree is built for searches.
    """

    name: ItemName = Field(description="Name of the model, and also of the action that it generates.")
    into: ReceivingPath = Field(
        min_length=1, description="The collection of the model; everything else is stored below it."
    )
    files: ImportParams | None = Field(None, description="Files of takes to import.")
    clips: Inputs = Field((), max_length=1000, description="Takes that are already in the project.")
    skeleton: ItemInput | None = Field(
        None, description="The skeleton that the takes are retargeted to; absent: no retargeting."
    )
    rigs: tuple[ItemInput, ...] = Field(
        (),
        max_length=1000,
        description="Revisions of the clips' skeletons whose joint mappings are used; needed only for "
        "mappings that were edited after the import.",
    )
    annotations: Inputs = Field((), max_length=1000, description="Annotations of the takes.")
    annotate: AnnotateParams | None = Field(
        None, description="Parameters of the job that proposes annotations, if none are given."
    )
    cut: CutParams | None = Field(
        None, description="Parameters of the job that cuts out examples; absent: every take is an example."
    )
    align: AlignParams = AlignParams()
    model: ModelParams = ModelParams()
    tree: TreeParams | None = Field(
        TreeParams(), description="Parameters of the job that makes the tree; null: no tree."
    )

    @model_validator(mode="after")
    def _check_takes(self) -> Self:
        if (self.files is None) == (not self.clips):
            raise ValueError("give either files to import or clips, not both")
        if self.annotations and (self.files is not None or self.annotate is not None):
            raise ValueError("annotations: can be combined only with `clips`, not with `files` or `annotate`")
        if self.cut is not None and not self.annotations and self.annotate is None:
            raise ValueError("cut: cutting needs annotations; give `annotations`, or `annotate` to have them proposed")
        if self.annotations and self.skeleton is not None and self.cut is None:
            raise ValueError(
                "annotations: the annotations of the takes cannot be used after retargeting; cut the clips first"
            )
        return self


def model_pipeline(plan: ModelPlan, **shared: Any) -> PipelineCreate:
    """Return the pipeline for a plan. `shared` contains further fields of the pipeline, such as `seed`."""
    steps: dict[str, PipelineStep] = {}
    clips: Any = plan.clips
    annotations: Any = plan.annotations

    def add(name: str, folder: str, params: Request, **inputs: Any) -> Any:
        """Add a step; return its outputs as the input of other steps."""
        into = f"{plan.into}/{folder}".rstrip("/")
        given = {role: value for role, value in inputs.items() if value not in ((), None)}
        steps[name] = PipelineStep(kind=name, inputs=given, params=_plain(params), into=into)
        return {"step": name}

    if plan.files is not None:
        clips = add("import", "takes", plan.files)
    if plan.cut is not None and plan.annotations:
        clips = add("cut", "pieces", plan.cut, annotations=annotations, clips=clips)
        annotations = clips if plan.skeleton is None else ()
    if plan.skeleton is not None:
        clips = add("retarget", "retargeted", Request(), clips=clips, skeleton=plan.skeleton, rigs=plan.rigs)
    if plan.annotate is not None:
        rigs = plan.rigs if plan.skeleton is None else ()
        annotations = add("annotate", "annotations", plan.annotate, clips=clips, rigs=rigs)
        if plan.cut is not None:
            clips = annotations = add("cut", "pieces", plan.cut, annotations=annotations, clips=clips)
    rig = plan.rigs[0] if plan.skeleton is None and len(plan.rigs) == 1 else None
    aligned = add("align", "aligned", plan.align, clips=clips, annotations=annotations, rig=rig)
    model = add("model", "", plan.model.model_copy(update={"name": plan.name}), aligned=aligned)
    if plan.tree is not None:  # it becomes a part of the model, wherever that is
        steps["tree"] = PipelineStep(kind="tree", inputs={"model": model}, params=_plain(plan.tree), into="")
    return PipelineCreate(steps=steps, **shared)


def _plain(params: Request) -> dict[str, Any]:
    return params.model_dump(mode="json", exclude_unset=True)
