"""Pipelines: jobs that work on what others of them make, submitted together."""

from __future__ import annotations

from marey_schemas.pipelines import Pipeline, PipelineCreate
from marey_server.handlers.jobs import MAX_SUBMISSION_BYTES
from marey_server.http.declarations import Access, RequestBody, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.jobs.submission import submit_pipeline


class ProjectPipelines(Resource):
    """Graphs of jobs."""

    path = "/projects/{project}/pipelines"
    tag = "Jobs"

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        body=RequestBody(PipelineCreate, max_bytes=MAX_SUBMISSION_BYTES),
        answer=Pipeline,
        status=202,
        idempotency="key",
    )
    async def post(self, project: str, body: PipelineCreate) -> Rendered:
        """Submit jobs of which some work on what others make, all or none.

        An input `{"step": name}` is everything of the input's kind that the step makes, at the revisions it makes. What
        was computed before is not computed again: of a pipeline submitted a second time, only what depends on a change
        is.
        """
        return await self.answer_with(
            lambda made: Reply(made, headers={"Retry-After": "1"}), submit_pipeline, project, body
        )


RESOURCES: tuple[type[Resource], ...] = (ProjectPipelines,)
