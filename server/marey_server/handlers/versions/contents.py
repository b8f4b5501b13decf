"""Resources that exchange versions with archives and other servers."""

from __future__ import annotations

from marey_schemas.datasets.commits import Commit
from marey_schemas.datasets.contents import (
    ContentsRequest,
    ExportCheck,
    ExportPermission,
    ReceivedCommit,
    ReceivedRevisions,
    StoredRevisions,
)
from marey_schemas.sizes import MIB
from marey_server.handlers.items import MAX_DOCUMENT_BYTES
from marey_server.http.declarations import Access, Document, RequestBody, reads, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import datasets

MAX_RECEIVED_BYTES = 64 * MIB


class ProjectContents(Resource):
    """Revisions and documents in a form that is the same on every server."""

    path = "/projects/{project}/contents"
    tag = "Datasets"

    @reads(access=Access.READER, body=ContentsRequest, answer=Document, compressed=True)
    async def post(self, project: str, body: ContentsRequest) -> Rendered:
        """Return revisions and documents by their content digests.

        The answer is `{"revisions": [...], "documents": [...], "facets": [...], "tiles": [...]}` in the order of the
        request. A revision has its `kind` and the content digests of its `parts`. Its facets are the numbers that jobs
        have published about it, by name. In documents, references to revisions are replaced by `{"content": digest}`,
        so that a document has the same digest on every server. If the request names a `base` for a document, arrays
        that hardly differ from those of the base are replaced by array differences (see the page about the block
        format). For each document in the list `tiles` of the request, the answer has the digests of the tiles of each
        array, by JSON Pointer. A revision or document that the project does not have is null. If the documents together
        are too large, the last ones are missing from the list: request them again.
        """
        found = await self.look_up(datasets.load_contents, project, body)
        return await self.render_document(Reply(await self.compute(datasets.contents_document, found)))


class ExportChecks(Resource):
    """Checks before revisions of a dataset are exported."""

    path = "/projects/{project}/datasets/{dataset}/export-checks"
    tag = "Datasets"

    @reads(access=Access.READER, body=ExportCheck, answer=ExportPermission)
    async def post(self, project: str, dataset: str, body: ExportCheck) -> Reply:
        """Check that the consent for the clips of an export has not ended.

        A program that writes an archive or other files sends this request first, and then reads the documents with
        `POST /projects/{project}/contents`. Aligned clips are checked, too. If the consent for one or more items has
        ended, the answer is an error (409, `consent-expired`) that names these items. Maintainers can allow the export
        with `allow_expired_consent` and a reason; an event then records these items.
        """
        run = self.change if body.allow_expired_consent else self.look_up
        return Reply(await run(datasets.check_export, project, dataset, body))


class ReceivedContents(Resource):
    """Revisions from archives and other servers."""

    path = "/projects/{project}/datasets/{dataset}/contents"
    tag = "Datasets"

    @writes(
        access=Access.MAINTAINER,
        body=RequestBody(ReceivedRevisions, max_bytes=MAX_DOCUMENT_BYTES),
        answer=StoredRevisions,
        compressed=True,
    )
    async def post(self, project: str, dataset: str, body: ReceivedRevisions) -> Rendered:
        """Store revisions from an archive or another server, so that received commits can refer to them.

        Received revisions refer to other revisions by content digest; the project must have these revisions. The server
        creates an item for each received revision. If the revision is the content of a dataset entry, the item is
        created as a deleted item; a checkout of a version with this entry restores the item. Otherwise, the item is
        created in the folder `imported`. Because quotas do not count deleted items, only maintainers may send this
        request.
        """
        local = await self.look_up(datasets.find_local, project, body.revisions, self.holding.grow)
        drafts = await self.compute(datasets.prepare_revisions, body.revisions, local)
        return await self.answer(datasets.store_revisions, project, dataset, drafts, local)


class ReceivedCommits(Resource):
    """Commits from archives and other servers."""

    path = "/projects/{project}/datasets/{dataset}/received-commits"
    tag = "Datasets"

    @writes(
        access=Access.MAINTAINER,
        body=RequestBody(ReceivedCommit, max_bytes=MAX_RECEIVED_BYTES),
        answer=Commit,
        status=201,
        compressed=True,
    )
    async def post(self, project: str, dataset: str, body: ReceivedCommit) -> Rendered:
        """Record a commit from an archive or another server with its author, time and digest.

        The server applies the changes of the commit to the tree of its first parent. If the result differs from the
        commit's tree, the server refuses the commit. A branch without commits can be set to the commit; no other branch
        moves. To add the commit to another branch, merge it.
        """
        prepared = await self.look_up(datasets.prepare_receipt, project, dataset, body)
        return await self.answer(datasets.record_receipt, project, dataset, body, prepared)


RESOURCES: tuple[type[Resource], ...] = (ProjectContents, ExportChecks, ReceivedContents, ReceivedCommits)
