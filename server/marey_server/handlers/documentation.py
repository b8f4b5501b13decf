"""The API's description of itself: for programs, and for people."""

from __future__ import annotations

from marey_server.handlers.declarations import Access, Bytes, reads
from marey_server.handlers.reply import Reply
from marey_server.handlers.resource import Resource


class OpenApiDocument(Resource):
    """What programs read."""

    path = "/openapi.json"
    tag = "Documentation"

    @reads(access=Access.ANYONE, scope=None, answer=Bytes, answer_types=("application/json",))
    async def get(self) -> Reply:
        """This API as an OpenAPI 3.1 document."""
        description = await self.compute(self.services.description)
        return Reply(description.document, rev=description.tag, media_type="application/json")


class DocumentationPage(Resource):
    """What people read."""

    path = "/docs"
    tag = "Documentation"

    @reads(access=Access.ANYONE, scope=None, answer=Bytes, answer_types=("text/html",))
    async def get(self) -> Reply:
        """This API as a page."""
        description = await self.compute(self.services.description)
        style_only = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
        headers = {"Content-Security-Policy": style_only}
        return Reply(description.page, rev=description.tag, media_type="text/html; charset=utf-8", headers=headers)


RESOURCES: tuple[type[Resource], ...] = (OpenApiDocument, DocumentationPage)
