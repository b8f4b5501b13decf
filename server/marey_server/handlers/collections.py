"""Resources of the folders of a project."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.items import Collection, CollectionChange, CollectionCreate
from marey_server.http.declarations import Access, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import collections


class CollectionsQuery(PageQuery):
    """Query parameters of a list of folders."""

    path: str = Field("", max_length=1024, description="Folder to list, with all folders below it; empty: all folders.")
    directly_in: str | None = Field(
        None,
        max_length=1024,
        description="List only the subfolders of this folder, without the folders below them; empty: the root.",
    )
    name: str | None = Field(
        None,
        max_length=255,
        description="With `directly_in`: list only subfolders with this name; a final * matches any ending.",
    )
    deleted: bool = Field(False, description="List deleted folders instead of existing ones.")


class ProjectCollections(Resource):
    """All folders."""

    path = "/projects/{project}/collections"
    tag = "Collections"

    @reads(access=Access.READER, query=CollectionsQuery, answer=Collection, paged=True)
    async def get(self, project: str, query: CollectionsQuery) -> Rendered:
        """List the folders of a project in the order of their paths."""
        return await self.answer(
            collections.list_collections,
            project,
            path=query.path,
            directly_in=query.directly_in,
            name=query.name,
            deleted=query.deleted,
            cursor=query.cursor,
            limit=query.limit,
        )

    @writes(
        access=Access.CONTRIBUTOR,
        body=CollectionCreate,
        answer=Collection,
        status=201,
        etag=True,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, body: CollectionCreate) -> Rendered:
        """Create a folder, and its parent folders if they are missing."""
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/projects/{project}/collections/{made.id}"),
            collections.create_collection,
            project,
            body,
        )


class CollectionResource(Resource):
    """A folder."""

    path = "/projects/{project}/collections/{collection}"
    tag = "Collections"

    @reads(access=Access.READER, answer=Collection, etag=True)
    async def get(self, project: str, collection: str) -> Rendered:
        """Return a folder."""
        return await self.answer(collections.read_collection, project, collection)

    @writes(
        access=Access.CONTRIBUTOR,
        body=CollectionChange,
        answer=Collection,
        precondition="required",
        etag=True,
        in_folders=True,
    )
    async def patch(self, project: str, collection: str, body: CollectionChange) -> Rendered:
        """Rename or move a folder with its contents."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(collections.move_collection, project, collection, body, expected_rev=expected_rev)

    @writes(access=Access.MAINTAINER, precondition="required", in_folders=True)
    async def delete(self, project: str, collection: str) -> Rendered:
        """Delete a folder with its contents; it can be restored."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(collections.delete_collection, project, collection, expected_rev=expected_rev)


class CollectionRestoration(Resource):
    """Restoration of a deleted folder."""

    path = "/projects/{project}/collections/{collection}/restore"
    tag = "Collections"

    @writes(access=Access.MAINTAINER, answer=Collection, etag=True, idempotency="key", in_folders=True)
    async def post(self, project: str, collection: str) -> Rendered:
        """Restore a folder with the contents that were deleted along with it."""
        return await self.answer(collections.restore_collection, project, collection)


RESOURCES: tuple[type[Resource], ...] = (ProjectCollections, CollectionResource, CollectionRestoration)
