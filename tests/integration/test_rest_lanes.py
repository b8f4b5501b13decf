"""Lanes, groups of threads with a queue: urgent requests, such as heartbeats, never wait behind long ones."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import update
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server, running

from marey_schemas.encoding.codecs import encode_tree
from marey_schemas.encoding.digests import digest_of
from marey_server.access.principal import SYSTEM
from marey_server.process import refusal_brake
from marey_server.process.refusal_brake import FREE_REFUSALS
from marey_server.store.credentials import tokens
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import Client
from marey_server.store.tables import attempt

WALK = b"HIERARCHY"
IMPORT = {"files": [{"name": "walk.bvh", "blob": digest_of(WALK)}]}
STUDY = {"schema": "marey/document@1", "answer": 42}


@contextmanager
def busy(server: Server) -> Iterator[None]:
    """During the `with` block, occupy all threads for ordinary reads, and fill the queue for these threads."""
    done = threading.Event()
    clients = [Client(f"user-{number}") for number in range(40)]
    reads = [server.database.queue_read(one, SYSTEM, lambda _tx: done.wait(PATIENCE_S)) for one in clients]
    try:
        yield
        assert not any(read.done() for read in reads)
    finally:
        done.set()


def noted_clients(server: Server, monkeypatch: pytest.MonkeyPatch) -> list[Client]:
    """Return a list to which the client of every further request is added."""
    clients: list[Client] = []
    take = server.app.services.turns.take

    def note(client: Client, *, reserved: bool) -> Any:
        clients.append(client)
        return take(client, reserved=reserved)

    monkeypatch.setattr(server.app.services.turns, "take", note)
    return clients


def test_heartbeats_claims_readiness_and_callers_do_not_wait_behind_reads(server: Server) -> None:
    server.make_project()
    worker = server.client(server.make_user("wanda", administrator=True, scopes=("work", "read")))
    claim = {"worker": "w", "kinds": ["export"]}
    with busy(server):
        answers = {
            "ready": httpx.get(f"{server.address}/readyz", timeout=PATIENCE_S),
            "me": worker.get("/me"),
            "claim": worker.post("/leases", json=claim),
            "sign-in": server.client().post("/login", json={"name": "olga", "password": "guess"}),
            "heartbeat": worker.post("/jobs/job_1/attempts/1/heartbeat", json={}),
        }
    assert {name: answer.status_code for name, answer in answers.items()} == {
        "ready": 200, "me": 200, "claim": 200, "sign-in": 401, "heartbeat": 403
    }  # fmt: skip


def test_reads_of_one_client_leave_a_thread_to_others(server: Server) -> None:
    done = threading.Event()
    queue = server.database.queue_read
    held = [queue(Client("anna"), SYSTEM, lambda _tx: done.wait(PATIENCE_S)) for _ in range(40)]
    try:
        assert queue(Client("ben"), SYSTEM, lambda _tx: "read").result(PATIENCE_S) == "read"
        assert not any(read.done() for read in held)
    finally:
        done.set()


def test_a_token_that_is_refused_often_takes_its_turns_among_strangers(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refusal_brake, "FORGIVEN_EVERY_S", PATIENCE_S)  # a busy machine needs more than a second
    prober, reader = (server.client(server.make_user(name)) for name in ("prober", "reader"))
    for one in (prober, reader):
        assert one.get("/me").status_code == 200
    for _ in range(FREE_REFUSALS + 1):
        assert prober.get("/projects/none").status_code == 404
    clients = noted_clients(server, monkeypatch)
    assert [one.get("/me").status_code for one in (prober, reader)] == [200, 200]
    assert [client.known for client in clients] == [False, True]


def test_every_server_knows_the_token_of_an_attempt_from_its_first_request_to_its_end(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = server.client(server.make_project())
    assert owner.put(f"/blobs/{digest_of(WALK)}", content=WALK).is_success
    assert owner.post("/projects/lab/jobs", json={"kind": "import", "params": IMPORT}).is_success
    worker = server.client(server.make_user("wanda", administrator=True, scopes=("work",)))
    (lease,) = worker.post("/leases", json={"worker": "w", "kinds": ["import"]}).json()["leases"]
    token, place = lease["attempt_token"], f"/jobs/{lease['job']}/attempts/{lease['fence']}"
    unsealed = token.rpartition("_")[0]
    with running(Database(server.database.url.render_as_string(hide_password=False)), tmp_path / "other") as other:
        clients = noted_clients(other, monkeypatch)
        assert other.client(token).post(f"{place}/heartbeat", json={}).is_success
        assert other.client(unsealed).post(f"{place}/heartbeat", json={}).is_success
        assert other.client("mareyjob_" + "0" * 64).get("/me").status_code == 401
        assert [client.known for client in clients] == [True, True, False]
        assert clients[0].key == clients[1].key  # so nobody gets more shares by changing the seal
    clients = noted_clients(server, monkeypatch)
    server.database.write(SYSTEM, lambda tx: tx.execute(update(attempt).values(ended_us=1)))
    for _ in range(2):
        assert server.client(token).post(f"{place}/heartbeat", json={}).json()["code"] == "lease-lost"
    assert [client.known for client in clients] == [True, False]


def test_refusals_of_unknown_addresses_methods_and_headers_are_counted(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = server.make_user("anna")
    user, user_id = server.client(token), server.database.read(SYSTEM, tokens.resolve_token, token).user_id
    assert user.get("/me").status_code == 200
    counted: list[str] = []

    def note(client: str, **_crowd: int) -> float:
        counted.append(client)
        return 1e-3

    monkeypatch.setattr(server.app.services.refusal_brake, "delay_s", note)
    guest = server.client()
    answers = [
        guest.get("/nowhere"),
        guest.delete("/login"),
        guest.get("/projects", headers={"Accept": "image/png"}),
        guest.get("/me", headers={"Authorization": "Basic x"}),
        user.get("/nowhere"),
    ]
    assert [answer.status_code for answer in answers] == [404, 405, 406, 401, 404]
    assert counted == ["127.0.0.1"] * 4 + [user_id]
    assert server.app.services.metrics.delayed._value.get() == len(counted)


def test_all_tokens_of_a_user_are_one_client_except_those_of_workers(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = server.make_user("anna", administrator=True)
    user_id = server.database.read(SYSTEM, tokens.resolve_token, first).user_id
    assert user_id is not None

    def more(*scopes: str) -> httpx.Client:
        return server.client(server.make_token(user_id, "anna", administrator=True, scopes=scopes))

    people = [server.client(first), more("read"), more("read", "work"), server.client(server.make_user("ben"))]
    workers = [more("work"), more("work")]
    claim = {"worker": "w", "kinds": ["export"]}

    def ask() -> None:
        assert [one.get("/me").status_code for one in people] == [200] * 4
        assert [one.post("/leases", json=claim).status_code for one in workers] == [200] * 2

    ask()
    clients = noted_clients(server, monkeypatch)
    ask()
    assert all(client.known for client in clients)
    assert {client.key for client in clients[:3]} == {user_id}
    assert len({client.key for client in clients}) == 4, "of Anna, of Ben and of two workers"


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_readiness_takes_a_reserved_turn(server: Server, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[bool] = []
    turns = server.app.services.turns
    take = turns.take

    def note(client: Client, *, reserved: bool) -> Any:
        taken.append(reserved)
        return take(client, reserved=reserved)

    monkeypatch.setattr(turns, "take", note)
    assert httpx.request(method, f"{server.address}/readyz", timeout=PATIENCE_S).status_code == 200
    assert taken == [True]


def test_documents_are_rendered_after_their_transactions(
    server: Server, owner: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: list[str] = []

    def noting(*args: Any, **options: Any) -> bytes:
        threads.append(threading.current_thread().name)
        return encode_tree(*args, **options)

    made = owner.post("/projects/lab/characters", json={"name": "s", "parts": {"character": STUDY}}).json()
    monkeypatch.setattr("marey_server.http.reply.encode_tree", noting)
    place = {"kind": "character", "item": made["id"], "revision": 1, "part": "character"}
    answers = [
        owner.get(f"/projects/lab/characters/{made['id']}/parts/character"),
        owner.post("/projects/lab/parts", json={"parts": [place]}),
    ]
    assert [answer.status_code for answer in answers] == [200, 200]
    assert len(threads) == 2
    assert all(name.startswith("marey-compute-rendering") for name in threads), threads


def test_a_function_that_ends_with_stop_iteration_is_a_failure_of_its_request(
    owner: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_args: Any, **_options: Any) -> Any:
        raise StopIteration

    monkeypatch.setattr("marey_server.handlers.projects.projects.read_project", stop)
    monkeypatch.setattr("marey_server.handlers.collections.collections.create_collection", stop)
    answers = [owner.get("/projects/lab"), owner.post("/projects/lab/collections", json={"path": "x"})]
    assert [answer.status_code for answer in answers] == [500, 500]
