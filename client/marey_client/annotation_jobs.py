"""Jobs that propose annotations of clips, and that cut clips along annotations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from marey_client.annotations import AnnotationHandle
from marey_client.evaluations import Places, as_input, as_places, items_at
from marey_schemas.items import Item
from marey_schemas.job_params import AnnotateParams, CutParams
from marey_schemas.jobs import CollectionInput, ItemInput, JobCreate

if TYPE_CHECKING:
    from marey_client.project import ProjectHandle

AnnotationPlace = str | CollectionInput | ItemInput | AnnotationHandle
"""A folder by its path, an annotation, or either as an input of jobs."""

AnnotationPlaces = AnnotationPlace | Sequence[AnnotationPlace]


def annotate_request(project: ProjectHandle, clips: Places, params: AnnotateParams) -> JobCreate:
    """The job that annotates clips, going by the mappings of their skeletons as they are now."""
    places = as_places(clips)
    inputs: dict[str, Any] = {"clips": tuple(map(as_input, places))}
    if edited := project.edited_rigs(item for place in places for item in items_at(project, place)):
        inputs["rigs"] = edited
    return JobCreate(kind="annotate", inputs=inputs, params=params.model_dump(mode="json", exclude_unset=True))


def cut_request(project: ProjectHandle, annotations: AnnotationPlaces, params: CutParams) -> JobCreate:
    """The job that cuts clips along annotations, with the clips among its inputs, as each annotation knows its own."""
    single = isinstance(annotations, str | CollectionInput | ItemInput | AnnotationHandle)
    places: list[AnnotationPlace] = [annotations] if single else list(annotations)  # type: ignore[arg-type, list-item]
    found = {
        one.id: one
        for place in places
        for one in _annotations_at(project, place)
        if params.layer in (None, one.summary["layer"])
    }
    clips = {(one.summary["clip"], one.summary["clip_revision"]) for one in found.values()}
    inputs = {
        "annotations": tuple(ItemInput(item=one.id, revision=one.revision) for one in found.values()),
        "clips": tuple(ItemInput(item=clip, revision=revision) for clip, revision in sorted(clips)),
    }
    return JobCreate(kind="cut", inputs=inputs, params=params.model_dump(mode="json", exclude_unset=True))


def _annotations_at(project: ProjectHandle, place: AnnotationPlace) -> Iterator[Item]:
    if isinstance(place, AnnotationHandle):
        yield place.item
    elif isinstance(place, ItemInput):
        item = project.annotations.get(place.item).item
        yield item if place.revision is None else item.model_copy(update={"revision": place.revision})
    else:
        folder = place.strip("/") if isinstance(place, str) else place.collection
        yield from (one.item for one in project.annotations.list(collection=folder, sort="id"))
