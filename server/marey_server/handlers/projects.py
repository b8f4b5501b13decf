"""Resources of projects and their members."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.access import (
    Member,
    MemberChange,
    Project,
    ProjectChange,
    ProjectCreate,
    ProjectQuotaChange,
    ProjectQuotasInUse,
)
from marey_server.http.declarations import Access, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import members, projects


class ProjectsQuery(PageQuery):
    """Query parameters of a list of projects: the page and the order."""

    sort: str = Field(
        "name",
        max_length=100,
        description="Sort keys: id, name, created_at, updated_at; a leading - sorts in descending order.",
    )


class Projects(Resource):
    """Projects that the caller may read."""

    path = "/projects"
    tag = "Projects"

    @reads(access=Access.ANYONE, query=ProjectsQuery, answer=Project, paged=True)
    async def get(self, query: ProjectsQuery) -> Rendered:
        """List the projects that you may read: your projects and public projects."""
        return await self.answer(projects.list_projects, sort=query.sort, cursor=query.cursor, limit=query.limit)

    @writes(
        access=Access.USER,
        body=ProjectCreate,
        answer=Project,
        status=201,
        etag=True,
        idempotency="key",
        also=((429, None),),
    )
    async def post(self, body: ProjectCreate) -> Rendered:
        """Create a project; you become its owner."""
        # The refusal of a taken name tells that the project exists, so it is counted before it is sent.
        per_hour = self.services.settings.name_guesses_per_hour
        if await self.look_up(projects.meets_hidden, body.name, per_hour):
            await self.change(projects.count_guess, per_hour)
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/projects/{made.name}"), projects.create_project, body
        )


class ProjectResource(Resource):
    """A project."""

    path = "/projects/{project}"
    tag = "Projects"

    @reads(access=Access.READER, answer=Project, etag=True)
    async def get(self, project: str) -> Rendered:
        """Return a project and your role in it."""
        return await self.answer(projects.read_project, project)

    @writes(access=Access.OWNER, body=ProjectChange, answer=Project, precondition="required", etag=True)
    async def patch(self, project: str, body: ProjectChange) -> Rendered:
        """Change the title, description or visibility of a project."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(projects.change_project, project, body, expected_rev=expected_rev)

    @writes(access=Access.OWNER, precondition="required")
    async def delete(self, project: str) -> Rendered:
        """Delete a project with its contents; it can be restored."""
        return await self.answer(projects.delete_project, project, expected_rev=self.precondition.expected_rev)


class ProjectRestoration(Resource):
    """Restoration of a deleted project."""

    path = "/projects/{project}/restore"
    tag = "Projects"

    @writes(access=Access.OWNER, answer=Project, etag=True, idempotency="key")
    async def post(self, project: str) -> Rendered:
        """Restore a deleted project; of several deleted projects with this name, the one that was deleted last."""
        return await self.answer(projects.restore_project, project)


class ProjectQuotas(Resource):
    """Quotas of a project."""

    path = "/projects/{project}/quotas"
    tag = "Projects"

    @reads(access=Access.READER, answer=ProjectQuotasInUse, public=False)
    async def get(self, project: str) -> Rendered:
        """Return the number of items, bytes and running jobs of a project, and the limits."""
        return await self.answer(projects.read_quotas, project)

    @writes(access=Access.ADMINISTRATOR, scope="admin", body=ProjectQuotaChange, answer=ProjectQuotasInUse)
    async def patch(self, project: str, body: ProjectQuotaChange) -> Rendered:
        """Change the limits of a project."""
        return await self.answer(projects.change_quotas, project, body)


class ProjectMembers(Resource):
    """Members of a project."""

    path = "/projects/{project}/members"
    tag = "Projects"

    @reads(access=Access.READER, query=PageQuery, answer=Member, paged=True, public=False)
    async def get(self, project: str, query: PageQuery) -> Rendered:
        """List the members of a project and their roles."""
        return await self.answer(members.list_members, project, cursor=query.cursor, limit=query.limit)


class MemberResource(Resource):
    """A member of a project."""

    path = "/projects/{project}/members/{user}"
    tag = "Projects"

    @reads(access=Access.READER, answer=Member, etag=True, public=False)
    async def get(self, project: str, user: str) -> Rendered:
        """Return the role of a member."""
        return await self.answer(members.read_member, project, user)

    @writes(access=Access.OWNER, body=MemberChange, answer=Member, precondition="optional", etag=True)
    async def put(self, project: str, user: str, body: MemberChange) -> Rendered:
        """Add a member, or change the member's role."""
        believed = self.precondition
        return await self.answer(
            members.put_member, project, user, body, expected_rev=believed.expected_rev, absent=believed.absent
        )

    @writes(access=Access.OWNER, precondition="required")
    async def delete(self, project: str, user: str) -> Rendered:
        """Remove a member; the last owner of a project cannot be removed."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(members.remove_member, project, user, expected_rev=expected_rev)


RESOURCES: tuple[type[Resource], ...] = (
    Projects,
    ProjectResource,
    ProjectRestoration,
    ProjectQuotas,
    ProjectMembers,
    MemberResource,
)
