"""Invitations over HTTP: codes are shown only once, guesses are limited, and people create accounts."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.rest_server import ALL_SCOPES, Server, running

from marey_schemas.access import Role, UserCreate
from marey_server.access import passwords
from marey_server.access.principal import SYSTEM
from marey_server.store import users
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Quotas

PASSWORD = "correct horse battery"
LAB = "/projects/lab/invitations"
WRONG = "mareyinvite_" + "0" * 12 + "_" + "0" * 64


@pytest.fixture(autouse=True)
def cheap_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passwords, "LOG2_N", 4)


@pytest.fixture
def chief(server: Server) -> httpx.Client:
    """The client of an administrator."""
    return server.client(server.make_user("chief", administrator=True, scopes=ALL_SCOPES))


def invite(owner: httpx.Client, **body: Any) -> dict[str, Any]:
    answer = owner.post(LAB, json={"role": "contributor", **body})
    assert (answer.status_code, answer.headers["Cache-Control"]) == (201, "no-store"), answer.text
    made: dict[str, Any] = answer.json()
    return made


def sign_up(server: Server, code: str, name: str = "ada", password: str = PASSWORD, **headers: str) -> httpx.Response:
    body = {"code": code, "name": name, "password": password}
    return server.client().post("/sign-up", json=body, headers=headers)


def test_an_invited_user_becomes_a_member_and_a_repetition_gets_the_same_answer(
    server: Server, owner: httpx.Client
) -> None:
    guest = server.client(server.make_user("guest"))
    made = invite(owner, note="animation team")
    [listed] = owner.get(LAB).json()["items"]
    assert listed == {name: value for name, value in made.items() if name != "code"}
    assert guest.get("/projects/lab").status_code == 404
    answers = [guest.post("/invitations/accept", json={"code": made["code"]}) for _ in range(2)]
    assert [one.status_code for one in answers] == [200, 200]
    assert [one.json() for one in answers] == [{"project": "lab", "role": "contributor", "joined": True}] * 2
    assert guest.get("/projects/lab").json()["role"] == "contributor"
    assert owner.get(LAB).json()["items"] == []
    entries = owner.get("/projects/lab/audit", params={"subject": made["prefix"]}).json()["items"]
    assert [(one["kind"], one["actor"]) for one in entries] == [
        ("invitation.accepted", "guest"),
        ("invitation.created", "olga"),
    ]


def test_an_invited_person_creates_an_account_with_a_password_of_their_own(
    server: Server, owner: httpx.Client, chief: httpx.Client
) -> None:
    body = {"project": "lab", "role": "reader", "note": "for Ada"}
    code = chief.post("/invitations", json=body).json()["code"]
    done = sign_up(server, code)
    assert (done.status_code, done.headers["Cache-Control"]) == (201, "no-store")
    made = done.json()
    assert (made["user"], made["project"], made["role"], made["session"]) == ("ada", "lab", "reader", True)
    assert server.client(made["secret"]).get("/projects/lab").json()["role"] == "reader"
    assert "admin" not in made["scopes"]
    login = server.client().post("/login", json={"name": "ada", "password": PASSWORD})
    assert login.status_code == 200
    again = sign_up(server, code)
    assert (again.status_code, again.json()["role"]) == (201, "reader")
    assert again.json()["secret"] != made["secret"]


def test_a_used_code_shows_neither_who_used_it_nor_their_password(
    server: Server, owner: httpx.Client, chief: httpx.Client
) -> None:
    code = chief.post("/invitations", json={}).json()["code"]
    assert sign_up(server, code).status_code == 201
    wrong = [sign_up(server, code, password="another password"), sign_up(server, code, name="ben")]
    wrong += [sign_up(server, code, name="olga"), sign_up(server, WRONG), sign_up(server, invite(owner)["code"])]
    answers = [{**one.json(), "instance": ""} for one in wrong]
    assert answers == [answers[0]] * len(wrong)
    assert (answers[0]["status"], answers[0]["code"]) == (404, "invitation-invalid")


def test_a_taken_name_is_refused_and_the_invitation_stays_valid(
    server: Server, owner: httpx.Client, chief: httpx.Client
) -> None:
    code = chief.post("/invitations", json={"project": "lab", "role": "reader"}).json()["code"]
    taken = sign_up(server, code, name="olga")
    assert (taken.status_code, taken.json()["code"]) == (409, "name-taken")
    assert sign_up(server, code).status_code == 201


def test_invalid_codes_get_one_answer_whatever_the_reason(server: Server, owner: httpx.Client) -> None:
    guest, other = (server.client(server.make_user(name)) for name in ("guest", "other"))
    used, withdrawn = invite(owner), invite(owner)
    assert other.post("/invitations/accept", json={"code": used["code"]}).is_success
    assert owner.delete(f"{LAB}/{withdrawn['prefix']}").status_code == 204
    answers = [
        guest.post("/invitations/accept", json={"code": code})
        for code in (used["code"], withdrawn["code"], WRONG, "nonsense", "")
    ]
    assert [one.status_code for one in answers] == [404] * 5
    shown = [{**one.json(), "instance": ""} for one in answers]
    assert shown == [shown[0]] * 5
    assert shown[0]["code"] == "invitation-invalid"


def test_guesses_are_limited_by_the_address_and_do_not_hinder_sign_ins(database: Database, tmp_path: Path) -> None:
    stored = passwords.hash_password(PASSWORD)
    with running(database, tmp_path, login_tries_per_minute=3) as server:
        owner, guest = server.client(server.make_project()), server.client(server.make_user("guest"))
        made = invite(owner)
        prefix = made["prefix"]
        guesses = [f"mareyinvite_{prefix}_{number:064x}" for number in range(4)]
        answers = [guest.post("/invitations/accept", json={"code": code}) for code in guesses]
        assert [one.status_code for one in answers] == [404] * 3 + [429]
        assert answers[-1].json()["code"] == "too-many-sign-ins"
        assert int(answers[-1].headers["Retry-After"]) > 0
        assert guest.post("/invitations/accept", json={"code": made["code"]}).status_code == 429
        assert sign_up(server, made["code"]).status_code == 429
        request = UserCreate(name=prefix)
        database.write(SYSTEM, users.create_user, request, password_hash=stored)
        assert server.client().post("/login", json={"name": prefix, "password": PASSWORD}).status_code == 200


def test_right_codes_are_not_limited(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, login_tries_per_minute=2) as server:
        owner = server.client(server.make_project())
        code = invite(owner, uses=10)["code"]
        for number in range(10):
            guest = server.client(server.make_user(f"guest-{number}"))
            assert guest.post("/invitations/accept", json={"code": code}).status_code == 200


def test_the_number_of_open_invitations_is_bounded(database: Database, tmp_path: Path) -> None:
    database.quotas = Quotas(project_invitations=1)
    with running(database, tmp_path) as server:
        owner = server.client(server.make_project())
        made = invite(owner)
        refused = owner.post(LAB, json={"role": "reader"})
        assert (refused.status_code, refused.json()["code"]) == (409, "quota-exceeded")
        assert refused.json()["context"] == {"quota": "project_invitations", "used": 1, "limit": 1}
        assert owner.delete(f"{LAB}/{made['id']}").status_code == 204
        invite(owner)


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ({"role": "king"}, "/role"), ({}, "/role"), ({"role": "reader", "uses": 0}, "/uses"),
        ({"role": "reader", "expires_in_s": 31 * 86400}, "/expires_in_s"),
        ({"role": "reader", "note": "x" * 256}, "/note"),
    ],
)  # fmt: skip
def test_a_wrong_request_is_told_where_it_is_wrong(owner: httpx.Client, body: dict[str, Any], pointer: str) -> None:
    refused = owner.post(LAB, json=body)
    assert (refused.status_code, refused.json()["errors"][0]["pointer"]) == (422, pointer)
    assert owner.get(LAB).json()["items"] == []


def test_an_invitation_to_an_account_names_project_and_role_or_neither(
    server: Server, owner: httpx.Client, chief: httpx.Client
) -> None:
    for body in ({"project": "lab"}, {"role": "reader"}):
        refused = chief.post("/invitations", json=body)
        assert refused.status_code == 422
        assert "both, or neither" in refused.text
    assert chief.post("/invitations", json={"project": "nowhere", "role": "reader"}).json()["code"] == "no-project"
    assert owner.post("/invitations", json={}).status_code == 403
    made = chief.post("/invitations", json={}).json()
    assert [one["id"] for one in chief.get("/invitations").json()["items"]] == [made["id"]]
    assert chief.delete(f"/invitations/{made['prefix']}").status_code == 204
    assert chief.delete(f"/invitations/{made['prefix']}").json()["code"] == "no-invitation"


def test_codes_and_notes_are_in_no_log_and_no_event(
    server: Server, owner: httpx.Client, chief: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG):
        guest = server.client(server.make_user("guest"))
        made = invite(owner, note="secret note")
        account = chief.post("/invitations", json={"project": "lab", "role": Role.READER}).json()
        for code in (made["code"], made["code"][:-1] + "x"):
            guest.post("/invitations/accept", json={"code": code})
        sign_up(server, account["code"], password="short")
        sign_up(server, account["code"])
        guest.post("/invitations/accept", json={"code": 2 * made["code"] + 100 * "x"})
    events = owner.get("/projects/lab/events", params={"limit": 1000}).text
    audit = chief.get("/audit").text
    for secret in (made["code"], account["code"]):
        hidden = secret.rpartition("_")[2]
        assert hidden[:-1] not in caplog.text + events + audit
    assert "secret note" not in caplog.text + events + audit
    assert PASSWORD not in caplog.text


def test_a_validation_error_does_not_repeat_the_code(server: Server) -> None:
    guest = server.client(server.make_user("guest"))
    refused = guest.post("/invitations/accept", json={"code": 3 * WRONG})
    assert refused.status_code == 422
    assert WRONG not in refused.text
    assert WRONG not in sign_up(server, WRONG, password="short").text


def test_an_invitation_cannot_be_accepted_with_a_token_for_one_project(server: Server, owner: httpx.Client) -> None:
    guest = server.client(server.make_user("guest"))
    guest.post("/projects", json={"name": "den"}).raise_for_status()
    for scope in ("write!project=den", "read"):
        narrow = guest.post("/tokens", json={"name": "narrow", "scopes": [scope]}).json()["secret"]
        code = invite(owner)["code"]
        refused = server.client(narrow).post("/invitations/accept", json={"code": code})
        assert (refused.status_code, refused.json()["code"]) == (403, "insufficient-scope")
