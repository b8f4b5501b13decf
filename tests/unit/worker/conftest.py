"""A small server that speaks the worker protocol and remembers what it heard, and workers to run against it."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree

THIRD_PARTY = Path(__file__).parent / "thirdparty"
ATTEMPT = re.compile(r"/api/v1/jobs/(\w+)/attempts/(\d+)/(\w+)")
PARTS = re.compile(r"/api/v1/projects/lab/parts")
RESULTS = re.compile(r"/api/v1/jobs/(\w+)/results")
BLOB = re.compile(r"/api/v1/blobs/(sha256:[0-9a-f]{64})")


class FakeServer:
    """Jobs to hand out, documents to read, and everything workers said, by job."""

    def __init__(self) -> None:
        self.jobs: list[Any] = []
        self.documents: dict[tuple[str, int, str], Any] = {}
        self.blobs: dict[str, bytes] = {}
        self.results: dict[str, list[Any]] = {}
        self.reads: list[tuple[str, int, str]] = []
        self.heartbeats: defaultdict[str, list[Any]] = defaultdict(list)
        self.logs: defaultdict[str, bytes] = defaultdict(bytes)
        self.staged: defaultdict[str, list[Any]] = defaultdict(list)
        self.completed: dict[str, Any] = {}
        self.failed: dict[str, Any] = {}
        self.cancelled: set[str] = set()
        self.lost: set[str] = set()
        self.silent: set[str] = set()
        self.started: list[str] = []
        self.completing: set[str] = set()
        self.may_complete = threading.Event()
        self.may_complete.set()
        self.ttl_s, self.heartbeat_s = 60.0, 15.0
        self.tokens_seen: set[str] = set()
        self._claims = 0
        self._lock = threading.Lock()
        self.http = _Connections(("127.0.0.1", 0), _handler(self))
        threading.Thread(target=self.http.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.http.server_address[1]}"

    def submit(
        self,
        kind: str,
        params: dict[str, Any] | None = None,
        inputs: Any = None,
        *,
        time_limit_s: int = 60,
        memory_limit_mb: int = 4096,
        job: str | None = None,
        position: int | None = None,
        size: int | None = None,
    ) -> str:
        with self._lock:
            job = job or f"job{len(self.jobs) + 1}x{self._claims}"
            self.jobs.append((job, kind, params or {}, inputs or {}, time_limit_s, memory_limit_mb, position, size))
        return job

    def claim(self, wanted: dict[str, Any]) -> list[dict[str, Any]]:
        deadline = time.monotonic() + min(wanted["wait_s"], 2)
        while time.monotonic() < deadline:
            with self._lock:
                for job in self.jobs:
                    if job[1] in wanted["kinds"]:
                        self.jobs.remove(job)
                        self._claims += 1
                        self.started.append(job[0])
                        return [self._lease(*job)]
            time.sleep(0.01)
        return []

    def read(self, places: list[dict[str, Any]]) -> bytes:
        """Documents as the server sends them: at most three at once, so that workers have to ask again."""
        keys = [(place["item"], place["revision"], place["part"]) for place in places[:3]]
        self.reads += keys
        return encode_tree({"documents": [self.documents.get(key) for key in keys]}, MSGPACK, arrays="blocks")

    def _lease(
        self,
        job: str,
        kind: str,
        params: dict[str, Any],
        inputs: dict[str, Any],
        time_limit_s: int,
        memory_limit_mb: int,
        position: int | None,
        size: int | None,
    ) -> dict[str, Any]:
        return {
            "job": job, "project": "lab", "kind": kind, "params": params, "inputs": inputs, "into": "out", "seed": 0,
            "resources": {"time_limit_s": time_limit_s, "memory_limit_mb": memory_limit_mb}, "fence": self._claims,
            "attempt": 1, "attempt_token": f"mareyjob_secret_of_{job}", "lease_ttl_s": self.ttl_s,
            "heartbeat_s": self.heartbeat_s, "position": position, "size": size,
        }  # fmt: skip

    def until(self, condition: Callable[[], object], timeout_s: int = 60) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain; failed: {self.failed}, completed: {self.completed}"
            time.sleep(0.01)

    def ended(self, job: str, timeout_s: int = 60) -> dict[str, Any]:
        self.until(lambda: job in self.completed or job in self.failed, timeout_s)
        return self.completed.get(job) or self.failed[job]


class _Connections(ThreadingHTTPServer):
    """Connections of workers, which end at any moment: tests stop and kill workers that wait for an answer."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def _handler(server: FakeServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None:
            pass

        def reply(self, status: int, body: bytes = b"", media_type: str = "application/json") -> None:
            self.send_response(status)
            self.send_header("Content-Type", media_type)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def problem(self, status: int, code: str, **context: Any) -> None:
            told = {"type": "", "title": "", "status": status, "detail": code, "instance": "r1", "code": code}
            self.reply(status, json.dumps({**told, "context": context}).encode(), "application/problem+json")

        def body(self) -> bytes:
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))

        def do_POST(self) -> None:
            body = self.body()
            server.tokens_seen.add(self.headers["Authorization"])
            if self.path == "/api/v1/leases":
                return self.reply(200, json.dumps({"leases": server.claim(json.loads(body))}).encode())
            if PARTS.fullmatch(self.path):
                return self.reply(200, server.read(json.loads(body)["parts"]), "application/msgpack; arrays=blocks")
            job, _fence, what = ATTEMPT.fullmatch(self.path).groups()
            if job in server.lost:
                return self.problem(409, "lease-lost")
            if job in server.silent:
                return self.problem(503, "unavailable")
            return getattr(self, f"on_{what}")(job, body)

        def on_heartbeat(self, job: str, body: bytes) -> None:
            server.heartbeats[job].append(json.loads(body).get("progress"))
            answer = {"lease_ttl_s": server.ttl_s, "cancel_requested": job in server.cancelled}
            self.reply(200, json.dumps(answer).encode())

        def on_log(self, job: str, body: bytes) -> None:
            if int(self.headers["Upload-Offset"]) != len(server.logs[job]):
                return self.problem(409, "offset", offset=len(server.logs[job]))
            server.logs[job] += body
            return self.reply(200, json.dumps({"offset": len(server.logs[job])}).encode())

        def on_outputs(self, job: str, body: bytes) -> None:
            server.staged[job] += decode_tree(body, MSGPACK)["outputs"]
            self.reply(204)

        def on_complete(self, job: str, body: bytes) -> None:
            server.completing.add(job)
            server.may_complete.wait(60)
            server.completed[job] = json.loads(body)
            self.reply(200, json.dumps({"job": job, "state": "succeeded"}).encode())

        def on_fail(self, job: str, body: bytes) -> None:
            server.failed[job] = json.loads(body)
            self.reply(200, json.dumps({"job": job, "state": "queued"}).encode())

        def do_GET(self) -> None:
            if found := RESULTS.match(self.path):
                told = [
                    {"job": f"task{n}", "position": n, "state": "succeeded", "result": result}
                    for n, result in enumerate(server.results[found[1]])
                ]
                return self.reply(200, json.dumps({"items": told}).encode())
            data = server.blobs.get(BLOB.fullmatch(self.path)[1])
            return self.problem(404, "not-found") if data is None else self.reply(200, data)

        def do_PUT(self) -> None:
            data = self.body()
            digest = BLOB.fullmatch(self.path)[1]
            assert digest == f"sha256:{hashlib.sha256(data).hexdigest()}"
            server.blobs[digest] = data
            self.reply(204)

    return Handler


@pytest.fixture
def server() -> Iterator[FakeServer]:
    fake = FakeServer()
    yield fake
    fake.http.shutdown()
    fake.http.server_close()


class Worker:
    """A worker process, as `marey serve` starts one."""

    def __init__(self, server: FakeServer, folder: Path, *options: str, env: dict[str, str] | None = None) -> None:
        self.log = folder / "worker.log"
        paths = [str(THIRD_PARTY), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **(env or {})}
        command = [sys.executable, "-m", "marey_worker", "--attached", "--server", server.url]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--cache", str(folder / "cache"), *options],
                stdin=subprocess.PIPE,
                stderr=log,
                env=environment,
            )
        self.process.stdin.write(b"marey_worker_token\n")
        self.process.stdin.flush()

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(30)


@pytest.fixture
def start_worker(server: FakeServer, tmp_path: Path) -> Iterator[Callable[..., Worker]]:
    workers = []

    def start(*options: str, env: dict[str, str] | None = None) -> Worker:
        workers.append(Worker(server, tmp_path, *options, env=env))
        return workers[-1]

    yield start
    for worker in workers:
        if worker.process.poll() is None:
            worker.process.kill()
            worker.process.wait()
        worker.process.stdin.close()
    for log in {worker.log for worker in workers}:
        sys.stderr.write(log.read_text())  # pytest shows it beside the failure of a test
