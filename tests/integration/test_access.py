"""Requests to every route by every kind of caller: rights, and no leaks of content.

The table of routes gives the requests.
"""

import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import select
from tests.support.furnished_house import BODIES, CANARY, ROUTES, SECRET_BYTES, SECRET_DIGEST, House, build_house
from tests.support.rest_server import Server, running
from tests.support.tiers import is_soak
from tests.support.who_may import LET_THROUGH, PEOPLE, Person, verdict

from marey_server.http.declarations import Access, writes
from marey_server.http.routes import Route
from marey_server.store import projects
from marey_server.store.database.connections import Database
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import project
from marey_server.store.transaction import Transaction

REFUSALS = {
    "unauthenticated", "bad-token", "no-project", "insufficient-role", "insufficient-scope",
    "administrators-only", "attempt-only", "not-for-attempts", "not-for-participants", "participants-only",
    "users-only", "forbidden", "no-user", "no-job", "no-blob", "no-attempt", "not-yours", "lease-lost",
}  # fmt: skip
"""Codes of problems which mean that the caller may not do something, or may not know about it."""
GUESSES = 3


@pytest.fixture
def house(server: Server) -> House:
    """A private project with marked contents, and one token for each kind of caller."""
    return build_house(server)


def send(house: House, route: Route, role: str) -> httpx.Response:
    """Send the request of a route as one kind of caller, and return the answer."""
    template, token = route.template, house.tokens[role]
    own = {"attempt": "owner", "ended": "contributor"}.get(role, role)
    changed = {"user": own} if "/users/" in template and token else {}
    if template.endswith("{project}/restore"):
        house.people.client(house.tokens["owner"]).delete("/projects/gone", headers={"If-Match": "*"})
    request = house.plan(route, **changed)
    client = house.people.client(token)
    if template.endswith("/logout") and PEOPLE[role].standing == "user":  # sign out of a session made for it
        made = client.post("/tokens", json=BODIES["TokenCreate"])
        client = house.people.client(made.json()["secret"]) if made.is_success else client
    address = house.people.address + request.path
    return client.request(request.method, address, headers=request.headers, content=request.content)


def all_callers(_route: Route) -> tuple[str, ...]:
    """Return all kinds of callers."""
    return tuple(PEOPLE)


def some_callers(route: Route) -> tuple[str, ...]:
    """Return the kinds of callers that send the request of a route in the tiers `check` and `test`.

    They include everybody with a lower role than the route requires, and whoever has just this role. One of each of the
    following groups is chosen, which differs between routes: callers whose credentials are refused, users without a
    role in the project, and callers with higher roles than required. At routes for anyone, credentials that only other
    routes refuse are left out.
    """
    number = zlib.crc32(f"{route.operation.method} {route.template}".encode())
    standings = {role: person.standing for role, person in PEOPLE.items()}
    refused = [role for role, standing in standings.items() if standing == "refused"]
    admitted = [
        role
        for role, person in PEOPLE.items()
        if person.standing == "user" and person.rank >= 0 and verdict(person, route.operation) == LET_THROUGH
    ]
    left_out = set[str]()
    for alike in (refused, ["stranger", "bound"], admitted[1:]):
        left_out |= {role for at, role in enumerate(alike) if at != number % len(alike)}
    if route.operation.access is Access.ANYONE:
        left_out |= {"stranger", "bound", "worker", "ended"}
    return tuple(role for role in PEOPLE if role not in left_out)


def renew_lease(house: House) -> None:
    """Renew the lease of the attempt, which ends before the last route if the machine is busy."""
    template = "/jobs/{job}/attempts/{fence}/heartbeat".format(**house.variables)
    assert house.people.client(house.tokens["attempt"]).post(template, json={}).status_code == 200


def find_wrong_answers(
    house: House, routes: tuple[Route, ...], callers: Callable[[Route], tuple[str, ...]]
) -> list[str]:
    """Send the request of every route as each of its callers; return answers that contradict the declarations."""
    wrong = []
    for route in routes:
        operation = route.operation
        renew_lease(house)
        for role in callers(route):
            person = PEOPLE[role]
            # An attempt ends when its own token completes or fails it; the routes that do are tried elsewhere.
            if role == "attempt" and route.template.endswith(("/complete", "/fail")):
                continue
            if role == "attempt" and route.template.endswith("{project}/restore"):
                continue  # it restores another project than that of the attempt
            if route.template.endswith("/logout") and person.standing == "user" and "write" not in person.scopes:
                continue  # nothing would be left of the only token of this kind
            answer = send(house, route, role)
            code = (
                answer.json().get("code") if answer.headers.get("Content-Type", "").endswith("problem+json") else None
            )
            refusal = verdict(person, operation)
            where = f"{operation.method} {route.template} as {role}: {answer.status_code} {code}"
            if answer.status_code >= 500:
                wrong.append(f"{where}: a fault: {answer.text[:300]}")
            elif refusal == LET_THROUGH and code in REFUSALS and not is_about_nobody(person, route):
                wrong.append(f"{where}: should be let through: {answer.text[:300]}")
            elif refusal and (answer.status_code not in refusal or code not in REFUSALS | {"not-found"}):
                wrong.append(f"{where}: should be refused with {sorted(refusal)}: {answer.text[:300]}")
            named = person.standing in ("attempt", "participant")  # what it may read names the canary
            if (refusal or (person.rank < 0 and not named)) and person.standing != "attempt" and CANARY in answer.text:
                wrong.append(f"{where}: a private byte leaked")
    return wrong


def test_every_route_lets_in_whom_it_declares_and_nobody_else(house: House) -> None:
    """One test covers the whole table, so that the project with its contents is created once per database."""
    wrong = find_wrong_answers(house, ROUTES, all_callers if is_soak() else some_callers)
    assert not wrong, "\n".join(wrong)


def test_a_store_that_checks_no_role_is_found(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the test above fails if the server changes members without a check of the caller's role."""
    routes = tuple(route for route in ROUTES if route.resource.path == "/projects/{project}/members/{user}")
    assert not find_wrong_answers(house, routes, all_callers)

    def see_without_asking(tx: Transaction, name: str, **_kwargs: Any) -> ProjectRow:
        return projects.find_by_id(tx, tx.execute(select(project.c.id).where(project.c.name == name)).scalar_one())

    monkeypatch.setattr(projects, "require", see_without_asking)
    wrong = find_wrong_answers(house, routes, all_callers)
    assert any("PUT" in line and "as reader" in line and "should be refused" in line for line in wrong), wrong
    assert any("GET" in line and "as stranger" in line and "should be refused" in line for line in wrong), wrong


def test_only_these_routes_ask_for_more_than_a_contributor() -> None:
    """The list repeats the declarations of the routes. Whoever lowers a role there must also change it here."""
    high = {
        f"{route.operation.method} {route.resource.path}": route.operation.access.value
        for route in ROUTES
        if route.operation.access in (Access.MAINTAINER, Access.OWNER, Access.ADMINISTRATOR)
    }
    assert high == {
        "GET /users": "administrator",
        "POST /users": "administrator",
        "DELETE /users/{user}": "administrator",
        "PATCH /users/{user}/quotas": "administrator",
        "POST /users/{user}/identities": "administrator",
        "DELETE /users/{user}/identities/{identity}": "administrator",
        "PATCH /projects/{project}/quotas": "administrator",
        "GET /audit": "administrator",
        "GET /workers": "administrator",
        "GET /projects/{project}/audit": "owner",
        "PATCH /projects/{project}": "owner",
        "DELETE /projects/{project}": "owner",
        "POST /projects/{project}/restore": "owner",
        "PUT /projects/{project}/members/{user}": "owner",
        "DELETE /projects/{project}/members/{user}": "owner",
        "GET /invitations": "administrator",
        "POST /invitations": "administrator",
        "DELETE /invitations/{invitation}": "administrator",
        "GET /projects/{project}/invitations": "owner",
        "POST /projects/{project}/invitations": "owner",
        "DELETE /projects/{project}/invitations/{invitation}": "owner",
        "GET /projects/{project}/webhooks": "owner",
        "POST /projects/{project}/webhooks": "owner",
        "GET /projects/{project}/webhooks/{webhook}": "owner",
        "PATCH /projects/{project}/webhooks/{webhook}": "owner",
        "DELETE /projects/{project}/webhooks/{webhook}": "owner",
        "POST /projects/{project}/webhooks/{webhook}/rotate": "owner",
        "POST /projects/{project}/webhooks/{webhook}/test": "owner",
        "GET /projects/{project}/webhooks/{webhook}/deliveries": "owner",
        "GET /projects/{project}/webhooks/{webhook}/deliveries/{delivery}": "owner",
        "POST /projects/{project}/webhooks/{webhook}/deliveries/{delivery}/redeliver": "owner",
        "POST /projects/{project}/skeleton-merges": "maintainer",
        "POST /projects/{project}/purges": "owner",
        "POST /projects/{project}/dataset-purges": "owner",
        "PUT /projects/{project}/collections/{collection}/roles/{user}": "owner",
        "DELETE /projects/{project}/collections/{collection}/roles/{user}": "owner",
        "POST /projects/{project}/scripts": "maintainer",
        "GET /projects/{project}/{kind}/{item}/participants": "maintainer",
        "POST /projects/{project}/{kind}/{item}/participants": "maintainer",
        "DELETE /projects/{project}/{kind}/{item}/participants/{participant}": "maintainer",
        "GET /projects/{project}/{kind}/{item}/judgements": "maintainer",
        "GET /projects/{project}/{kind}/{item}/differences": "maintainer",
        "DELETE /projects/{project}/scripts/{script}": "maintainer",
        "DELETE /projects/{project}/collections/{collection}": "maintainer",
        "POST /projects/{project}/collections/{collection}/restore": "maintainer",
        "DELETE /projects/{project}/datasets/{dataset}": "maintainer",
        "DELETE /projects/{project}/datasets/{dataset}/refs/{ref}": "maintainer",
        "PATCH /projects/{project}/datasets/{dataset}/refs/{ref}": "maintainer",
        "PUT /projects/{project}/datasets/{dataset}/refs/{ref}/protection": "maintainer",
        "DELETE /projects/{project}/datasets/{dataset}/refs/{ref}/protection": "maintainer",
        "POST /projects/{project}/datasets/{dataset}/checkout": "maintainer",
        "POST /projects/{project}/datasets/{dataset}/contents": "maintainer",
        "POST /projects/{project}/datasets/{dataset}/received-commits": "maintainer",
        "DELETE /projects/{project}/{kind}/{item}": "maintainer",
        "POST /projects/{project}/{kind}/{item}/restore": "maintainer",
    }


def test_a_change_cannot_be_declared_for_readers() -> None:
    with pytest.raises(TypeError, match="contributor"):
        writes(access=Access.READER)


def is_about_nobody(person: Person, route: Route) -> bool:
    """Return whether the reason of a refusal is a wrong password or an unneeded credential, not the caller's rights."""
    operation = route.operation
    useless = person.standing == "refused" or not person.has(operation.scope)
    return operation.access is Access.ANYONE and (useless or route.template.endswith("/login"))


def test_an_attempt_ends_with_its_own_token_and_no_other(house: House) -> None:
    template = "/jobs/{job}/attempts/{fence}/fail".format(**house.variables)
    body = {"write_id": "12345678", "code": "gave-up"}
    for role in PEOPLE:
        if role != "attempt":
            refused = house.people.client(house.tokens[role]).post(template, json=body)
            assert refused.status_code in ((404,) if role == "ended" else (401, 403)), (role, refused.text)
    attempt = house.people.client(house.tokens["attempt"])
    assert attempt.post(template, json=body).status_code == 200
    assert attempt.get("/projects/lab").status_code == 409


def test_a_public_project_is_read_by_everybody_but_not_its_members_and_events(house: House) -> None:
    owner = house.people.client(house.tokens["owner"])
    etag = owner.get("/projects/lab").headers["ETag"]
    owner.patch("/projects/lab", json={"visibility": "public"}, headers={"If-Match": etag})
    for token in (None, house.tokens["stranger"]):
        guest = house.people.client(token)
        item = house.variables["item"]
        assert guest.get("/projects/lab").status_code == 200
        assert guest.get(f"/projects/lab/clips/{item}/parts/info").json()["comment"] == CANARY
        assert guest.get(f"/blobs/{SECRET_DIGEST}").content == SECRET_BYTES
        for closed in ("members", "events"):
            assert guest.get(f"/projects/lab/{closed}").status_code in (401, 403)
        refused = guest.patch(f"/projects/lab/clips/{item}", json={"name": "x"}, headers={"If-Match": "*"})
        assert refused.status_code in (401, 403)


def test_a_token_allows_no_more_than_its_scopes(house: House) -> None:
    owner = house.people.client(house.tokens["owner"])
    assert owner.post("/projects", json={"name": "other"}).status_code == 201
    for scope in ("read", "write", "jobs", "read!project=lab", "write!project=other"):
        made = owner.post("/tokens", json={"name": "narrow", "scopes": [scope]})
        assert made.status_code == 201, scope
        narrow = house.people.client(made.json()["secret"])
        item = house.variables["item"]
        reads = narrow.get(f"/projects/lab/clips/{item}").status_code
        writes = narrow.post("/projects/lab/collections", json={"path": f"made with {scope}"}).status_code
        assert reads == 200 if scope.startswith("read") else reads in (403, 404), scope
        assert writes == 204 if scope == "write" else writes in (403, 404), scope


def test_a_worker_token_reaches_no_further_than_its_labels(house: House) -> None:
    owner, chief = (house.people.client(house.tokens[role]) for role in ("owner", "administrator"))
    clip = {"item": house.variables["item"]}
    job = {"kind": "export", "inputs": {"clips": [clip]}, "cache": "off"}
    needs = {site: {**job, "labels": {"site": site}} for site in ("lyon", "paris")}
    jobs = {site: owner.post("/projects/lab/jobs", json=body).json()["id"] for site, body in needs.items()}
    made = chief.post("/tokens", json={"name": "lyon", "scopes": ["work"], "labels": {"site": "lyon"}})
    assert (made.status_code, made.json()["labels"]) == (201, {"site": "lyon"})
    worker = house.people.client(made.json()["secret"])
    claim = {"worker": "w", "kinds": ["export"], "max": 9}
    refused = worker.post("/leases", json={**claim, "labels": {"site": "paris"}})
    assert (refused.status_code, refused.json()["code"]) == (403, "label-not-allowed")
    assert refused.json()["context"] == {"label": "site=paris"}
    leases = worker.post("/leases", json={**claim, "labels": {"site": "lyon"}}).json()["leases"]
    assert jobs["lyon"] in [lease["job"] for lease in leases]
    assert jobs["paris"] not in [lease["job"] for lease in leases]
    pointless = chief.post("/tokens", json={"name": "x", "scopes": ["read"], "labels": {"site": "lyon"}})
    assert (pointless.status_code, pointless.json()["errors"][0]["pointer"]) == (422, "/labels")


def test_a_worker_rotates_its_token_which_no_other_token_can(house: House) -> None:
    worker, chief = (house.people.client(house.tokens[role]) for role in ("worker", "administrator"))
    own = worker.get("/me").json()["token"]
    rotation = {"rotation_id": "0123456789abcdef" * 2}
    for client in (chief, house.people.client(house.tokens["attempt"])):
        assert client.post(f"/tokens/{own}/rotate", json=rotation).status_code == 403
    answers = [worker.post(f"/tokens/{own}/rotate", json=rotation) for _ in range(2)]
    assert {(one.status_code, one.headers["Cache-Control"]) for one in answers} == {(200, "no-store")}
    first, again = (one.json() for one in answers)
    assert first == again
    assert (first["scopes"], first["successor_of"]) == (["work"], own)
    successor = house.people.client(first["secret"])
    assert successor.get("/me").json()["token"] == first["id"]
    assert successor.post("/leases", json=BODIES["ClaimRequest"]).status_code == 200
    refused = worker.post(f"/tokens/{own}/rotate", json={"rotation_id": "f" * 32})
    assert (refused.status_code, refused.json()["code"]) == (409, "token-rotated")
    for wrong in ({}, {"rotation_id": "short"}, {"rotation_id": "0 " * 20}, {**rotation, "grace_s": 59}):
        assert worker.post(f"/tokens/{own}/rotate", json=wrong).status_code == 422


def test_guesses_of_project_names_are_limited_and_then_no_answer_tells_one(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, name_guesses_per_hour=GUESSES) as server:
        owner, guesser = server.client(server.make_project("secret")), server.client(server.make_user("eve"))
        chief = server.client(server.make_user("root", administrator=True, scopes=("read", "write", "admin")))
        for _ in range(2 * GUESSES):  # a name that is known is no guess
            for client in (owner, chief):
                assert client.post("/projects", json={"name": "secret"}).status_code == 409
        assert guesser.post("/projects", json={"name": "mine"}).status_code == 201
        assert guesser.post("/projects", json={"name": "mine"}).status_code == 409
        with ThreadPoolExecutor(3 * GUESSES) as threads:
            guess = partial(guesser.post, "/projects", json={"name": "secret"})
            answers = [one.result() for one in [threads.submit(guess) for _ in range(3 * GUESSES)]]
        assert sorted(one.status_code for one in answers) == [409] * GUESSES + [429] * 2 * GUESSES
        taken, free = (guesser.post("/projects", json={"name": name}) for name in ("secret", "free"))
        assert taken.json()["code"] == free.json()["code"] == "too-many-names"
        assert 0 < int(free.headers["Retry-After"]) <= 3600 // GUESSES
        assert taken.json()["detail"].partition(" in ")[0] == free.json()["detail"].partition(" in ")[0]
        assert owner.post("/projects", json={"name": "free"}).status_code == 201


def test_who_may_write_but_not_read_does_not_see_what_they_change(house: House) -> None:
    owner = house.people.client(house.tokens["owner"])
    assert owner.patch("/projects/lab", json={"description": CANARY}, headers={"If-Match": "*"}).status_code == 200
    item = f"/projects/lab/clips/{house.variables['item']}"
    both = ["read!project=lab", "write!project=lab"]
    for scopes, status in (
        (["write"], 204),
        (["write!project=lab"], 204),
        (["write!project=lab", "jobs"], 204),
        (both, 200),
    ):
        made = owner.post("/tokens", json={"name": "writer", "scopes": scopes})
        writer = house.people.client(made.json()["secret"])
        for path in ("/projects/lab", item):
            changed = writer.patch(path, json={}, headers={"If-Match": "*"})
            assert changed.status_code == status
            assert bool(changed.content) == (status == 200)
            assert changed.headers["ETag"].count(".") == (2 if status == 200 else 1)  # with a digest of the answer
        created = writer.post("/projects/lab/collections", json={"path": f"made/{'-'.join(scopes)}".replace("!", "")})
        assert created.status_code == (201 if status == 200 else 204)
        assert created.headers["Location"].startswith("/api/v1/projects/lab/collections/")


def test_nobody_makes_a_token_that_reaches_further_than_his_own(house: House) -> None:
    reader = house.people.client(house.tokens["reader"])
    made = reader.post("/tokens", json={"name": "more", "scopes": ["admin"]})
    assert made.status_code == 403


def test_a_revoked_token_stops_working_at_once(house: House) -> None:
    reader = house.people.client(house.tokens["reader"])
    assert reader.post("/logout").status_code == 204
    assert reader.get("/me").status_code == 401
