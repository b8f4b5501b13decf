"""Counterparts of `marey_client.handles.scripts` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping, Sequence

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.scripts import ScriptHandle, Scripts
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.comparisons import Goal, RunComparison
from marey_schemas.queue.jobs import Job, JobInput
from marey_schemas.queue.scripts import Script, ScriptCreate, ScriptRun, Value


@counterpart_of(Scripts)
class AsyncScripts(Counterpart):
    """Scripts of a project: commands of pinned Git commits, which run as jobs."""

    _sync: Scripts

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def url(self) -> str:
        """The path of the scripts, relative to the API's root."""
        return self._sync.url

    async def register(self, script: ScriptCreate) -> Script:
        """Register a script, so that members of the project can run it.

        Raises `Forbidden` if the server runs no scripts or the caller is no maintainer, `Conflict` if the name is
        taken, and `Invalid` if the server does not allow the repository.
        """
        return await self._run(self._sync.register, script)

    def list(self) -> AsyncIterator[Script]:
        """List the scripts by name."""
        return self._each(self._sync.list)

    def at(self, name: str) -> AsyncScriptHandle:
        """Return a handle of the script with this name; no request is sent."""
        exchanged: AsyncScriptHandle = self._now(self._sync.at, name)
        return exchanged


@counterpart_of(ScriptHandle)
class AsyncScriptHandle(Counterpart):
    """Handle of a script; requests are sent only by its methods."""

    _sync: ScriptHandle

    @property
    def url(self) -> str:
        return self._sync.url

    async def read(self) -> Script:
        """Return the script with its command, parameters, inputs, outputs and limits."""
        return await self._run(self._sync.read)

    async def run(
        self,
        values: Mapping[str, Value] | None = None,
        *,
        inputs: Mapping[str, JobInput | tuple[JobInput, ...]] | None = None,
        into: str = "",
        seed: int = 0,
        message: str = "",
        commit: OutputsCommit | str | None = None,
        allow_expired_consent: str | None = None,
    ) -> Job:
        """Submit a job that runs the script; return the job.

        `values` are the values of the script's parameters, and `inputs` are items, folders or outputs of other jobs.
        The clips that the script writes are stored in the folder `into`, and committed as `commit` says, such as
        "gaits@trial". If the consent for an input clip has ended, the run fails, unless `allow_expired_consent` gives a
        reason. Raises `Invalid` if a value or an input is wrong.
        """
        return await self._run(
            self._sync.run,
            values,
            inputs=inputs,
            into=into,
            seed=seed,
            message=message,
            commit=commit,
            allow_expired_consent=allow_expired_consent,
        )

    async def runs(self, *, sort: str = "-created_at", limit: int = 50) -> tuple[ScriptRun, ...]:
        """Return the first `limit` runs, sorted by `created_at`, `fields.<name>` or `values.<name>`.

        A minus sign before the key reverses the order, as in `-created_at`.
        """
        return await self._run(self._sync.runs, sort=sort, limit=limit)

    async def compare(
        self,
        *,
        sort: str = "-created_at",
        limit: int | None = None,
        fields: Sequence[str] = (),
        goals: Mapping[str, Goal] | None = None,
        curves: bool = False,
    ) -> RunComparison:
        """Compare settings, logged fields and curves of the first `limit` succeeded runs in the order `sort`.

        Without `limit`, as many runs as possible are compared. `fields` are the logged fields to compare, by default
        all. `goals` state for a field whether its highest or its lowest value is the best. With `curves`, the result
        contains the curves of at most 6 fields. Raises `BadRequest` for a field that no run has logged.
        """
        return await self._run(self._sync.compare, sort=sort, limit=limit, fields=fields, goals=goals, curves=curves)

    async def delete(self) -> None:
        """Delete the script; its runs remain."""
        await self._run(self._sync.delete)
