"""Resources of the roles of members in folders of a project."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.access import FolderRole, FolderRoleChange
from marey_schemas.names import CollectionPath
from marey_server.http.declarations import Access, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered
from marey_server.http.resource import Resource
from marey_server.store.folder_roles import managing


class FolderRolesQuery(PageQuery):
    """Query parameters of a list of roles in folders: the page, the folder and the user."""

    folder: CollectionPath = Field("", description="List only the roles in this folder and the folders below it.")
    user: str | None = Field(
        None,
        max_length=64,
        description="List only the roles of this member; `*`: only the roles that are given to all members together.",
    )


class ProjectFolderRoles(Resource):
    """Roles in folders of a project."""

    path = "/projects/{project}/folder-roles"
    tag = "Projects"

    @reads(access=Access.READER, query=FolderRolesQuery, answer=FolderRole, paged=True, public=False)
    async def get(self, project: str, query: FolderRolesQuery) -> Rendered:
        """List the roles in folders, which replace the members' roles in the project."""
        return await self.answer(
            managing.list_folder_roles,
            project,
            folder=query.folder,
            user_name=query.user,
            cursor=query.cursor,
            limit=query.limit,
        )


class FolderRoleResource(Resource):
    """Role of a member in a folder."""

    path = "/projects/{project}/collections/{collection}/roles/{user}"
    tag = "Projects"

    @reads(access=Access.READER, answer=FolderRole, etag=True, public=False)
    async def get(self, project: str, collection: str, user: str) -> Rendered:
        """Return the role of a member in a folder; the user `*` stands for all members."""
        return await self.answer(managing.read_folder_role, project, collection, user)

    @writes(access=Access.OWNER, body=FolderRoleChange, answer=FolderRole, precondition="optional", etag=True)
    async def put(self, project: str, collection: str, user: str, body: FolderRoleChange) -> Rendered:
        """Set the role of a member in a folder and everything below it.

        The role in the folder may be higher or lower than the role in the project. The role in the folder concerns
        changes only: every member may read the whole project. If several folders on a path have roles, the role in the
        deepest of these folders applies. In one folder, a role for the member takes precedence over the role for all
        members (user `*`). Owners have all rights in all folders.
        """
        believed = self.precondition
        return await self.answer(
            managing.put_folder_role,
            project,
            collection,
            user,
            body,
            expected_rev=believed.expected_rev,
            absent=believed.absent,
        )

    @writes(access=Access.OWNER, precondition="required")
    async def delete(self, project: str, collection: str, user: str) -> Rendered:
        """Remove the role of a member in a folder; then the role in a folder above, or else in the project, applies."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(managing.remove_folder_role, project, collection, user, expected_rev=expected_rev)


RESOURCES: tuple[type[Resource], ...] = (ProjectFolderRoles, FolderRoleResource)
