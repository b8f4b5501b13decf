"""Logs, request ids and metrics.

Labels of metrics are route templates, methods and codes that the server defines, never values that a client sent. So
metrics reveal no names. The number of metrics does not grow with the data, and an attack cannot increase it.
"""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
from collections.abc import Iterable, Mapping, Sized
from dataclasses import dataclass
from functools import partial

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Metric,
    ProcessCollector,
    disable_created_metrics,
)
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from marey_schemas.queue.log_lines import LogForm, log_to_standard_error
from marey_server.process.operator_metrics import OperatorMetrics

_SANE_ID = re.compile(r"[A-Za-z0-9._:-]{8,128}")
_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)
_DELAYS_S = (0.01, 0.05, 0.1, 0.5, 1, 5, 30, 120, 600, 3600, 86400)
_MALFORMED = (
    "Invalid Host header",
    "Invalid header name",
    "Invalid header value",
    "Malformed HTTP request line",
    "Only integer Content-Length is allowed",
    "Unsupported Transfer-Encoding",
    "header line cannot start with whitespace",
    "no colon in header line",
)
"""Beginnings of Tornado's messages about malformed requests; the rest of a message may quote received text."""

disable_created_metrics()  # times of the first count, which would double the text

access_log = logging.getLogger("marey_server.access_log")


def request_id(given: str | None) -> str:
    """Return `given`, the request id that the client sent, if it is valid; otherwise, return a new request id."""
    return given if given is not None and _SANE_ID.fullmatch(given) else secrets.token_hex(12)


def configure_logging(form: LogForm, level: str) -> None:
    """Write every log record of the process to standard error, all in the same form."""
    log_to_standard_error(form, level)
    logging.getLogger("tornado.access").setLevel("ERROR")  # requests are logged by log_request
    logging.getLogger("tornado.general").addFilter(without_received_text)
    logging.getLogger("alembic.runtime.migration").addFilter(_is_of_an_upgrade)


def without_received_text(record: logging.LogRecord) -> bool:
    """Remove received text from Tornado's message about a malformed request; return True, to keep the log record.

    Only the kind of the fault is kept and logged. The rest is removed, because it may quote a header that contains a
    token.
    """
    if isinstance(record.args, tuple):
        record.args = tuple(_kind_of_fault(arg) if isinstance(arg, Exception) else arg for arg in record.args)
    return True


def _kind_of_fault(error: Exception) -> str:
    return next((known for known in _MALFORMED if str(error).startswith(known)), "the request is malformed")


def _is_of_an_upgrade(record: logging.LogRecord) -> bool:
    """Return whether to keep a log record of Alembic, the library that upgrades the schema of the database.

    Warnings, errors, and records about upgrade steps that run are kept. Other records, such as those of the schema
    check in each readiness request, are dropped.
    """
    return record.levelno > logging.INFO or record.getMessage().startswith("Running")


@dataclass(frozen=True)
class _OneMetric:
    """Registry for the Prometheus client that contains one metric only."""

    metric: Metric

    def collect(self) -> Iterable[Metric]:
        """Return the metric as a tuple of one element, as the Prometheus client expects."""
        return (self.metric,)


class Metrics:
    """Prometheus metrics of this process, which `/metrics` shows, in a registry of their own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self.requests = Counter(
            "marey_http_requests", "Requests answered.", ("method", "route", "status"), registry=self.registry
        )
        self.seconds = Histogram(
            "marey_http_request_seconds", "Time from the headers of a request to the end of its answer.",
            ("method", "route"), buckets=_BUCKETS_S, registry=self.registry,
        )  # fmt: skip
        self._add_refusals()
        self.received = Counter("marey_http_received_bytes", "Bytes of request bodies.", registry=self.registry)
        self.in_flight = Gauge("marey_http_in_flight", "Requests under way.", registry=self.registry)
        self.connections = Gauge("marey_connections", "Open connections.", registry=self.registry)
        self.waiting = Gauge("marey_waiting", "Calls that wait for a thread.", ("lane",), registry=self.registry)
        self.request_memory = Gauge(
            "marey_request_memory_bytes", "Memory counted for bodies and unsent answers.", registry=self.registry
        )
        self.database_connections = Gauge(
            "marey_database_connections", "Connections to the database in use.", registry=self.registry
        )
        self.children = Gauge(
            "marey_children",
            "Tasks that child processes run: they read uploaded files or compute.",
            registry=self.registry,
        )
        self.children_stopped = Counter(
            "marey_children_stopped", "Child processes that ended during their work, by reason (memory, time, "
            "client-gone or died) and kind of work.", ("reason", "work"), registry=self.registry,
        )  # fmt: skip
        self.imports = Counter("marey_imported_files", "Files imported.", ("status",), registry=self.registry)
        self.draining = Gauge("marey_draining", "1 while the server is stopping.", registry=self.registry)
        self._add_webhooks()
        self.operator = OperatorMetrics(self.registry)
        self._rendering = asyncio.Lock()
        self._renderings = 0
        self._rendered = b""

    def _add_refusals(self) -> None:
        self.refusals = Counter(
            "marey_refusals", "Requests refused, by problem code.", ("code", "route"), registry=self.registry
        )
        self.closed = Counter(
            "marey_connections_closed", "Connections refused or closed to protect others, by reason: `full` (too many "
            "connections), `exhausted` (no file descriptors left), `evicted` (idle), `slow` (the client does not read "
            "the answer), `head-timeout` or `body-timeout` (the client does not send the head or the body of a request "
            "in time), `long-head` or `malformed` (the request cannot be read).", ("reason",), registry=self.registry,
        )  # fmt: skip
        self.delayed = Counter(
            "marey_refusals_delayed", "Refusals that were delayed because the event loop was late and the client was "
            "often refused.", registry=self.registry,
        )  # fmt: skip

    def _add_webhooks(self) -> None:
        self.webhook_deliveries = Counter(
            "marey_webhook_deliveries", "Attempts to deliver to webhooks, by outcome: delivered, retry (will be "
            "repeated) or dead (given up).", ("outcome",), registry=self.registry,
        )  # fmt: skip
        self.webhook_delay = Histogram(
            "marey_webhook_delay_seconds", "Time from an event to its delivery.", buckets=_DELAYS_S,
            registry=self.registry,
        )  # fmt: skip

    async def exposition(self) -> tuple[bytes, str]:
        """Return all metrics in the text format of Prometheus, and its media type.

        Rendering all metrics takes 50 ms, so the event loop handles other work after each metric. Calls that arrive
        while the metrics are being rendered wait, and share the result of the next rendering.
        """
        wanted = self._renderings + 1
        async with self._rendering:
            if self._renderings < wanted:
                self._renderings = wanted
                self._rendered = await self._render()
            return self._rendered, CONTENT_TYPE_LATEST

    async def _render(self) -> bytes:
        rendered = bytearray()
        for metric in self.registry.collect():
            rendered += generate_latest(_OneMetric(metric))
            await asyncio.sleep(0)
        return bytes(rendered)

    def count_request(self, method: str, route: str, status: int, duration_s: float, bytes_in: int) -> None:
        """Count one answered request."""
        self.requests.labels(method, route, str(status)).inc()
        self.seconds.labels(method, route).observe(duration_s)
        if bytes_in:
            self.received.inc(bytes_in)

    def count_stopped_child(self, reason: str, work: str) -> None:
        """Count a child process that ended before its task was done.

        `reason` is the reason of the end, and `work` the name of the task's function, both as the server's code defines
        them.
        """
        self.children_stopped.labels(reason, work).inc()

    def watch(self, lanes: Mapping[str, Sized]) -> None:
        """Let the metric of waiting calls show the number of queued calls of each lane (threads with a queue)."""
        for name, lane in lanes.items():
            self.waiting.labels(name).set_function(partial(len, lane))
