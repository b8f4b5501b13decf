"""Sign-in with an identity provider: the whole flow through a server, and everything that must not work in it."""

from __future__ import annotations

import hashlib
import secrets
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from tests.support.identity_provider import CLIENT, SECRET, FakeProvider, ec_key, provider_running, rsa_key
from tests.support.rest_server import Server, running

from marey_schemas.sign_ins import CALLBACK_PATH
from marey_server.access.principal import SYSTEM
from marey_server.process import identity_provider
from marey_server.store.credentials import browser_sign_ins
from marey_server.store.database.connections import Database
from marey_server.store.tables import browser_sign_in

ON_SQLITE = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
"""Mark of tests to which the kind of database makes no difference."""
ADMIN_SCOPES = ("read", "write", "admin")


class Person:
    """A program that begins a sign-in, and the browser of the person who completes it."""

    def __init__(self, server: Server, **wanted: Any) -> None:
        self.server = server
        self.verifier = secrets.token_urlsafe(32)
        challenge = hashlib.sha256(self.verifier.encode()).hexdigest()
        answer = server.client().post("/sign-ins", json={"challenge": challenge, **wanted})
        assert answer.status_code == 201, answer.text
        self.begun = answer.json()
        self.browser = httpx.Client(timeout=60)

    def open(self) -> str:
        """Open the address of the sign-in, and return the address at the provider to which it leads."""
        answer = self.browser.get(self.begun["url"])
        assert answer.status_code == 303, answer.text
        return answer.headers["Location"]

    def sign_in(self) -> str:
        """Sign in at the provider, and return the address at the server to which it sends the browser back."""
        return str(self.browser.get(self.open()).headers["Location"])

    def finish(self) -> httpx.Response:
        """Do everything in the browser, and return the last answer."""
        return self.browser.get(self.sign_in())

    def redeem(self, code: str, verifier: str | None = None) -> httpx.Response:
        body = {"code": code, "verifier": verifier or self.verifier}
        return self.server.client().post(f"/sign-ins/{self.begun['id']}/token", json=body)


def code_on(page: httpx.Response) -> str:
    """Return the code that a page shows."""
    assert page.status_code == 200, page.text
    return page.text.partition("<code>")[2].partition("</code>")[0]


Start = Callable[..., Server]


@pytest.fixture
def provider() -> Iterator[FakeProvider]:
    with provider_running() as one:
        yield one


@contextmanager
def serving(database: Database, folder: Path, provider: FakeProvider, **settings: Any) -> Iterator[Server]:
    """Run a server that trusts the provider; browsers reach it at the address where it listens."""
    secret = folder / "client-secret"
    secret.write_text(SECRET + "\n")
    given = {"oidc_issuer": provider.url, "oidc_client_id": CLIENT, "oidc_client_secret_file": secret, **settings}
    with running(database, folder, public_url="http://127.0.0.1:1", **given) as server:
        found = server.app.services.identity_provider
        assert found is not None  # the port is known only now
        found._settings = found._settings.model_copy(update={"public_url": server.address})
        yield server


@pytest.fixture
def house(database: Database, tmp_path: Path, provider: FakeProvider) -> Iterator[Server]:
    with serving(database, tmp_path, provider) as server:
        yield server


def link(server: Server, user: str = "ada", subject: str = "sub-ada") -> httpx.Client:
    """Create a user and link a person with it; return the client of the administrator who did it."""
    admin = server.client(server.make_user("root", administrator=True, scopes=ADMIN_SCOPES))
    server.make_user(user)
    linked = admin.post(f"/users/{user}/identities", json={"subject": subject})
    assert linked.status_code == 201, linked.text
    return admin


def test_a_linked_person_signs_in_and_gets_an_ordinary_token(house: Server) -> None:
    admin = link(house)
    person = Person(house, expires_in_s=80 * 86400)
    page = person.finish()
    assert "signed in as ada" in page.text
    made = person.redeem(code_on(page))
    assert made.status_code == 200, made.text
    token = made.json()
    assert (token["user"], token["session"], token["scopes"]) == ("ada", True, ["read", "write", "jobs", "work"])
    assert made.headers["Cache-Control"] == "no-store"
    me = house.client(token["secret"])
    shown = me.get("/me").json()
    assert shown["user"]["name"] == "ada"
    created, expires = (
        time.mktime(time.strptime(token[key][:19], "%Y-%m-%dT%H:%M:%S")) for key in ("created_at", "expires_at")
    )
    assert expires - created == 7 * 86400  # the longest time in the settings
    [identity] = me.get("/users/ada/identities").json()["items"]
    assert identity["last_used_at"] is not None
    kinds = [one["kind"] for one in admin.get("/audit").json()["items"]]
    assert {"identity.linked", "token.created"} <= set(kinds)

    waiting = Person(house)
    code = code_on(waiting.finish())
    assert admin.delete(f"/users/ada/identities/{identity['id']}").status_code == 204
    assert me.get("/me").status_code == 401  # the sign-in has ended
    assert waiting.redeem(code).json()["code"] == "sign-in-invalid"
    assert Person(house).finish().status_code == 403


@ON_SQLITE
def test_a_program_on_the_same_machine_gets_the_code_from_the_browser(house: Server) -> None:
    link(house)
    person = Person(house, port=40123)
    answer = person.finish()
    target = urlsplit(answer.headers["Location"])
    assert (answer.status_code, target.scheme, target.netloc, target.path) == (303, "http", "127.0.0.1:40123", "/")
    query = parse_qs(target.query)
    assert query["sign_in"] == [person.begun["id"]]
    assert person.redeem(query["code"][0]).status_code == 200


def test_a_code_works_once_and_only_with_the_verifier_of_its_program(house: Server) -> None:
    link(house)
    person, thief = Person(house), Person(house)
    code = code_on(person.finish())
    assert person.redeem(code, "v" * 43).json()["code"] == "sign-in-invalid"
    assert thief.redeem(code).json()["code"] == "sign-in-invalid"
    assert person.redeem(code).status_code == 200
    assert person.redeem(code).json()["code"] == "sign-in-invalid"
    answers = [person.redeem("x") for _ in range(12)]
    assert answers[-1].json()["code"] == "too-many-sign-ins"


def test_a_state_works_once_and_only_in_the_browser_that_began(house: Server) -> None:
    link(house)
    person, other = Person(house), Person(house)
    other.open()
    back = person.sign_in()
    strange = other.browser.get(back)
    assert (strange.status_code, strange.headers["Content-Type"]) == (404, "text/html; charset=utf-8")
    assert httpx.get(back).status_code == 404
    assert person.browser.head(back).status_code == 405
    cookie = person.browser.cookies["marey-sign-in"]
    assert person.browser.get(back).status_code == 200
    replayed = httpx.get(back, headers={"Cookie": f"marey-sign-in={cookie}"})
    assert replayed.status_code == 404
    assert httpx.get(person.begun["url"]).status_code == 404  # opened already
    invented = other.browser.get(f"{house.api}{CALLBACK_PATH}", params={"state": "x", "code": "y", "unknown": "z"})
    assert invented.status_code == 404


def test_a_sign_in_ends_after_its_time(house: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    link(house)
    monkeypatch.setattr(browser_sign_ins, "LIFETIME_US", 0)
    late = Person(house)
    assert late.browser.get(late.begun["url"]).status_code == 404
    assert house.database.write(SYSTEM, browser_sign_ins.delete_expired) == 1
    monkeypatch.setattr(browser_sign_ins, "MOST_WAITING", 0)
    assert house.client().post("/sign-ins", json={"challenge": "0" * 64}).status_code == 503
    monkeypatch.undo()
    for _ in range(20):
        answer = house.client().post("/sign-ins", json={"challenge": "0" * 64})
    assert answer.json()["code"] == "too-many-sign-ins"
    for wrong in ({"challenge": "x"}, {"challenge": "0" * 64, "port": 80}, {"challenge": "0" * 64, "url": "http://e"}):
        assert house.client().post("/sign-ins", json=wrong).status_code == 422


def test_no_row_contains_a_secret(house: Server) -> None:
    link(house)
    person = Person(house)
    back = parse_qs(urlsplit(person.sign_in()).query)
    cookie = person.browser.cookies["marey-sign-in"]
    rows = house.database.read(SYSTEM, lambda tx: str(tx.execute(browser_sign_in.select()).all()))
    for secret in (person.verifier, cookie, back["state"][0]):
        assert secret not in rows


def test_nobody_is_let_in_by_a_name_or_as_a_disabled_user(house: Server, provider: FakeProvider) -> None:
    admin = link(house)
    provider.claims = {"sub": "sub-eve; rm -rf 'x'", "preferred_username": "ada", "email": "ada@lab.example"}
    refused = Person(house).finish()
    assert refused.status_code == 403
    assert "marey user link NAME" in refused.text
    assert "<script" not in refused.text
    house.make_user("eve")
    taken = admin.post("/users/eve/identities", json={"subject": "sub-ada"})
    assert (taken.status_code, taken.json()["code"]) == (409, "identity-linked")

    provider.claims = {"sub": "sub-ada"}
    waiting = Person(house)
    code = code_on(waiting.finish())
    assert admin.delete("/users/ada", headers={"If-Match": "*"}).status_code == 204
    assert waiting.redeem(code).json()["code"] == "user-disabled"
    assert Person(house).finish().status_code == 403


@ON_SQLITE
def test_only_administrators_link_people(house: Server) -> None:
    link(house)
    ben = house.client(house.make_user("ben"))
    assert ben.get("/users/ben/identities").json()["items"] == []
    assert ben.get("/users/ada/identities").status_code == 404
    assert ben.post("/users/ben/identities", json={"subject": "sub-eve"}).status_code in (403, 404)
    assert ben.delete("/users/ada/identities/identity_x").status_code in (403, 404)


def test_unknown_people_become_users_only_if_the_operator_wants_it(
    database: Database, tmp_path: Path, provider: FakeProvider
) -> None:
    allowed = {"oidc_allowed_claim": "groups", "oidc_allowed_values": ("mocap",)}
    with serving(database, tmp_path, provider, oidc_creates_users=True, **allowed) as server:
        assert Person(server).finish().status_code == 403
        provider.claims |= {"groups": ["staff", "mocap"], "name": "Ada\0 \ud83d<b>L</b>"}
        person = Person(server)
        me = server.client(person.redeem(code_on(person.finish())).json()["secret"]).get("/me").json()
        assert (me["user"]["name"], me["user"]["display_name"]) == ("ada", "Ada <b>L</b>")
        assert not me["user"]["administrator"]
        provider.claims["sub"] = "somebody else with the same name"
        assert Person(server).finish().status_code == 409
        provider.claims["preferred_username"] = "Zoë!"
        assert "no valid user name for you" in Person(server).finish().text


@ON_SQLITE
def test_new_keys_of_the_provider_are_read_once(
    house: Server, provider: FakeProvider, monkeypatch: pytest.MonkeyPatch
) -> None:
    link(house)
    assert Person(house).finish().status_code == 200
    provider.key = rsa_key("second")
    provider.listed = [rsa_key("second")]
    assert "does not list" in Person(house).finish().text  # read a moment ago
    assert provider.requests.count("/keys") == 1
    monkeypatch.setattr(identity_provider, "REFETCH_S", 0.0)
    assert Person(house).finish().status_code == 200
    assert provider.requests.count("/keys") == 2
    provider.key = ec_key("of somebody else")
    assert Person(house).finish().status_code == 401
    assert provider.requests.count("/keys") == 3
    assert provider.requests.count("/.well-known/openid-configuration") == 1


@ON_SQLITE
@pytest.mark.parametrize("fault", ["status", "redirect", "huge", "slow", "text", "list", "issuer", "down"])
def test_a_faulty_provider_gives_a_clear_error_and_keeps_nobody_else_waiting(
    house: Server, provider: FakeProvider, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identity_provider, "PROVIDER_TIMEOUT_S", 1.0)
    provider.fault = fault
    if fault == "down":
        with socket.create_server(("127.0.0.1", 0)) as closed:
            port = closed.getsockname()[1]
        found = house.app.services.identity_provider
        assert found is not None
        found.issuer = f"http://127.0.0.1:{port}"
    person = Person(house)
    begun_s = time.monotonic()
    answer = person.browser.get(person.begun["url"])
    assert (answer.status_code, answer.headers["Content-Type"]) == (503, "text/html; charset=utf-8")
    assert "discovery document of the identity provider cannot be used" in answer.text
    assert time.monotonic() - begun_s < 30
    assert len(provider.requests) == (0 if fault == "down" else 1)
    person.browser.get(person.begun["url"])
    assert len(provider.requests) <= 1  # the failure is remembered
    assert house.client().get("/me").status_code == 401


@ON_SQLITE
@pytest.mark.parametrize("fault", ["status", "slow", "text"])
def test_a_provider_that_fails_later_ends_the_sign_in(
    house: Server, provider: FakeProvider, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    link(house)
    person = Person(house)
    back = person.sign_in()
    provider.fault = fault
    with monkeypatch.context() as impatient:
        if fault == "slow":  # other answers may take as long as they need on a busy machine
            impatient.setattr(identity_provider, "PROVIDER_TIMEOUT_S", 1.0)
        answer = person.browser.get(back)
    assert answer.status_code == 503
    assert "answer with the ID token" in answer.text
    provider.fault, provider.error = "", "access_denied"
    denied = Person(house).finish()
    assert denied.status_code == 401
    assert "access_denied" in denied.text
    provider.error = ""
    provider.claims["aud"] = "another client"
    assert "the claim aud of the token does not have the expected value" in Person(house).finish().text


@ON_SQLITE
def test_without_a_provider_there_is_nothing_to_begin(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path) as server:
        answer = server.client().post("/sign-ins", json={"challenge": "0" * 64})
        assert (answer.status_code, answer.json()["code"]) == (404, "no-identity-provider")
