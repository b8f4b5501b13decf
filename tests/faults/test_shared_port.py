"""Several server processes at one port, on Postgres: one is killed, all are replaced, and changes are seen by all."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self

import httpx
import psutil
import pytest
from sqlalchemy import URL
from tests.support.database_fixtures import database_address, new_postgres_database
from tests.support.server_process import QUICK_LEASES, READY_S, ServerProcess

from marey_schemas.access import ProjectCreate

pytestmark = [pytest.mark.timeout(600), pytest.mark.xdist_group("shared port")]  # whose tests share one server

PROGRAM, WORKER = "marey_server.process_program", "marey_worker"
COLLECTIONS = "/projects/lab/collections"
FEW_TRIES = {"MAREY_LOGIN_TRIES_PER_MINUTE": "1"}
"""Setting that allows ten wrong passwords from one address."""


class SharingServer(ServerProcess):
    """A server of two processes."""

    def modules(self, name: str) -> list[psutil.Process]:
        """Return the processes below the parent that run a Python module, in the order of their starts."""
        assert self.process is not None
        found = []
        for one in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                if name in one.cmdline():
                    found.append(one)
        return sorted(found, key=lambda one: one.create_time())

    def wait_for(self, what: str, condition: Callable[[], bool]) -> None:
        """Wait until a condition holds."""
        deadline = time.monotonic() + READY_S
        while not condition():
            assert self.process is not None
            assert self.process.poll() is None, self.log.read_text()[-3000:]
            assert time.monotonic() < deadline, f"{what}:\n{self.log.read_text()[-3000:]}"
            time.sleep(0.05)

    def logged(self, text: str) -> int:
        """Return how often a text is in the log."""
        return self.log.read_text().count(text)

    def client_of(self, pid: int) -> httpx.Client:
        """Return an administrator's client whose only connection leads to one of the processes."""
        for _ in range(200):
            client = self.one_connection()
            stream = client.get("/me").extensions["network_stream"]
            port = stream.get_extra_info("client_addr")[1]
            if any(one.raddr and one.raddr.port == port for one in psutil.Process(pid).net_connections("tcp4")):
                return client
            client.close()
        raise AssertionError(f"no connection was accepted by {pid}")

    def one_connection(self) -> httpx.Client:
        """Return an administrator's client that keeps one connection and repeats no request."""
        return httpx.Client(
            base_url=f"{self.url}/api/v1",
            headers={"Authorization": f"Bearer {self.token}"},
            limits=httpx.Limits(max_connections=1),
            timeout=60,
            verify=False,
        )


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, postgres_url: URL) -> Iterator[SharingServer]:
    """Two processes and one worker, with a project."""
    with new_postgres_database(postgres_url, "processes") as url:
        folder = tmp_path_factory.mktemp("sharing")
        one = SharingServer(folder, database_address(url), MAREY_PROCESSES="2", **FEW_TRIES, **QUICK_LEASES)
        one.start(workers=1)
        one.wait_for("both are ready", lambda: one.logged("all 2 server processes are ready") == 1)
        with one.client() as marey:
            marey.create_project(ProjectCreate(name="lab"))
        yield one
        one.stop()
        one.check_database()


@pytest.fixture
def pair(server: SharingServer) -> Iterator[tuple[httpx.Client, httpx.Client]]:
    """A client of each of the two processes."""
    first, second = (server.client_of(one.pid) for one in server.modules(PROGRAM))
    with contextlib.closing(first), contextlib.closing(second):
        yield first, second


Pair = tuple[httpx.Client, httpx.Client]


def test_what_one_process_writes_another_reads_changes_and_refuses_to_overwrite(pair: Pair) -> None:
    first, second = pair
    made = first.post(COLLECTIONS, json={"path": "shared"}, headers={"Idempotency-Key": "once-0001"})
    assert made.status_code == 201, made.text
    again = second.post(COLLECTIONS, json={"path": "shared"}, headers={"Idempotency-Key": "once-0001"})
    assert (again.status_code, again.json()) == (201, made.json())
    address = f"{COLLECTIONS}/{made.json()['id']}"
    tag = second.get(address).headers["ETag"]
    assert second.patch(address, json={"path": "renamed"}, headers={"If-Match": tag}).status_code == 200
    assert first.get(address).json()["path"] == "renamed"
    assert first.patch(address, json={"path": "late"}, headers={"If-Match": tag}).status_code == 412


def test_a_token_that_is_revoked_at_one_process_is_refused_by_another_at_once(pair: Pair) -> None:
    first, second = pair
    made = first.post("/tokens", json={"name": "short", "scopes": ["read", "write"]}).json()
    stolen = {"Authorization": f"Bearer {made['secret']}"}
    for number in range(3):  # so that the second process knows the token, and has admitted bodies with it
        assert second.get("/me", headers=stolen).status_code == 200
        assert second.post(COLLECTIONS, json={"path": f"before {number}"}, headers=stolen).status_code == 201
    assert first.delete(f"/tokens/{made['id']}", headers={"If-Match": "*"}).status_code == 204
    assert second.post(COLLECTIONS, json={"path": "after"}, headers=stolen).status_code == 401
    assert second.get("/me", headers=stolen).status_code == 401


def test_a_follower_at_one_process_sees_an_event_of_another_at_once(pair: Pair) -> None:
    first, second = pair
    with second.stream("GET", "/projects/lab/events", headers={"Accept": "text/event-stream"}) as stream:
        lines = stream.iter_lines()
        time.sleep(0.5)
        waits_s = []
        for number in range(5):
            written_s = time.monotonic()
            made = first.post(COLLECTIONS, json={"path": f"followed {number}"}).json()
            while made["id"] not in next(lines):
                pass
            waits_s.append(time.monotonic() - written_s)
        # Regular looks at the feed are seconds apart, so the second event and those after it would all come late.
        assert min(waits_s[1:]) < 1.0, "the follower had to wait for regular looks at the feed"


def test_sign_ins_are_limited_at_all_processes_together(pair: Pair) -> None:
    first, second = pair
    wrong = {"name": "nobody", "password": "wrong password"}
    statuses = []
    for one in (first, second) * 8:
        request = one.build_request("POST", "/login", json=wrong)
        del request.headers["Authorization"]
        statuses.append(one.send(request).status_code)
    assert statuses[0] == 401
    assert 429 in statuses, "each process has counted the tries for itself"


class Load:
    """Threads that create collections during a `with` block, some over a new connection for each request.

    After the block, the load checks that all accepted collections are stored. Unless it is `forgiving`, it also checks
    that no request has failed.
    """

    def __init__(self, server: SharingServer, name: str, *, forgiving: bool) -> None:
        self.server, self.name, self.forgiving = server, name, forgiving
        self.accepted: list[str] = []
        self.failures: list[str] = []
        self._stop = threading.Event()
        self._pool = ThreadPoolExecutor(4)
        self._running = [self._pool.submit(self._write, number) for number in range(4)]

    def _write(self, writer: int) -> None:
        client = self.server.one_connection()
        number = 0
        while not self._stop.is_set():
            number += 1
            path = f"{self.name} {writer} {number}"
            try:
                answer = client.post(COLLECTIONS, json={"path": path})
                if answer.status_code == 201:
                    self.accepted.append(path)
                else:
                    self.failures.append(answer.text)
                found = client.get("/me")
                if found.status_code != 200:
                    self.failures.append(found.text)
            except httpx.TransportError as error:
                self.failures.append(repr(error))
            if writer % 2:
                client.close()
                client = self.server.one_connection()
            time.sleep(0.05)  # leave the processor to the processes that start
        client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, failed: type[BaseException] | None, _error: object, _at: object) -> None:
        self._stop.set()
        self._pool.shutdown()
        if failed is not None:
            return
        for one in self._running:
            one.result()
        with self.server.client() as marey:
            stored = {one.path for one in marey.project("lab").collections.list()}
        assert stored >= set(self.accepted)
        assert self.accepted
        assert self.forgiving or not self.failures, self.failures[:5]


def test_a_process_that_is_killed_is_replaced_and_no_accepted_write_is_lost(server: SharingServer) -> None:
    server.wait_for("there is one worker", lambda: len(server.modules(WORKER)) == 1)
    (worker,) = server.modules(WORKER)
    victim = worker.parent()
    assert victim is not None
    (survivor,) = [one for one in server.modules(PROGRAM) if one != victim]
    with Load(server, "killed", forgiving=True) as load:
        time.sleep(1)
        victim.kill()
        time.sleep(0.2)
        went_on = len(load.accepted)
        server.wait_for("the process is replaced", lambda: len(set(server.modules(PROGRAM)) - {victim}) == 2)
    assert survivor.is_running()
    assert len(load.accepted) > went_on
    assert len(load.failures) <= 2 * 4, "each writer may lose the requests that the process was answering"
    server.wait_for("the other process runs the worker", lambda: keepers_of_workers(server) == [survivor])


def keepers_of_workers(server: SharingServer) -> list[psutil.Process | None]:
    """Return the process that runs each worker."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return [one.parent() for one in server.modules(WORKER)]
    return []


@pytest.mark.soak
def test_processes_are_replaced_without_a_failed_request(server: SharingServer) -> None:
    before = {one.pid for one in server.modules(PROGRAM)}
    replaced = server.logged("all server processes are replaced")
    with Load(server, "replaced", forgiving=False):
        time.sleep(0.5)
        server.send(signal.SIGHUP)
        server.wait_for("all are replaced", lambda: server.logged("all server processes are replaced") > replaced)
    after = {one.pid for one in server.modules(PROGRAM)}
    assert len(after) == 2
    assert not after & before


@pytest.mark.soak
def test_processes_that_are_not_forked_share_the_port_and_end_when_their_parent_is_killed(
    tmp_path: Path, postgres_url: URL
) -> None:
    """The processes of the other tests are forked; these are started as in production, and inherit the sockets."""
    with new_postgres_database(postgres_url, "not_forked") as url:
        server = SharingServer(tmp_path, database_address(url), MAREY_PROCESSES="2")
        server.own_children = True
        try:
            server.start()
            server.wait_for("both are ready", lambda: server.logged("all 2 server processes are ready") == 1)
            processes = server.modules(PROGRAM)
            assert len(processes) == 2
            for one in processes:
                with contextlib.closing(server.client_of(one.pid)) as client:
                    assert client.get("/me").status_code == 200
        finally:
            server.kill()
        assert psutil.wait_procs(processes, timeout=60)[1] == []
