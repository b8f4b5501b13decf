"""Base of all handlers: request ids, answers, errors as RFC 9457 problem documents, and closed connections."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
from dataclasses import replace
from http.client import responses
from typing import Any, ClassVar, cast

from tornado.http1connection import HTTP1Connection
from tornado.iostream import StreamClosedError
from tornado.web import HTTPError, RequestHandler

from marey_schemas.address import API
from marey_schemas.problems import MEDIA_TYPE, Problem
from marey_schemas.sizes import KIB, MIB
from marey_schemas.tracing.context import HEADER
from marey_server.errors import (
    ApiProblem,
    BadRequestProblem,
    DamagedProblem,
    MethodNotAllowedProblem,
    StoppingProblem,
    UnauthenticatedProblem,
    forget_origin,
)
from marey_server.http.caching import NOT_STORED
from marey_server.http.declarations import Declared, Operation
from marey_server.http.etags import entity_tag
from marey_server.http.reply import Rendered
from marey_server.http.tracing import RequestTrace
from marey_server.process.observe import request_id
from marey_server.process.services import Services
from marey_versions.tree.chunks import DamagedChunk

LINGER_BYTES = 64 * 2**20
"""Number of bytes of a refused body that are read and discarded, so that its sender receives the answer."""
JOINED_BYTES = 64 * KIB
"""Size above which a body is sent in pieces, each after the client has received the previous piece."""
PIECE_BYTES = MIB
"""Size of a piece of a body, so that at most this number of bytes waits in a connection for the client."""
_LENGTH = re.compile("[0-9]{1,4300}")
"""Pattern of a Content-Length; the number of digits is limited because `int` refuses very long ones."""
_SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}
log = logging.getLogger(__name__)


class ClientGone:
    """Whether the client of a request has closed the connection; also a function that returns this.

    The request refers to this object, but this object does not refer to the request. Otherwise, the two would form a
    reference cycle, which only the garbage collector frees.
    """

    value = False

    def __call__(self) -> bool:
        return self.value


class Exchange(RequestHandler):
    """HTTP request and its answer."""

    path: ClassVar[str]
    root: ClassVar[str] = API
    operations: ClassVar[dict[str, Operation]] = {}
    running: asyncio.Task[Any] | None = None
    """Task that handles the request; None before `prepare`."""

    def initialize(self) -> None:
        """Set up the state of one request."""
        self.request_id = request_id(self.request.headers.get("X-Request-Id"))
        self.set_header("X-Request-Id", self.request_id)
        self.trace = self._begin_trace()
        self.received_bytes = 0
        self.problem_code: str | None = None
        self.refused = self.performing = self.aborted = self.may_have_written = False
        self.client_gone = ClientGone()

    def _begin_trace(self) -> RequestTrace | None:
        tracer = self.services.tracer
        if tracer is None:
            return None
        return RequestTrace(tracer, self.services.settings.traces_callers, self.request.headers.get(HEADER))

    @classmethod
    def template(cls) -> str:
        """Return the template of the address, as in `/api/v1/projects/{project}`."""
        return cls.root + cls.path.replace(":int}", "}")

    @property
    def services(self) -> Services:
        """The services of the process."""
        services: Services = self.application.services  # pyrefly: ignore[missing-attribute]  # `app` sets it
        return services

    @property
    def wire(self) -> HTTP1Connection:
        """The connection of the request."""
        return cast(HTTP1Connection, self.request.connection)

    @property
    def client_address(self) -> str:
        """The address of the client; behind a trusted proxy, the address that the proxy gives in a header."""
        settings = self.services.settings
        peer = self.request.remote_ip or ""
        named = self.request.headers.get(settings.proxy_header) if settings.trust_proxy else None
        return peer if named is None else forwarded_address(named, settings.proxy_hops) or peer

    def decode_argument(self, value: bytes, name: str | None = None) -> str:
        """Decode a part of the path of the address. Raises `BadRequestProblem` if it is not UTF-8."""
        try:
            return value.decode()
        except UnicodeDecodeError:
            where = f"The part {name!r} of the address" if name else "The address"
            raise BadRequestProblem(f"{where} must be percent-encoded UTF-8.", code="not-utf8") from None

    # -- the body that comes ------------------------------------------------------------------------------------------

    def declared_length(self) -> int:
        """Return the Content-Length of the request; 0 if it is missing or malformed."""
        text = self.request.headers.get("Content-Length", "0").partition(",")[0].strip()  # the same may stand twice
        return int(text) if _LENGTH.fullmatch(text) else 0

    def expects_body(self) -> bool:
        """Return whether the request has a body after its headers."""
        return self.declared_length() > 0 or "Transfer-Encoding" in self.request.headers

    def drop(self) -> None:
        """Close the connection if a refused request has sent too much of its body; shorter bodies are ignored."""
        if self.received_bytes > LINGER_BYTES:
            self.wire.close()

    # -- the answer that goes -----------------------------------------------------------------------------------------

    def send(self, rendered: Rendered, *, whole_bytes: int | None = None) -> None:
        """Set status, headers and body of the response.

        If `whole_bytes` is given, the body of `rendered` is only the beginning of a body with this number of bytes.
        """
        self.set_status(rendered.status)
        for name, value in rendered.headers.items():
            self.set_header(name, value)
        if self.services.lingering:
            self.set_header("Connection", "close")
        if rendered.status not in (204, 304):
            self.set_header("Content-Length", str(len(rendered.body) if whole_bytes is None else whole_bytes))
            self.write(rendered.body)

    async def send_in_pieces(self, rendered: Rendered) -> None:
        """Send a long body in pieces, and wait until the client has received it."""
        self.send(replace(rendered, body=b""), whole_bytes=len(rendered.body))
        for start in range(0, len(rendered.body), PIECE_BYTES):
            await self.flush()
            self.write(rendered.body[start : start + PIECE_BYTES])
        await self.flush()

    async def refuse(self, error: ApiProblem) -> None:
        """Answer before the body is read.

        The body is then discarded, because closing the connection could lose the answer. After the answer, the
        connection counts as idle: it is closed if there are too many connections.
        """
        self.refused = True
        self._write_problem(error)
        forget_origin(error)
        if self.request.headers.get("Expect", "").lower() == "100-continue":
            self.finish()
        elif self.expects_body():
            await self.flush()
            self.services.in_flight.discard(self)  # the rest of the body may never come

    def abort(self) -> None:
        """End the request before its answer is complete, because the server stops.

        The answer is then an error that asks the client to repeat the request. If the request may have changed
        something, or a part of its answer was sent, the connection is closed without this error.
        """
        self.aborted = True
        if self.running is not None:
            self.running.cancel()

    def method_not_allowed(self) -> MethodNotAllowedProblem:
        """Return the error for a method that the resource does not declare."""
        allowed = ", ".join(sorted({*self.operations, *(["HEAD"] if "GET" in self.operations else [])}))
        return MethodNotAllowedProblem(f"This address accepts only {allowed}.", headers={"Allow": allowed})

    @property
    def stream(self) -> object:
        """The stream of the request's connection, which `Connections` uses as the key of the connection."""
        return self.wire.stream

    def is_awaited(self) -> bool:
        """Return whether the client is still connected and the server is not stopping."""
        return not self.client_gone.value and not self.services.draining.is_set()

    async def pause(self, seconds: float) -> bool:
        """Wait for `seconds` and return False, or return True as soon as the server is stopping."""
        try:
            async with asyncio.timeout(seconds):
                await self.services.draining.wait()
        except TimeoutError:
            return False
        return True

    # -- what Tornado asks for ----------------------------------------------------------------------------------------

    async def _undeclared(self, **_path: str) -> None:
        """Do nothing, because `Resource.prepare` has already refused a method that the resource does not declare."""

    get: Declared = _undeclared
    head: Declared = _undeclared
    post: Declared = _undeclared
    put: Declared = _undeclared
    patch: Declared = _undeclared
    delete: Declared = _undeclared
    options: Declared = _undeclared

    def set_default_headers(self) -> None:
        """Set the headers of every answer."""
        self.clear_header("Server")
        for name, value in _SECURITY_HEADERS.items():
            self.set_header(name, value)

    def compute_etag(self) -> None:
        """Disable the ETags of Tornado: resources set their own, and hashing an answer costs more than sending it."""

    def send_error(self, status_code: int = 500, **kwargs: Any) -> None:
        """Answer with an error document.

        If a part of another answer is sent already, close the connection instead, so that the client notices that the
        answer is incomplete.
        """
        if self.aborted:
            if self.may_have_written:
                self.wire.close()  # the error would say that the request had no effect
            error = StoppingProblem()
            kwargs["exc_info"] = (type(error), error, None)
        if not self._headers_written:
            super().send_error(status_code, **kwargs)
            return
        self.wire.close()
        if not self._finished:
            self.finish()

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Answer any error with a problem document; details of internal errors are only logged."""
        exc_info = kwargs.get("exc_info")
        error = exc_info[1] if exc_info else HTTPError(status_code)
        if isinstance(error, HTTPError) and error.status_code == 405:  # a method that Tornado itself does not know
            error = self.method_not_allowed()
        if isinstance(error, DamagedChunk):
            error = DamagedProblem("Stored data of the dataset are missing or damaged on the server.")
        self.set_header("X-Request-Id", self.request_id)
        self._write_problem(error)
        forget_origin(error)
        if not self._finished:
            self.finish()

    def _write_problem(self, error: BaseException) -> None:
        self.problem_code = problem_code(error)
        self.send(self.problem_answer(error))

    def problem_answer(self, error: BaseException) -> Rendered:
        """Return the answer to a request that failed with `error`."""
        return render_problem(error, self.request_id, names=self.sees_names)

    @property
    def sees_names(self) -> bool:
        """True if an error may name objects that the request does not name; see `ApiProblem`."""
        return True

    def on_finish(self) -> None:
        """Remove the request from the requests in progress after its answer was written."""
        self.services.in_flight.discard(self)

    def on_connection_close(self) -> None:
        """Record that the client has closed the connection."""
        super().on_connection_close()
        self.client_gone.value = True
        if not self.performing:  # a method that runs ends by itself, and a draining server waits for it
            self.services.in_flight.discard(self)


def forwarded_address(header: str, hops: int) -> str | None:
    """Return the address that the outermost of `hops` trusted proxies appended to a header.

    Returns None if the header has too few entries, or if the entry is not an address.
    """
    entries = [entry.strip() for entry in header.split(",")]
    try:
        return str(ipaddress.ip_address(entries[-hops]))
    except (IndexError, ValueError):
        return None


def problem_code(error: BaseException) -> str:
    """Return the code of the problem document of an error."""
    if isinstance(error, ApiProblem):
        return error.error_code
    if isinstance(error, HTTPError):
        return responses.get(error.status_code, "Error").lower().replace(" ", "-")
    return ApiProblem.code


def render_problem(error: BaseException, request_id: str, *, names: bool = True) -> Rendered:
    """Return the problem document of an error; for internal errors, it contains only the request id.

    If `names` is false, the document names only objects that the request names.
    """
    if isinstance(error, ApiProblem):
        problem = _of_refusal(error, request_id, names=names)
        headers = dict(error.headers)
    elif isinstance(error, HTTPError):
        title = responses.get(error.status_code, "Error")
        problem = _problem(error.status_code, problem_code(error), title, f"{title}.", request_id)
        headers = {}
    else:
        detail = "The server failed to handle the request; its log describes the error under this request id."
        problem = _problem(500, problem_code(error), "The server failed.", detail, request_id)
        headers = {}
    if problem.status == 401:
        headers.setdefault("WWW-Authenticate", 'Bearer realm="marey"')
    if problem.status == 412 and isinstance(rev := problem.context.get("rev"), int):
        headers.setdefault("ETag", entity_tag(rev, "json"))
    headers |= {"Content-Type": MEDIA_TYPE, "Cache-Control": NOT_STORED}
    return Rendered(problem.status, headers, problem.model_dump_json(by_alias=True).encode())


def _of_refusal(error: ApiProblem, request_id: str, *, names: bool) -> Problem:
    if names or error.unnamed is None:
        problem = _problem(error.status, error.error_code, error.title, error.detail, request_id)
        return problem.model_copy(update={"errors": error.errors, "context": error.context})
    problem = _problem(error.status, error.error_code, error.title, error.unnamed, request_id)
    errors = tuple(one.model_copy(update={"detail": error.unnamed}) for one in error.errors)
    return problem.model_copy(update={"errors": errors})


def _problem(status: int, code: str, title: str, detail: str, request_id: str) -> Problem:
    return Problem(
        type=f"{API}/docs#problem-{code}", title=title, status=status, detail=detail, instance=request_id, code=code
    )


def log_fault(error: BaseException, request_id: str, method: str, path: str, *, trace_id: str | None = None) -> None:
    """Log an internal error with its traceback; errors that refuse a request are not logged."""
    if isinstance(error, ApiProblem | HTTPError | StreamClosedError | UnauthenticatedProblem):
        return
    log.error("%s %s failed", method, path, exc_info=error, extra={"request_id": request_id, "trace_id": trace_id})
