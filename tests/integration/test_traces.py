"""Traces: one trace from an upload to the result of a job, headers of strangers, and collectors that do not answer."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from tests.support.command_line import run_here
from tests.support.database_fixtures import copied_sqlite
from tests.support.motion_files import bvh
from tests.support.patience import wait_until
from tests.support.rest_server import Server, running
from tests.support.server_process import MareyProcess
from tests.support.webhook_receiver import Open, Receiver

from marey_client import Marey
from marey_client.imports import find_files
from marey_client.tracing import tracing_command
from marey_client.transport import Transport
from marey_schemas.options.imports import ImportOptions
from marey_schemas.tracing import export
from marey_schemas.tracing.declared import ATTRIBUTES, SPANS
from marey_server.store.database.connections import Database

SECRET_PROJECT = "unreleased-sequel"
CENTIMETRES = ImportOptions(collection="raw", unit_scale_m=0.01)


@dataclass(frozen=True)
class SentSpan:
    """Span as the collector got it."""

    service: str
    name: str
    trace: str
    id: str
    parent: str
    attributes: dict[str, Any]


def spans_of(receiver: Receiver) -> list[SentSpan]:
    """Return all spans that a collector has received, in the order of their beginnings."""
    found = []
    for request in receiver.received:
        for resource in ExportTraceServiceRequest.FromString(request.body).resource_spans:
            service = next(one.value.string_value for one in resource.resource.attributes if one.key == "service.name")
            found += [(service, span) for scope in resource.scope_spans for span in scope.spans]
    return [
        SentSpan(
            service, span.name, span.trace_id.hex(), span.span_id.hex(), span.parent_span_id.hex(),
            {one.key: getattr(one.value, str(one.value.WhichOneof("value"))) for one in span.attributes},
        )
        for service, span in sorted(found, key=lambda one: one[1].start_time_unix_nano)
    ]  # fmt: skip


def path_of(span: SentSpan, spans: list[SentSpan]) -> list[str]:
    """Return the names of a span and of the spans above it, from the root."""
    above = next((one for one in spans if one.id == span.parent), None)
    return [*(path_of(above, spans) if above else []), span.name]


@pytest.fixture
def collector(open_receiver: Open, monkeypatch: pytest.MonkeyPatch) -> Receiver:
    """A collector, which the variables of OpenTelemetry name."""
    receiver = open_receiver(status=200)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", receiver.url)
    return receiver


@contextmanager
def serving(template: Path, folder: Path, **settings: Any) -> Iterator[Server]:
    database = Database(copied_sqlite(template, folder), readers=2)
    with running(database, folder, **settings) as server:
        yield server


@contextmanager
def working(server: Server, folder: Path) -> Iterator[None]:
    """Run a worker process for edits, which has the variables of OpenTelemetry, until the `with` block ends."""
    token = server.make_user("wanda", administrator=True, scopes=("work",))
    worker = MareyProcess(folder / "worker.log")
    cache = str(folder / "inputs")
    arguments = ["marey_worker", "--attached", "--server", server.address, "--cache", cache, "--kind", "edit"]
    worker.spawn(arguments, {}, f"{token}\n".encode())
    try:
        yield
    finally:
        assert worker.stop() == 0, worker.log.read_text()


def test_one_trace_leads_from_the_upload_to_the_result(
    collector: Receiver, sqlite_template: Path, tmp_path: Path
) -> None:
    takes = tmp_path / "takes"
    takes.mkdir()
    (takes / "actor-anonymous.bvh").write_bytes(bvh([f"0 {row} 0 0 0 {row} 0 0 0" for row in range(30)]))
    with serving(sqlite_template, tmp_path) as server, working(server, tmp_path):
        token = server.make_project(SECRET_PROJECT)
        with Marey(server.address, token) as marey, tracing_command("test"):
            lab = marey.project(SECRET_PROJECT)
            (entry,) = lab.imports.upload(find_files([takes]).files, CENTIMETRES)
            assert entry.item is not None, entry.error
            job = lab.edit(["raw"], [{"command": "trim", "stop": 20}], into="cut")
            assert marey.jobs.wait(job.id).state == "succeeded"
    spans = spans_of(collector)
    (root,) = [one for one in spans if one.name == "marey test"]
    ours = [one for one in spans if one.trace == root.trace]
    known = {one.id for one in ours} | {""}
    assert [one for one in ours if one.parent not in known] == []
    assert [one.name for one in ours if not one.parent] == ["marey test"]
    assert {one.service for one in ours} == {"marey", "marey-server", "marey-worker"}
    paths = [path_of(one, ours) for one in ours]
    submission = ["marey test", "POST", "POST /api/v1/projects/{project}/jobs"]
    attempt = [*submission, "job attempt"]
    attempts = "/api/v1/jobs/{job}/attempts/{fence}"
    for expected in (
        ["marey test", "PUT", "PUT /api/v1/blobs/{digest}", "database write"],
        ["marey test", "POST", "POST /api/v1/projects/{project}/imports", "child process"],
        [*submission, "database write"],
        [*submission, "job queued"],
        [*attempt, "job compute", "job inputs", "POST", "POST /api/v1/projects/{project}/parts", "database read"],
        [*attempt, "job compute", "job outputs", "POST", f"POST {attempts}/outputs", "database write"],
        [*attempt, "job complete", "POST", f"POST {attempts}/complete", "database write"],
    ):
        assert expected in paths, [one for one in paths if one[:-1] == expected[:-1] or one == expected[:-1]]
    _assert_as_declared(spans)
    sent = b"".join(one.body for one in collector.received)
    for secret in (SECRET_PROJECT, token, "actor-anonymous", entry.item):
        assert secret.encode() not in sent


def _assert_as_declared(spans: list[SentSpan]) -> None:
    """Assert that the reference of traces lists every span with its attributes."""
    patterns = {declared.name.split()[0 if declared.name.startswith("marey") else -1]: declared for declared in SPANS}
    for span in spans:
        declared = next((one for one in SPANS if one.name == span.name), None)
        if declared is None:
            words = span.name.split()
            declared = patterns["marey" if words[0] == "marey" else "ROUTE" if len(words) == 2 else "METHOD"]
        assert set(span.attributes) <= set(declared.attributes) <= set(ATTRIBUTES), span


def test_a_command_begins_a_trace(collector: Receiver, sqlite_template: Path, tmp_path: Path) -> None:
    with serving(sqlite_template, tmp_path, traces_share=0) as server:
        file = tmp_path / "token"
        file.touch(0o600)
        file.write_text(server.make_project(SECRET_PROJECT))
        done = run_here(["--server", server.address, "--token-file", str(file), "project", "show", SECRET_PROJECT])
        assert done.returncode == 0, done.stderr
    spans = spans_of(collector)
    expected = ["marey project", "GET", "GET /api/v1/projects/{project}", "database read"]
    assert expected in [path_of(one, spans) for one in spans]
    _assert_as_declared(spans)


BAD_HEADERS = (
    "", "00", f"00-{'a' * 32}-{'b' * 16}", f"00-{'0' * 32}-{'b' * 16}-01", f"00-{'a' * 32}-{'0' * 16}-01",
    f"ff-{'a' * 32}-{'b' * 16}-01", f"00-{'A' * 32}-{'b' * 16}-01", f"00-{'a' * 32}-{'b' * 16}-01-more",
    f"00-{'a' * 33}-{'b' * 16}-01", f"00-{'a' * 32}-{'b' * 16}-01, 00-{'a' * 32}-{'b' * 16}-01", "x" * 20_000,
)  # fmt: skip


def test_only_callers_with_a_token_decide_which_requests_are_recorded(
    collector: Receiver, sqlite_template: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good = f"00-{'a' * 32}-{'b' * 16}-01"
    with serving(sqlite_template, tmp_path, traces_share=0) as server:
        caplog.set_level(logging.INFO, "marey_server.access_log")
        owner, stranger = server.client(server.make_project("lab")), server.client()
        for header in BAD_HEADERS:
            assert owner.get("/projects/lab", headers={"traceparent": header}).status_code == 200
        assert stranger.get("/projects/lab", headers={"traceparent": good}).status_code == 404
        assert server.client("marey_x").get("/projects/lab", headers={"traceparent": good}).status_code == 401
        owner.get("/projects/lab", headers={"traceparent": good[:-2] + "00"})
        owner.get("/projects/nothing", headers={"traceparent": good, "X-Request-Id": "request-1"})
    found = {one.name: one for one in spans_of(collector)}
    assert set(found) == {"GET /api/v1/projects/{project}", "database read"}
    top = found["GET /api/v1/projects/{project}"]
    assert (top.trace, top.parent) == ("a" * 32, "b" * 16)
    assert top.attributes["marey.request_id"] == "request-1"
    (trace,) = [vars(one)["trace_id"] for one in caplog.records if vars(one).get("request_id") == "request-1"]
    assert trace == "a" * 32


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the logged messages about traces."""
    return [text for text in map(logging.LogRecord.getMessage, caplog.records) if "traces" in text]


def is_exporting() -> bool:
    """Return whether a thread of this process still sends spans."""
    return any(thread.name.startswith("OtelBatch") for thread in threading.enumerate())


@pytest.mark.parametrize("answers", ["never", "with an error"])
def test_a_collector_that_does_not_work_stops_nobody_and_does_not_flood_the_log(
    answers: str, open_receiver: Open, sqlite_template: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    receiver = open_receiver(status=400, silent=answers == "never")
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "20")
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1")
    monkeypatch.setattr(export, "CLOSE_S", 0.2)
    monkeypatch.setattr(logging.getLogger("opentelemetry"), "handlers", [])  # the limit of another test's messages
    with serving(sqlite_template, tmp_path, traces_endpoint=receiver.url) as server:
        owner = server.client(server.make_project("lab"))
        for _ in range(50):
            assert owner.get("/projects/lab").status_code == 200
        deadline = time.monotonic() + 30
        while answers == "with an error" and not told(caplog) and time.monotonic() < deadline:
            time.sleep(0.01)
    if answers == "never":
        assert receiver.received == []  # the first request of the exporter still waits for its answer
    else:
        assert receiver.received
    assert len(told(caplog)) == 1
    wait_until(lambda: not is_exporting())  # its last message must not reach the log of another test


def test_the_trace_of_a_program_is_passed_on_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    headers: list[str | None] = []

    def answer(request: httpx.Request) -> httpx.Response:
        headers.append(request.headers.get("traceparent"))
        return httpx.Response(204)

    given = f"00-{'a' * 32}-{'b' * 16}-01"
    transport = Transport("http://marey.test", http=httpx.MockTransport(answer))
    transport.send("GET", "/whoami")
    with monkeypatch.context() as patched, tracing_command("test"):
        transport.send("GET", "/whoami")
        patched.setenv("TRACEPARENT", given)
        with tracing_command("test"):
            transport.send("GET", "/whoami")
    assert headers == [None, None, given]
