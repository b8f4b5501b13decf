"""Scripts of a project: commands of pinned Git commits that run as jobs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from marey_client.arguments import checked, checks_arguments
from marey_client.paging import pages
from marey_client.transport import Transport, named_path, sends_nothing
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.comparisons import GOALS, MOST_COMPARED, Goal, RunComparison
from marey_schemas.queue.jobs import Job, JobInput
from marey_schemas.queue.scripts import Script, ScriptCreate, ScriptRun, ScriptRunCreate, Value


@checks_arguments
@dataclass(frozen=True)
class Scripts:
    """Scripts of a project: commands of pinned Git commits, which run as jobs."""

    transport: Transport
    project: str

    @property
    def url(self) -> str:
        """The path of the scripts, relative to the API's root."""
        return f"/projects/{self.project}/scripts"

    def register(self, script: ScriptCreate) -> Script:
        """Register a script, so that members of the project can run it.

        Raises `Forbidden` if the server runs no scripts or the caller is no maintainer, `Conflict` if the name is
        taken, and `Invalid` if the server does not allow the repository.
        """
        return self.transport.post(Script, self.url, script)

    def list(self) -> Iterator[Script]:
        """List the scripts by name."""
        return pages(self.transport, Script, self.url)

    @sends_nothing
    def at(self, name: str) -> ScriptHandle:
        """Return a handle of the script with this name; no request is sent."""
        return ScriptHandle(self.transport, named_path(self.url, name))


@checks_arguments
@dataclass(frozen=True)
class ScriptHandle:
    """Handle of a script; requests are sent only by its methods."""

    transport: Transport
    url: str

    def read(self) -> Script:
        """Return the script with its command, parameters, inputs, outputs and limits."""
        return self.transport.get(Script, self.url)

    def run(
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
        request = checked(ScriptRunCreate,
            values=dict(values or {}), inputs=dict(inputs or {}), into=into, seed=seed, message=message,
            commit=OutputsCommit.of(commit), allow_expired_consent=allow_expired_consent is not None,
            consent_reason=allow_expired_consent,
        )  # fmt: skip
        return self.transport.post(Job, f"{self.url}/runs", request)

    def runs(self, *, sort: str = "-created_at", limit: int = 50) -> tuple[ScriptRun, ...]:
        """Return the first `limit` runs, sorted by `created_at`, `fields.<name>` or `values.<name>`.

        A minus sign before the key reverses the order, as in `-created_at`.
        """
        found = pages(self.transport, ScriptRun, f"{self.url}/runs", {"sort": sort, "limit": limit})
        return tuple(found)

    def compare(
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
        named: dict[str, str] = {
            goal: ",".join(name for name, own in (goals or {}).items() if own == goal) for goal in GOALS
        }
        most = MOST_COMPARED if limit is None else limit
        wanted: dict[str, Any] = {"sort": sort, "limit": most, "fields": ",".join(fields), **named}
        if curves:
            wanted["curves"] = True
        given = {name: value for name, value in wanted.items() if value != ""}
        return self.transport.get(RunComparison, f"{self.url}/comparison", given)

    def delete(self) -> None:
        """Delete the script; its runs remain."""
        self.transport.send("DELETE", self.url)
