"""Counterparts of `marey_client.project` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Unpack

from marey_client.asynchronous.access import AsyncMembers
from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.coverage_streams import AsyncCoverageStreams
from marey_client.asynchronous.handles.crossings import AsyncOnMeasured
from marey_client.asynchronous.handles.datasets import AsyncDatasets
from marey_client.asynchronous.handles.evaluations import AsyncEvaluationHandle
from marey_client.asynchronous.handles.invitations import AsyncInvitations
from marey_client.asynchronous.handles.schedules import AsyncSchedules
from marey_client.asynchronous.handles.scripts import AsyncScripts
from marey_client.asynchronous.handles.webhooks import AsyncWebhooks
from marey_client.asynchronous.jobs import AsyncOnProgress
from marey_client.asynchronous.submitting.project_jobs import AsyncJobSubmission
from marey_client.asynchronous.uploads import AsyncUploadReport
from marey_client.audit import AuditConditions
from marey_client.handles.crossings import Crossing, Limit
from marey_client.keywords.asking import ImportKeywords
from marey_client.keywords.evaluation import EvaluateKeywords
from marey_client.project import ProjectHandle
from marey_schemas.access import Project, ProjectChange, ProjectQuotaChange, ProjectQuotasInUse
from marey_schemas.audit import AuditEntry
from marey_schemas.datasets.naming import MAIN
from marey_schemas.queue.jobs import CacheMode
from marey_schemas.sign_ins import BrowserLink


@counterpart_of(ProjectHandle)
class AsyncProjectHandle(AsyncJobSubmission):
    """Handle of a project, given by name; requests are sent only by its methods."""

    _sync: ProjectHandle

    @property
    def url(self) -> str:
        """The path of the project, relative to the API's root."""
        return self._sync.url

    async def read(self) -> Project:
        """Return the project: its title, its visibility, and the caller's role in it."""
        return await self._run(self._sync.read)

    async def change(self, change: ProjectChange) -> Project:
        """Change title, description or visibility of the project; absent fields stay as they are."""
        return await self._run(self._sync.change, change)

    async def quotas(self) -> ProjectQuotasInUse:
        """Return the numbers of items, bytes and running jobs in the project, and their limits."""
        return await self._run(self._sync.quotas)

    async def change_quotas(self, change: ProjectQuotaChange) -> ProjectQuotasInUse:
        """Change the quotas of the project; None restores the limit of the settings, or no limit of running jobs.

        For administrators.
        """
        return await self._run(self._sync.change_quotas, change)

    async def delete(self) -> None:
        """Delete the project; `restore` restores it."""
        await self._run(self._sync.delete)

    async def restore(self) -> Project:
        """Restore the project of this name that was deleted last.

        Raises `Conflict` if another project has the name now.
        """
        return await self._run(self._sync.restore)

    async def browser_link(self) -> BrowserLink:
        """Create a code that signs one browser in, once, to read the project; append `#` and the code to an address."""
        return await self._run(self._sync.browser_link)

    @property
    def coverage_streams(self) -> AsyncCoverageStreams:
        """The coverage streams of the project: performances that are measured during their recording."""
        exchanged: AsyncCoverageStreams = self._as_async(self._sync.coverage_streams)
        return exchanged

    @property
    def datasets(self) -> AsyncDatasets:
        """The datasets of the project: versions of its items."""
        exchanged: AsyncDatasets = self._as_async(self._sync.datasets)
        return exchanged

    @property
    def members(self) -> AsyncMembers:
        """The members of the project and their roles."""
        exchanged: AsyncMembers = self._as_async(self._sync.members)
        return exchanged

    @property
    def invitations(self) -> AsyncInvitations:
        """The invitations to the project."""
        exchanged: AsyncInvitations = self._as_async(self._sync.invitations)
        return exchanged

    @property
    def schedules(self) -> AsyncSchedules:
        """The schedules of the project, which submit jobs at certain times."""
        exchanged: AsyncSchedules = self._as_async(self._sync.schedules)
        return exchanged

    @property
    def scripts(self) -> AsyncScripts:
        """The scripts of the project: commands of pinned Git commits that run as jobs."""
        exchanged: AsyncScripts = self._as_async(self._sync.scripts)
        return exchanged

    @property
    def webhooks(self) -> AsyncWebhooks:
        """The webhooks of the project: addresses to which the server sends events."""
        exchanged: AsyncWebhooks = self._as_async(self._sync.webhooks)
        return exchanged

    def audit(self, **conditions: Unpack[AuditConditions]) -> AsyncIterator[AuditEntry]:
        """List changes of members and settings, deletions and restorations, newest first.

        Only owners of the project may read this log. `AuditConditions` describes the conditions.
        """
        return self._each(self._sync.audit, **conditions)

    async def upload(
        self, places: str | Path | Iterable[str | Path], *, shown: bool | None = None, **options: Unpack[ImportKeywords]
    ) -> AsyncUploadReport:
        """Import the motion files in folders and subfolders; return a report. Refused files do not affect the others.

        `options` are those of `ImportOptions`, for example `collection="raw"`. A progress bar is shown on terminals and
        in notebooks; `shown` overrides this. Uploading the same files again changes nothing. Raises the errors of
        `find_files`, and `NotFound` if there is no such project.
        """
        exchanged: AsyncUploadReport = await self._exchange(self._sync.upload, places, shown=shown, **options)
        return exchanged

    async def bisect(
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
        normaliser: AsyncEvaluationHandle | str | None = None,
        priority: int = 0,
        cache: CacheMode = "use",
        on_progress: AsyncOnProgress | None = None,
        on_measured: AsyncOnMeasured | None = None,
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
        exchanged: Crossing = await self._exchange(
            self._sync.bisect,
            dataset,
            good,
            bad,
            metric=metric,
            limit=limit,
            first_parent=first_parent,
            path=path,
            into=into,
            normaliser=normaliser,
            priority=priority,
            cache=cache,
            on_progress=on_progress,
            on_measured=on_measured,
            **options,
        )
        return exchanged
