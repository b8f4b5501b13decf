"""Handle of a project, with access to its settings, members, datasets, items and jobs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Unpack

from marey_client.access import Members, change_quotas
from marey_client.arguments import checked, checks_arguments
from marey_client.audit import AuditConditions, read_audit
from marey_client.handles.bisections import read_range
from marey_client.handles.coverage_streams import CoverageStreams
from marey_client.handles.crossings import Crossing, Limit, OnMeasured, VersionEvaluations, find_crossing
from marey_client.handles.datasets import Datasets
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.handles.invitations import Invitations
from marey_client.handles.schedules import Schedules
from marey_client.handles.scripts import Scripts
from marey_client.handles.webhooks import Webhooks
from marey_client.imports import find_files
from marey_client.jobs import OnProgress
from marey_client.keywords.asking import ImportKeywords
from marey_client.keywords.evaluation import EvaluateKeywords
from marey_client.progress import progress
from marey_client.submitting.project_jobs import JobSubmission
from marey_client.transport import as_json, read_model
from marey_client.uploads import UploadReport, upload
from marey_schemas.access import Project, ProjectChange, ProjectQuotaChange, ProjectQuotasInUse
from marey_schemas.audit import AuditEntry
from marey_schemas.datasets.naming import MAIN
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.job_params import EvaluateParams
from marey_schemas.queue.jobs import CacheMode
from marey_schemas.sign_ins import BrowserLink


@checks_arguments
class ProjectHandle(JobSubmission):
    """Handle of a project, given by name; requests are sent only by its methods."""

    def __repr__(self) -> str:
        return f"<project {self.name!r} at {self.transport.url}>"

    @property
    def url(self) -> str:
        """The path of the project, relative to the API's root."""
        return f"/projects/{self.name}"

    def read(self) -> Project:
        """Return the project: its title, its visibility, and the caller's role in it."""
        return self.transport.get(Project, self.url)

    def change(self, change: ProjectChange) -> Project:
        """Change title, description or visibility of the project; absent fields stay as they are."""
        return read_model(
            Project, self.transport.send("PATCH", self.url, content=as_json(change), headers={"If-Match": "*"})
        )

    def quotas(self) -> ProjectQuotasInUse:
        """Return the numbers of items, bytes and running jobs in the project, and their limits."""
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
        """Restore the project of this name that was deleted last.

        Raises `Conflict` if another project has the name now.
        """
        return self.transport.post(Project, f"{self.url}/restore")

    def browser_link(self) -> BrowserLink:
        """Create a code that signs one browser in, once, to read the project; append `#` and the code to an address."""
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

    def upload(
        self, places: str | Path | Iterable[str | Path], *, shown: bool | None = None, **options: Unpack[ImportKeywords]
    ) -> UploadReport:
        """Import the motion files in folders and subfolders; return a report. Refused files do not affect the others.

        `options` are those of `ImportOptions`, for example `collection="raw"`. A progress bar is shown on terminals and
        in notebooks; `shown` overrides this. Uploading the same files again changes nothing. Raises the errors of
        `find_files`, and `NotFound` if there is no such project.
        """
        found, chosen = find_files(places), checked(ImportOptions, options)
        self.read()  # a missing project is an error before any bytes are sent
        with progress(shown) as advance:
            return upload(self, found, chosen, advance)

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
            self, handle, metric, checked(EvaluateParams, options),
            path=path, into=into, normaliser=normaliser, priority=priority, cache=cache, on_progress=on_progress,
        )  # fmt: skip
        return find_crossing(read_range(handle, good, bad, first_parent=first_parent), evaluations, limit, on_measured)
