"""Export of spans to a collector, by OTLP over HTTP; needs the packages of the extra `traces`.

Importing this module loads none of these packages: only `open_tracer` does, and only if a collector is configured.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from marey_schemas.tracing.context import TraceContext, new_trace_id
from marey_schemas.tracing.spans import Span

if TYPE_CHECKING:
    from collections.abc import Iterator

    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import ReadableSpan
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

SERVICE_VARIABLE = "OTEL_SERVICE_NAME"
ENDPOINT_VARIABLE = "MAREY_TRACES_ENDPOINT"
SHARE_VARIABLE = "MAREY_TRACES_SHARE"
_ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
_PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
PROTOCOL = "http/protobuf"
PATH = "/v1/traces"
CLOSE_S = 2.0
"""Longest time in seconds that a process waits for the collector before it ends."""
WARN_EVERY_S = 60.0
"""Shortest time in seconds between two log lines about a collector that does not work."""
_LONGEST_WARNING = 300
_SHARES = {"always_on": 1.0, "always_off": 0.0}
_WANTED = 1 << 64

log = logging.getLogger(__name__)


class TracesUnusable(Exception):
    """Traces are configured, but cannot be sent; the text says why, and what to do."""


class Tracer:
    """Sender of ended spans, in batches and in a thread of its own.

    If the collector is slow or does not answer, spans are dropped.
    """

    def __init__(self, processor: BatchSpanProcessor, resource: Resource, share: float) -> None:
        self._processor = processor
        self._resource = resource
        self._share = share

    def new_root(self) -> TraceContext:
        """Return the context of a new trace without spans (`span_id` is 0); a configured share of traces is sampled."""
        trace_id = new_trace_id()
        return TraceContext(trace_id, 0, trace_id % _WANTED < self._share * _WANTED)

    def emit(self, context: TraceContext, span: Span) -> None:
        """Send an ended span of a trace that is sampled. Does not wait."""
        self._processor.on_end(_readable(context, span, self._resource))

    def close(self) -> None:
        """Send the remaining spans, and end after `CLOSE_S` seconds even if the collector does not answer."""
        closing = threading.Thread(target=self._processor.shutdown, name="marey-traces-close", daemon=True)
        closing.start()
        closing.join(CLOSE_S)
        if closing.is_alive():
            self._processor.span_exporter.shutdown()
            log.warning("the last traces were not sent, because the collector does not answer")


def open_tracer(
    service: str, environment: Mapping[str, str], *, endpoint: str | None = None, share: float | None = None
) -> Tracer | None:
    """Return the sender of the traces of this process; None if no collector is configured, or if traces are disabled.

    `endpoint` and `share` take precedence over the variables of OpenTelemetry, which are read from `environment`; the
    exporter itself reads further ones (headers, certificates, sizes of batches) from the process. Raises
    `TracesUnusable` if a setting is not valid or not supported, or if the optional packages for traces are missing.
    """
    if environment.get("OTEL_SDK_DISABLED", "").strip().lower() == "true":
        return None
    exporter = environment.get("OTEL_TRACES_EXPORTER", "").strip().lower()
    if exporter == "none" or not (endpoint or exporter or any(environment.get(name) for name in _ENDPOINTS)):
        return None
    if exporter not in ("", "otlp"):
        raise TracesUnusable(f"OTEL_TRACES_EXPORTER is {exporter!r}; Marey knows only otlp and none")
    protocol = next((environment[name] for name in _PROTOCOLS if environment.get(name)), PROTOCOL)
    if protocol != PROTOCOL and not endpoint:
        raise TracesUnusable(f"the protocol of OTLP is {protocol!r}; Marey knows only {PROTOCOL}")
    share = _share_in(environment) if share is None else share
    return _opened(service, environment, None if endpoint is None else full_endpoint(endpoint), share)


def open_optional_tracer(service: str, environment: Mapping[str, str], *, share: float | None = None) -> Tracer | None:
    """Return the sender of traces as `open_tracer` does; if traces cannot be sent, log the reason and return None.

    The variables `MAREY_TRACES_ENDPOINT` and `MAREY_TRACES_SHARE` apply, too.
    """
    try:
        if share is None and (text := environment.get(SHARE_VARIABLE)):
            share = _fraction(SHARE_VARIABLE, text)
        return open_tracer(service, environment, endpoint=environment.get(ENDPOINT_VARIABLE), share=share)
    except TracesUnusable as error:
        log.warning("no traces are sent: %s", error)
        return None


def full_endpoint(address: str) -> str:
    """Return the address for spans at a collector; an address without a path gets the usual path.

    Raises `TracesUnusable` if it is not an address of HTTP, or contains a user name, password, query or fragment.
    """
    try:
        parts = urlsplit(address)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        parts = None
        usable = False
    if parts is None or not usable:
        raise TracesUnusable(f"{address!r} is not an address of a collector; write it like http://127.0.0.1:4318")
    if parts.username is not None or parts.password is not None or parts.query or parts.fragment:
        raise TracesUnusable(
            "the address of the collector must contain no user name, password, query or fragment; set "
            "OTEL_EXPORTER_OTLP_HEADERS instead"
        )
    return address if parts.path.strip("/") else address.rstrip("/") + PATH


def _share_in(environment: Mapping[str, str]) -> float:
    """Return the share of new traces that are sampled, as the variables of OpenTelemetry define it."""
    sampler = environment.get("OTEL_TRACES_SAMPLER", "").strip().lower() or "parentbased_always_on"
    name = sampler.removeprefix("parentbased_")
    if name == "traceidratio":
        return _fraction("OTEL_TRACES_SAMPLER_ARG", environment.get("OTEL_TRACES_SAMPLER_ARG") or "1")
    if name not in _SHARES:
        known = ", ".join([*_SHARES, "traceidratio"])
        raise TracesUnusable(f"OTEL_TRACES_SAMPLER is {sampler!r}; known are {known}, also with parentbased_ before")
    return _SHARES[name]


def _fraction(name: str, text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0 <= share <= 1:
        raise TracesUnusable(f"{name} is {text!r}; it must be a number from 0 to 1")
    return share


def _opened(service: str, environment: Mapping[str, str], endpoint: str | None, share: float) -> Tracer:
    from importlib.metadata import version  # slow to load, and needed only here

    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise TracesUnusable('traces need optional packages; run pip install "marey[traces]"') from error
    _quieten("opentelemetry")
    own: dict[str, str | int] = {"service.version": version("marey"), "process.pid": os.getpid()}
    if not environment.get(SERVICE_VARIABLE) and "service.name=" not in environment.get("OTEL_RESOURCE_ATTRIBUTES", ""):
        own["service.name"] = service
    try:
        processor = BatchSpanProcessor(OTLPSpanExporter(endpoint=endpoint))
    except ValueError as error:
        raise TracesUnusable(f"a variable of OpenTelemetry is not valid: {error}") from error
    return Tracer(processor, Resource.create(own), share)


def _readable(context: TraceContext, span: Span, resource: Resource) -> ReadableSpan:
    """Return a span in the form that the processor of OpenTelemetry takes."""
    from opentelemetry.sdk.trace import ReadableSpan
    from opentelemetry.sdk.util.instrumentation import InstrumentationScope
    from opentelemetry.trace import SpanContext, SpanKind, Status, StatusCode, TraceFlags

    sampled, error_type = TraceFlags(TraceFlags.SAMPLED), span.attributes.get("error.type")
    parent = None if span.parent_id is None else SpanContext(context.trace_id, span.parent_id, True, sampled)
    return ReadableSpan(
        span.name,
        SpanContext(context.trace_id, span.span_id, False, sampled),
        parent,
        resource,
        span.attributes,
        kind=SpanKind[span.declaration.kind.upper()],
        status=Status(StatusCode.UNSET if error_type is None else StatusCode.ERROR),
        start_time=span.started_ns,
        end_time=max(span.started_ns, span.ended_ns),
        instrumentation_scope=InstrumentationScope("marey"),
    )


class _RateLimited(logging.Handler):
    """Logging handler that logs at most one message in `WARN_EVERY_S` seconds, so that no collector floods the log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._due = 0.0
        self._held_back = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Log the message as a warning of Marey, without the traceback; only count it if it follows too soon."""
        if (now := time.monotonic()) < self._due:
            self._held_back += 1
            return
        held_back, self._held_back, self._due = self._held_back, 0, now + WARN_EVERY_S
        more = f" ({held_back} messages like this one since the last)" if held_back else ""
        log.warning("traces are not sent: %s%s", record.getMessage()[:_LONGEST_WARNING], more)


def _quieten(name: str) -> None:
    """Send the log messages of a library only to a handler that limits their rate."""
    logger = logging.getLogger(name)
    logger.propagate = False
    if not any(isinstance(handler, _RateLimited) for handler in logger.handlers):
        logger.addHandler(_RateLimited())


@contextmanager
def closing(tracer: Tracer | None) -> Iterator[Tracer | None]:
    """Close a tracer, if there is one, at the end of the `with` block."""
    try:
        yield tracer
    finally:
        if tracer is not None:
            tracer.close()
