"""Job requests for each kind of job. Where necessary, the inputs are looked up on the server.

Every request uses the newest joint mapping of each skeleton.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias, Unpack, cast

from marey_client.arguments import checked
from marey_client.errors import NoAnnotations
from marey_client.handles.annotations import AnnotationHandle
from marey_client.handles.clips import ClipHandle
from marey_client.handles.edits import Commands, EditHandle, as_edit
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.handles.metrics import Metric, metric_choice
from marey_client.handles.processed import ProcessedHandle
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.imports import LocalFile, Notice
from marey_client.jobs import job_request
from marey_client.keywords.processing import DistancesKeywords, EditKeywords, ModelPlanKeywords
from marey_client.places import Places, as_inputs, items_at, resolved
from marey_client.project_items import ProjectItems
from marey_schemas.items import LOOP_TAG, Item
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.job_params import (
    AlignParams,
    AnnotateParams,
    CutParams,
    DistancesParams,
    EditParams,
    EvaluateParams,
    IndexParams,
    ModelParams,
    QualityParams,
    RetargetParams,
)
from marey_schemas.queue.jobs import ItemInput, JobCreate
from marey_schemas.queue.model_pipelines import ModelPlan

Clips: TypeAlias = Places[ClipHandle]
"""Clips as handles, paths or ids; folders of clips given by their paths; or several of these."""

Annotations: TypeAlias = Places[AnnotationHandle]
AlignedClips: TypeAlias = Places[ProcessedHandle]

Takes: TypeAlias = Clips | Sequence[LocalFile]
"""Clips and folders of clips on the server, or local files as returned by `find_files`."""


def retarget_request(
    project: ProjectItems, clips: Clips, skeleton: SkeletonHandle | str, params: RetargetParams
) -> JobCreate:
    """Return the job request to retarget clips to a skeleton, given as handle, path or id."""
    clips = resolved(project.clips, clips)
    target = project.skeletons[skeleton] if isinstance(skeleton, str) else skeleton
    inputs: dict[str, Any] = {"clips": as_inputs(clips), "skeleton": ItemInput(item=target.id)}
    if edited := project.edited_rigs(items_at(project.clips, clips)):
        inputs["rigs"] = edited
    return job_request("retarget", inputs, params)


def annotate_request(project: ProjectItems, clips: Clips, params: AnnotateParams) -> JobCreate:
    """Return the job request to annotate clips by the method that `params` name."""
    clips = resolved(project.clips, clips)
    inputs: dict[str, Any] = {"clips": as_inputs(clips)}
    if edited := project.edited_rigs(items_at(project.clips, clips)):
        inputs["rigs"] = edited
    return job_request("annotate", inputs, params)


def cut_request(project: ProjectItems, annotations: Annotations, params: CutParams) -> JobCreate:
    """Return the job request to cut the annotated clips along the segments of the annotations."""
    annotations = resolved(project.annotations, annotations)
    found = {
        one.id: one
        for one in items_at(project.annotations, annotations, sort="id")
        if params.layer in (None, one.summary["layer"])
    }
    clips = {(one.summary["clip"], one.summary["clip_revision"]) for one in found.values()}
    inputs = {
        "annotations": tuple(ItemInput(item=one.id, revision=one.revision) for one in found.values()),
        "clips": tuple(ItemInput(item=clip, revision=revision) for clip, revision in sorted(clips)),
    }
    return job_request("cut", inputs, params)


def align_request(
    project: ProjectItems,
    clips: Clips,
    annotations: Annotations | None,
    params: AlignParams,
    metric: Metric | None = None,
) -> JobCreate:
    """Return the job request to align clips with each other.

    If `annotations` is None and `params` name a layer or labels, the annotations of these clips are used. If `params`
    name a layer, only annotations in this layer are used.
    """
    clips = resolved(project.clips, clips)
    found = {item.id: item for item in items_at(project.clips, clips)}
    chosen, named = metric_choice(metric)
    params = params.model_copy(update=named)
    inputs: dict[str, Any] = {"clips": as_inputs(clips), **chosen}
    if len(edited := project.edited_rigs(found.values())) == 1:
        (inputs["rig"],) = edited
    if annotations is not None:
        inputs["annotations"] = as_inputs(resolved(project.annotations, annotations))
    elif params.layer is not None or params.labels:
        inputs["annotations"] = _annotations_of(project, found, params.layer)
    return job_request("align", inputs, params)


def edit_request(project: ProjectItems, clips: Clips, commands: Commands, options: EditKeywords) -> JobCreate:
    """Return the job request to edit clips; further clips that the commands name become inputs, too.

    `options` are those of `EditParams`.
    """
    clips = resolved(project.clips, clips)
    inputs: dict[str, Any] = {"clips": as_inputs(clips)}
    if isinstance(commands, EditHandle):
        edit = commands.document(revision=commands.item.revision)
        inputs["edit"] = commands.as_input()
        params = checked(EditParams, options)
    else:
        edit = as_edit(commands)
        params = checked(EditParams, {**options, "commands": edit.commands})
    if edit.sources:
        inputs["sources"] = tuple(ItemInput(item=item) for item in edit.sources)
    if edited := project.edited_rigs(items_at(project.clips, clips)):
        inputs["rigs"] = edited
    return job_request("edit", inputs, params)


def evaluate_request(
    project: ProjectItems,
    clips: Clips,
    params: EvaluateParams,
    normaliser: EvaluationHandle | str | None,
    metric: Metric | None = None,
) -> JobCreate:
    """Return the job request to evaluate clips; clips with the tag `loop` are treated as loops."""
    clips = resolved(project.clips, clips)
    found = list(items_at(project.clips, clips))
    chosen, named = metric_choice(metric)
    params = params.model_copy(update=named)
    inputs: dict[str, Any] = {"clips": as_inputs(clips), **chosen}
    if isinstance(normaliser, str):
        inputs["normaliser"] = ItemInput(item=project.evaluations[normaliser].id)
    elif normaliser is not None:
        inputs["normaliser"] = normaliser.as_input()
    if len(edited := project.edited_rigs(found)) == 1:
        (inputs["rig"],) = edited
    if tagged := [item.id for item in found if LOOP_TAG in item.tags]:
        params = params.model_copy(update={"loops": tuple(dict.fromkeys((*params.loops, *tagged)))})
    return job_request("evaluate", inputs, params)


def distances_request(
    project: ProjectItems, clips: Clips, metric: Metric | None, options: DistancesKeywords
) -> JobCreate:
    """Return the job request to compare clips by a metric; clips with the tag `loop` are treated as loops.

    `options` are those of `DistancesParams`.
    """
    clips = resolved(project.clips, clips)
    found = list(items_at(project.clips, clips))
    chosen, named = metric_choice(metric)
    params = checked(DistancesParams, {**options, **named})
    inputs: dict[str, Any] = {"clips": as_inputs(clips), **chosen}
    if len(edited := project.edited_rigs(found)) == 1:
        (inputs["rig"],) = edited
    return job_request("distances", inputs, params)


def quality_request(
    project: ProjectItems, clips: Clips, reference: Clips | None, contacts: Annotations | None, params: QualityParams
) -> JobCreate:
    """Return the job request to measure the quality of clips, and of `reference` clips if they are given.

    `contacts` are annotations of all clips; if they are None, contacts are detected.
    """
    clips = resolved(project.clips, clips)
    inputs: dict[str, Any] = {"clips": as_inputs(clips)}
    found = list(items_at(project.clips, clips))
    if reference is not None:
        reference = resolved(project.clips, reference)
        inputs["reference"] = as_inputs(reference)
        found += items_at(project.clips, reference)
    if contacts is not None:
        inputs["contacts"] = as_inputs(resolved(project.annotations, contacts))
    if edited := project.edited_rigs(found):
        inputs["rigs"] = edited
    return job_request("quality", inputs, params)


def index_request(project: ProjectItems, clips: Clips, params: IndexParams) -> JobCreate:
    """Return the job request to index clips; an index with the same name in the top folder is updated."""
    clips = resolved(project.clips, clips)
    inputs: dict[str, Any] = {"clips": as_inputs(clips)}
    earlier = next(iter(project.items(Kind.INDEX).list(path=params.name, page_size=1)), None)
    if earlier is not None:
        inputs["index"] = ItemInput(item=earlier.id)
    return job_request("index", inputs, params)


def model_request(project: ProjectItems, aligned: AlignedClips, params: ModelParams) -> JobCreate:
    """Return the job request to train a model on aligned clips."""
    return job_request("model", {"aligned": as_inputs(resolved(project.processed, aligned))}, params)


def plan_model(
    project: ProjectItems,
    takes: Takes,
    *,
    name: str,
    options: ImportOptions | None = None,
    layer: str | None = None,
    notice: Notice | None = None,
    **choices: Unpack[ModelPlanKeywords],
) -> ModelPlan:
    """Plan the jobs that build a model from takes. Files are uploaded, and the jobs import them with `options`.

    With a `layer`, clips on the server are cut along their annotations in this layer, or aligned by these annotations.
    The `choices` are fields of `ModelPlan`; by default, results are stored in a folder with the model's name. Raises
    `NoAnnotations` if no clip has an annotation in the layer.
    """
    files = [one for one in takes if isinstance(one, LocalFile)] if isinstance(takes, Sequence) else []
    known = _of_files(project, files, options, notice) if files else _of_clips(project, cast(Clips, takes), layer)
    return checked(ModelPlan, {"name": name, "into": name, **known, **choices})


def _of_files(
    project: ProjectItems, files: Sequence[LocalFile], options: ImportOptions | None, notice: Notice | None
) -> dict[str, Any]:
    given = options.model_dump(exclude_unset=True) if options else {}
    return {"files": {"files": project.imports.send(files, notice=notice), **given}}


def _of_clips(project: ProjectItems, clips: Clips, layer: str | None) -> dict[str, Any]:
    clips = resolved(project.clips, clips)
    found = {one.id: one for one in items_at(project.clips, clips)}
    known = {"clips": as_inputs(clips), "rigs": project.edited_rigs(found.values())}
    if layer is None:
        return known
    annotations = _annotations_of(project, found, layer)
    if not annotations:
        raise NoAnnotations(
            f"none of these clips has an annotation in the layer {layer!r}; name another layer, or annotate the clips "
            "first"
        )
    return {**known, "annotations": annotations}


def _annotations_of(project: ProjectItems, clips: Mapping[str, Item], layer: str | None) -> tuple[ItemInput, ...]:
    """Return the annotations of clips, which are given by id; with a `layer`, only the annotations in this layer."""
    listed: Iterable[AnnotationHandle] = project.annotations.list(sort="id")
    return tuple(
        one.as_input()
        for one in listed
        if one.item.summary["clip"] in clips and layer in (None, one.item.summary["layer"])
    )
