"""Spans, and the current place in a trace of a thread or a process.

This module needs no package of the extra `traces`, so that programs without it can pass a trace on.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import ClassVar

from marey_schemas.tracing.context import HEADER, TraceContext, new_span_id
from marey_schemas.tracing.declared import SpanDeclaration

AttributeValue = str | int | float
_ERROR_TYPE = re.compile("[A-Za-z_][A-Za-z0-9_.-]{0,63}")


@dataclass(slots=True)
class Span:
    """Span of a trace: a piece of work with its beginning and end, in nanoseconds since 1970."""

    declaration: SpanDeclaration
    name: str
    parent_id: int | None
    span_id: int = field(default_factory=new_span_id)
    attributes: dict[str, AttributeValue] = field(default_factory=dict)
    started_ns: int = field(default_factory=time.time_ns)
    ended_ns: int = 0

    def fail(self, error_type: str) -> None:
        """Mark the span as failed, with the code of a refusal or the class of an error; other texts are not kept."""
        self.attributes["error.type"] = error_type if _ERROR_TYPE.fullmatch(error_type) else "other"


Emit = Callable[[TraceContext, Span], None]
"""Function that sends an ended span of a trace to the collector."""


@dataclass(frozen=True, slots=True)
class SpanScope:
    """Place in a trace: `context` names the span under which new spans are recorded, and `emit` sends the new spans.

    Without `emit`, nothing is recorded, and requests only pass the trace on. `span` is the span itself, if this process
    records it.
    """

    context: TraceContext
    emit: Emit | None = None
    span: Span | None = None

    @contextmanager
    def child(self, declaration: SpanDeclaration, name: str | None = None) -> Iterator[SpanScope]:
        """Record a span below this scope while the `with` block runs, and yield the scope of the new span.

        The yielded scope is the current one in the block. If nothing is recorded, this scope is yielded.
        """
        if self.emit is None or not self.context.sampled:
            with entering(self):
                yield self
            return
        span = Span(declaration, name or declaration.name, self.context.span_id or None)
        scope = SpanScope(self.context.within(span.span_id), self.emit, span)
        try:
            with entering(scope):
                yield scope
        except BaseException as error:
            code = getattr(error, "code", None) if isinstance(error, Exception) else None
            span.fail(code if isinstance(code, str) else type(error).__name__)
            raise
        finally:
            span.ended_ns = time.time_ns()
            self.emit(scope.context, span)


_current: ContextVar[SpanScope | None] = ContextVar("marey_trace", default=None)


@contextmanager
def entering(scope: SpanScope | None) -> Iterator[None]:
    """Make `scope` the current scope of this thread or task while the `with` block runs."""
    token = _current.set(scope)
    try:
        yield
    finally:
        _current.reset(token)


class ProcessScope:
    """Holder of the `SpanScope` of the process, which threads without a scope of their own use; commands set it."""

    scope: ClassVar[SpanScope | None] = None


def current_scope() -> SpanScope | None:
    """Return the scope of this thread, else that of the process, else that of an OpenTelemetry trace of the program.

    Return None if there is none of these.
    """
    return _current.get() or ProcessScope.scope or _foreign_scope()


def trace_headers(scope: SpanScope | None) -> dict[str, str]:
    """Return the HTTP headers that pass the trace of a scope on; empty without a scope."""
    return {} if scope is None else {HEADER: scope.context.header}


def _foreign_scope() -> SpanScope | None:
    """Return the scope of the active span if the program uses OpenTelemetry itself, else None.

    The package is never loaded here.
    """
    module = sys.modules.get("opentelemetry.trace")
    if module is None or not hasattr(module, "get_current_span"):  # it is being loaded
        return None
    found = module.get_current_span().get_span_context()
    return SpanScope(TraceContext(found.trace_id, found.span_id, found.trace_flags.sampled)) if found.is_valid else None
