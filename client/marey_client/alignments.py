"""Aligned clips: ask for them, and read what alignment made of each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from marey_client.annotation_jobs import AnnotationPlaces
from marey_client.annotations import AnnotationHandle
from marey_client.evaluations import Places, as_input, as_places, items_at
from marey_client.items import ItemHandle
from marey_client.motions import ClipHandle, MotionArrays, frames_text
from marey_client.one_or_several import several
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.items import Item
from marey_schemas.job_params import AlignParams
from marey_schemas.jobs import CollectionInput, ItemInput, JobCreate
from marey_schemas.kinds import Kind

if TYPE_CHECKING:
    from marey_client.project import ProjectHandle


class ProcessedHandle(ItemHandle):
    """One aligned clip: canonical frames of an action, and the way back to the clip that they come from."""

    def motion(
        self, *, frames: slice | None = None, joints: str | Sequence[str] | None = None, revision: int | None = None
    ) -> MotionArrays:
        """Its canonical frames, in the canonical frame of reference."""
        query = {"frames": frames_text(frames), "joints": ",".join(several(joints)) if joints is not None else None}
        return MotionArrays.model_validate(self.part("motion", revision=revision, **query))

    def info(self, *, revision: int | None = None) -> AlignmentInfo:
        """Which set it belongs to, its keyframes, cost and options, and where and when its frames were."""
        return AlignmentInfo.model_validate(self.part("info", revision=revision))

    def time_function(self) -> NDArray[np.float64]:
        """(N,) fractional frame of the source, counted at the set's rate, at each canonical frame."""
        return self.info().time_function

    def source(self) -> ClipHandle | None:
        """The clip it comes from, as it is now; None where that is not in the store."""
        clip = self.info().clip
        if clip is None:
            return None
        item = self.transport.get(Item, f"/projects/{self.project}/{Kind.CLIP.plural}/{clip.item}")
        return ClipHandle(self.transport, self.project, item)


def align_request(
    project: ProjectHandle, clips: Places, annotations: AnnotationPlaces | None, params: AlignParams
) -> JobCreate:
    """The job that aligns clips, going by the mapping of their skeleton as it is now.

    Without annotations, but with a layer or labels: the annotations of that layer over these clips.
    """
    places = as_places(clips)
    found = {item.id: item for place in places for item in items_at(project, place)}
    inputs: dict[str, Any] = {"clips": tuple(map(as_input, places))}
    if len(edited := project.edited_rigs(found.values())) == 1:
        (inputs["rig"],) = edited
    if annotations is not None:
        single = isinstance(annotations, str | CollectionInput | ItemInput | AnnotationHandle)
        given = [annotations] if single else list(annotations)  # type: ignore[arg-type]
        inputs["annotations"] = tuple(map(_annotation_input, given))
    elif params.layer is not None or params.labels:
        inputs["annotations"] = tuple(
            one.as_input()
            for one in project.annotations.list(sort="id")
            if one.item.summary["clip"] in found and params.layer in (None, one.item.summary["layer"])
        )
    return JobCreate(kind="align", inputs=inputs, params=params.model_dump(mode="json", exclude_defaults=True))


def _annotation_input(place: Any) -> CollectionInput | ItemInput:
    if isinstance(place, str):
        return CollectionInput(collection=place.strip("/"))
    return place.as_input() if isinstance(place, AnnotationHandle) else place
