"""Cookies of browser sessions: one for each project, sent only by pages of this server, accepted only for reading.

A cookie contains the token of a session, which has only the scope `read` in its project. Other sites can neither send
the cookie (`SameSite=Strict`) nor read answers (`Cross-Origin-Resource-Policy`, and no CORS). Pages cannot read it
(`HttpOnly`). It is accepted only for declared GET operations of its project, so a forged request could change nothing.
The only other request with the cookie ends the session; it is refused if another site has sent it.
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
_SITE = "Sec-Fetch-Site"
"""Header in which browsers state who has caused a request; they omit it without https, and pages cannot set it."""
_OWN_SITES = ("same-origin", "none")
"""Values of the header `Sec-Fetch-Site` in requests that other sites have not caused."""


def cookie_name(project: str, *, https: bool) -> str:
    """Return the name of the cookie of a project."""
    return f"{_OVER_HTTPS if https else ''}{_NAME}{project}"


def is_secure(name: str) -> bool:
    """Return whether browsers send a cookie of this name only over https."""
    return name.startswith(_OVER_HTTPS)


def sent_cookies(request: HTTPServerRequest, project: str) -> dict[str, str]:
    """Return the session tokens of a project that the browser has sent, by the name of the cookie.

    There are at most two: the cookies for https and for http have different names.
    """
    if "Cookie" not in request.headers:
        return {}
    sent: dict[str, Morsel[Any]] = dict(request.cookies)
    names = (cookie_name(project, https=https) for https in (True, False))
    return {name: sent[name].value for name in names if name in sent and sent[name].value}


def require_own_page(request: HTTPServerRequest) -> None:
    """Raise `ForbiddenProblem` if a page of another site has sent the request.

    Requests of programs, which have neither `Sec-Fetch-Site` nor `Origin`, are allowed.
    """
    site, origin = request.headers.get(_SITE), request.headers.get("Origin")
    by_origin = site is None and origin is not None  # a proxy may have changed Host, so the other header goes first
    foreign = urlsplit(origin or "").netloc != request.headers.get("Host") if by_origin else _is_foreign(request)
    if foreign:
        raise ForbiddenProblem("Only pages of this server may send this request.", code="other-site")


def _is_foreign(request: HTTPServerRequest) -> bool:
    """Return whether the browser states that another site has caused the request."""
    return request.headers.get(_SITE, "none") not in _OWN_SITES


def session_token(request: HTTPServerRequest, operation: Operation, project: str | None) -> str | None:
    """Return the token of the browser's session in a project, from the cookies of the request.

    Return None if the browser has sent none, if another site has caused the request, or if the operation does more than
    read the project.
    """
    reads_project = operation.method == "GET" and operation.scope == "read" and operation.access.role is not None
    if project is None or not reads_project or _is_foreign(request):
        return None
    return next(iter(sent_cookies(request, project).values()), None)
