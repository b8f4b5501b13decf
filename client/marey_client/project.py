"""Handle of a project: its items, collections, members, imports and jobs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

from marey_client.access import Members, change_quotas
from marey_client.audit import AuditConditions, read_audit
from marey_client.handles.bisections import read_range
from marey_client.handles.coverage_streams import CoverageStreams
from marey_client.handles.crossings import Crossing, Limit, OnMeasured, VersionEvaluations, find_crossing
from marey_client.handles.datasets import Datasets
from marey_client.handles.edits import Commands
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.handles.invitations import Invitations
from marey_client.handles.jobs import JobHandle
from marey_client.handles.metrics import Metric
from marey_client.handles.models import ModelHandle
from marey_client.handles.pipelines import PipelineRun, submit_pipeline
from marey_client.handles.schedules import Schedules
from marey_client.handles.scripts import Scripts
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.handles.webhooks import Webhooks
from marey_client.imports import Notice, find_files
from marey_client.jobs import Jobs, OnProgress
from marey_client.keywords.asking import ImportKeywords
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
from marey_client.progress import progress
from marey_client.project_items import ProjectItems
from marey_client.requests import (
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
from marey_client.transport import Params, as_json, read_model
from marey_client.uploads import UploadReport, upload
from marey_schemas.access import Project, ProjectChange, ProjectQuotaChange, ProjectQuotasInUse
from marey_schemas.audit import AuditEntry
from marey_schemas.datasets.naming import MAIN
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
from marey_schemas.sign_ins import BrowserLink

CommitTo = OutputsCommit | str | None
"""Branch and folder to which a job commits its results, as `OutputsCommit` or as `dataset[@branch][/folder]`."""


class ProjectHandle(ProjectItems):
    """Handle of a project, given by name; requests are sent only by its methods.

    Methods that submit a job take `commit`: if the job succeeds, its results are committed to a branch of a dataset.
    For example, "gaits@main/studio" is the folder `studio` on the branch `main` of the dataset `gaits`.
    """

    def __repr__(self) -> str:
        return f"<project {self.name!r} at {self.transport.url}>"

    @property
    def url(self) -> str:
        """The path of the resource, relative to the API's root."""
        return f"/projects/{self.name}"

    def read(self) -> Project:
        """Return the project's title, visibility and the caller's role."""
        return self.transport.get(Project, self.url)

    def change(self, change: ProjectChange) -> Project:
        """Change title, description or visibility."""
        return read_model(
            Project, self.transport.send("PATCH", self.url, content=as_json(change), headers={"If-Match": "*"})
        )

    def quotas(self) -> ProjectQuotasInUse:
        """Return the number of items and bytes in the project, and the limits."""
        return self.transport.get(ProjectQuotasInUse, f"{self.url}/quotas")

    def change_quotas(self, change: ProjectQuotaChange) -> ProjectQuotasInUse:
        """Change the quotas of the project; None restores the limit of the settings, or no limit of running jobs.

        For administrators.
        """
        return change_quotas(self.transport, f"{self.url}/quotas", change, ProjectQuotasInUse)

    def delete(self) -> None:
        """Delete the project; `restore` restores it."""
        self.transport.send("DELETE", self.url, headers={"If-Match": "*"})

    def restore(self) -> Project:
        """Restore the deleted project."""
        return self.transport.post(Project, f"{self.url}/restore")

    def browser_link(self) -> BrowserLink:
        """Create a code that signs one browser in, once, to read the project; append it to an address after `#`."""
        return self.transport.post(BrowserLink, f"{self.url}/browser-links", repeatable=False)

    # -- what it holds -------------------------------------------------------------------------------------------------

    @cached_property
    def coverage_streams(self) -> CoverageStreams:
        """The coverage streams of the project: performances that are measured during their recording."""
        return CoverageStreams(self.transport, self.name)

    @cached_property
    def datasets(self) -> Datasets:
        """The datasets of the project: versions of its items."""
        return Datasets(self.transport, self.name)

    @cached_property
    def members(self) -> Members:
        """The members of the project and their roles."""
        return Members(self.transport, self.name)

    @cached_property
    def invitations(self) -> Invitations:
        """The invitations to the project."""
        return Invitations(self.transport, f"{self.url}/invitations")

    @cached_property
    def schedules(self) -> Schedules:
        """The schedules of the project, which submit jobs at certain times."""
        return Schedules(self.transport, self.name)

    @cached_property
    def scripts(self) -> Scripts:
        """The scripts of the project: commands of pinned Git commits that run as jobs."""
        return Scripts(self.transport, self.name)

    @cached_property
    def webhooks(self) -> Webhooks:
        """The webhooks of the project: addresses to which the server sends events."""
        return Webhooks(self.transport, f"{self.url}/webhooks")

    def audit(self, **conditions: Unpack[AuditConditions]) -> Iterator[AuditEntry]:
        """List changes of members and settings, deletions and restorations, newest first.

        Only owners of the project may read this log. `AuditConditions` describes the conditions.
        """
        return read_audit(self.transport, f"{self.url}/audit", **conditions)

    # -- jobs ----------------------------------------------------------------------------------------------------------

    def upload(
        self, places: str | Path | Iterable[str | Path], *, shown: bool | None = None, **options: Unpack[ImportKeywords]
    ) -> UploadReport:
        """Import the motion files in folders and below; return a report on each file. A refused file stops no other.

        `options` are those of `ImportOptions`, for example `collection="raw"`. A progress bar is shown on terminals and
        in notebooks; `shown` overrides this. Uploading the same files again changes nothing. Raises the errors of
        `find_files`, and `NotFound` if there is no such project.
        """
        found, chosen = find_files(places), ImportOptions.model_validate(options)
        self.read()  # a missing project is an error before any bytes are sent
        with progress(shown) as advance:
            return upload(self, found, chosen, advance)

    def submit(self, job: JobCreate) -> JobHandle:
        """Submit a job."""
        return JobHandle.of(Jobs(self.transport).submit(self.name, job), self)

    def job(self, job_id: str) -> JobHandle:
        """Return a job of the project by its id."""
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
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update=chosen))

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
        request = annotate_request(self, clips, AnnotateParams.model_validate({"proposal": method, **options}))
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update=chosen))

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
        request = cut_request(self, annotations, CutParams.model_validate(options))
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update=chosen))

    def index(
        self, clips: Clips = "", *, priority: int = 0, cache: CacheMode = "use", **options: Unpack[IndexKeywords]
    ) -> JobHandle:
        """Submit a job that indexes clips or folders (default: all clips), so that `similar` finds moments of them.

        `options` are those of `IndexParams`. If the top folder has an index with this name, it is updated: clips at
        revisions that it has are not read again, and it loses the clips that are not given.
        """
        request = index_request(self, clips, IndexParams.model_validate(options))
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
        labels, the default for `annotations` is the annotations of the clips. With a `metric`, perceptual distances are
        the costs of poses.
        """
        request = align_request(self, clips, annotations, AlignParams.model_validate(options), metric)
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update=chosen))

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
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update=chosen))

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
        request = evaluate_request(self, clips, EvaluateParams.model_validate(options), normaliser, metric)
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update=chosen))

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

        `reference` are recorded clips, which are measured in the same way and shown beside the others; `contacts` are
        annotations of all clips with segments `contact_left`, `contact_right` or `contact_both`; `options` are those of
        `QualityParams`, for example `rate_hz=60`. `handles.findings.Quality` reads the result. The numbers are also
        facets of the clips.
        """
        request = quality_request(self, clips, reference, contacts, QualityParams.model_validate(options))
        return self.submit(request.model_copy(update={"seed": seed, "priority": priority, "cache": cache}))

    def evaluation(self, job: Job, *, on_progress: OnProgress | None = None) -> EvaluationHandle:
        """Wait for a job, and return the evaluation that it created. Raises `JobUnsuccessful` if the job failed."""
        return self.evaluations.get(self._made_by(job, on_progress))

    def bisect(
        self,
        dataset: str,
        good: str,
        bad: str = MAIN,
        *,
        metric: str,
        limit: Limit | None = None,
        first_parent: bool = False,
        path: str = "",
        into: str | None = None,
        normaliser: EvaluationHandle | str | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        on_progress: OnProgress | None = None,
        on_measured: OnMeasured | None = None,
        **options: Unpack[EvaluateKeywords],
    ) -> Crossing:
        """Find the first bad version of a dataset between `good` and `bad`: the first one whose metric exceeds a limit.

        Evaluates the clips below `path` at both ends, then at few versions between them. A version is bad if `metric`,
        one of `HEADLINE_METRICS`, exceeds `limit`, for example `Limit(0.3)` or `Limit(0.5, above=False)`; by default,
        the limit is half-way between the values at the ends. A version that cannot be evaluated is skipped. The
        evaluations are stored in the folder `into`, by default the dataset's name with `-bisect` at its end. If the
        search is interrupted, the same call continues it, because existing evaluations are reused.

        `options` are those of `EvaluateParams`. Raises `CannotBisect` in these cases: there is no such metric; `good`
        is not among the versions before `bad`; one of these two versions cannot be evaluated; `good` turns out to be
        bad, or `bad` to be good; no `limit` is given, and both versions have the same value.
        """
        handle = self.datasets.at(dataset)
        evaluations = VersionEvaluations(
            self, handle, metric, EvaluateParams.model_validate(options),
            path=path, into=into, normaliser=normaliser, priority=priority, cache=cache, on_progress=on_progress,
        )  # fmt: skip
        return find_crossing(read_range(handle, good, bad, first_parent=first_parent), evaluations, limit, on_measured)

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
        request = model_request(self, aligned, ModelParams.model_validate(options))
        chosen = {"into": into, "priority": priority, "cache": cache, "commit": OutputsCommit.of(commit)}
        return self.submit(request.model_copy(update={"seed": seed, **chosen}))

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
