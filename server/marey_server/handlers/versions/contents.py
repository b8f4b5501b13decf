"""Resource that returns the content of versions by digest, for archives and other servers."""

from __future__ import annotations

from marey_schemas.datasets.contents import ContentsRequest
from marey_server.http.declarations import Access, Document, reads
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import datasets


class ProjectContents(Resource):
    """Revisions and documents in the form that is the same on every server."""

    path = "/projects/{project}/contents"
    tag = "ProjectDatasets"

    @reads(access=Access.READER, body=ContentsRequest, answer=Document)
    async def post(self, project: str, body: ContentsRequest) -> Rendered:
        """Return revisions by their content digests, and documents of them.

        The answer is `{"revisions": [...], "documents": [...]}` in the order of the request. A revision has its `kind`
        and the content digests of its `parts`. In documents, references to revisions are replaced by `{"content":
        digest}`, so that a document has the same digest on every server. What the project does not have is null. If the
        documents together are too large, the last ones are missing from the list: request them again.
        """
        found = await self.look_up(datasets.load_contents, project, body)
        return await self.render_document(Reply(found))


RESOURCES: tuple[type[Resource], ...] = (ProjectContents,)
