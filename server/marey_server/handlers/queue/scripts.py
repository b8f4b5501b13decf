"""Resources of scripts, which projects run as jobs."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.queue.comparisons import GOALS, MOST_COMPARED, MOST_DRAWN, Goal, RunComparison
from marey_schemas.queue.jobs import Job
from marey_schemas.queue.scripts import FieldName, Script, ScriptCreate, ScriptRun, ScriptRunCreate
from marey_schemas.sizes import KIB
from marey_server.handlers.queue.jobs import MAX_SUBMISSION_BYTES, accepted
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import CommaSeparatedOf, PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.motions.run_comparison import Compared, compare_runs
from marey_server.store.listing import DEFAULT_LIMIT, MAX_LIMIT
from marey_server.store.scripts import registry, runs

MAX_SCRIPT_BYTES = 64 * KIB
"""Greatest size of a request with a script; small, because a page of a list contains many scripts."""


class ProjectScripts(Resource):
    """Scripts of a project."""

    path = "/projects/{project}/scripts"
    tag = "Jobs"

    @reads(access=Access.READER, query=PageQuery, answer=Script, paged=True, public=False)
    async def get(self, project: str, query: PageQuery) -> Rendered:
        """List the scripts of a project by name."""
        return await self.answer(registry.list_scripts, project, cursor=query.cursor, limit=query.limit)

    @writes(
        access=Access.MAINTAINER,
        body=RequestBody(ScriptCreate, max_bytes=MAX_SCRIPT_BYTES),
        answer=Script,
        status=201,
        idempotency="key",
    )
    async def post(self, project: str, body: ScriptCreate) -> Rendered:
        """Register a script: a command that is run in a pinned commit of a Git repository.

        The setting `script_repositories` must allow the repository. Contributors of the project can then run the script
        as jobs.
        """
        return await self.answer_with(
            lambda made: Reply(made, location=f"/projects/{project}/scripts/{made.name}"),
            registry.register_script,
            project,
            body,
            self.services.settings.script_repositories,
        )


class ScriptResource(Resource):
    """A script."""

    path = "/projects/{project}/scripts/{script}"
    tag = "Jobs"

    @reads(access=Access.READER, answer=Script, public=False)
    async def get(self, project: str, script: str) -> Rendered:
        """Return a script with its command, parameters, inputs, outputs and limits."""
        return await self.answer(registry.read_script, project, script)

    @writes(access=Access.MAINTAINER)
    async def delete(self, project: str, script: str) -> Rendered:
        """Delete a script; its runs remain, but cannot be retried."""
        return await self.answer(registry.delete_script, project, script)


class OrderQuery(Request):
    """Query parameters that select the order of runs."""

    sort: str = Field(
        "-created_at",
        max_length=100,
        description="Order: created_at, fields.<name> or values.<name>; a leading - sorts in descending order. Runs "
        "without the field come last.",
    )


class RunsQuery(OrderQuery):
    """Query parameters of a list of runs: their order and number."""

    limit: int = Field(DEFAULT_LIMIT, ge=1, le=MAX_LIMIT, description="Greatest number of runs.")


class ScriptRuns(Resource):
    """Runs of a script."""

    path = "/projects/{project}/scripts/{script}/runs"
    tag = "Jobs"

    @reads(access=Access.READER, query=RunsQuery, answer=ScriptRun, paged=True, public=False)
    async def get(self, project: str, script: str, query: RunsQuery) -> Rendered:
        """List the runs of a script, in the requested order, with their parameters and logged fields.

        The answer is a single page with the first `limit` runs.
        """
        return await self.answer(runs.list_runs, project, script, sort=query.sort, limit=query.limit)

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        body=RequestBody(ScriptRunCreate, max_bytes=MAX_SUBMISSION_BYTES),
        answer=Job,
        status=202,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, script: str, body: ScriptRunCreate) -> Rendered:
        """Run a script as a job. Inputs are pinned to their newest revisions."""
        return await self.answer_with(accepted, runs.run_script, project, script, body)


class ComparisonQuery(OrderQuery):
    """Query parameters of a comparison of runs."""

    limit: int = Field(MOST_COMPARED, ge=1, le=MOST_COMPARED, description="Greatest number of runs.")
    fields: CommaSeparatedOf[FieldName] = Field((), description="Logged fields to compare; absent: all.")
    highest: CommaSeparatedOf[FieldName] = Field((), description="Fields whose highest value is the best.")
    lowest: CommaSeparatedOf[FieldName] = Field((), description="Fields whose lowest value is the best.")
    curves: bool = Field(
        False,
        description=f"Return the curves of at most {MOST_DRAWN} fields: of the given fields, otherwise of the fields "
        "that most runs logged over steps.",
    )


class ScriptComparison(Resource):
    """Comparison of the runs of a script."""

    path = "/projects/{project}/scripts/{script}/comparison"
    tag = "Jobs"

    @reads(access=Access.READER, query=ComparisonQuery, answer=RunComparison, public=False)
    async def get(self, project: str, script: str, query: ComparisonQuery) -> Rendered:
        """Compare the succeeded runs of a script: their settings, logged fields and curves.

        Runs that differ only by their seeds form a setting, with means and 95 % confidence intervals.
        """
        goals: dict[str, Goal] = {field: goal for goal in GOALS for field in getattr(query, goal)}
        wanted = Compared(query.sort, query.limit, query.fields, goals, query.curves)
        return await self.answer(compare_runs, project, script, wanted)


RESOURCES: tuple[type[Resource], ...] = (ProjectScripts, ScriptResource, ScriptRuns, ScriptComparison)
