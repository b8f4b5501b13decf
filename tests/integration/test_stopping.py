"""Requests that are in progress, or arrive, while a server stops: they end, or are refused without an error."""

from __future__ import annotations

import json
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.rest_server import Server, running
from tests.support.server_process import ServerProcess

from marey_schemas.encoding.codecs import JSON, MSGPACK, encode_tree
from marey_server.process.computing import RENDERING_THREADS
from marey_server.store import projects
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import Client
from marey_server.store.transaction import Transaction

DRAIN_S = 0.3
LONG_VALUES = 400_000
"""Number of floats in a document whose JSON takes a tenth of a second or more to write."""
READERS = 24
"""Number of readers of this document that no server can answer within `DRAIN_S`."""


def add_character(client: httpx.Client, values: int) -> str:
    """Create an item with a document of some random numbers; return the path of the document."""
    array = np.random.default_rng(1).random(values)
    body = encode_tree({"name": "s", "parts": {"character": {"schema": "marey/document@1", "x": array}}}, MSGPACK)
    made = client.post("/projects/lab/characters", content=body, headers={"Content-Type": MSGPACK})
    assert made.status_code == 201, made.text
    return f"/projects/lab/characters/{made.json()['id']}/parts/character"


@contextmanager
def asking(requests: int = 1) -> Iterator[ThreadPoolExecutor]:
    """Yield threads for this number of requests at the same time."""
    with ThreadPoolExecutor(requests) as threads:
        yield threads


@contextmanager
def held_rendering(server: Server) -> Iterator[Callable[[], None]]:
    """Let all answers wait for a thread until the yielded function is called, or the `with` block ends."""
    go_on = threading.Event()
    for number in range(RENDERING_THREADS):
        server.app.services.compute_threads.rendering.submit(Client(f"busy-{number}"), go_on.wait, PATIENCE_S)
    try:
        yield go_on.set
    finally:
        go_on.set()


def faults_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR or record.exc_info]


def test_a_request_that_takes_longer_than_the_drain_time_is_refused_and_is_no_fault(
    database: Database, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with running(database, tmp_path, drain_s=DRAIN_S) as server, ExitStack() as open_until:
        client = server.client(server.make_project())
        path = add_character(client, 10)
        threads = open_until.enter_context(asking())
        open_until.enter_context(held_rendering(server))
        answer = threads.submit(client.get, path)
        wait_until(lambda: len(server.app.services.compute_threads.rendering))
        server.stop()
        refused = answer.result(PATIENCE_S)
        assert (refused.status_code, refused.json()["code"]) == (503, "draining")
        assert int(refused.headers["Retry-After"]) > 0
        assert refused.headers["Connection"] == "close"
    assert faults_of(caplog) == []
    lines = [record.getMessage() for record in caplog.records if record.getMessage().endswith(" 503")]
    assert lines == ["GET /api/v1/projects/{project}/{kind}/{item}/parts/{part} 503"]


def test_a_request_that_ends_within_the_drain_time_is_answered(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, drain_s=PATIENCE_S) as server, ExitStack() as open_until:
        client, services = server.client(server.make_project()), server.app.services
        worker = server.client(server.make_user("wanda", administrator=True, scopes=("work",)))
        path = add_character(client, 10)
        threads = open_until.enter_context(asking(3))
        release = open_until.enter_context(held_rendering(server))
        following = threads.submit(client.get, "/projects/lab/events", headers={"Accept": "text/event-stream"})
        claim = threads.submit(worker.post, "/leases", json={"worker": "w", "kinds": ["retarget"], "wait_s": 30})
        answer = threads.submit(client.get, path)
        wait_until(lambda: len(services.in_flight) == 3 and len(services.compute_threads.rendering))
        server.stop()
        assert claim.result(PATIENCE_S).json() == {"leases": [], "state": None}
        assert following.result(PATIENCE_S).text.startswith(": follow")
        assert services.draining.is_set()
        release()
        assert answer.result(PATIENCE_S).status_code == 200


def test_a_stopping_server_refuses_new_requests_on_open_connections(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, drain_s=PATIENCE_S) as server, ExitStack() as open_until:
        token = server.make_project()
        client = server.client(token)
        path = add_character(client, 10)
        threads = open_until.enter_context(asking())
        release = open_until.enter_context(held_rendering(server))
        headers = {"Authorization": f"Bearer {token}"}
        one, other = (open_until.enter_context(httpx.Client(base_url=server.api, headers=headers)) for _ in range(2))
        assert one.get("/me").status_code == other.get("/me").status_code == 200
        answer = threads.submit(client.get, path)
        wait_until(lambda: len(server.app.services.compute_threads.rendering))
        server.stop()
        wait_until(server.app.services.draining.is_set)
        refused = one.post("/projects", json={"name": "late"})
        assert (refused.status_code, refused.json()["code"]) == (503, "draining")
        assert int(refused.headers["Retry-After"]) > 0
        assert refused.headers["Connection"] == "close"
        assert other.get(f"{server.address}/healthz").status_code == 200
        release()
        assert answer.result(PATIENCE_S).status_code == 200


def test_no_answer_says_that_a_change_was_refused_if_it_may_have_been_stored(
    database: Database, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def create_slowly(tx: Transaction, request: Any) -> Any:
        made = create_at_once(tx, request)
        begun.set()
        go_on.wait(PATIENCE_S)
        return made

    create_at_once = projects.create_project
    monkeypatch.setattr(projects, "create_project", create_slowly)
    with running(database, tmp_path, drain_s=DRAIN_S) as server, asking() as threads:
        client = server.client(server.make_user("olga"))
        answer = threads.submit(client.post, "/projects", json={"name": "lab"})
        assert begun.wait(PATIENCE_S)
        server.stop()
        try:
            assert isinstance(answer.exception(PATIENCE_S), httpx.TransportError)
        finally:
            go_on.set()
    assert faults_of(caplog) == []


def test_slow_requests_of_all_kinds_are_no_faults_of_a_process_that_is_stopped(tmp_path: Path) -> None:
    server = ServerProcess(tmp_path, MAREY_DRAIN_S=str(DRAIN_S), MAREY_LOG_FORM="json").start()
    outcomes: dict[str, list[Future[httpx.Response]]] = {}
    try:
        with ExitStack() as open_until:
            threads = open_until.enter_context(asking(READERS + 8))
            client = httpx.Client(
                base_url=f"{server.url}/api/v1",
                headers={"Authorization": f"Bearer {server.token}"},
                timeout=PATIENCE_S,
                limits=httpx.Limits(max_connections=None),
            )
            open_until.enter_context(client)
            assert client.post("/projects", json={"name": "lab"}).is_success
            begin_slow_requests(client, add_character(client, LONG_VALUES), threads, outcomes)
            time.sleep(DRAIN_S)
            server.send(signal.SIGTERM)
            assert server.wait_until_dead() == 0
            answers = {kind: [outcome_of(one) for one in sent] for kind, sent in outcomes.items()}
    finally:
        server.stop()
    seen = {status for statuses in answers.values() for status in statuses}
    assert not any(status is not None and status >= 500 and status != 503 for status in seen), answers
    assert 503 in seen, answers
    log = [json.loads(line) for line in server.log.read_text().splitlines()]
    faults = [line for line in log if line["level"] in ("ERROR", "CRITICAL") or "Traceback" in json.dumps(line)]
    assert faults == []


def begin_slow_requests(
    client: httpx.Client, path: str, threads: ThreadPoolExecutor, outcomes: dict[str, list[Future[httpx.Response]]]
) -> None:
    """Send requests that last long, because of their bodies, their answers, computations, or because they wait."""

    def endless() -> Iterator[bytes]:
        while True:
            yield b"x" * 1000
            time.sleep(0.05)

    def ask(kind: str, *arguments: Any, **options: Any) -> None:
        outcomes.setdefault(kind, []).append(threads.submit(client.request, *arguments, **options))

    ask("upload", "PUT", f"/blobs/sha256:{'0' * 64}", content=endless())
    for _ in range(READERS):
        ask("json", "GET", path, headers={"Accept": JSON})
    ask("list", "GET", "/projects/lab/characters")
    for _ in range(3):
        ask("sign-in", "POST", "/login", json={"name": "admin", "password": "not the password"})
    claim = {"worker": "w", "kinds": ["retarget"], "wait_s": 30, "protocol": 1}
    ask("lease", "POST", "/leases", json=claim)
    ask("events", "GET", "/projects/lab/events", headers={"Accept": "text/event-stream"})


def outcome_of(sent: Future[httpx.Response]) -> int | None:
    """Return the status of an answer, or None if the connection was closed without one."""
    error = sent.exception(PATIENCE_S)
    assert error is None or isinstance(error, httpx.TransportError), error
    return None if error is not None else sent.result().status_code
