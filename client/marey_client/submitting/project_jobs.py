"""Jobs of a project: methods that submit jobs, and handles of the items that the jobs created."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Unpack

from marey_client.arguments import checked, checks_arguments
from marey_client.handles.edits import Commands
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.handles.jobs import JobHandle
from marey_client.handles.metrics import Metric
from marey_client.handles.models import ModelHandle
from marey_client.handles.pipelines import PipelineRun, submit_pipeline
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.imports import Notice
from marey_client.jobs import Jobs, OnProgress
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
from marey_client.project_items import ProjectItems
from marey_client.submitting.requests import (
    AlignedClips,
    Annotations,
    Clips,
    Takes,
    align_request,
    annotate_request,
    cut_request,
    distances_request,
    edit_request,
    evaluate_request,
    index_request,
    model_request,
    plan_model,
    quality_request,
    retarget_request,
)
from marey_client.transport import Params
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.job_params import (
    AlignParams,
    AnnotateParams,
    CutParams,
    EvaluateParams,
    IndexParams,
    ModelParams,
    QualityParams,
    RetargetParams,
)
from marey_schemas.queue.jobs import CacheMode, Job, JobCreate
from marey_schemas.queue.model_pipelines import model_pipeline
from marey_schemas.queue.pipelines import PipelineCreate

CommitTo = OutputsCommit | str | None
"""Branch and folder to which a job commits its results: an `OutputsCommit`, or a text `dataset[@branch][/folder]`."""


@checks_arguments
class JobSubmission(ProjectItems):
    """Items of a project, and methods that submit jobs, which make new items from items.

    Methods that submit a job take `commit`: if the job succeeds, its results are committed to a branch of a dataset.
    For example, "gaits@main/studio" is the folder `studio` on the branch `main` of the dataset `gaits`.
    """

    def submit(self, job: JobCreate) -> JobHandle:
        """Submit a job of any kind to the project; return its handle."""
        return JobHandle.of(Jobs(self.transport).submit(self.name, job), self)

    def _submit(self, request: JobCreate, *, into: str, priority: int, cache: CacheMode, commit: CommitTo) -> JobHandle:
        """Submit a job with the options that all jobs have: folder of the results, priority, cache and commit."""
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update=chosen))

    def job(self, job_id: str) -> JobHandle:
        """Return a handle of the job of the project with this id. Raises `NotFound` if there is none."""
        return JobHandle.of(Jobs(self.transport).get(job_id), self)

    def pipeline(self, pipeline: PipelineCreate) -> PipelineRun:
        """Submit jobs that read each other's outputs; either all jobs are submitted, or none is."""
        return submit_pipeline(self.transport, self.name, pipeline)

    def build_model(
        self,
        takes: Takes,
        *,
        name: str,
        seed: int = 0,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        options: ImportOptions | None = None,
        layer: str | None = None,
        notice: Notice | None = None,
        **choices: Unpack[ModelPlanKeywords],
    ) -> PipelineRun:
        """Submit the jobs that make a model from takes: import, retarget, annotate, cut, align, model, tree.

        `takes` are clips and folders of clips, or files that `find_files` found, which are imported with `options`;
        `notice` is called during their upload. With a `layer`, clips on the server are cut along their annotations in
        this layer, or aligned by these annotations. The `choices` are fields of `ModelPlan`, for example
        `skeleton={"item": id}`, `annotate={"proposal": {"method": "steps"}}`, `cut={"labels": ["left"]}`. If some
        takes have changed, only the results that depend on these takes are computed again.
        """
        plan = plan_model(self, takes, name=name, options=options, layer=layer, notice=notice, **choices)
        to = OutputsCommit.of(commit)
        return self.pipeline(model_pipeline(plan, seed=seed, priority=priority, cache=cache, commit=to))

    def retarget(
        self,
        clips: Clips,
        skeleton: SkeletonHandle | str,
        *,
        into: str,
        params: RetargetParams | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
    ) -> JobHandle:
        """Submit a job that retargets clips, or folders given by path, to a skeleton given as handle, path or id.

        Uses the newest joint mapping of each skeleton.
        """
        request = retarget_request(self, clips, skeleton, params or RetargetParams())
        return self._submit(request, into=into, priority=priority, cache=cache, commit=commit)

    def annotate(
        self,
        clips: Clips,
        *,
        proposal: str | Mapping[str, Any] = "steps",
        into: str = "",
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[AnnotateKeywords],
    ) -> JobHandle:
        """Submit a job that annotates clips with the method `proposal`; the results go below the folder `into`.

        Methods are `steps`, `velocity_minima` and `wrist_contact`, as in `{"method": "steps", "most_turn_deg": 45}`;
        `options` are the other fields of `AnnotateParams`.
        """
        method = {"method": proposal} if isinstance(proposal, str) else proposal
        request = annotate_request(self, clips, checked(AnnotateParams, {"proposal": method, **options}))
        return self._submit(request, into=into, priority=priority, cache=cache, commit=commit)

    def cut(
        self,
        annotations: Annotations,
        *,
        into: str,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[CutKeywords],
    ) -> JobHandle:
        """Submit a job that cuts clips along the segments of annotations, into folders below `into`.

        `options` are those of `CutParams`, for example `labels=("step_left", "step_right")` or `by_label=True`.
        """
        request = cut_request(self, annotations, checked(CutParams, options))
        return self._submit(request, into=into, priority=priority, cache=cache, commit=commit)

    def index(
        self, clips: Clips = "", *, priority: int = 0, cache: CacheMode = "use", **options: Unpack[IndexKeywords]
    ) -> JobHandle:
        """Submit a job that indexes clips or folders (default: all clips), so that `similar` finds moments in them.

        `options` are those of `IndexParams`. An index with the same name in the top folder is updated: clips whose
        revisions are in the index already are not read again, and clips that are not given are removed from the index.
        """
        request = index_request(self, clips, checked(IndexParams, options))
        return self.submit(request.model_copy(update={"priority": priority, "cache": cache}))

    def align(
        self,
        clips: Clips,
        *,
        into: str,
        annotations: Annotations | None = None,
        metric: Metric | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[AlignKeywords],
    ) -> JobHandle:
        """Submit a job that aligns clips of one skeleton, all of which show the same action.

        `options` are those of `AlignParams`, for example `rate_hz=30` or `layer="steps"`. If `options` name a layer or
        labels, the default for `annotations` is the annotations of the clips. With a `metric`, the cost of a pair of
        poses is their perceptual distance.
        """
        request = align_request(self, clips, annotations, checked(AlignParams, options), metric)
        return self._submit(request, into=into, priority=priority, cache=cache, commit=commit)

    def edit(
        self,
        clips: Clips,
        commands: Commands,
        *,
        into: str = "",
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[EditKeywords],
    ) -> JobHandle:
        """Submit a job that edits clips, or folders given by path, with commands or with a stored edit.

        The results are new clips in the folder `into`, or, with the option `suffix`, in the folders of the edited
        clips. With `in_place=True`, the results are new revisions of the edited clips instead. `options` are those of
        `EditParams`.
        """
        request = edit_request(self, clips, commands, options)
        return self._submit(request, into=into, priority=priority, cache=cache, commit=commit)

    def evaluate(
        self,
        clips: Clips,
        *,
        into: str = "",
        normaliser: EvaluationHandle | str | None = None,
        metric: Metric | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[EvaluateKeywords],
    ) -> JobHandle:
        """Submit a job that evaluates clips of one skeleton, or folders of clips given by path.

        `options` are those of `EvaluateParams`, for example `name="walks-eval"` or `database={"mirroring": "add"}`;
        `normaliser` is another evaluation, or the id of one: its scaling of features is used, so that the results of
        both evaluations can be compared. With a `metric`, the perceptual distances of transitions are measured, too.
        """
        request = evaluate_request(self, clips, checked(EvaluateParams, options), normaliser, metric)
        return self._submit(request, into=into, priority=priority, cache=cache, commit=commit)

    def distances(
        self,
        clips: Clips,
        *,
        metric: Metric | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        **options: Unpack[DistancesKeywords],
    ) -> JobHandle:
        """Submit a job that measures how different clips look to people, by a perceptual metric.

        `metric` is a stored metric, its id, or the name of a built-in one, such as `published/sigmoid`; `options` are
        those of `DistancesParams`. `handles.metrics.Distances` reads the result.
        """
        request = distances_request(self, clips, metric, options)
        return self.submit(request.model_copy(update={"priority": priority, "cache": cache}))

    def quality(
        self,
        clips: Clips,
        *,
        reference: Clips | None = None,
        contacts: Annotations | None = None,
        seed: int = 0,
        priority: int = 0,
        cache: CacheMode = "use",
        **options: Unpack[QualityKeywords],
    ) -> JobHandle:
        """Submit a job that measures foot skate, contacts, penetration, jitter, joint limits, speed and turn rate.

        `reference` are recorded clips, which are measured in the same way and shown beside `clips`; `contacts` are
        annotations of all clips with segments `contact_left`, `contact_right` or `contact_both`; `options` are those of
        `QualityParams`, for example `rate_hz=60`. `handles.findings.Quality` reads the result. The numbers are also
        facets of the clips.
        """
        request = quality_request(self, clips, reference, contacts, checked(QualityParams, options))
        return self.submit(request.model_copy(update={"seed": seed, "priority": priority, "cache": cache}))

    def evaluation(self, job: Job, *, on_progress: OnProgress | None = None) -> EvaluationHandle:
        """Wait for a job, and return the evaluation that it created. Raises `JobUnsuccessful` if the job failed."""
        return self.evaluations.get(self._made_by(job, on_progress))

    def train_model(
        self,
        aligned: AlignedClips,
        *,
        into: str = "",
        seed: int = 0,
        priority: int = 0,
        cache: CacheMode = "use",
        commit: CommitTo = None,
        **options: Unpack[ModelKeywords],
    ) -> JobHandle:
        """Submit a job that trains a model on clips that were aligned with each other, given as one or several folders.

        `options` are those of `ModelParams`, for example `name="step"` or `spatial_share=0.98`.
        """
        request = model_request(self, aligned, checked(ModelParams, options))
        seeded = request.model_copy(update={"seed": seed})
        return self._submit(seeded, into=into, priority=priority, cache=cache, commit=commit)

    def model(self, job: Job, *, on_progress: OnProgress | None = None) -> ModelHandle:
        """Wait for a job, and return the model that it created. Raises `JobUnsuccessful` if the job failed."""
        return self.models.get(self._made_by(job, on_progress))

    def jobs(self, *, filters: Params | None = None) -> Iterator[JobHandle]:
        """List the project's jobs, newest first."""
        return (JobHandle.of(job, self) for job in Jobs(self.transport).list(self.name, filters=filters))

    def _made_by(self, job: Job, on_progress: OnProgress | None) -> str:
        """Wait for a job and return the id of its only output."""
        jobs = Jobs(self.transport)
        jobs.wait(job.id, on_progress=on_progress)
        (made,) = jobs.outputs(job.id)
        return made.item
