"""Spans of an attempt of a job, from its claim to the report of its end."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from marey_schemas.queue.worker_protocol import Lease
from marey_schemas.tracing.context import TraceContext
from marey_schemas.tracing.declared import ATTEMPT, COMPUTE, INPUTS, OUTPUTS, QUEUED, SpanDeclaration
from marey_schemas.tracing.export import Tracer
from marey_schemas.tracing.spans import AttributeValue, Span, SpanScope, entering
from marey_worker.attempt_limits import Stop
from marey_worker.messages import Done, Failed, PutFile, Request, Stage

MOST_TRANSFERS = 200
"""Greatest number of downloads and uploads of an attempt that are recorded; a job may make many thousands."""


class AttemptTrace:
    """Spans of one attempt; nothing is recorded if the job belongs to no trace, or if the worker sends no traces."""

    def __init__(self, lease: Lease, tracer: Tracer | None) -> None:
        self._span: Span | None = None
        self._scope = None if tracer is None else self._begin(lease, tracer)
        self._computing: SpanScope | None = None
        self._transfers = 0
        self._lock = threading.Lock()

    def _begin(self, lease: Lease, tracer: Tracer) -> SpanScope | None:
        """Record the job's time in the queue, and begin the span of the attempt; None if nothing is recorded."""
        submitted = None if lease.trace is None else TraceContext.parse(lease.trace.traceparent)
        if lease.trace is None or submitted is None or not submitted.sampled:
            return None
        of_job: dict[str, AttributeValue] = {
            "marey.job.id": lease.job,
            "marey.job.kind": lease.kind,
            "marey.job.attempt": lease.attempt,
        }
        queued = Span(QUEUED, QUEUED.name, submitted.span_id, attributes={**of_job})
        queued.ended_ns = queued.started_ns
        queued.started_ns -= int(lease.trace.waited_s * 1e9)
        tracer.emit(submitted.within(queued.span_id), queued)
        self._span = Span(ATTEMPT, ATTEMPT.name, submitted.span_id, attributes={**of_job})
        return SpanScope(submitted.within(self._span.span_id), tracer.emit, self._span)

    @contextmanager
    def stage(self, declaration: SpanDeclaration) -> Iterator[None]:
        """Record a stage of the attempt, such as `COMPUTE`, while the `with` block runs.

        Downloads and uploads belong to the stage `COMPUTE`, even if they begin later: the child does not wait for
        uploads.
        """
        if self._scope is None:
            yield
            return
        with self._scope.child(declaration) as stage:
            if declaration is COMPUTE:
                self._computing = stage
            yield

    @contextmanager
    def transfer(self, request: Request) -> Iterator[None]:
        """Record a download or upload for the child process, while the `with` block runs. Any thread may call this."""
        computing = self._computing
        if computing is None:
            yield
            return
        with self._lock:
            self._transfers += 1
            recorded = self._transfers <= MOST_TRANSFERS
        if not recorded:  # and neither are its requests to the server
            with entering(None):
                yield
            return
        with computing.child(OUTPUTS if isinstance(request, PutFile | Stage) else INPUTS):
            yield

    def end(self, end: Done | Failed | Stop) -> None:
        """End the span of the attempt with the outcome `end`, and send it."""
        if self._scope is None or self._span is None or self._scope.emit is None:
            return
        attributes = self._span.attributes
        attributes["marey.job.outcome"] = "succeeded" if isinstance(end, Done) else _outcome(end)
        if isinstance(end, Failed):
            self._span.fail(end.code)
        if self._transfers > MOST_TRANSFERS:
            attributes["marey.spans_dropped"] = self._transfers - MOST_TRANSFERS
        self._span.ended_ns = time.time_ns()
        self._scope.emit(self._scope.context, self._span)


def _outcome(end: Failed | Stop) -> str:
    return "failed" if isinstance(end, Failed) else end.value
