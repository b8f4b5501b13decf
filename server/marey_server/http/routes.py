"""Table of all routes, used for serving, documentation and the access test."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import unquote_to_bytes

from tornado.httputil import HTTPMessageDelegate, HTTPServerRequest
from tornado.routing import Router
from tornado.web import Application

from marey_server.errors import NotFoundProblem
from marey_server.http.caching import NOT_STORED
from marey_server.http.declarations import Operation
from marey_server.http.negotiation import prefers_page
from marey_server.http.reply import Rendered
from marey_server.http.resource import Resource
from marey_server.http.short_pages import BROWSER, STYLED, page

_VARIABLE = re.compile(r"\{(\w+)(?::int)?\}")
_NUMBER = re.compile(rb"\d{1,9}")
_CONTROL = re.compile(rb"[\x00-\x1f\x7f]")

_NO_PAGE = page(
    "No page at this address",
    "A link from a message may have been copied only in part: open the whole link, or ask for a new one.",
)


@dataclass(frozen=True, slots=True)
class Route:
    """Operation and the template of its path, as in `/api/v1/projects/{project}`."""

    template: str
    operation: Operation
    resource: type[Resource]

    @property
    def variables(self) -> tuple[str, ...]:
        """The names of the variables in the path."""
        return tuple(_VARIABLE.findall(self.template))


@dataclass(slots=True)
class _Node:
    """Segment of a path, with the segments that may follow it."""

    literals: dict[str, _Node] = field(default_factory=dict)
    variable: _Node | None = None
    resource: type[Resource] | None = None


class UnknownPath(Resource):
    """Answer to a request for an unknown path: a page for browsers, a problem document for other clients."""

    root = ""
    path = "(unknown)"
    tag = ""

    def _check_head(self) -> None:
        raise NotFoundProblem("No resource has this address; /api/v1/docs lists the addresses of this server.")

    def problem_answer(self, error: BaseException) -> Rendered:
        """Return a short page if the client prefers HTML, and otherwise the problem document."""
        if isinstance(error, NotFoundProblem) and prefers_page(self.request.headers.get("Accept")):
            headers = {"Content-Type": BROWSER, "Cache-Control": NOT_STORED, "Content-Security-Policy": STYLED}
            return Rendered(error.status, headers, _NO_PAGE)
        return super().problem_answer(error)


def routes_of(resources: Iterable[type[Resource]]) -> Iterator[Route]:
    """Yield the route of each operation of some resources."""
    for resource in resources:
        for operation in resource.operations.values():
            yield Route(resource.template(), operation, resource)


class RouteTable(Router):
    """Search tree of path segments, so that the time to find a resource does not depend on the number of routes."""

    def __init__(self, application: Application, resources: Iterable[type[Resource]]) -> None:
        self._application = application
        self._root = _Node()
        for resource in resources:
            self._add(resource)

    def _add(self, resource: type[Resource]) -> None:
        node = self._root
        for segment in _segments(resource.root + resource.path):
            if _VARIABLE.fullmatch(segment):
                node.variable = node.variable or _Node()
                node = node.variable
            else:
                node = node.literals.setdefault(segment, _Node())
        if node.resource is not None:
            raise ValueError(f"two resources have the path {resource.template()}")
        node.resource = resource

    def find_handler(self, request: HTTPServerRequest, **_kwargs: Any) -> HTTPMessageDelegate:
        """Return the resource of a request's path, with the values of the path's variables."""
        resource, values = self._find(request.path or "")
        names = _VARIABLE.findall(resource.path)
        return self._application.get_handler_delegate(
            request, resource, path_kwargs=dict(zip(names, values, strict=True))
        )

    def _find(self, path: str) -> tuple[type[Resource], list[bytes]]:
        node = self._root
        values: list[bytes] = []
        for segment in _segments(path):
            following = node.literals.get(segment)
            if following is None:
                value = unquote_to_bytes(segment)
                if node.variable is None or not value or _CONTROL.search(value):
                    return UnknownPath, []
                following = node.variable
                values.append(value)
            node = following
        if node.resource is None or not _numbers_fit(node.resource.path, values):
            return UnknownPath, []
        return node.resource, values


def _segments(path: str) -> list[str]:
    return path.removeprefix("/").split("/")


def _numbers_fit(path: str, values: list[bytes]) -> bool:
    wanted = [match[0].endswith(":int}") for match in _VARIABLE.finditer(path)]
    return all(_NUMBER.fullmatch(value) for value, number in zip(values, wanted, strict=True) if number)
