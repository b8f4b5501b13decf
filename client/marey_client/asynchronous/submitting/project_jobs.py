"""Counterparts of `marey_client.submitting.project_jobs` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from typing import Any, Unpack

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.edits import AsyncCommands
from marey_client.asynchronous.handles.evaluations import AsyncEvaluationHandle
from marey_client.asynchronous.handles.jobs import AsyncJobHandle
from marey_client.asynchronous.handles.metrics import AsyncMetric
from marey_client.asynchronous.handles.models import AsyncModelHandle
from marey_client.asynchronous.handles.pipelines import AsyncPipelineRun
from marey_client.asynchronous.handles.skeletons import AsyncSkeletonHandle
from marey_client.asynchronous.imports import AsyncNotice
from marey_client.asynchronous.jobs import AsyncOnProgress
from marey_client.asynchronous.project_items import AsyncProjectItems
from marey_client.asynchronous.submitting.requests import AsyncAlignedClips, AsyncAnnotations, AsyncClips, AsyncTakes
from marey_client.keywords.evaluation import EvaluateKeywords
from marey_client.keywords.processing import (
    AlignKeywords,
    AnnotateKeywords,
    CutKeywords,
    DistancesKeywords,
    EditKeywords,
    IndexKeywords,
    ModelKeywords,
    ModelPlanKeywords,
    QualityKeywords,
)
from marey_client.submitting.project_jobs import CommitTo, JobSubmission
from marey_client.transport import Params
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.job_params import RetargetParams
from marey_schemas.queue.jobs import CacheMode, Job, JobCreate
from marey_schemas.queue.pipelines import PipelineCreate


@counterpart_of(JobSubmission)
class AsyncJobSubmission(AsyncProjectItems):
    """Items of a project, and methods that submit jobs, which make new items from items.

    Methods that submit a job take `commit`: if the job succeeds, its results are committed to a branch of a dataset.
    For example, "gaits@main/studio" is the folder `studio` on the branch `main` of the dataset `gaits`.
    """

    _sync: JobSubmission

    async def submit(self, job: JobCreate) -> AsyncJobHandle:
        """Submit a job of any kind to the project; return its handle."""
        exchanged: AsyncJobHandle = await self._exchange(self._sync.submit, job)
        return exchanged

    async def job(self, job_id: str) -> AsyncJobHandle:
        """Return a handle of the job of the project with this id. Raises `NotFound` if there is none."""
        exchanged: AsyncJobHandle = await self._exchange(self._sync.job, job_id)
        return exchanged

    async def pipeline(self, pipeline: PipelineCreate) -> AsyncPipelineRun:
        """Submit jobs that read each other's outputs; either all jobs are submitted, or none is."""
        exchanged: AsyncPipelineRun = await self._exchange(self._sync.pipeline, pipeline)
        return exchanged

    async def build_model(
        self,
        takes: AsyncTakes,
        *,
        name: str,
        seed: int = 0,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        options: ImportOptions | None = None,
        layer: str | None = None,
        notice: AsyncNotice | None = None,
        **choices: Unpack[ModelPlanKeywords],
    ) -> AsyncPipelineRun:
        """Submit the jobs that make a model from takes: import, retarget, annotate, cut, align, model, tree.

        `takes` are clips and folders of clips, or files that `find_files` found, which are imported with `options`;
        `notice` is called during their upload. With a `layer`, clips on the server are cut along their annotations in
        this layer, or aligned by these annotations. The `choices` are fields of `ModelPlan`, for example
        `skeleton={"item": id}`, `annotate={"proposal": {"method": "steps"}}`, `cut={"labels": ["left"]}`. If some
        takes have changed, only the results that depend on these takes are computed again.
        """
        exchanged: AsyncPipelineRun = await self._exchange(
            self._sync.build_model,
            takes,
            name=name,
            seed=seed,
            priority=priority,
            cache=cache,
            commit=commit,
            options=options,
            layer=layer,
            notice=notice,
            **choices,
        )
        return exchanged

    async def retarget(
        self,
        clips: AsyncClips,
        skeleton: AsyncSkeletonHandle | str,
        *,
        into: str,
        params: RetargetParams | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
    ) -> AsyncJobHandle:
        """Submit a job that retargets clips, or folders given by path, to a skeleton given as handle, path or id.

        Uses the newest joint mapping of each skeleton.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.retarget,
            clips,
            skeleton,
            into=into,
            params=params,
            priority=priority,
            cache=cache,
            commit=commit,
        )
        return exchanged

    async def annotate(
        self,
        clips: AsyncClips,
        *,
        proposal: str | Mapping[str, Any] = "steps",
        into: str = "",
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[AnnotateKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that annotates clips with the method `proposal`; the results go below the folder `into`.

        Methods are `steps`, `velocity_minima` and `wrist_contact`, as in `{"method": "steps", "most_turn_deg": 45}`;
        `options` are the other fields of `AnnotateParams`.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.annotate,
            clips,
            proposal=proposal,
            into=into,
            priority=priority,
            cache=cache,
            commit=commit,
            **options,
        )
        return exchanged

    async def cut(
        self,
        annotations: AsyncAnnotations,
        *,
        into: str,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[CutKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that cuts clips along the segments of annotations, into folders below `into`.

        `options` are those of `CutParams`, for example `labels=("step_left", "step_right")` or `by_label=True`.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.cut, annotations, into=into, priority=priority, cache=cache, commit=commit, **options
        )
        return exchanged

    async def index(
        self, clips: AsyncClips = "", *, priority: int = 0, cache: CacheMode = "use", **options: Unpack[IndexKeywords]
    ) -> AsyncJobHandle:
        """Submit a job that indexes clips or folders (default: all clips), so that `similar` finds moments in them.

        `options` are those of `IndexParams`. An index with the same name in the top folder is updated: clips whose
        revisions are in the index already are not read again, and clips that are not given are removed from the index.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.index, clips, priority=priority, cache=cache, **options
        )
        return exchanged

    async def align(
        self,
        clips: AsyncClips,
        *,
        into: str,
        annotations: AsyncAnnotations | None = None,
        metric: AsyncMetric | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[AlignKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that aligns clips of one skeleton, all of which show the same action.

        `options` are those of `AlignParams`, for example `rate_hz=30` or `layer="steps"`. If `options` name a layer or
        labels, the default for `annotations` is the annotations of the clips. With a `metric`, the cost of a pair of
        poses is their perceptual distance.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.align,
            clips,
            into=into,
            annotations=annotations,
            metric=metric,
            priority=priority,
            cache=cache,
            commit=commit,
            **options,
        )
        return exchanged

    async def edit(
        self,
        clips: AsyncClips,
        commands: AsyncCommands,
        *,
        into: str = "",
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[EditKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that edits clips, or folders given by path, with commands or with a stored edit.

        The results are new clips in the folder `into`, or, with the option `suffix`, in the folders of the edited
        clips. With `in_place=True`, the results are new revisions of the edited clips instead. `options` are those of
        `EditParams`.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.edit, clips, commands, into=into, priority=priority, cache=cache, commit=commit, **options
        )
        return exchanged

    async def evaluate(
        self,
        clips: AsyncClips,
        *,
        into: str = "",
        normaliser: AsyncEvaluationHandle | str | None = None,
        metric: AsyncMetric | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[EvaluateKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that evaluates clips of one skeleton, or folders of clips given by path.

        `options` are those of `EvaluateParams`, for example `name="walks-eval"` or `database={"mirroring": "add"}`;
        `normaliser` is another evaluation, or the id of one: its scaling of features is used, so that the results of
        both evaluations can be compared. With a `metric`, the perceptual distances of transitions are measured, too.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.evaluate,
            clips,
            into=into,
            normaliser=normaliser,
            metric=metric,
            priority=priority,
            cache=cache,
            commit=commit,
            **options,
        )
        return exchanged

    async def distances(
        self,
        clips: AsyncClips,
        *,
        metric: AsyncMetric | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        **options: Unpack[DistancesKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that measures how different clips look to people, by a perceptual metric.

        `metric` is a stored metric, its id, or the name of a built-in one, such as `published/sigmoid`; `options` are
        those of `DistancesParams`. `handles.metrics.Distances` reads the result.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.distances, clips, metric=metric, priority=priority, cache=cache, **options
        )
        return exchanged

    async def quality(
        self,
        clips: AsyncClips,
        *,
        reference: AsyncClips | None = None,
        contacts: AsyncAnnotations | None = None,
        seed: int = 0,
        priority: int = 0,
        cache: CacheMode = "use",
        **options: Unpack[QualityKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that measures foot skate, contacts, penetration, jitter, joint limits, speed and turn rate.

        `reference` are recorded clips, which are measured in the same way and shown beside `clips`; `contacts` are
        annotations of all clips with segments `contact_left`, `contact_right` or `contact_both`; `options` are those of
        `QualityParams`, for example `rate_hz=60`. `handles.findings.Quality` reads the result. The numbers are also
        facets of the clips.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.quality,
            clips,
            reference=reference,
            contacts=contacts,
            seed=seed,
            priority=priority,
            cache=cache,
            **options,
        )
        return exchanged

    async def evaluation(self, job: Job, *, on_progress: AsyncOnProgress | None = None) -> AsyncEvaluationHandle:
        """Wait for a job, and return the evaluation that it created. Raises `JobUnsuccessful` if the job failed."""
        exchanged: AsyncEvaluationHandle = await self._exchange(self._sync.evaluation, job, on_progress=on_progress)
        return exchanged

    async def train_model(
        self,
        aligned: AsyncAlignedClips,
        *,
        into: str = "",
        seed: int = 0,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[ModelKeywords],
    ) -> AsyncJobHandle:
        """Submit a job that trains a model on clips that were aligned with each other, given as one or several folders.

        `options` are those of `ModelParams`, for example `name="step"` or `spatial_share=0.98`.
        """
        exchanged: AsyncJobHandle = await self._exchange(
            self._sync.train_model,
            aligned,
            into=into,
            seed=seed,
            priority=priority,
            cache=cache,
            commit=commit,
            **options,
        )
        return exchanged

    async def model(self, job: Job, *, on_progress: AsyncOnProgress | None = None) -> AsyncModelHandle:
        """Wait for a job, and return the model that it created. Raises `JobUnsuccessful` if the job failed."""
        exchanged: AsyncModelHandle = await self._exchange(self._sync.model, job, on_progress=on_progress)
        return exchanged

    def jobs(self, *, filters: Params | None = None) -> AsyncIterator[AsyncJobHandle]:
        """List the project's jobs, newest first."""
        return self._each(self._sync.jobs, filters=filters)
