"""From takes to a model in one call: what the server knows of the takes goes into the plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from marey_client.errors import NoAnnotations
from marey_client.evaluations import Places, as_input, as_places, items_at
from marey_client.imports import LocalFile, Notice
from marey_schemas.model_pipelines import ModelPlan
from marey_schemas.options.imports import ImportOptions

if TYPE_CHECKING:
    from marey_client.project import ProjectHandle

Takes = Places | Sequence[LocalFile]
"""Clips and folders of clips that are there, or files on this machine, as `find_files` finds them."""


def plan_model(
    project: ProjectHandle,
    takes: Takes,
    *,
    options: ImportOptions | None = None,
    layer: str | None = None,
    notice: Notice | None = None,
    **choices: Any,
) -> ModelPlan:
    """The plan for a model of these takes. Files are sent now, to be imported as the `options` say.

    With a `layer`, clips are cut along their annotations of that layer, or aligned by them. The `choices` are fields of
    `ModelPlan`; results go to a folder of the model's name unless one is named.
    Raises `NoAnnotations` where no annotation of the layer is over the clips.
    """
    files = [one for one in takes if isinstance(one, LocalFile)] if isinstance(takes, Sequence) else []
    known = _of_files(project, files, options, notice) if files else _of_clips(project, takes, layer)  # type: ignore[arg-type]
    return ModelPlan.model_validate({"into": choices.get("name"), **known, **choices})


def _of_files(
    project: ProjectHandle, files: Sequence[LocalFile], options: ImportOptions | None, notice: Notice | None
) -> dict[str, Any]:
    given = options.model_dump(exclude_unset=True) if options else {}
    return {"files": {"files": project.imports.send(files, notice=notice), **given}}


def _of_clips(project: ProjectHandle, clips: Places, layer: str | None) -> dict[str, Any]:
    """Clips with the mappings of their skeletons as they are now, and with their annotations of a layer."""
    places = as_places(clips)
    found = {one.id: one for place in places for one in items_at(project, place)}
    known = {"clips": tuple(map(as_input, places)), "rigs": project.edited_rigs(found.values())}
    if layer is None:
        return known
    summaries = ((one, one.item.summary) for one in project.annotations.list(sort="id"))
    annotations = tuple(one.as_input() for one, it in summaries if it["clip"] in found and it["layer"] == layer)
    if not annotations:
        raise NoAnnotations(f"none of these clips has an annotation in the layer {layer!r}")
    return {**known, "annotations": annotations}
