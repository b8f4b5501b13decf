"""One project: its items, collections, members, imports and jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from marey_client.access import Members
from marey_client.alignments import ProcessedHandle, align_request
from marey_client.annotation_jobs import AnnotationPlaces, annotate_request, cut_request
from marey_client.annotations import AnnotationHandle
from marey_client.blobs import Blobs
from marey_client.coverage_streams import CoverageStreams
from marey_client.edit_jobs import edit_request
from marey_client.edits import Commands, EditHandle, Edits
from marey_client.evaluations import EvaluationHandle, Places, as_input, as_places, evaluate_request, items_at
from marey_client.imports import Imports
from marey_client.items import ItemHandle, Items
from marey_client.jobs import Jobs
from marey_client.model_building import Takes, plan_model
from marey_client.models import AlignedPlaces, ModelHandle, model_request
from marey_client.motions import ClipHandle, SkeletonHandle
from marey_client.paging import pages
from marey_client.pipelines import PipelineRun, submit_pipeline
from marey_client.transport import Params, Transport, as_json, read_model
from marey_schemas.access import Project, ProjectChange
from marey_schemas.items import Collection, CollectionChange, CollectionCreate, Item
from marey_schemas.job_params import AlignParams, AnnotateParams, CutParams, EvaluateParams, ModelParams, RetargetParams
from marey_schemas.jobs import ItemInput, Job, JobCreate
from marey_schemas.kinds import Kind
from marey_schemas.model_pipelines import model_pipeline
from marey_schemas.pipelines import PipelineCreate


class ProjectHandle:
    """A project by its name; nothing is asked until a method is called."""

    def __init__(self, transport: Transport, name: str) -> None:
        self.transport = transport
        self.name = name

    def __repr__(self) -> str:
        return f"<project {self.name!r} at {self.transport.url}>"

    @property
    def url(self) -> str:
        """The path below the API's root."""
        return f"/projects/{self.name}"

    def read(self) -> Project:
        """Title, visibility and the caller's role."""
        return self.transport.get(Project, self.url)

    def change(self, change: ProjectChange) -> Project:
        """Change title, description or visibility."""
        return read_model(
            Project, self.transport.send("PATCH", self.url, content=as_json(change), headers={"If-Match": "*"})
        )

    def delete(self) -> None:
        """Hide the project; `restore` brings it back."""
        self.transport.send("DELETE", self.url, headers={"If-Match": "*"})

    def restore(self) -> Project:
        """Bring a deleted project back."""
        return self.transport.post(Project, f"{self.url}/restore")

    # -- what it holds -------------------------------------------------------------------------------------------------

    @cached_property
    def clips(self) -> Items[ClipHandle]:
        """Its clips."""
        return Items(self.transport, self.name, Kind.CLIP, ClipHandle)

    @cached_property
    def skeletons(self) -> Items[SkeletonHandle]:
        """Its skeletons."""
        return Items(self.transport, self.name, Kind.SKELETON, SkeletonHandle)

    @cached_property
    def annotations(self) -> Items[AnnotationHandle]:
        """Its annotations."""
        return Items(self.transport, self.name, Kind.ANNOTATION, AnnotationHandle)

    @cached_property
    def processed(self) -> Items[ProcessedHandle]:
        """Its aligned clips."""
        return Items(self.transport, self.name, Kind.PROCESSED, ProcessedHandle)

    @cached_property
    def edits(self) -> Edits:
        """Its edits."""
        return Edits(self.transport, self.name, Kind.EDIT, EditHandle)

    @cached_property
    def models(self) -> Items[ModelHandle]:
        """Its models."""
        return Items(self.transport, self.name, Kind.MODEL, ModelHandle)

    @cached_property
    def evaluations(self) -> Items[EvaluationHandle]:
        """Its evaluations."""
        return Items(self.transport, self.name, Kind.EVALUATION, EvaluationHandle)

    def items(self, kind: Kind) -> Items[Any]:
        """Its items of any kind."""
        known: dict[Kind, type[ItemHandle]] = {
            Kind.CLIP: ClipHandle,
            Kind.SKELETON: SkeletonHandle,
            Kind.ANNOTATION: AnnotationHandle,
            Kind.PROCESSED: ProcessedHandle,
            Kind.EDIT: EditHandle,
            Kind.EVALUATION: EvaluationHandle,
            Kind.MODEL: ModelHandle,
        }
        return Items(self.transport, self.name, kind, known.get(kind, ItemHandle))

    @cached_property
    def collections(self) -> Collections:
        """Its tree of folders."""
        return Collections(self.transport, self.name)

    @cached_property
    def coverage_streams(self) -> CoverageStreams:
        """Performances that are being measured while they are recorded."""
        return CoverageStreams(self.transport, self.name)

    @cached_property
    def members(self) -> Members:
        """Who may do what."""
        return Members(self.transport, self.name)

    @cached_property
    def imports(self) -> Imports:
        """Files in."""
        return Imports(self.transport, self.name, Blobs(self.transport), Jobs(self.transport))

    # -- jobs ----------------------------------------------------------------------------------------------------------

    def submit(self, job: JobCreate) -> Job:
        """Hand in a job."""
        return Jobs(self.transport).submit(self.name, job)

    def pipeline(self, pipeline: PipelineCreate) -> PipelineRun:
        """Hand in jobs that work on what others of them make: all, or none."""
        return submit_pipeline(self.transport, self.name, pipeline)

    def build_model(
        self,
        takes: Takes,
        *,
        name: str,
        seed: int = 0,
        priority: int = 0,
        cache: Literal["use", "refresh", "off"] = "use",
        **choices: Any,
    ) -> PipelineRun:
        """Hand in all that leads from takes to a model: import, retarget, annotate, cut, align, model, tree.

        `takes` are clips and folders of clips, or files that `find_files` found. The `choices` are those of
        `model_building.plan_model`, for example `skeleton={"item": id}`, `annotate={"proposal": {"method": "steps"}}`,
        `cut={"labels": ["left"]}`. Of takes of which some have changed, only what depends on those is computed again.
        """
        plan = plan_model(self, takes, name=name, **choices)
        return self.pipeline(model_pipeline(plan, seed=seed, priority=priority, cache=cache))

    def retarget(
        self,
        clips: Places,
        skeleton: str,
        *,
        into: str,
        params: RetargetParams | None = None,
        priority: int = 0,
    ) -> Job:
        """Hand in the retargeting of clips, a folder by its path, or folders and clips, to the skeleton with this id.

        Mappings of the clips' skeletons that were edited since the clips were imported are gone by.
        """
        places = as_places(clips)
        inputs: dict[str, Any] = {"clips": tuple(map(as_input, places)), "skeleton": ItemInput(item=skeleton)}
        if edited := self.edited_rigs(item for place in places for item in items_at(self, place)):
            inputs["rigs"] = edited
        given = (params or RetargetParams()).model_dump(exclude_unset=True)
        return self.submit(JobCreate(kind="retarget", inputs=inputs, params=given, into=into, priority=priority))

    def annotate(
        self,
        clips: Places,
        *,
        proposal: str | Mapping[str, Any] = "steps",
        into: str = "",
        priority: int = 0,
        **options: Any,
    ) -> Job:
        """Hand in the annotation of clips, by a method or a method with its options, below the folder `into`.

        Methods are `steps`, `velocity_minima` and `wrist_contact`, as in `{"method": "steps", "most_turn_deg": 45}`;
        `options` are the others of `AnnotateParams`.
        """
        method = {"method": proposal} if isinstance(proposal, str) else proposal
        request = annotate_request(self, clips, AnnotateParams.model_validate({"proposal": method, **options}))
        return self.submit(request.model_copy(update={"into": into, "priority": priority}))

    def cut(self, annotations: AnnotationPlaces, *, into: str, priority: int = 0, **options: Any) -> Job:
        """Hand in the cutting of clips along the segments of annotations, into folders below `into`.

        `options` are those of `CutParams`, for example `labels=("step_left", "step_right")` or `by_label=True`.
        """
        request = cut_request(self, annotations, CutParams.model_validate(options))
        return self.submit(request.model_copy(update={"into": into, "priority": priority}))

    def align(
        self,
        clips: Places,
        *,
        into: str,
        annotations: AnnotationPlaces | None = None,
        priority: int = 0,
        cache: Literal["use", "refresh", "off"] = "use",
        **options: Any,
    ) -> Job:
        """Hand in the alignment of clips of one skeleton, all of which show the same action.

        `options` are those of `AlignParams`, for example `rate_hz=30` or `layer="steps"`. Where a layer or labels are
        named and no annotations are given, the annotations of the clips are gone by.
        """
        request = align_request(self, clips, annotations, AlignParams.model_validate(options))
        return self.submit(request.model_copy(update={"into": into, "priority": priority, "cache": cache}))

    def edit(self, clips: Places, commands: Commands, *, into: str = "", priority: int = 0, **options: Any) -> Job:
        """Hand in the editing of clips, a folder by its path, or folders and clips, by commands or a stored edit.

        The results go to the folder `into`, or get a `suffix`, or with `in_place=True` are the next revisions of the
        clips themselves. `options` are those of `EditParams`.
        """
        request = edit_request(self, clips, commands, **options)
        return self.submit(request.model_copy(update={"into": into, "priority": priority}))

    def evaluate(
        self,
        clips: Places,
        *,
        into: str = "",
        normaliser: EvaluationHandle | str | None = None,
        priority: int = 0,
        cache: Literal["use", "refresh", "off"] = "use",
        **options: Any,
    ) -> Job:
        """Hand in the evaluation of clips of one skeleton: a folder by its path, or folders and clips.

        `options` are those of `EvaluateParams`, for example `name="walks-eval"` or `database={"mirroring": "add"}`;
        `normaliser` is an evaluation, or its id, that the result shall be comparable with.
        """
        request = evaluate_request(self, clips, EvaluateParams.model_validate(options), normaliser)
        return self.submit(request.model_copy(update={"into": into, "priority": priority, "cache": cache}))

    def evaluation(self, job: Job, *, on_progress: Callable[[Job], None] | None = None) -> EvaluationHandle:
        """The evaluation that a job makes, once it is there. Raises `JobUnsuccessful`."""
        jobs = Jobs(self.transport)
        jobs.wait(job.id, on_progress=on_progress)
        (made,) = jobs.outputs(job.id)
        return self.evaluations.get(made.item)

    def train_model(
        self,
        aligned: AlignedPlaces,
        *,
        into: str = "",
        seed: int = 0,
        priority: int = 0,
        cache: Literal["use", "refresh", "off"] = "use",
        **options: Any,
    ) -> Job:
        """Hand in the training of a model on clips that were aligned with each other: a folder, or several of them.

        `options` are those of `ModelParams`, for example `name="step"` or `spatial_share=0.98`.
        """
        request = model_request(aligned, ModelParams.model_validate(options))
        update = {"into": into, "seed": seed, "priority": priority, "cache": cache}
        return self.submit(request.model_copy(update=update))

    def model(self, job: Job, *, on_progress: Callable[[Job], None] | None = None) -> ModelHandle:
        """The model that a job makes, once it is there. Raises `JobUnsuccessful`."""
        jobs = Jobs(self.transport)
        jobs.wait(job.id, on_progress=on_progress)
        (made,) = jobs.outputs(job.id)
        return self.models.get(made.item)

    def edited_rigs(self, clips: Iterable[Item]) -> tuple[ItemInput, ...]:
        """The skeletons of clips that have more than their first revision: their mapping may have been edited."""
        used = {str(clip.summary["skeleton"]) for clip in clips}
        skeletons = map(self.skeletons.get, sorted(used))
        return tuple(ItemInput(item=one.id) for one in skeletons if one.item.revision > 1)

    def jobs(self, *, filters: Params | None = None) -> Iterator[Job]:
        """Its jobs, newest first."""
        return Jobs(self.transport).list(self.name, filters=filters)


@dataclass(frozen=True)
class Collections:
    """The tree of folders of a project."""

    transport: Transport
    project: str

    @property
    def url(self) -> str:
        """The path below the API's root."""
        return f"/projects/{self.project}/collections"

    def list(
        self, *, path: str | None = None, deleted: bool = False, filters: Params | None = None
    ) -> Iterator[Collection]:
        """Every folder, by path; with `path` that one and those below it, with `deleted` those that can be restored."""
        params = {"path": path or None, "deleted": "true" if deleted else None, **(filters or {})}
        return pages(self.transport, Collection, self.url, params)

    def at(self, path: str, *, deleted: bool = False) -> Collection | None:
        """The folder with this path, or None; of several that were deleted, the one that was last."""
        found = [one for one in self.list(path=path, deleted=deleted) if one.path == path]
        return max(found, key=lambda one: one.deleted_at or one.created_at, default=None)

    def create(self, path: str) -> Collection:
        """Make a folder and those above it."""
        return self.transport.post(Collection, self.url, CollectionCreate(path=path))

    def move(self, collection: Collection, path: str) -> Collection:
        """Move or rename a folder with all it holds."""
        state = {"If-Match": f'"{collection.rev}.json"'}
        body = as_json(CollectionChange(path=path))
        return read_model(
            Collection, self.transport.send("PATCH", f"{self.url}/{collection.id}", content=body, headers=state)
        )

    def delete(self, collection: Collection) -> None:
        """Hide a folder with all it holds."""
        state = {"If-Match": f'"{collection.rev}.json"'}
        self.transport.send("DELETE", f"{self.url}/{collection.id}", headers=state)

    def restore(self, collection: Collection) -> Collection:
        """Bring a deleted folder back with all it held."""
        return self.transport.post(Collection, f"{self.url}/{collection.id}/restore")
