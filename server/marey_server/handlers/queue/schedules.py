"""Resources of schedules, which submit jobs at certain times."""

from __future__ import annotations

from marey_schemas.queue.schedules import Schedule, ScheduleChange, ScheduleCreate
from marey_schemas.sizes import KIB
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.schedules import managing

MAX_SCHEDULE_BYTES = 64 * KIB
"""Greatest size of a request with a schedule; small, because a page of a list contains many schedules."""


class ProjectSchedules(Resource):
    """Schedules of a project."""

    path = "/projects/{project}/schedules"
    tag = "Jobs"

    @reads(access=Access.READER, query=PageQuery, answer=Schedule, paged=True, public=False)
    async def get(self, project: str, query: PageQuery) -> Rendered:
        """List the schedules of a project by name."""
        return await self.answer(managing.list_schedules, project, cursor=query.cursor, limit=query.limit)

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        body=RequestBody(ScheduleCreate, max_bytes=MAX_SCHEDULE_BYTES),
        answer=Schedule,
        status=201,
        etag=True,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, body: ScheduleCreate) -> Rendered:
        """Create a schedule: the server submits a job at the times of a cron expression.

        The jobs are submitted as you, with the scopes of this request's token, also after this token has ended. If you
        may no longer submit jobs at such a time, the schedule records the reason and submits nothing.
        """
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/projects/{project}/schedules/{made.name}"),
            managing.create_schedule,
            project,
            body,
        )


class ScheduleResource(Resource):
    """A schedule."""

    path = "/projects/{project}/schedules/{schedule}"
    tag = "Jobs"

    @reads(access=Access.READER, answer=Schedule, etag=True, public=False)
    async def get(self, project: str, schedule: str) -> Rendered:
        """Return a schedule with its next time, its last job, and the reason if the last job was not submitted."""
        return await self.answer(managing.read_schedule, project, schedule)

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        body=RequestBody(ScheduleChange, max_bytes=MAX_SCHEDULE_BYTES),
        answer=Schedule,
        precondition="optional",
        etag=True,
        in_folders=True,
    )
    async def patch(self, project: str, schedule: str, body: ScheduleChange) -> Rendered:
        """Change, pause or resume a schedule; only its author and the maintainers of the project may do this.

        Any change except a pause or a new description makes you the author of the schedule; its jobs are then submitted
        as you.
        """
        expected_rev = self.precondition.expected_rev
        return await self.answer(managing.change_schedule, project, schedule, body, expected_rev=expected_rev)

    @writes(access=Access.CONTRIBUTOR, scope="jobs", precondition="optional", in_folders=True)
    async def delete(self, project: str, schedule: str) -> Rendered:
        """Delete a schedule; only its author and the maintainers of the project may do this. Its jobs remain."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(managing.delete_schedule, project, schedule, expected_rev=expected_rev)


RESOURCES: tuple[type[Resource], ...] = (ProjectSchedules, ScheduleResource)
