"""Sign-in over HTTP: limits on what a stranger can learn and on the resources that a stranger can use."""

import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import islice
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server, running

from marey_schemas.access import UserCreate
from marey_server.access import passwords
from marey_server.access.principal import SYSTEM
from marey_server.process.password_lanes import PLACES, PLACES_PER_ADDRESS
from marey_server.store import users
from marey_server.store.database.connections import Database

PASSWORD = "correct horse battery"
STRANGER, OWNER = "203.0.113.7", "198.51.100.1"


@pytest.fixture(autouse=True)
def cheap_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passwords, "LOG2_N", 4)


def make_ann(database: Database) -> None:
    stored = passwords.hash_password(PASSWORD)
    database.write(SYSTEM, users.create_user, UserCreate(name="ann"), password_hash=stored)


def sign_in(server: Server, password: str = "guess", *, name: str = "ann", **headers: str) -> httpx.Response:
    return server.client().post("/login", json={"name": name, "password": password}, headers=headers)


def test_ten_wrong_guesses_of_a_stranger_do_not_keep_the_owner_out(database: Database, tmp_path: Path) -> None:
    make_ann(database)
    with running(database, tmp_path, trust_proxy=True) as server:
        stranger, owner = ({"X-Forwarded-For": address} for address in (STRANGER, OWNER))
        guesses = [sign_in(server, **stranger).status_code for _ in range(10)]
        assert guesses == [401] * 10
        refused = sign_in(server, PASSWORD, **stranger)
        assert (refused.status_code, refused.json()["code"]) == (429, "too-many-sign-ins")
        assert refused.headers["Retry-After"] == str(refused.json()["context"]["wait_s"])
        assert sign_in(server, PASSWORD, **owner).status_code == 200


@pytest.mark.parametrize("invented", ["X-Forwarded-For", "X-Real-IP"])
def test_an_address_that_a_client_invents_counts_for_nothing(database: Database, tmp_path: Path, invented: str) -> None:
    make_ann(database)
    proxied = invented == "X-Real-IP"  # a proxy that sets X-Forwarded-For passes it on as it came
    with running(database, tmp_path, trust_proxy=proxied, login_tries_per_minute=3) as server:
        for number in range(4):
            headers = {"X-Forwarded-For": STRANGER} if proxied else {}
            answer = sign_in(server, **headers, **{invented: f"10.0.0.{number}"})
        assert answer.status_code == 429


def test_an_unknown_user_gets_the_answer_of_a_wrong_password_for_the_same_work(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_ann(database)
    database.write(SYSTEM, users.create_user, UserCreate(name="silent"))
    costs: list[tuple[Any, ...]] = []
    derive = passwords._derive

    def noted(password: str, salt: bytes, *cost: int) -> bytes:
        costs.append(cost)
        return derive(password, salt, *cost)

    monkeypatch.setattr(passwords, "_derive", noted)
    with running(database, tmp_path, login_tries_per_minute=2) as server:
        answers = [[sign_in(server, name=name) for _ in range(3)] for name in ("ann", "silent", "nobody")]
    for one in zip(*answers, strict=True):
        shown = [{**answer.json(), "instance": ""} for answer in one]
        assert shown[0]["status"] in (401, 429)
        for field in ("status", "code", "title", "errors"):
            assert len({str(each[field]) for each in shown}) == 1
    assert len(costs) == 6
    assert len(set(costs)) == 1


@pytest.fixture
def going_on(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Event for which checks of wrong passwords wait; the test sets it to let them continue."""
    event = threading.Event()
    matches = passwords.password_matches

    def check(password: str, stored: str | None) -> bool:
        if password != PASSWORD:
            event.wait(PATIENCE_S)
        return matches(password, stored)

    monkeypatch.setattr(passwords, "password_matches", check)
    return event


def guess_once(server: Server, address: str) -> int:
    """Try to sign in with a wrong password from an address, on a new connection; return the status of the answer."""
    with httpx.Client(base_url=server.api, timeout=PATIENCE_S) as client:
        body = {"name": "ann", "password": "guess"}
        return client.post("/login", json=body, headers={"X-Forwarded-For": address}).status_code


def test_a_flood_of_sign_ins_keeps_nobody_from_anything_else(
    database: Database, tmp_path: Path, going_on: threading.Event
) -> None:
    make_ann(database)
    owner = {"X-Forwarded-For": OWNER}
    with running(database, tmp_path, trust_proxy=True) as server, ThreadPoolExecutor(2 * PLACES) as strangers:
        assert sign_in(server, PASSWORD, **owner).status_code == 200
        client = server.client(server.make_project())
        flood = [strangers.submit(guess_once, server, f"203.0.113.{number}") for number in range(2 * PLACES)]
        try:
            refused = [one.result() for one in islice(as_completed(flood), PLACES)]
            assert refused == [503] * PLACES  # and the others wait
            assert client.get("/projects/lab").status_code == 200
            assert client.post("/projects/lab/collections", json={"path": "a"}).status_code == 201
            assert httpx.get(f"{server.address}/readyz").status_code == 200
            assert sign_in(server, PASSWORD, **owner).status_code == 200
            beyond = sign_in(server, PASSWORD, **{"X-Forwarded-For": "192.0.2.1"})
            assert (beyond.json()["code"], beyond.headers["Retry-After"]) == ("too-many-passwords", "2")
        finally:
            going_on.set()


def test_one_address_checks_few_passwords_at_once(
    database: Database, tmp_path: Path, going_on: threading.Event
) -> None:
    make_ann(database)
    with running(database, tmp_path) as server, ThreadPoolExecutor(2 * PLACES_PER_ADDRESS) as strangers:
        flood = [strangers.submit(guess_once, server, "") for _ in range(2 * PLACES_PER_ADDRESS)]
        try:
            refused = [one.result() for one in islice(as_completed(flood), PLACES_PER_ADDRESS)]
            assert refused == [429] * PLACES_PER_ADDRESS
        finally:
            going_on.set()
