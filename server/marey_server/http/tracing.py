"""Spans of a request, kept until the request ends, because its caller may be identified only then.

The header `traceparent` is untrusted input. A setting states whether nobody, all callers with a valid token, or
everybody may continue a trace, and so decide that their requests are recorded. Other callers with a valid token begin
new traces, of which a share is recorded. Requests without a valid token are recorded only if everybody may continue a
trace, because anybody can send any number of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Generic, TypeVar

from marey_schemas.tracing.context import TraceContext, new_span_id, new_trace_id
from marey_schemas.tracing.declared import CHILD, DATABASE_READ, DATABASE_WRITE, REQUEST, SpanDeclaration
from marey_schemas.tracing.export import Tracer
from marey_schemas.tracing.spans import AttributeValue, Span
from marey_server.access.principal import Principal
from marey_server.errors import ApiProblem
from marey_server.process.setting_groups.trace_settings import TraceCallers
from marey_server.store.transaction import Transaction

T = TypeVar("T")

MOST_SPANS = 64
"""Greatest number of spans of one request, so that a request cannot fill the memory or the queue of the exporter."""


class RequestTrace:
    """Spans of one request, and the request's context (trace and parent span) in a distributed trace."""

    def __init__(self, tracer: Tracer, callers: TraceCallers, header: str | None) -> None:
        self._tracer = tracer
        self._callers = callers
        self._remote = None if callers == "nobody" else TraceContext.parse(header)
        self._place: TraceContext | None = None
        self._span_id = new_span_id()
        self._spans: list[Span] = []
        self._dropped = 0
        self._started_ns = time.time_ns()

    def place(self, principal: Principal | None) -> TraceContext:
        """Return the trace context of the request.

        The first call decides whether the request continues the trace that `principal` has sent. So the first call
        must be made when the caller is known, or at the end of the request.
        """
        if self._place is None:
            known = principal is not None and principal.kind != "anonymous"
            if not known and self._callers != "everybody":
                self._remote = None
                self._place = TraceContext(new_trace_id(), self._span_id, sampled=False)
            else:
                self._place = (self._remote or self._tracer.new_root()).within(self._span_id)
        return self._place

    def job_parent(self, principal: Principal) -> str | None:
        """Return a `traceparent` header for the jobs of this request; None if the request is not recorded."""
        place = self.place(principal)
        return place.header if place.sampled else None

    def transaction(self, run: Callable[[Transaction], T], system: str, *, writes: bool) -> TracedTransaction[T]:
        """Return a callable that runs `run` in a transaction, and records the transaction as a span.

        `system` is the kind of database, such as `postgresql`; `writes` states whether the transaction may write.
        """
        return TracedTransaction(
            self, self._begin(DATABASE_WRITE if writes else DATABASE_READ, {"db.system.name": system}), run
        )

    def record_child(self, work: str, future: Future[T]) -> None:
        """Record the work of a child process as a span, which ends when `future` is done."""
        span = self._begin(CHILD, {"marey.work": work})
        future.add_done_callback(lambda done: self.end(span, None if done.cancelled() else done.exception()))

    def _begin(self, declaration: SpanDeclaration, attributes: dict[str, AttributeValue]) -> Span:
        return Span(declaration, declaration.name, self._span_id, attributes=attributes)

    def end(self, span: Span, error: BaseException | None) -> None:
        """End a span, and keep it unless the request has `MOST_SPANS` spans already."""
        span.ended_ns = time.time_ns()
        if error is not None:
            span.fail(error.error_code if isinstance(error, ApiProblem) else type(error).__name__)
        if len(self._spans) < MOST_SPANS:
            self._spans.append(span)
        else:
            self._dropped += 1

    def finish(
        self, name: str, principal: Principal | None, *, uneventful: bool, attributes: Mapping[str, AttributeValue]
    ) -> None:
        """Send the spans of the request, which has ended, if they are recorded.

        An uneventful request, such as a readiness check or a claim without jobs, is recorded only if it continues a
        trace of its caller.
        """
        place = self.place(principal)
        if not place.sampled or (uneventful and self._remote is None):
            return
        parent_id = None if self._remote is None else self._remote.span_id
        dropped: dict[str, AttributeValue] = {"marey.spans_dropped": self._dropped} if self._dropped else {}
        root = Span(
            REQUEST, name, parent_id, self._span_id, {**attributes, **dropped}, self._started_ns, time.time_ns()
        )
        for span in (*self._spans, root):
            self._tracer.emit(place, span)


class TracedTransaction(Generic[T]):
    """Function that runs in a transaction, with the span that records the transaction.

    The span begins when a thread runs the function, not while the call waits for a thread.
    """

    def __init__(self, trace: RequestTrace, span: Span, run: Callable[[Transaction], T]) -> None:
        self._trace = trace
        self._span = span
        self._run = run
        self._runs = 0

    def __call__(self, tx: Transaction) -> T:
        """Run the function in a transaction.

        This may be called several times, because a transaction may be repeated.
        """
        if not self._runs:
            now_ns = time.time_ns()
            self._span.attributes["marey.waited_ms"] = round((now_ns - self._span.started_ns) / 1e6, 3)
            self._span.started_ns = now_ns
        self._runs += 1
        tx.trace_of_jobs = self._trace.job_parent
        return self._run(tx)

    def recorded(self, future: Future[T]) -> Future[T]:
        """End the span when `future` is done; return `future`."""
        future.add_done_callback(self._end)
        return future

    def _end(self, future: Future[T]) -> None:
        self._span.attributes["marey.runs"] = self._runs
        self._trace.end(self._span, None if future.cancelled() else future.exception())
