"""Resources of the audit logs of a project and of the whole server; clients can only read them."""

from __future__ import annotations

from pydantic import AwareDatetime, Field

from marey_schemas.audit import AuditEntry
from marey_schemas.event_kinds import AuditKind
from marey_server.http.declarations import Access, reads
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered
from marey_server.http.resource import Resource
from marey_server.store import audit
from marey_server.store.audit import AuditFilter


class AuditQuery(PageQuery):
    """Query parameters of the audit log: the page and the filters."""

    kind: AuditKind | None = Field(None, description="Kind of the entries; absent: any.")
    actor: str | None = Field(
        None, min_length=1, max_length=255, description="Name of the user who made the change, or `job:<id>`."
    )
    subject: str | None = Field(
        None, min_length=1, max_length=1024, description="Name or id of the user or of the object that was changed."
    )
    since: AwareDatetime | None = Field(
        None, description="List entries from this time on, in RFC 3339 with a time zone such as Z."
    )
    until: AwareDatetime | None = Field(
        None, description="List entries before this time, in RFC 3339 with a time zone such as Z."
    )

    @property
    def filter(self) -> AuditFilter:
        """The query parameters as the `AuditFilter` by which the store selects entries."""
        return AuditFilter(self.kind, self.actor, self.subject, self.since, self.until)


class ServerAudit(Resource):
    """The audit log of the server."""

    path = "/audit"
    tag = "Audit"

    @reads(access=Access.ADMINISTRATOR, scope="admin", query=AuditQuery, answer=AuditEntry, paged=True)
    async def get(self, query: AuditQuery) -> Rendered:
        """List the audit entries of all projects, and changes of users and tokens, newest first."""
        await self.services.number_events()
        return await self.answer(audit.list_audit, query.filter, cursor=query.cursor, limit=query.limit)


class ProjectAudit(Resource):
    """The audit log of a project."""

    path = "/projects/{project}/audit"
    tag = "Audit"

    @reads(access=Access.OWNER, query=AuditQuery, answer=AuditEntry, paged=True, public=False)
    async def get(self, project: str, query: AuditQuery) -> Rendered:
        """List changes of members and settings of a project, deletions and restorations, newest first."""
        await self.services.number_events()
        return await self.answer(
            audit.list_project_audit, project, query.filter, cursor=query.cursor, limit=query.limit
        )


RESOURCES: tuple[type[Resource], ...] = (ServerAudit, ProjectAudit)
