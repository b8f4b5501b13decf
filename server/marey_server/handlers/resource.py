"""The base of every handler: checks what the declaration says, runs the method, sends what it answers.

A resource names its `path` and declares its methods:

    class ProjectResource(Resource):
        path = "/projects/{project}"
        tag = "Projects"

        @reads(access=Access.READER, answer=Project, etag=True)
        async def get(self, project: str) -> Rendered:
            \"\"\"A project.\"\"\"
            return await self.answer(projects.read_project, project)

A method gets the path's variables (`{fence:int}` as an int), `query` and `body` as declared. `self.answer` calls a
function of the store with a transaction, in its own thread, and renders its result there; `self.look_up` and
`self.change` only call it.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, ClassVar, Concatenate, ParamSpec, TypeVar
from urllib.parse import urlencode

from pydantic import BaseModel
from tornado.web import HTTPError, RequestHandler, stream_request_body

from marey_server.access.principal import ANONYMOUS, Principal
from marey_server.errors import BadRequest, MareyError, MethodNotAllowed, TooLarge
from marey_server.handlers import negotiation, problem
from marey_server.handlers.calls import Call, Caller, only_identify, require_access, run_call, run_plain
from marey_server.handlers.declarations import Bytes, Declared, Document, Operation
from marey_server.handlers.etags import ANY_STATE, Precondition, write_precondition
from marey_server.handlers.reply import API, Form, Rendered, Reply, render
from marey_server.handlers.validation import decode_body, parse_query, validate_body
from marey_server.observe import request_id
from marey_server.services import Services
from marey_server.store.database import Transaction

P = ParamSpec("P")
T = TypeVar("T")

LINGER_BYTES = 64 * 2**20
"""How much of a refused body is read and thrown away, so that its sender gets to read why."""
INLINE_BYTES = 32 * 1024
"""Bodies and answers up to this size are converted on the event loop; larger ones in a thread."""
EARLY_CHECK_BYTES = 1024 * 1024
"""Before a larger body is taken in, the credential is looked up."""
_METHODS = ("get", "post", "put", "patch", "delete")
_KEY = re.compile(r"[\x21-\x7e]{1,255}")
_SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@stream_request_body
class Resource(RequestHandler):
    """A thing with a path and declared methods."""

    path: ClassVar[str]
    tag: ClassVar[str]
    root: ClassVar[str] = API
    operations: ClassVar[dict[str, Operation]] = {}

    operation: Operation
    caller: Caller
    media: negotiation.MediaType
    query: BaseModel | None = None
    precondition: Precondition = ANY_STATE

    def __init_subclass__(cls) -> None:
        methods = {name: getattr(cls, name) for name in _METHODS if hasattr(vars(cls).get(name), "operation")}
        cls.operations = {name.upper(): method.operation for name, method in methods.items()}
        if "get" in methods:
            cls.head = cls.get

    @classmethod
    def template(cls) -> str:
        """The template of the address, as in `/api/v1/projects/{project}`."""
        return cls.root + cls.path.replace(":int}", "}")

    def initialize(self) -> None:
        """Set up the state of one request."""
        self.request_id = request_id(self.request.headers.get("X-Request-Id"))
        self.set_header("X-Request-Id", self.request_id)
        self._received = bytearray()
        self.received_bytes = 0
        self._refused = self._performing = self._gone = False

    @property
    def services(self) -> Services:
        """What the server holds."""
        services: Services = self.application.services  # type: ignore[attr-defined]
        return services

    @property
    def principal(self) -> Principal | None:
        """Who asked, once it is known."""
        caller: Caller | None = getattr(self, "caller", None)  # absent where the request was refused before
        return caller.principal if caller is not None else None

    # -- for the methods of resources ---------------------------------------------------------------------------------

    async def look_up(self, function: Callable[Concatenate[Transaction, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `function(tx, ...)` returns, on behalf of the caller, in a read-only transaction."""
        future = self.services.database.submit_read(ANONYMOUS, run_plain, self.caller, function, *args, **kwargs)
        return await asyncio.wrap_future(future)

    async def change(self, function: Callable[Concatenate[Transaction, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `function(tx, ...)` returns, on behalf of the caller, committed."""
        future = self.services.database.submit_write(ANONYMOUS, run_plain, self.caller, function, *args, **kwargs)
        return await asyncio.wrap_future(future)

    async def answer(
        self,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Rendered:
        """The answer that `function(tx, ...)` gives, by the declaration: a model, its ETag, the declared status."""
        return await self.answer_with(self._declared_reply, function, *args, **kwargs)

    async def answer_with(
        self,
        to_reply: Callable[[T], Reply],
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Rendered:
        """The answer that `to_reply` makes of what `function(tx, ...)` returns, both in the transaction's thread."""
        key = self._idempotency_key()
        fingerprint = self._fingerprint() if key else ""
        call = Call(self.caller, self.answer_form, to_reply, function, args, kwargs, key, fingerprint)
        database = self.services.database
        submit = database.submit_read if self.operation.method == "GET" else database.submit_write
        return await asyncio.wrap_future(submit(ANONYMOUS, run_call, call))

    async def compute(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `function` returns, computed in a thread away from the event loop."""
        return await asyncio.wrap_future(self.services.submit(function, *args, **kwargs))

    async def pause(self, seconds: float) -> bool:
        """Wait; return at once, with True, when the server is stopping."""
        try:
            await asyncio.wait_for(self.services.draining.wait(), seconds)
        except TimeoutError:
            return False
        return True

    def is_awaited(self) -> bool:
        """Whether an answer still has somebody to go to, and the server time to make one."""
        return not self._gone and not self.services.draining.is_set()

    @property
    def answer_form(self) -> Form:
        """How the caller wants the answer."""
        reading = self.request.method in ("GET", "HEAD")
        return Form(self.media, self.request.headers.get("If-None-Match") if reading else None, self.operation.status)

    async def _begin(self, **_path: Any) -> None:
        pass

    begin: Declared = _begin
    """Called before the first byte of a streamed body, with the path's variables."""

    async def receive(self, chunk: bytes) -> None:
        """Called with each piece of a streamed body."""

    def _declared_reply(self, outcome: Any) -> Reply:
        if self.operation.answer is None:
            return Reply()
        if self.operation.paged:
            return Reply(outcome, headers=self._link_to_next(outcome.next_cursor))
        return Reply(outcome, rev=outcome.rev if self.operation.etag else None)

    def _link_to_next(self, cursor: str | None) -> dict[str, str]:
        if cursor is None:
            return {}
        query = [(name, values[0]) for name, values in self.request.query_arguments.items() if name != "cursor"]
        return {"Link": f'<{self.request.path}?{urlencode([*query, ("cursor", cursor)])}>; rel="next"'}

    # -- one request, from its headers to its answer ------------------------------------------------------------------

    async def prepare(self) -> None:
        """Check everything that the headers and the address tell, before any of the body is taken in."""
        self.services.in_flight.add(self)
        try:
            self._check_head()
            body = self.operation.body
            if body is not None and body.streamed:
                self.request.connection.set_body_timeout(self.services.settings.upload_timeout_s)  # type: ignore[union-attr]
                await self.begin(**self.path_variables)
            elif self.declared_length() > EARLY_CHECK_BYTES:
                await self.look_up(only_identify)
        except MareyError as error:
            await self._refuse(error)

    def _check_head(self) -> None:
        method = "GET" if self.request.method == "HEAD" else self.request.method
        operation = self.operations.get(method or "")
        if operation is None:
            raise self._method_not_allowed()
        self.operation = operation
        headers = self.request.headers
        offers = self._offers(operation)
        chosen_otherwise = operation.answer is Bytes  # by the address: bytes have the one type they have
        self.media = offers[0] if chosen_otherwise else negotiation.choose(headers.get("Accept"), offers)
        self.caller = Caller(negotiation.bearer_token(headers.get("Authorization")), operation)
        if self.caller.token is None:
            require_access(operation, ANONYMOUS)
        self.query = parse_query(operation.query, self.request.query_arguments)
        if operation.precondition == "required" or (
            operation.precondition != "none" and ("If-Match" in headers or "If-None-Match" in headers)
        ):
            self.precondition = write_precondition(
                headers.get("If-Match"), headers.get("If-None-Match"), may_create=operation.may_create
            )
        elif operation.precondition == "create":
            write_precondition(None, None, may_create=True)
        self._check_body_head(operation)

    def _method_not_allowed(self) -> MethodNotAllowed:
        allowed = ", ".join(sorted({*self.operations, *(["HEAD"] if "GET" in self.operations else [])}))
        return MethodNotAllowed(f"Here one can {allowed}.", headers={"Allow": allowed})

    def _offers(self, operation: Operation) -> tuple[negotiation.MediaType, ...]:
        if operation.answer_types:
            return tuple(negotiation.MediaType(name, "bytes") for name in operation.answer_types)
        if operation.stream:
            return (*negotiation.MODEL_FORMS, negotiation.EVENT_STREAM)
        return negotiation.DOCUMENT_FORMS if operation.answer is Document else negotiation.MODEL_FORMS

    def _check_body_head(self, operation: Operation) -> None:
        body = operation.body
        negotiation.require_plain_encoding(self.request.headers.get("Content-Encoding"))
        if body is None or not self._expects_body():
            return
        if self.declared_length() > body.max_bytes:
            raise TooLarge(f"The body has {self.declared_length()} bytes; at most {body.max_bytes} are taken here.")
        if body.content is not Bytes and not body.streamed:
            self.body_type = negotiation.body_type(self.request.headers.get("Content-Type"))

    def declared_length(self) -> int:
        """The length of the body as its sender says; 0 where it does not."""
        text = self.request.headers.get("Content-Length", "0")
        return int(text) if text.isdigit() else 0

    def _expects_body(self) -> bool:
        return self.declared_length() > 0 or "Transfer-Encoding" in self.request.headers

    @property
    def path_variables(self) -> dict[str, Any]:
        """The variables of the path, converted."""
        numbers = set(re.findall(r"\{(\w+):int\}", self.path))
        return {name: int(text) if name in numbers else text for name, text in self.path_kwargs.items()}

    async def data_received(self, chunk: bytes) -> None:
        """Take a piece of the body in, or throw it away where the request was refused already."""
        self.received_bytes += len(chunk)
        if self._refused:
            if self.received_bytes > LINGER_BYTES:
                self.request.connection.close()  # type: ignore[union-attr]
            return
        body = self.operation.body
        try:
            limit = body.max_bytes if body is not None else 0
            if self.received_bytes > limit:
                raise TooLarge(f"The body is longer than the {limit} bytes that are taken here.")
            if body is not None and body.streamed:
                await self.receive(chunk)
            else:
                self._received += chunk
        except MareyError as error:
            await self._refuse(error)

    async def _refuse(self, error: MareyError) -> None:
        """Answer before the body is read. The rest of it is read and dropped: closing at once could lose the answer."""
        self._refused = True
        self._write_problem(error)
        if self.request.headers.get("Expect", "").lower() == "100-continue":
            self.finish()
        elif self._expects_body():
            await self.flush()

    async def perform(self, method: Callable[..., Awaitable[Reply | Rendered | None]]) -> None:
        """Run a declared method and send what it answers."""
        if self._refused:
            return
        self._performing = True
        arguments = self.path_variables
        if self.query is not None:
            arguments["query"] = self.query
        body = self.operation.body
        if body is not None and not body.streamed:
            arguments["body"] = await self._read_body()
        outcome = await method(self, **arguments)
        if isinstance(outcome, Reply):
            outcome = render(outcome, self.answer_form)
        if outcome is not None:
            self.send(outcome)

    async def _read_body(self) -> Any:
        body = self.operation.body
        assert body is not None
        data = bytes(self._received)
        if body.content is Bytes:
            return data
        if not data:
            if body.required:
                raise BadRequest("A body is needed.", code="body-missing")
            return None
        read = partial(_decode, data, self.body_type, body.content)
        return read() if len(data) <= INLINE_BYTES else await self.compute(read)

    def send(self, rendered: Rendered) -> None:
        """Put status, headers and body of an answer into the response."""
        self.set_status(rendered.status)
        for name, value in rendered.headers.items():
            self.set_header(name, value)
        if rendered.status not in (204, 304):
            self.set_header("Content-Length", str(len(rendered.body)))
            self.write(rendered.body)

    # -- idempotency --------------------------------------------------------------------------------------------------

    def _idempotency_key(self) -> str | None:
        if self.operation.idempotency != "key":
            return None
        key = self.request.headers.get("Idempotency-Key")
        if key is not None and not _KEY.fullmatch(key):
            raise BadRequest("An Idempotency-Key has 1 to 255 visible ASCII characters.", code="bad-idempotency-key")
        return key

    def _fingerprint(self) -> str:
        digest = hashlib.sha256(f"{self.request.method} {self.request.uri}\n".encode())
        digest.update(self.request.headers.get("Content-Type", "").encode() + b"\n")
        digest.update(self._received)
        return f"sha256:{digest.hexdigest()}"

    async def _undeclared(self, **_path: str) -> None:
        """Methods without a declaration are refused before they are called."""

    get: Declared = _undeclared
    head: Declared = _undeclared
    post: Declared = _undeclared
    put: Declared = _undeclared
    patch: Declared = _undeclared
    delete: Declared = _undeclared
    options: Declared = _undeclared

    # -- what Tornado asks for ----------------------------------------------------------------------------------------

    def set_default_headers(self) -> None:
        """Headers of every answer."""
        self.clear_header("Server")
        for name, value in _SECURITY_HEADERS.items():
            self.set_header(name, value)

    def compute_etag(self) -> None:
        """No tag from the bytes of an answer: tags name states, and hashing an answer costs more than sending it."""

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Any error as a problem document; details of our own faults stay in the log."""
        if self._headers_written:  # part of an answer is out: only a cut connection says that it is not whole
            self.request.connection.close()  # type: ignore[union-attr]
            return
        exc_info = kwargs.get("exc_info")
        error = exc_info[1] if exc_info else HTTPError(status_code)
        if isinstance(error, HTTPError) and error.status_code == 405:  # a method that Tornado itself does not know
            error = self._method_not_allowed()
        self.set_header("X-Request-Id", self.request_id)
        self._write_problem(error)
        if not self._finished:
            self.finish()

    def _write_problem(self, error: BaseException) -> None:
        self.send(problem.render(error, self.request_id))

    def log_exception(self, _type: Any, value: Any, _traceback: Any) -> None:
        """Faults of ours are logged with their traceback, refusals are not faults."""
        problem.log_fault(value, self.request_id, self.request.method or "", self.template())

    def on_finish(self) -> None:
        """The answer is on its way."""
        if self.principal is not None:
            self.services.note_use(self.principal)
        self.services.in_flight.discard(self)

    def on_connection_close(self) -> None:
        """The caller has gone."""
        super().on_connection_close()
        self._gone = True
        if not self._performing:  # a method that runs ends by itself, and a draining server waits for it
            self.services.in_flight.discard(self)


def _decode(data: bytes, media_type: str, content: Any) -> Any:
    tree = decode_body(data, media_type)
    return tree if content is Document else validate_body(content, tree)
