"""Every route times every role, from the route table itself: who may do what, and that nothing private leaks."""

import hashlib
from dataclasses import dataclass
from typing import Any

import httpx
import pytest
from sqlalchemy import select
from tests.support.rest_server import ALL_SCOPES, Server

from marey_schemas.access import Role
from marey_server.handlers.catalogue import RESOURCES
from marey_server.http.declarations import Access, writes
from marey_server.store import projects
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import project
from marey_server.store.transaction import Transaction

CANARY = "canary-5e0f2b"
ROLES = ("none", "stranger", "reader", "contributor", "maintainer", "owner", "admin", "attempt")
RANK = {role: rank for rank, role in enumerate(("reader", "contributor", "maintainer", "owner"))}
REFUSALS = {
    "unauthenticated", "bad-token", "no-project", "insufficient-role", "insufficient-scope", "scope-missing",
    "administrators-only", "attempt-only", "not-for-attempts", "users-only", "forbidden", "no-user", "no-job",
    "no-blob", "no-attempt", "not-yours",
}  # fmt: skip
"""Problem codes that say: you may not, or you may not know."""

HIERARCHY = {"schema": "marey/skeleton@1", "joints": [{"name": CANARY, "parent": -1, "offset": [0, 1, 0]}]}
MOTION = {
    "schema": "marey/motion@1",
    "frame_rate_hz": 30,
    "joints": [CANARY],
    "poses": {"dtype": "<f4", "shape": [1, 7], "data": [[0, 1, 0, 1, 0, 0, 0]]},
}
SECRET_BYTES = f"{CANARY} bytes".encode()
SECRET_DIGEST = f"sha256:{hashlib.sha256(SECRET_BYTES).hexdigest()}"
OTHER_BYTES = b"bytes of anybody"
OTHER_DIGEST = f"sha256:{hashlib.sha256(OTHER_BYTES).hexdigest()}"
MULTIPART = b"--b\r\nContent-Disposition: form-data; name=files; filename=x.bvh\r\n\r\nno motion\r\n--b--\r\n"

BODIES = {
    "Login": {"name": "nobody", "password": "wrong wrong wrong"},
    "TokenCreate": {"name": "t", "scopes": ["read"]},
    "UserCreate": {"name": "new-user"},
    "UserChange": {"display_name": "D"},
    "ProjectCreate": {"name": "lab"},  # taken: 409 tells that the caller was let through
    "ProjectChange": {"title": "T"},
    "MemberChange": {"role": "reader"},
    "CollectionCreate": {"path": CANARY},
    "CollectionChange": {"path": "elsewhere"},
    "ItemCreate": {"name": CANARY, "collection": CANARY, "parts": {"hierarchy": HIERARCHY}},
    "PartsRequest": {"parts": [{"kind": "clip", "item": "item_of_nobody", "revision": 1, "part": "info"}]},
    "ItemChange": {"name": "renamed"},
    "Document": {"schema": "marey/clip-info@1", "comment": CANARY},
    "JobCreate": {"kind": "no-such-kind"},
    "JobBatch": {"jobs": [{"kind": "no-such-kind"}]},
    "PipelineCreate": {"steps": {"only": {"kind": "no-such-kind"}}},
    "ClaimRequest": {"worker": "w", "kinds": ["no-such-kind"]},
    "BatchCompleteRequest": {"completions": [{"job": "job_x", "fence": 1, "write_id": "12345678"}]},
    "Heartbeat": {},
    "StageRequest": {
        "outputs": [{"name": "o", "kind": "skeleton", "item_name": "s", "parts": {"hierarchy": HIERARCHY}}]
    },
    "CompleteRequest": {"write_id": "12345678"},
    "FailRequest": {"write_id": "12345678", "code": "x"},
    "BlobsQuery": {"digests": [SECRET_DIGEST]},
    "UploadCreate": {"length": 5},
    "CoverageStreamCreate": {"frame_rate_hz": 60},
    "CoverageFrames": {"offset": 0, "ends_take": True},
    "AnnotationChange": {"commands": [{"command": "clear"}]},
    "AnnotationImport": {"document": {"sections": [{"start_idx": 0, "end_idx": 0}]}},
    "EditPreviewRequest": {"commands": [{"command": "trim", "start": 0, "stop": 1}]},
    "SearchRequest": {"constraints": [{"type": "root_heading", "at": "end", "heading_deg": 0}]},
}
"""A body for every model that a route takes; a route with a new one fails here until it gets one."""


@dataclass
class House:
    """A private project full of canaries, and one token per role."""

    server: Server
    tokens: dict[str, str | None]
    variables: dict[str, str]


@pytest.fixture
def house(server: Server) -> House:
    """A private project full of canaries, and one token per role."""
    tokens: dict[str, str | None] = {"none": None, "stranger": server.make_user("stranger")}
    for name in ("reader", "contributor", "maintainer"):
        tokens[name] = server.make_user(name)
    tokens["admin"] = server.make_user("root", administrator=True, scopes=ALL_SCOPES)
    members = {name: Role(name) for name in ("reader", "contributor", "maintainer")}
    tokens["owner"] = server.make_project("lab", owner="owner", **members)
    owner = server.client(tokens["owner"])
    etag = owner.get("/projects/lab").headers["ETag"]
    assert owner.patch("/projects/lab", json={"description": CANARY}, headers={"If-Match": etag}).is_success
    assert owner.put(f"/blobs/{SECRET_DIGEST}", content=SECRET_BYTES).is_success
    collection = owner.post("/projects/lab/collections", json={"path": CANARY}).json()["id"]
    body = {"name": CANARY, "collection": CANARY, "parts": {"hierarchy": HIERARCHY}}
    skeleton = owner.post("/projects/lab/skeletons", json=body).json()["id"]
    info = {"schema": "marey/clip-info@1", "comment": CANARY, "source": {"file": SECRET_DIGEST, "file_name": CANARY}}
    motion = {**MOTION, "skeleton": {"item": skeleton, "revision": 1}}
    made = owner.post("/projects/lab/clips", json={"name": CANARY, "parts": {"motion": motion, "info": info}})
    assert made.status_code == 201, made.text
    layer = {"schema": "marey/annotation@1", "clip": {"item": made.json()["id"], "revision": 1}, "layer": CANARY}
    annotation = owner.post("/projects/lab/annotations", json={"name": CANARY, "parts": {"annotation": layer}})
    assert annotation.status_code == 201, annotation.text
    contributor = server.client(tokens["contributor"])
    job = contributor.post(
        "/projects/lab/jobs", json={"kind": "export", "inputs": {"clips": [{"item": made.json()["id"]}]}}
    )
    assert job.status_code == 202, job.text
    stream = contributor.post("/projects/lab/coverage-streams", json=BODIES["CoverageStreamCreate"])
    assert stream.status_code == 201, stream.text
    worker = server.client(server.make_user("worker", administrator=True, scopes=("work",)))
    lease = worker.post("/leases", json={"worker": "w", "kinds": ["export"]}).json()["leases"][0]
    assert owner.post("/projects", json={"name": "gone"}).is_success
    for name in ("reader", "contributor", "maintainer"):
        assert owner.put(f"/projects/gone/members/{name}", json={"role": name}).is_success
    tokens["attempt"] = lease["attempt_token"]
    variables = {
        "project": "lab", "collection": collection, "kind": "clips", "item": made.json()["id"], "part": "info",
        "revision": "1", "user": "reader", "job": lease["job"], "fence": str(lease["fence"]), "digest": SECRET_DIGEST,
        "job_kind": "import", "figure": "offsets", "stream": stream.json()["id"],
        "token": "token_of_nobody", "upload": "upload_of_nobody", "annotation": annotation.json()["id"],
    }  # fmt: skip
    return House(server, tokens, variables)


def send(house: House, route: tuple[Any, ...], role: str) -> httpx.Response:
    """The request of a route, with everything right but perhaps the caller."""
    operation, variables = route[1], dict(house.variables)
    headers: dict[str, str] = {}
    content: dict[str, Any] = {}
    template = route[0].template()
    if "/users/" in template and house.tokens[role]:
        variables["user"] = {"admin": "root", "attempt": "owner"}.get(role, role)
    if template.endswith("{project}/restore"):
        variables["project"] = "gone"
        house.server.client(house.tokens["owner"]).delete("/projects/gone", headers={"If-Match": "*"})
    if operation.precondition != "none":
        headers["If-Match"] = '"999999.json"'
    if operation.body is not None:
        name = operation.body.content.__name__
        if name == "Bytes":
            variables["digest"] = OTHER_DIGEST
            content = {"content": OTHER_BYTES}
            headers["Upload-Offset"] = "0"
        elif name == "Files":
            content = {"content": MULTIPART}
            headers["Content-Type"] = "multipart/form-data; boundary=b"
        else:
            content = {"json": BODIES[name]}
    if template.endswith("/{kind}") and operation.method == "POST":
        variables["kind"] = "skeletons"
    if template.endswith("/commands"):
        variables |= {"kind": "annotations", "item": variables["annotation"]}
    if template.endswith("/walk-graph"):
        variables |= {"kind": "evaluations", "item": "evaluation_of_nobody"}
    if "/samples" in template or "/search" in template:
        variables |= {"kind": "models", "item": "model_of_nobody"}
    address = house.server.address + template.format(**variables)
    query = {"format": "original"} if template.endswith("{item}/export") else {}
    client = house.server.client(house.tokens[role])
    if template.endswith("/logout") and role not in ("none", "attempt"):  # sign out of a session made for it
        client = house.server.client(client.post("/tokens", json=BODIES["TokenCreate"]).json()["secret"])
    return client.request(operation.method, address, params=query, headers=headers, **content)


def expected(access: Access, scope: str | None, role: str, public: bool) -> set[int] | None:
    """Statuses of a refusal; None where the caller must be let through."""
    if access is Access.ANYONE:
        return None
    if role == "none":
        return {401, 404} if access is Access.READER else {401}
    if access is Access.ATTEMPT:
        return None if role == "attempt" else {403}
    if role == "attempt":
        return None if access in (Access.SIGNED_IN, Access.READER) else {403, 404}
    if access is Access.WORKER or access is Access.ADMINISTRATOR:
        return None if role == "admin" else {403}
    if access.value not in RANK or role == "admin":
        return None
    if role == "stranger":
        return {404}
    return None if RANK[role] >= RANK[access.value] else {403}


ROUTES = [(resource, operation) for resource in RESOURCES for operation in resource.operations.values()]


def find_wrong_answers(house: House, routes: list[Any]) -> list[str]:
    """Send every route as every role; list the answers that differ from the declaration."""
    wrong = []
    for route in routes:
        resource, operation = route
        for role in ROLES:
            # An attempt ends when its own token completes or fails it; the routes that do are tried last.
            if role == "attempt" and resource.template().endswith(("/complete", "/fail")):
                continue
            answer = send(house, route, role)
            code = (
                answer.json().get("code") if answer.headers.get("Content-Type", "").endswith("problem+json") else None
            )
            refusal = expected(operation.access, operation.scope, role, operation.public)
            where = f"{operation.method} {resource.template()} as {role}: {answer.status_code} {code}"
            if answer.status_code >= 500:
                wrong.append(f"{where}: a fault: {answer.text[:300]}")
            elif refusal is None and code in REFUSALS and not is_about_nobody(resource, role, code):
                wrong.append(f"{where}: should be let through: {answer.text[:300]}")
            elif refusal is not None and (answer.status_code not in refusal or code not in REFUSALS | {"not-found"}):
                wrong.append(f"{where}: should be refused with {sorted(refusal)}: {answer.text[:300]}")
            if (refusal is not None or role in ("none", "stranger")) and CANARY in answer.text:
                wrong.append(f"{where}: a private byte leaked")
    return wrong


def test_every_route_lets_in_whom_it_declares_and_nobody_else(house: House) -> None:
    """One test for the whole table: a house full of canaries is built once per database."""
    wrong = find_wrong_answers(house, ROUTES)
    assert not wrong, "\n".join(wrong)


def test_a_store_that_checks_no_role_is_found(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control: members are changed without asking for the caller's role, and the walk reports it."""
    routes = [route for route in ROUTES if route[0].path == "/projects/{project}/members/{user}"]
    assert not find_wrong_answers(house, routes)

    def see_without_asking(tx: Transaction, name: str, **_kwargs: Any) -> ProjectRow:
        return projects.find_by_id(tx, tx.execute(select(project.c.id).where(project.c.name == name)).scalar_one())

    monkeypatch.setattr(projects, "require", see_without_asking)
    wrong = find_wrong_answers(house, routes)
    assert any("PUT" in line and "as reader" in line and "should be refused" in line for line in wrong), wrong
    assert any("GET" in line and "as stranger" in line and "should be refused" in line for line in wrong), wrong


def test_only_these_routes_ask_for_more_than_a_contributor() -> None:
    """A second home on purpose: whoever lowers the role of one of them changes this list, too."""
    high = {
        f"{operation.method} {resource.path}": operation.access.value
        for resource, operation in ROUTES
        if operation.access in (Access.MAINTAINER, Access.OWNER, Access.ADMINISTRATOR)
    }
    assert high == {
        "GET /users": "administrator",
        "POST /users": "administrator",
        "DELETE /users/{user}": "administrator",
        "PATCH /projects/{project}": "owner",
        "DELETE /projects/{project}": "owner",
        "POST /projects/{project}/restore": "owner",
        "PUT /projects/{project}/members/{user}": "owner",
        "DELETE /projects/{project}/members/{user}": "owner",
        "DELETE /projects/{project}/collections/{collection}": "maintainer",
        "POST /projects/{project}/collections/{collection}/restore": "maintainer",
        "DELETE /projects/{project}/{kind}/{item}": "maintainer",
        "POST /projects/{project}/{kind}/{item}/restore": "maintainer",
    }


def test_a_change_cannot_be_declared_for_readers() -> None:
    with pytest.raises(TypeError, match="contributor"):
        writes(access=Access.READER)


def is_about_nobody(resource: Any, role: str, code: str) -> bool:
    """Sign-in with a wrong password is refused whoever asks; it says nothing about the caller."""
    return resource.template().endswith("/login")


def test_an_attempt_ends_with_its_own_token_and_no_other(house: House) -> None:
    template = "/jobs/{job}/attempts/{fence}/fail".format(**house.variables)
    body = {"write_id": "12345678", "code": "gave-up"}
    for role in ROLES:
        if role != "attempt":
            assert house.server.client(house.tokens[role]).post(template, json=body).status_code in (401, 403)
    attempt = house.server.client(house.tokens["attempt"])
    assert attempt.post(template, json=body).status_code == 200
    assert attempt.get("/projects/lab").status_code in (401, 404)


def test_a_public_project_is_read_by_everybody_but_not_its_members_and_events(house: House) -> None:
    owner = house.server.client(house.tokens["owner"])
    etag = owner.get("/projects/lab").headers["ETag"]
    owner.patch("/projects/lab", json={"visibility": "public"}, headers={"If-Match": etag})
    for token in (None, house.tokens["stranger"]):
        guest = house.server.client(token)
        item = house.variables["item"]
        assert guest.get("/projects/lab").status_code == 200
        assert guest.get(f"/projects/lab/clips/{item}/parts/info").json()["comment"] == CANARY
        assert guest.get(f"/blobs/{SECRET_DIGEST}").content == SECRET_BYTES
        for closed in ("members", "events"):
            assert guest.get(f"/projects/lab/{closed}").status_code in (401, 403)
        refused = guest.patch(f"/projects/lab/clips/{item}", json={"name": "x"}, headers={"If-Match": "*"})
        assert refused.status_code in (401, 403)


@pytest.mark.parametrize("scope", ["read", "write", "jobs", "read!project=lab", "write!project=other"])
def test_a_token_allows_no_more_than_its_scopes(house: House, scope: str) -> None:
    owner = house.server.client(house.tokens["owner"])
    made = owner.post("/tokens", json={"name": "narrow", "scopes": [scope]})
    assert made.status_code == 201
    narrow = house.server.client(made.json()["secret"])
    item = house.variables["item"]
    reads = narrow.get(f"/projects/lab/clips/{item}").status_code
    writes = narrow.post("/projects/lab/collections", json={"path": "made-by-narrow"}).status_code
    assert reads == 200 if scope.startswith("read") else reads in (403, 404)
    assert writes == 201 if scope == "write" else writes in (403, 404)


def test_nobody_makes_a_token_that_reaches_further_than_his_own(house: House) -> None:
    reader = house.server.client(house.tokens["reader"])
    made = reader.post("/tokens", json={"name": "more", "scopes": ["admin"]})
    assert made.status_code == 403


def test_a_revoked_token_stops_working_at_once(house: House) -> None:
    reader = house.server.client(house.tokens["reader"])
    assert reader.post("/logout").status_code == 204
    assert reader.get("/me").status_code == 401
