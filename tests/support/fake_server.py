"""A small server that speaks the worker protocol and records what workers send."""

import hashlib
import json
import re
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import socket
from typing import Any

from tests.support.present import present

from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree

ATTEMPT = re.compile(r"/api/v1/jobs/(\w+)/attempts/(\d+)/(\w+)")
PARTS = re.compile(r"/api/v1/projects/lab/parts")
RESULTS = re.compile(r"/api/v1/jobs/(\w+)/results")
BLOB = re.compile(r"/api/v1/blobs/(sha256:[0-9a-f]{64})")


@dataclass(frozen=True, kw_only=True)
class FakeJob:
    """Job of the fake server; the fields are values of the lease that workers get."""

    name: str
    kind: str
    params: dict[str, Any] = field(default_factory=dict)
    time_limit_s: int = 60
    memory_limit_mb: int = 4096
    ttl_s: float = 60.0
    heartbeat_s: float = 15.0
    position: int | None = None
    size: int | None = None

    def lease(self, fence: int) -> dict[str, Any]:
        """Return the lease of this job in the form in which the server sends it."""
        limits = {"time_limit_s": self.time_limit_s, "memory_limit_mb": self.memory_limit_mb}
        return {
            "job": self.name, "project": "lab", "kind": self.kind, "params": self.params, "inputs": {}, "into": "out",
            "seed": 0, "resources": limits, "fence": fence, "attempt": 1,
            "attempt_token": f"mareyjob_secret_of_{self.name}", "lease_ttl_s": self.ttl_s,
            "heartbeat_s": self.heartbeat_s, "position": self.position, "size": self.size,
        }  # fmt: skip


class FakeServer:
    """Jobs to claim, documents to read, and everything that workers sent, by job.

    Tests add names of jobs to sets that change the answers. A job in `lost` has lost its lease. Requests about a job in
    `silent` are answered as if the server were unavailable, and counted in `refused`. Results of a job in `slow` are
    answered only after the job is removed from `slow`. Results of a job in `unwelcome` are refused. `refusals`
    contains, by job, the status and code of the answer to its completion.

    `order` lists claims and ends of jobs. `claimants` contains, for each claim, the tokens with which it was sent,
    and `announced` contains kinds and labels of the newest claim. If `valid_tokens` is set, claims with other tokens
    are refused.
    """

    def __init__(self) -> None:
        self.jobs: list[FakeJob] = []
        self.documents: dict[tuple[str, int, str], Any] = {}
        self.blobs: dict[str, bytes] = {}
        self.results: dict[str, list[Any]] = {}
        self.heartbeats: defaultdict[str, list[Any]] = defaultdict(list)
        self.logs: defaultdict[str, bytes] = defaultdict(bytes)
        self.staged: defaultdict[str, list[Any]] = defaultdict(list)
        self.completed: dict[str, Any] = {}
        self.failed: dict[str, Any] = {}
        self.cancelled: set[str] = set()
        self.lost: set[str] = set()
        self.silent: set[str] = set()
        self.slow: set[str] = set()
        self.unwelcome: set[str] = set()
        self.refusals: dict[str, tuple[int, str]] = {}
        self.order: list[tuple[str, str]] = []
        self.refused: defaultdict[str, int] = defaultdict(int)
        self.leased: dict[str, FakeJob] = {}
        self.completing: set[str] = set()
        self.may_complete = threading.Event()
        self.may_complete.set()
        self.tokens_seen: set[str] = set()
        self.claims: dict[str, list[dict[str, Any]]] = {}
        self.announced: dict[str, Any] = {}
        self.claimants: dict[str, set[str]] = defaultdict(set)
        self.valid_tokens: set[str] | None = None
        self.answers_to_lose = 0
        self._lock = threading.Lock()
        self._http = _Connections(("127.0.0.1", 0), _handler(self))
        threading.Thread(target=self._http.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._http.server_address[1]}"

    def close(self) -> None:
        """Stop listening."""
        self._http.shutdown()
        self._http.server_close()

    def submit(self, kind: str, params: dict[str, Any] | None = None, *, job: str = "", **terms: Any) -> str:
        """Submit a job with further fields of `FakeJob`, and return its name."""
        with self._lock:
            name = job or f"job{len(self.jobs) + 1}x{len(self.leased)}"
            self.jobs.append(FakeJob(name=name, kind=kind, params=params or {}, **terms))
        return name

    def claim(self, wanted: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the lease of the first job of a wanted kind, or nothing after a short wait.

        A repeated `claim_id` gets the same lease.
        """
        self.announced = {name: wanted[name] for name in ("kinds", "labels")}
        if wanted["claim_id"] in self.claims:
            return self.claims[wanted["claim_id"]]
        deadline = time.monotonic() + min(wanted["wait_s"], 2)
        while time.monotonic() < deadline:
            with self._lock:
                for job in self.jobs:
                    if job.kind in wanted["kinds"]:
                        self.jobs.remove(job)
                        self.leased[job.name] = job
                        self.order.append(("claimed", job.name))
                        self.claims[wanted["claim_id"]] = [job.lease(fence=len(self.leased))]
                        return self.claims[wanted["claim_id"]]
            time.sleep(0.01)
        return []

    def read(self, places: list[dict[str, Any]]) -> bytes:
        """Return documents as the server sends them.

        It sends at most three at once, so workers need several requests.
        """
        keys = [(place["item"], place["revision"], place["part"]) for place in places[:3]]
        return encode_tree({"documents": [self.documents.get(key) for key in keys]}, MSGPACK, arrays="blocks")

    def until(self, condition: Callable[[], object]) -> None:
        """Wait until a condition is true; the time limit is long, because the machine may be busy."""
        deadline = time.monotonic() + 120
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain; failed: {self.failed}, completed: {self.completed}"
            time.sleep(0.01)

    def ended(self, job: str) -> dict[str, Any]:
        """Wait for the end of a job, and return the worker's report of it."""
        self.until(lambda: job in self.completed or job in self.failed)
        return self.completed.get(job) or self.failed[job]


class _Connections(ThreadingHTTPServer):
    """Connections of workers, which may break at any moment because tests stop and kill workers."""

    daemon_threads = True

    def handle_error(self, request: socket | tuple[bytes, socket], client_address: object) -> None:
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def _handler(server: FakeServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, format: str, *_: object) -> None:  # noqa: A002
            pass

        def reply(self, status: int, body: bytes = b"", media_type: str = "application/json") -> None:
            self.send_response(status)
            self.send_header("Content-Type", media_type)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def problem(self, status: int, code: str, **context: int) -> None:
            document = {"type": "", "title": "", "status": status, "detail": code, "instance": "r1", "code": code}
            self.reply(status, json.dumps({**document, "context": context}).encode(), "application/problem+json")

        def body(self) -> bytes:
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))

        def do_POST(self) -> None:
            body = self.body()
            server.tokens_seen.add(self.headers["Authorization"])
            if self.path == "/api/v1/leases":
                token = self.headers["Authorization"].removeprefix("Bearer ")
                if server.valid_tokens is not None and token not in server.valid_tokens:
                    return self.problem(401, "bad-token")
                server.claimants[json.loads(body)["claim_id"]].add(token)
                leases = server.claim(json.loads(body))
                if leases and server.answers_to_lose:
                    server.answers_to_lose -= 1
                    return self.problem(503, "unavailable")
                return self.reply(200, json.dumps({"leases": leases}).encode())
            if PARTS.fullmatch(self.path):
                return self.reply(200, server.read(json.loads(body)["parts"]), "application/msgpack; arrays=blocks")
            job, _fence, request = present(ATTEMPT.fullmatch(self.path)).groups()
            if job in server.lost:
                return self.problem(409, "lease-lost")
            if job in server.silent:
                server.refused[job] += 1
                return self.problem(503, "unavailable")
            return getattr(self, f"on_{request}")(job, body)

        def on_heartbeat(self, job: str, body: bytes) -> None:
            server.heartbeats[job].append(json.loads(body).get("progress"))
            answer = {"lease_ttl_s": server.leased[job].ttl_s, "cancel_requested": job in server.cancelled}
            self.reply(200, json.dumps(answer).encode())

        def on_log(self, job: str, body: bytes) -> None:
            if int(self.headers["Upload-Offset"]) != len(server.logs[job]):
                return self.problem(409, "offset", offset=len(server.logs[job]))
            server.logs[job] += body
            return self.reply(200, json.dumps({"offset": len(server.logs[job])}).encode())

        def on_outputs(self, job: str, body: bytes) -> None:
            server.until(lambda: job not in server.slow)
            if job in server.lost:
                return self.problem(409, "lease-lost")
            if job in server.unwelcome:
                return self.problem(422, "invalid")
            server.staged[job] += decode_tree(body, MSGPACK)["outputs"]
            return self.reply(204)

        def on_complete(self, job: str, body: bytes) -> None:
            server.completing.add(job)
            server.may_complete.wait(60)
            if job in server.refusals:
                return self.problem(*server.refusals[job])
            server.completed[job] = json.loads(body)
            server.order.append(("ended", job))
            return self.reply(200, json.dumps({"job": job, "state": "succeeded"}).encode())

        def on_fail(self, job: str, body: bytes) -> None:
            server.failed[job] = json.loads(body)
            server.order.append(("ended", job))
            self.reply(200, json.dumps({"job": job, "state": "queued"}).encode())

        def do_GET(self) -> None:
            if found := RESULTS.match(self.path):
                results = [
                    {"job": f"task{n}", "position": n, "state": "succeeded", "result": result}
                    for n, result in enumerate(server.results[found[1]])
                ]
                return self.reply(200, json.dumps({"items": results}).encode())
            data = server.blobs.get(present(BLOB.fullmatch(self.path))[1])
            return self.problem(404, "not-found") if data is None else self.reply(200, data)

        def do_PUT(self) -> None:
            data = self.body()
            digest = present(BLOB.fullmatch(self.path))[1]
            assert digest == f"sha256:{hashlib.sha256(data).hexdigest()}"
            server.blobs[digest] = data
            self.reply(204)

    return Handler
