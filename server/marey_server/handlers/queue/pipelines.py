"""Resource of pipelines: jobs that are submitted together and may read outputs of each other."""

from __future__ import annotations

from marey_schemas.queue.pipelines import Pipeline, PipelineCreate
from marey_server.handlers.queue.jobs import MAX_SUBMISSION_BYTES
from marey_server.http.declarations import Access, RequestBody, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.jobs.submission import submit_pipeline


class ProjectPipelines(Resource):
    """Pipelines of jobs."""

    path = "/projects/{project}/pipelines"
    tag = "Jobs"

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        body=RequestBody(PipelineCreate, max_bytes=MAX_SUBMISSION_BYTES),
        answer=Pipeline,
        status=202,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, body: PipelineCreate) -> Rendered:
        """Submit several jobs that may read outputs of each other; if one job is not valid, no job is submitted.

        An input `{"step": name}` stands for outputs of another step: all outputs of the kind that the input takes, at
        the revisions that the other step creates. Cached results are used: if a pipeline is submitted again, only the
        jobs that a change affects are computed.
        """
        return await self.answer_with(
            lambda made: Reply(made, headers={"Retry-After": "1"}), submit_pipeline, project, body
        )


RESOURCES: tuple[type[Resource], ...] = (ProjectPipelines,)
