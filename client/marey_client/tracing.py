"""Traces of a client: requests carry the trace context of the program; a command of `marey` may begin a trace.

In a program that uses OpenTelemetry, requests belong to the active span, without further settings.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from marey_schemas.tracing.context import TraceContext
from marey_schemas.tracing.declared import CALL, COMMAND
from marey_schemas.tracing.spans import ProcessScope, SpanScope, current_scope, trace_headers

SERVICE = "marey"
"""Service name under which collectors show commands, unless an environment variable of OpenTelemetry sets another."""
PARENT_VARIABLE = "TRACEPARENT"
"""Environment variable by which the program that starts a command passes on its trace, as in `traceparent` headers."""


@dataclass(slots=True)
class TracedRequest:
    """Request of a client, which may be sent several times. If there is a trace, the request belongs to it."""

    scope: SpanScope | None
    tries: int = 0

    @property
    def headers(self) -> dict[str, str]:
        """The headers that send the trace context to the server."""
        return trace_headers(self.scope)

    def note_try(self) -> None:
        """Count a try of the request; from the second try on, record the number of repetitions in the span."""
        if self.tries:
            self._note("http.request.resend_count", self.tries)
        self.tries += 1

    def note_answer(self, status: int) -> None:
        """Record the HTTP status of an answer in the span."""
        self._note("http.response.status_code", status)

    def _note(self, attribute: str, value: int) -> None:
        if self.scope is not None and self.scope.span is not None:
            self.scope.span.attributes[attribute] = value


@contextmanager
def calling(method: str) -> Iterator[TracedRequest]:
    """Record a request while the `with` block runs, if this process records the current trace."""
    scope = current_scope()
    if scope is None or scope.emit is None:
        yield TracedRequest(scope)
        return
    with scope.child(CALL, method) as call:
        if call.span is not None:
            call.span.attributes["http.request.method"] = method
        yield TracedRequest(call)


@contextmanager
def tracing_command(name: str) -> Iterator[None]:
    """Assign all requests of this process to one trace while the `with` block runs.

    The environment variable `TRACEPARENT` names the trace. Without this variable, a new trace begins if a collector is
    configured.
    """
    from marey_schemas.tracing.export import closing, open_optional_tracer

    given = TraceContext.parse(os.environ.get(PARENT_VARIABLE))
    with closing(open_optional_tracer(SERVICE, os.environ)) as tracer:
        place = given if tracer is None or given is not None else tracer.new_root()
        if place is None or not (place.sampled or given):
            yield
            return
        with SpanScope(place, None if tracer is None else tracer.emit).child(COMMAND, f"marey {name}") as scope:
            ProcessScope.scope = scope
            try:
                yield
            finally:
                ProcessScope.scope = None
