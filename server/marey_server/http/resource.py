"""Base class of all handlers: checks requests against the declaration, runs the method, and sends its answer.

A resource names its `path` and declares its methods:

    class ProjectResource(Resource):
        path = "/projects/{project}"
        tag = "Projects"

        @reads(access=Access.READER, answer=Project, etag=True)
        async def get(self, project: str) -> Rendered:
            \"\"\"A project.\"\"\"
            return await self.answer(projects.read_project, project)

A method gets the path's variables (`{fence:int}` as an int), `query` and `body` as declared. `self.answer` calls a
function of the store with a transaction and renders the result, both in another thread; `self.look_up` and
`self.change` only call a function.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, ClassVar, Concatenate, ParamSpec, TypeVar
from urllib.parse import urlencode

from pydantic import BaseModel
from tornado.web import stream_request_body

from marey_schemas.encoding.codecs import JSON
from marey_schemas.sizes import KIB
from marey_server.access.principal import ANONYMOUS
from marey_server.errors import (
    ApiProblem,
    BadRequestProblem,
    LeaseLostProblem,
    StoppingProblem,
    TooLargeProblem,
)
from marey_server.http import negotiation
from marey_server.http.browser_cookies import session_token
from marey_server.http.calling import CallingExchange
from marey_server.http.calls import (
    BodyTarget,
    Call,
    Caller,
    IdempotentRequest,
    admission_of,
    admit,
    find_first_answer,
    idempotent_request,
    require_access,
    run_call,
    run_plain,
)
from marey_server.http.declarations import Access, Bytes, Declared, Document, Operation, RequestBody
from marey_server.http.etags import ANY_STATE, Precondition, write_precondition
from marey_server.http.exchange import JOINED_BYTES
from marey_server.http.receiving import PauseLimit
from marey_server.http.reply import AnswerForm, LoadedDocument, Rendered, Reply, render
from marey_server.http.validation import decode_body, decompressed, parse_query, stated_size, validate_body
from marey_server.store.transaction import Transaction

P = ParamSpec("P")
T = TypeVar("T")

INLINE_BYTES = 4 * KIB
"""Greatest size of JSON bodies that are decoded on the event loop; all other bodies are decoded in a thread."""
GUEST_BODY_BYTES = 64 * KIB
"""Greatest size of a body that a caller without a token may send, such as a search in a public project."""
ADMISSION_S = 5.0
"""Time in seconds for which an admitted caller may send further bodies without another check in the database."""
_METHODS = ("get", "post", "put", "patch", "delete")


@stream_request_body
class Resource(CallingExchange):
    """Resource with a path and declared methods."""

    tag: ClassVar[str]
    uneventful = False
    """True if a success is too frequent to be logged, such as an empty claim or a readiness check."""

    answers_while_stopping = False
    """True if requests are answered even if they come after the server has begun to stop."""

    media: negotiation.MediaType
    query: BaseModel | None = None
    precondition: Precondition = ANY_STATE
    is_compressed = False
    """True if the body of the request is compressed."""

    def __init_subclass__(cls) -> None:
        methods = {name: getattr(cls, name) for name in _METHODS if hasattr(vars(cls).get(name), "operation")}
        cls.operations = {name.upper(): method.operation for name, method in methods.items()}
        if "get" in methods:
            cls.head = cls.get  # pyrefly: ignore[instance-var-assign]  # Tornado declares methods as attributes

    def initialize(self) -> None:
        """Set up the state of one request."""
        super().initialize()
        self._received: bytearray | bytes = bytearray()
        self._pauses = PauseLimit(self.services.settings.body_timeout_s, self.wire.stream.close)

    # -- for the methods of resources ---------------------------------------------------------------------------------

    async def answer(
        self,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Rendered:
        """Run `function(tx, ...)` and return its result as the declared answer, encoded, with ETag and status."""
        return await self.answer_with(self._declared_reply, function, *args, **kwargs)

    async def answer_with(
        self,
        to_reply: Callable[[T], Reply],
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Rendered:
        """Run `function(tx, ...)` in a transaction, and return the encoded answer.

        `to_reply` converts the result of the function to a `Reply`, in the same transaction.
        """
        answers = self.services.answers
        call = Call(self.caller, self.answer_form, answers, to_reply, function, args, kwargs, self._idempotent())
        run = self._read if self.operation.method == "GET" else self._write
        outcome = await run(partial(run_call, call))
        return outcome if isinstance(outcome, Rendered) else await self.render_document(outcome)

    def _idempotent(self) -> IdempotentRequest | None:
        """Return the request with its idempotency key; None if the request has no key or the operation accepts none."""
        if self.operation.idempotency != "key":
            return None
        place = {name: self.path_kwargs.get(name) for name in ("project", "job")}
        return idempotent_request(self.request, self._received, **place)

    async def _first_answer(self) -> Rendered | None:
        """Return the answer to an earlier, equal request with the same idempotency key, or None if the key is new."""
        idempotent = self._idempotent()
        return None if idempotent is None else await self._read(partial(find_first_answer, self.caller, idempotent))

    async def render_document(self, reply: Reply) -> Rendered:
        """Render a loaded document in a rendering thread.

        Until the document is rendered, its memory counts towards the limits on the memory of requests.
        """
        rendering, answers = self.services.compute_threads.rendering, self.services.answers
        loaded_bytes = reply.content.size_bytes if isinstance(reply.content, LoadedDocument) else 0
        self.holding.grow(loaded_bytes)
        rendered = await asyncio.wrap_future(rendering.submit(self.client, render, reply, self.answer_form, answers))
        self.holding.shrink(loaded_bytes)
        return rendered

    @property
    def sees_names(self) -> bool:
        """True if an error may name objects that the request does not name; see `ApiProblem`."""
        return not hasattr(self, "caller") or self.caller.sees_names(self.path_kwargs.get("project"))

    def _write_problem(self, error: BaseException) -> None:
        super()._write_problem(error)
        if isinstance(error, LeaseLostProblem) and error.attempt_to_end is not None:
            self.services.end_attempt(*error.attempt_to_end)

    def on_finish(self) -> None:
        """Record the use of the caller's token after the answer was written."""
        super().on_finish()
        if self.principal is not None and self.caller.token is not None:
            self.services.note_use(self.caller.token, self.principal)

    @property
    def awaits_guest(self) -> bool:
        """True if the request waits for a body from a caller without a token, who may never send this body."""
        return not self.performing and hasattr(self, "caller") and self.caller.token is None and self.expects_body()

    async def _wait_for_refusal(self, error: ApiProblem) -> None:
        """Delay the answer to a refused request if the event loop is late and this client was refused several times.

        Refusals of a busy server (status 503) do not count, because the client has not caused them.
        """
        if error.status >= 500:
            return
        key = self.client.key
        at_once = sum(request.client.key == key for request in self.services.in_flight)
        brake, waiting = self.services.refusal_brake, len(self.services.turns)
        if delay_s := brake.delay_s(key, at_once=at_once, waiting=waiting):
            self.services.metrics.delayed.inc()
            self._release_memory()
            with brake.delaying():
                await self.pause(delay_s)

    def _release_memory(self) -> None:
        if hasattr(self, "operation"):  # otherwise the path or the method is unknown, and nothing was received
            self.holding.release()

    @property
    def answer_form(self) -> AnswerForm:
        """The form in which the client requested the answer."""
        reading = self.request.method in ("GET", "HEAD")
        known = self.request.headers.get("If-None-Match") if reading else None
        return AnswerForm(self.media, known, self.operation.status)

    async def _begin(self, **_path: Any) -> None:
        pass

    begin: Declared = _begin
    """Method called before the first byte of a streamed body, with the variables of the path."""

    async def receive(self, chunk: bytes) -> None:
        """Process the next piece of a streamed body."""

    def hold_body(self, most_bytes: int) -> None:
        """Count the memory that a streamed body needs while it is received: its size, but at most `most_bytes`.

        `begin` calls this, so that the request is refused before the client has sent a long body if there is not enough
        memory.
        """
        if self.expects_body():
            self.holding.grow(min(self.declared_length() or most_bytes, most_bytes))

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
        """Check the path, the query and the headers before the body is received."""
        self.services.in_flight.add(self)
        self.running = asyncio.current_task()
        if (turn := self._turn()) is not None:
            await turn
        try:
            if self.services.draining.is_set() and not self.answers_while_stopping:
                raise StoppingProblem
            self._check_head()
            body = self.operation.body
            if body is not None and (body.streamed or self.expects_body()):
                await self._admit()
                if self.operation.stores:
                    self.services.disk.require()
            if body is not None and body.streamed:
                await self.begin(**self.path_variables)
                self.wire.set_body_timeout(self.services.settings.upload_timeout_s)
                self._pauses.start()
        except ApiProblem as error:
            self._release_memory()  # `perform` does not release it, because the method of this request never runs
            await self._wait_for_refusal(error)
            await self.refuse(error)

    def _turn(self) -> asyncio.Future[None] | None:
        """Return a future that ends when it is this request's turn, or None if the request may begin at once."""
        operation = self._declared()
        reserved = operation is not None and operation.reserved
        return self.services.turns.take(self.client, reserved=reserved)

    async def _admit(self) -> None:
        """Refuse callers who may not send a body, before any of the body is received or decoded.

        The transaction of the request checks the caller again. Here, an earlier check of the same caller may be reused
        for `ADMISSION_S` seconds. It is not reused for results of jobs, whose bodies may be the largest.
        """
        operation = self.operation
        project = self.path_kwargs.get("project") if operation.access.role is not None else None
        if self.caller.token is None and project is None:
            return  # the head showed that anyone may do this
        of_attempt = operation.access is Access.ATTEMPT
        target = BodyTarget(project, (self.path_variables["job"], self.path_variables["fence"]) if of_attempt else None)
        admission, now = admission_of(self.caller, target), time.monotonic()
        admitted = self.services.admitted.get(admission)
        wide = operation.body is not None and operation.body.results
        if admitted is None or wide or now - admitted > ADMISSION_S:
            check = partial(run_plain, self.caller, partial(admit, target=target))
            await asyncio.wrap_future(self.services.database.queue_read(self.client, ANONYMOUS, check, reserved=True))
            self.services.admitted.put(admission, now)

    def _declared(self) -> Operation | None:
        """Return the declaration of the request's method, or None for an undeclared method; HEAD counts as GET."""
        method = "GET" if self.request.method == "HEAD" else self.request.method
        return self.operations.get(method or "")

    def _check_head(self) -> None:
        operation = self._declared()
        if operation is None:
            raise self.method_not_allowed()
        self.operation = operation
        headers = self.request.headers
        offers = self._offers(operation)
        chosen_otherwise = operation.answer is Bytes  # by the address: bytes have the one type they have
        self.media = offers[0] if chosen_otherwise else negotiation.choose(headers.get("Accept"), offers)
        token = negotiation.bearer_token(headers.get("Authorization"))
        if token is None:
            token = session_token(self.request, operation, self.path_kwargs.get("project"))
        self.caller = Caller(token, operation)
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

    def _offers(self, operation: Operation) -> tuple[negotiation.MediaType, ...]:
        if operation.answer_types:
            return (
                negotiation.MediaType(operation.answer_types[0], "bytes"),
            )  # what bytes are is not the caller's choice
        if operation.stream:
            return (*negotiation.MODEL_FORMS, negotiation.EVENT_STREAM)
        return negotiation.DOCUMENT_FORMS if operation.answer is Document else negotiation.MODEL_FORMS

    def _check_body_head(self, operation: Operation) -> None:
        body = operation.body
        self.is_compressed = negotiation.is_compressed(
            self.request.headers.get("Content-Encoding"), may_be=operation.compressed
        )
        if body is None or not self.expects_body():
            return
        if self.declared_length() > self._most_bytes(body):
            raise TooLargeProblem(
                f"The request body has {self.declared_length()} bytes; this address accepts at most "
                f"{self._most_bytes(body)}."
            )
        if body.content is not Bytes and not body.streamed:
            self.body_type = negotiation.body_type(self.request.headers.get("Content-Type"))

    def _most_bytes(self, body: RequestBody) -> int:
        """Return the greatest allowed size of the body in bytes; the limit is lower for callers without a token."""
        return body.max_bytes if self.caller.token is not None else min(body.max_bytes, GUEST_BODY_BYTES)

    @property
    def path_variables(self) -> dict[str, Any]:
        """The variables of the path, converted to their types."""
        numbers = set(re.findall(r"\{(\w+):int\}", self.path))
        return {name: int(text) if name in numbers else text for name, text in self.path_kwargs.items()}

    async def data_received(self, chunk: bytes) -> None:
        """Process the next piece of the body, or discard it if the request was refused already."""
        with self._pauses.suspended():
            await self._process(chunk)

    async def _process(self, chunk: bytes) -> None:
        self.received_bytes += len(chunk)
        if self.refused:
            self.drop()
            return
        body = self.operation.body
        try:
            limit = self._most_bytes(body) if body is not None else 0
            if self.received_bytes > limit:
                raise TooLargeProblem(f"The request body is longer than the {limit} bytes that this address accepts.")
            if body is not None and body.streamed:
                await self.receive(chunk)
            else:
                self.holding.grow(len(chunk))
                self._received += chunk
        except ApiProblem as error:
            self._received = bytearray()
            self.holding.release()
            await self.refuse(error)

    async def perform(self, method: Callable[..., Awaitable[Reply | Rendered | None]]) -> None:
        """Run a declared method and send its answer."""
        self._pauses.stop()
        if self.refused:
            return
        self.performing = True
        try:
            await self._perform(method)
        except ApiProblem as error:
            await self._wait_for_refusal(error)
            raise
        finally:
            self.holding.release()

    async def _perform(self, method: Callable[..., Awaitable[Reply | Rendered | None]]) -> None:
        arguments = self.path_variables
        if self.query is not None:
            arguments["query"] = self.query
        body = self.operation.body
        if body is not None and not body.streamed:
            arguments["body"] = await self._read_body()
        try:
            outcome = await method(self, **arguments)
        except ApiProblem as refusal:  # perhaps by a preparation that has seen the effects of the first, equal request
            outcome = await self._first_answer() if refusal.status < 500 else None
            if outcome is None:
                raise
        if isinstance(outcome, Reply):
            outcome = render(outcome, self.answer_form, self.services.answers)
        if outcome is None:
            return
        if not self.caller.sees_answer(self.path_kwargs.get("project")):
            outcome = outcome.without_content()
        accepted = self.request.headers.get("Accept-Encoding")
        if self.operation.compressed and outcome.worth_compressing and negotiation.accepts_zstd(accepted):
            outcome = await self.compute(outcome.compressed)
        if len(outcome.body) > JOINED_BYTES and self.request.method != "HEAD":
            self.holding.grow(len(outcome.body))
            await self.send_in_pieces(outcome)
        else:
            self.send(outcome)

    def on_connection_close(self) -> None:
        """Release the body and stop child processes, because the client has closed the connection."""
        super().on_connection_close()
        self._pauses.stop()
        if not self.performing:
            self._release_memory()

    async def _read_body(self) -> Any:
        body = self.operation.body
        assert body is not None
        data = self._received = bytes(self._received)  # one copy of a long body is enough
        if body.content is Bytes:
            return data
        if not data:
            if body.required:
                raise BadRequestProblem("The request needs a body.", code="body-missing")
            return None
        if self.is_compressed:
            self.holding.grow(stated_size(data, self._most_bytes(body)))
            data = await self.compute(decompressed, data)
        decode = partial(
            decode_body,
            data,
            self.body_type,
            max_array_bytes=body.max_bytes,
            keep_blocks=body.results,
            take_bytes=self.holding.grow,
        )
        read = partial(_read_tree, decode, body.content)
        inline = len(data) <= INLINE_BYTES and self.body_type == JSON  # a few bytes of blocks unpack to megabytes
        return read() if inline else await self.compute(read)


def _read_tree(decode: Callable[[], Any], content: Any) -> Any:
    tree = decode()
    return tree if content is Document else validate_body(content, tree)
