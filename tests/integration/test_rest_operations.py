"""Starting, watching and stopping a server."""

import contextlib
import json
import os
import re
import signal
import socket
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from tests.support.forked_programs import nursery
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server, running

from marey_client.cli.doctor import check_server
from marey_client.marey import Marey
from marey_schemas.access import UserCreate
from marey_server.access.passwords import hash_password
from marey_server.access.principal import SYSTEM
from marey_server.process import services
from marey_server.process.operator_metrics import OperatorMetrics
from marey_server.store import users
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import SERVER
from marey_server.store.monitoring.figures import Figures


class Process:
    """A server in a separate process, started as by an operator."""

    def __init__(self, folder: Path, *, warm_up: bool = False, **environment: str) -> None:
        """Start the server; with `warm_up`, it warms up at the start, which is the default of servers."""
        self.folder = folder
        own = {"MAREY_DATA": str(folder), "MAREY_PORT": "0", "MAREY_LOG_FORM": "json", "MAREY_LOCAL_WORKERS": "0"}
        if not warm_up:
            own["MAREY_WARM_UP"] = "false"
        reading, writing = os.pipe()
        self.process = nursery().start(
            ["marey_client.cli", "serve"], {**os.environ, **own, **environment}, output=writing, with_stdin=False
        )
        os.close(writing)
        self.lines: list[dict[str, Any]] = []
        self.no_json: list[str] = []
        self._listening = threading.Event()
        self._reader = threading.Thread(target=self._read, args=[reading])
        self._reader.start()
        assert self._listening.wait(PATIENCE_S), self.lines
        found = [found[1] for line in self.lines if (found := re.search(r"(http://\S+)", line["message"]))]
        assert found, f"the server has ended: {self.lines} {''.join(self.no_json)}"
        self.address = found[0]

    def _read(self, descriptor: int) -> None:
        with open(descriptor, encoding="utf-8") as log:
            for line in log:
                if line.startswith("{"):
                    self.lines.append(json.loads(line))
                else:
                    self.no_json.append(line)
                if "listening" in line:
                    self._listening.set()
        self._listening.set()  # the server has ended

    @property
    def token(self) -> str:
        return (self.folder / "admin.token").read_text().strip()

    def end(self) -> int:
        """Ask the process to stop with SIGTERM, and return its exit status."""
        self.process.send_signal(signal.SIGTERM)
        status = self.process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return status


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    started = Process(tmp_path / "data")
    yield started
    if started.process.poll() is None:
        started.process.kill()
        started.process.wait()


def test_a_fresh_folder_gets_a_database_and_an_administrator_whose_token_only_the_owner_reads(process: Process) -> None:
    file = process.folder / "admin.token"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    me = httpx.get(f"{process.address}/api/v1/me", headers={"Authorization": f"Bearer {process.token}"}).json()
    assert me["user"]["name"] == "admin"
    assert me["user"]["administrator"]
    first = process.token
    assert process.end() == 0
    again = Process(process.folder)
    assert again.token == first
    assert httpx.get(f"{again.address}/readyz").status_code == 200
    assert again.end() == 0


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Process:
    """A server that has answered requests and ended; tests examine its log."""
    process = Process(tmp_path_factory.mktemp("ended") / "data")
    headers = {"Authorization": f"Bearer {process.token}"}
    for _ in range(3):
        assert httpx.get(f"{process.address}/readyz").status_code == 200
    url, asked = f"{process.address}/api/v1/leases", {"worker": "w", "kinds": ["retarget"]}
    found = httpx.post(url, json=asked, headers=headers)
    assert (found.status_code, found.json()["leases"]) == (200, [])
    for path in ("/healthz", "/readyz", "/metrics", "/api/v1/me"):
        assert httpx.get(process.address + path, headers=headers).status_code == 200
    assert httpx.post(url, json=asked).status_code == 401
    traced = headers | {"X-Request-Id": "trace-me-please"}
    assert httpx.get(f"{process.address}/api/v1/projects/secret-name", headers=traced).status_code == 404
    send_malformed_token(process)
    assert process.end() == 0
    return process


def send_malformed_token(process: Process) -> None:
    """Send a header with a token that was read from a file with DOS line ends; the server closes the connection."""
    host, port = process.address.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as connection:
        head = f"GET /api/v1/me HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {process.token}\r\r\n\r\n"
        connection.sendall(head.encode())
        while connection.recv(1024):
            pass


def children_of(process: Process) -> int:
    """Return how many processes below a server are children that compute."""
    count = 0
    for one in psutil.Process(process.process.pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            count += "marey_server.motions.child" in one.cmdline()
    return count


def test_a_server_with_default_settings_starts_its_children_before_a_request_needs_them(tmp_path: Path) -> None:
    """Two processes are waited for: one that has loaded the modules, and the child that it forks."""
    process = Process(tmp_path / "data", warm_up=True, MAREY_CHILD_PROCESSES="2")
    try:
        deadline = time.monotonic() + PATIENCE_S
        while children_of(process) < 2:
            assert time.monotonic() < deadline, process.lines
            time.sleep(0.1)
        assert httpx.get(f"{process.address}/readyz").status_code == 200
    finally:
        status = process.end()
    assert (status, process.no_json) == (0, [])


def test_requests_are_logged_as_json_with_who_what_and_how_long(ended: Process) -> None:
    (line,) = [line for line in ended.lines if line.get("request_id") == "trace-me-please"]
    assert line["principal"] == "admin"
    assert line["route"] == "/api/v1/projects/{project}"
    assert (line["method"], line["status"]) == ("GET", 404)
    assert line["duration_ms"] > 0
    assert not any("secret-name" in json.dumps(line) or ended.token in json.dumps(line) for line in ended.lines)


def test_the_log_of_a_server_contains_no_token_of_a_malformed_request(ended: Process) -> None:
    (line,) = [line for line in ended.lines if line["logger"] == "tornado.general"]
    assert line["message"].startswith("Malformed HTTP message from 127.0.0.1")
    assert not any(ended.token in json.dumps(line) for line in ended.lines)


def test_a_stopping_server_finishes_what_it_began_and_takes_nothing_new(process: Process) -> None:
    host, port = process.address.removeprefix("http://").split(":")
    body = json.dumps({"name": "slow"}).encode()
    head = f"POST /api/v1/projects HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {process.token}\r\n"
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as connection:
        connection.sendall(f"{head}Content-Length: {len(body)}\r\nExpect: 100-continue\r\n\r\n".encode())
        assert connection.recv(65536).startswith(b"HTTP/1.1 100")  # it has begun
        connection.sendall(body[:5])
        process.process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            try:
                httpx.get(f"{process.address}/healthz", timeout=PATIENCE_S)
            except httpx.TransportError:
                break
            time.sleep(0.05)
        else:
            pytest.fail("the server still takes connections")
        assert process.process.poll() is None
        connection.sendall(body[5:])
        assert connection.recv(65536).startswith(b"HTTP/1.1 201")
    assert process.process.wait(PATIENCE_S) == 0


def test_a_stopping_server_says_that_it_is_not_ready(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path) as server:
        client = httpx.Client(base_url=server.address)
        assert client.get("/readyz").json() == {"status": "ready"}
        server.app.services.draining.set()
        refused = client.get("/readyz")
        assert (refused.status_code, refused.json()["code"]) == (503, "draining")
        assert "Retry-After" in refused.headers
        assert client.get("/healthz").status_code == 200


def test_a_database_of_another_version_is_not_ready(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marey_server.store.monitoring.readiness.schema_fits", lambda _connection: False)
    operator = server.client(server.make_user("ada", administrator=True)).headers["Authorization"]
    told, not_told = (
        httpx.get(f"{server.address}/readyz", headers=headers) for headers in ({"Authorization": operator}, {})
    )
    assert (told.status_code, told.json()["code"]) == (not_told.status_code, not_told.json()["code"])
    assert (told.status_code, told.json()["code"]) == (503, "not-ready")
    assert "db upgrade" in told.json()["detail"]
    assert "db upgrade" not in not_told.text


def test_metrics_count_requests_by_route_template(server: Server, owner: httpx.Client) -> None:
    for name in ("lab", "private-name"):
        owner.get(f"/projects/{name}")
    text = httpx.get(f"{server.address}/metrics").text
    counted = 'marey_http_requests_total{method="GET",route="/api/v1/projects/{project}",status="%d"} 1.0'
    assert counted % 200 in text
    assert counted % 404 in text
    assert "private-name" not in text


def metrics(server: Server) -> str:
    return httpx.get(f"{server.address}/metrics").text


def test_metrics_count_refusals_by_code_and_route_and_name_nobody(server: Server, owner: httpx.Client) -> None:
    invented = "marey_aaaaaaaaaaaa_" + "b" * 64
    for _ in range(2):
        server.client(invented).get("/projects/secret-name")
    httpx.post(f"{server.api}/login", json={"name": "secret-name", "password": "secret-word"})
    owner.post("/projects", json={"name": "lab"})
    httpx.get(f"{server.address}/secret-path")
    text = metrics(server)
    for code, route, count in (
        ("bad-token", "/api/v1/projects/{project}", 2),
        ("wrong-password", "/api/v1/login", 1),
        ("name-taken", "/api/v1/projects", 1),
        ("not-found", "(unknown)", 1),
    ):
        assert f'marey_refusals_total{{code="{code}",route="{route}"}} {count}.0' in text
    for private in ("secret", "olga", "aaaaaaaa", "bbbbbbbb", "127.0.0.1"):
        assert private not in text


def test_metrics_do_not_grow_with_invented_methods_and_paths(server: Server) -> None:
    def series() -> int:
        for number in range(3):
            httpx.request(f"INVENTED{number}", f"{server.address}/path{number}")
        return metrics(server).count("\n")

    series()
    assert series() == series()
    assert "INVENTED" not in metrics(server)


def test_metrics_tell_the_sizes_of_queues_and_pools(server: Server) -> None:
    going_on = threading.Event()
    reads = [server.database.queue_read(SERVER, SYSTEM, lambda _tx: going_on.wait(PATIENCE_S)) for _ in range(20)]
    try:
        sizes = dict(line.rsplit(" ", 1) for line in metrics(server).splitlines() if line.startswith("marey_"))
    finally:
        going_on.set()
    assert not any(read.exception() for read in reads)
    assert float(sizes['marey_waiting{lane="database"}']) >= 12
    assert float(sizes['marey_waiting{lane="passwords"}']) == 0
    assert float(sizes["marey_database_connections"]) >= 0
    assert float(sizes["marey_connections"]) >= 1
    assert float(sizes["marey_children"]) == float(sizes['marey_waiting{lane="children"}']) == 0
    assert float(sizes["marey_request_memory_bytes"]) >= 0


def test_metrics_never_wait_for_the_database_except_for_the_first_numbers(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services, "FIGURES_WAIT_S", PATIENCE_S)
    assert 'marey_workers{version="unknown"}' in metrics(server)  # the first request already shows numbers
    begun, going_on = threading.Event(), threading.Event()

    def read_slowly(*_given: Any, **_options: Any) -> Figures:
        begun.set()
        going_on.wait(PATIENCE_S)
        return Figures(uploads=7)

    monkeypatch.setattr(services, "read_figures", read_slowly)
    monkeypatch.setattr(OperatorMetrics, "is_due", True)
    try:
        assert "marey_upload_sessions 0.0" in metrics(server)  # and does not hang
        assert begun.wait(PATIENCE_S)
        assert "marey_upload_sessions 0.0" in metrics(server)
    finally:
        going_on.set()
    deadline = time.monotonic() + PATIENCE_S
    while "marey_upload_sessions 7.0" not in metrics(server):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_metrics_tell_how_many_requests_are_under_way(server: Server) -> None:
    asked = {"Authorization": f"Bearer {server.make_project()}", "Accept": "text/event-stream"}
    assert "marey_http_in_flight 1.0" in httpx.get(f"{server.address}/metrics").text  # this one
    with httpx.stream("GET", f"{server.api}/projects/lab/events", headers=asked):
        assert "marey_http_in_flight 2.0" in httpx.get(f"{server.address}/metrics").text


def test_signing_in_gives_a_token_and_signing_out_ends_it(database: Database, tmp_path: Path) -> None:
    database.write(SYSTEM, users.ensure_first_administrator)
    stored = hash_password("correct horse battery")
    database.write(SYSTEM, users.create_user, UserCreate(name="ann"), password_hash=stored)
    with running(database, tmp_path) as server:
        made = server.client().post("/login", json={"name": "ann", "password": "correct horse battery"})
        assert made.status_code == 200
        assert made.headers["Cache-Control"] == "no-store"
        ann = server.client(made.json()["secret"])
        user = ann.get("/users/ann")
        change = {"password": "another long password", "current_password": "correct horse battery"}
        wrong = ann.patch("/users/ann", json={**change, "current_password": "x"}, headers={"If-Match": "*"})
        assert (wrong.status_code, wrong.json()["code"]) == (403, "wrong-password")
        changed = ann.patch("/users/ann", json=change, headers={"If-Match": user.headers["ETag"]})
        assert changed.status_code == 200, changed.text
        assert "password" not in changed.text
        assert ann.post("/logout").status_code == 204
        assert ann.get("/me").status_code == 401
        again = {"name": "ann", "password": "another long password"}
        assert server.client().post("/login", json=again).status_code == 200


def test_a_log_tells_where_everything_is_and_what_to_do_next(ended: Process) -> None:
    told = "\n".join(line["message"] for line in ended.lines)
    assert f"data: {ended.folder}; database: {ended.folder / 'marey.db'}" in told
    assert f"administrator: admin; a token of an administrator is in {ended.folder / 'admin.token'}" in told
    assert f"marey --server {ended.address} --token-file {ended.folder / 'admin.token'} project create lab" in told
    assert ended.token not in told


def test_questions_for_work_that_find_none_and_probes_are_not_logged(ended: Process) -> None:
    logged = [(line["route"], line["status"]) for line in ended.lines if "route" in line]
    assert logged == [("/api/v1/me", 200), ("/api/v1/leases", 401), ("/api/v1/projects/{project}", 404)]
    after = next(number for number, line in enumerate(ended.lines) if "listening" in line["message"])
    others = {line["logger"] for line in ended.lines[after + 1 :] if "route" not in line}
    of_malformed_request = {"marey_server.http.accepting", "tornado.general"}
    assert others - of_malformed_request <= {"marey_server.app"}
    assert any(line["message"].startswith("Running upgrade") for line in ended.lines)


def test_a_worker_beside_the_server_logs_in_the_same_form(tmp_path: Path) -> None:
    process = Process(tmp_path / "data", MAREY_LOCAL_WORKERS="1")
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not any(line["logger"] == "marey_worker.supervisor" for line in process.lines):
            assert time.monotonic() < deadline, process.lines
            time.sleep(0.1)
    finally:
        assert process.end() == 0
    assert process.no_json == []


@pytest.mark.parametrize("path", ["/", "/api/v1"])
def test_the_roots_tell_programs_where_to_go_and_lead_browsers_to_the_page(server: Server, path: str) -> None:
    with httpx.Client(base_url=server.address, timeout=60) as client:  # the description is built at the first request
        told = client.get(path).json()
        assert told["name"] == "Marey"
        assert client.get(told["openapi"]).json()["info"]["version"] == told["version"]
        assert client.get(told["ready"]).status_code == 200
        browser = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
        led = client.get(path, headers=browser)
        assert (led.status_code, led.headers["Location"]) == (303, told["documentation"])
        page = client.get(led.headers["Location"], headers=browser)
        assert (page.status_code, page.headers["Content-Type"]) == (200, "text/html; charset=utf-8")


def test_the_doctor_finds_a_running_server_ready_and_lists_workers_for_administrators_only(server: Server) -> None:
    administrator = server.make_user("chief", administrator=True, scopes=("read", "admin"))
    for token, told in ((administrator, "no worker is alive"), (server.make_project(), "not checked")):
        with Marey(server.address, token) as marey:
            ready, version, workers = check_server(marey)
        assert ready == ("server", "ok", f"{server.address} is ready")
        assert version[1] == "ok"
        assert told in workers[2]
