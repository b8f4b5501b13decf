"""Cookies of browser sessions: one for each project, sent only by pages of this server, accepted only for reading.

A cookie contains the token of a session, which has only the scope `read` in its project. Other sites can neither send
the cookie (`SameSite=Strict`) nor read answers (`Cross-Origin-Resource-Policy`, and no CORS). Pages cannot read it
(`HttpOnly`). It is accepted only for declared GET operations of its project, so a forged request could change nothing.
"""

from __future__ import annotations

from http.cookies import Morsel
from typing import Any
from urllib.parse import urlsplit

from tornado.httputil import HTTPServerRequest

from marey_server.errors import ForbiddenProblem
from marey_server.http.declarations import Operation

_NAME = "marey-view-"
_OVER_HTTPS = "__Host-"
"""Prefix with which browsers accept a cookie only from this host, over https, for all paths."""
_OWN_PAGES = (None, "same-origin", "none")
"""Values of the header Sec-Fetch-Site of requests that other sites have not caused; None: an old browser."""


def cookie_name(project: str, *, https: bool) -> str:
    """Return the name of the cookie of a project."""
    return f"{_OVER_HTTPS if https else ''}{_NAME}{project}"


def is_own_page(request: HTTPServerRequest) -> bool:
    """Return whether a page of this server has sent the request, or a program."""
    return request.headers.get("Sec-Fetch-Site") in _OWN_PAGES


def require_own_page(request: HTTPServerRequest) -> None:
    """Raise `ForbiddenProblem` if a page of another site has sent the request."""
    origin = request.headers.get("Origin")
    same = origin is None or urlsplit(origin).netloc == request.headers.get("Host")
    if not same or not is_own_page(request):
        raise ForbiddenProblem("Only pages of this server may send this request.", code="other-site")


def session_token(request: HTTPServerRequest, operation: Operation, project: str | None) -> str | None:
    """Return the token of the browser's session, if the operation only reads the project of the session."""
    reads_project = operation.method == "GET" and operation.scope == "read" and operation.access.role is not None
    if project is None or not reads_project or "Cookie" not in request.headers or not is_own_page(request):
        return None
    sent: dict[str, Morsel[Any]] = dict(request.cookies)
    names = (cookie_name(project, https=https) for https in (True, False))
    return next((sent[name].value for name in names if name in sent and sent[name].value), None)
