"""All spans that Marey records, and all attributes of spans; the reference page of traces is made from this module.

A span never contains what a user has named or written: no names of projects, items or files, no tokens, no parameters
of SQL statements.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

SpanKind = Literal["internal", "server", "client", "consumer"]

ATTRIBUTES = {
    "http.request.method": "Method of the request.",
    "http.request.resend_count": "Number of times that the request was sent again.",
    "http.response.status_code": "Status of the answer.",
    "http.route": "Pattern of the address, such as `/api/v1/projects/{project}`.",
    "error.type": "Code of the refusal, reason of the failure, or class of the error.",
    "db.system.name": "`sqlite` or `postgresql`.",
    "marey.request_id": "Id of the request, as in the log and in the header `X-Request-Id`.",
    "marey.waited_ms": "Time until a thread of the server began with the transaction, in milliseconds.",
    "marey.runs": "Number of times that the function ran in a transaction; more than 1 if it was repeated.",
    "marey.work": "Function that the child process ran; the server's code defines its name.",
    "marey.spans_dropped": "Number of spans that were not recorded, because there were too many.",
    "marey.job.id": "Id of the job.",
    "marey.job.kind": "Kind of the job.",
    "marey.job.attempt": "Number of the attempt, from 1.",
    "marey.job.outcome": "`succeeded`, `failed`, or the reason why the job was stopped.",
}
"""Attributes of spans, each with its meaning."""


class SpanDeclaration(NamedTuple):
    """Kind of span: its name as in the reference, the program that records it, and its attributes."""

    name: str
    maker: Literal["client", "server", "worker"]
    kind: SpanKind
    meaning: str
    attributes: tuple[str, ...] = ()


_OF_JOB = ("marey.job.id", "marey.job.kind", "marey.job.attempt")

COMMAND = SpanDeclaration(
    "marey COMMAND",
    "client",
    "internal",
    "A command of `marey`, from the reading of its options to its end.",
    ("error.type",),
)
CALL = SpanDeclaration(
    "METHOD", "client", "client", "A request of a client or worker, with its repetitions.",
    ("http.request.method", "http.response.status_code", "http.request.resend_count", "error.type"),
)  # fmt: skip
REQUEST = SpanDeclaration(
    "METHOD ROUTE", "server", "server", "A request, from its headers to the end of its answer.",
    ("http.request.method", "http.route", "http.response.status_code", "marey.request_id", "error.type",
     "marey.spans_dropped"),
)  # fmt: skip
DATABASE_READ = SpanDeclaration(
    "database read", "server", "client", "A read-only transaction of a request.",
    ("db.system.name", "marey.waited_ms", "marey.runs", "error.type"),
)  # fmt: skip
DATABASE_WRITE = DATABASE_READ._replace(name="database write", meaning="A transaction of a request, with its commit.")
CHILD = SpanDeclaration(
    "child process", "server", "internal", "Work in a child process, such as reading an uploaded file; the wait for a "
    "free child process is part of it.", ("marey.work", "error.type"),
)  # fmt: skip
QUEUED = SpanDeclaration(
    "job queued", "worker", "internal", "Time from the moment when the job could run to its claim. Its start is "
    "computed from the wait that the server has measured.", _OF_JOB,
)  # fmt: skip
ATTEMPT = SpanDeclaration(
    "job attempt", "worker", "consumer", "An attempt of a job, from its claim to the report of its end.",
    (*_OF_JOB, "marey.job.outcome", "error.type", "marey.spans_dropped"),
)  # fmt: skip
COMPUTE = SpanDeclaration(
    "job compute",
    "worker",
    "internal",
    "Work of the child process, until it has sent its result. The spans of uploads below it may end later.",
)
INPUTS = SpanDeclaration(
    "job inputs", "worker", "internal", "Download of inputs, or their lookup in the cache.", ("error.type",)
)
OUTPUTS = SpanDeclaration(
    "job outputs", "worker", "internal", "Upload of results, which stay invisible for now.", ("error.type",)
)
COMPLETE = SpanDeclaration(
    "job complete", "worker", "internal", "Wait for the uploads, then the report of the attempt's end; after a "
    "success, the server publishes the results.", ("error.type",),
)  # fmt: skip

SPANS = (
    COMMAND, CALL, REQUEST, DATABASE_READ, DATABASE_WRITE, CHILD, QUEUED, ATTEMPT, COMPUTE, INPUTS, OUTPUTS, COMPLETE,
)  # fmt: skip
"""All spans, in the order of the reference."""
