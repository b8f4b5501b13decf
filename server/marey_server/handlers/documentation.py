"""Resources that describe the API, for programs and for people."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version

from pydantic import Field

from marey_schemas.address import API
from marey_schemas.base import Answer
from marey_server.http.declarations import Access, Bytes, reads
from marey_server.http.docs_page import POLICY
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.process.services import Description

DESCRIBE_API = "marey_server.handlers.catalogue:describe_api"
"""Function that child processes run."""

marey_version = cache(version)
"""Function that returns the version of an installed package, whose metadata it reads only once."""


class Service(Answer):
    """The service at this address, with links to its API."""

    name: str = "Marey"
    version: str
    api: str = Field(API, description="Prefix of all paths of the API.")
    documentation: str = Field(f"{API}/docs", description="Path of the API documentation for people.")
    openapi: str = Field(f"{API}/openapi.json", description="Path of the OpenAPI document.")
    ready: str = Field("/readyz", description="Path of the readiness check.")


class ApiRoot(Resource):
    """The root of the API."""

    path = ""
    tag = "Documentation"

    @reads(access=Access.ANYONE, scope=None, answer=Service, also=((303, None),))
    async def get(self) -> Reply:
        """Return the version of this server and the addresses of its documentation; redirect browsers to `/docs`."""
        if "text/html" in self.request.headers.get("Accept", ""):
            return Reply(status=303, location="/docs")
        return Reply(Service(version=marey_version("marey")))


class ServerRoot(ApiRoot):
    """The root of the server."""

    root = ""
    path = "/"

    get = ApiRoot.get


class _Describing(Resource):
    """Base of the resources that need the description of the API."""

    async def describe(self) -> Description:
        """Return the description of the API. The first request computes it in a child process, in some seconds."""
        services = self.services
        async with services.describing:
            if services.description is None:
                services.description = await self.compute_apart(DESCRIBE_API, bytes, Description.unpack)
        return services.description


class OpenApiDocument(_Describing):
    """The OpenAPI document."""

    path = "/openapi.json"
    tag = "Documentation"

    @reads(access=Access.ANYONE, scope=None, answer=Bytes, answer_types=("application/json",))
    async def get(self) -> Reply:
        """Return this API as an OpenAPI 3.1 document."""
        description = await self.describe()
        return Reply(description.document, rev=description.tag, media_type="application/json")


class DocumentationPage(_Describing):
    """The documentation page."""

    path = "/docs"
    tag = "Documentation"

    @reads(access=Access.ANYONE, scope=None, answer=Bytes, answer_types=("text/html",))
    async def get(self) -> Reply:
        """Return this API as an HTML page."""
        description = await self.describe()
        headers = {"Content-Security-Policy": POLICY}
        return Reply(description.page, rev=description.tag, media_type="text/html; charset=utf-8", headers=headers)


RESOURCES: tuple[type[Resource], ...] = (ServerRoot, ApiRoot, OpenApiDocument, DocumentationPage)
