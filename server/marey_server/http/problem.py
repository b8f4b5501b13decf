"""Errors as RFC 9457 problem documents, always in JSON."""

from __future__ import annotations

import logging
from http.client import responses

from tornado.iostream import StreamClosedError
from tornado.web import HTTPError

from marey_schemas.problems import MEDIA_TYPE, Problem
from marey_server.errors import MareyError, Unauthenticated
from marey_server.http.etags import entity_tag
from marey_server.http.reply import API, Rendered

log = logging.getLogger(__name__)


def render(error: BaseException, request_id: str) -> Rendered:
    """The problem document of an error. Of faults that are not refusals it says nothing but the request id."""
    if isinstance(error, MareyError):
        problem = _of_refusal(error, request_id)
        headers = dict(error.headers)
    elif isinstance(error, HTTPError):
        title = responses.get(error.status_code, "Error")
        problem = _problem(error.status_code, title.lower().replace(" ", "-"), title, f"{title}.", request_id)
        headers = {}
    else:
        detail = "Something went wrong here. It is in the server's log under this request id."
        problem = _problem(500, MareyError.code, "The server failed.", detail, request_id)
        headers = {}
    if problem.status == 401:
        headers.setdefault("WWW-Authenticate", 'Bearer realm="marey"')
    if problem.status == 412 and isinstance(rev := problem.context.get("rev"), int):
        headers.setdefault("ETag", entity_tag(rev, "json"))
    headers |= {"Content-Type": MEDIA_TYPE, "Cache-Control": "no-store"}
    return Rendered(problem.status, headers, problem.model_dump_json(by_alias=True).encode())


def _of_refusal(error: MareyError, request_id: str) -> Problem:
    problem = _problem(error.status, error.error_code, error.title, error.detail, request_id)
    return problem.model_copy(update={"errors": error.errors, "context": error.context})


def _problem(status: int, code: str, title: str, detail: str, request_id: str) -> Problem:
    return Problem(
        type=f"{API}/docs#problem-{code}", title=title, status=status, detail=detail, instance=request_id, code=code
    )


def log_fault(error: BaseException, request_id: str, method: str, path: str) -> None:
    """Write a fault of ours to the log, with its traceback."""
    if isinstance(error, MareyError | HTTPError | StreamClosedError | Unauthenticated):
        return
    log.error("%s %s failed", method, path, exc_info=error, extra={"request_id": request_id})
