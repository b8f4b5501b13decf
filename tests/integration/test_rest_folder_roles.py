"""Roles in folders over REST: operations that they allow or forbid, and requests that set them."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import httpx
import pytest
from tests.support.furnished_house import BODIES, HIERARCHY, MOTION, MULTIPART, ROUTES
from tests.support.motion_files import AMC, ASF
from tests.support.rest_server import Server

from marey_schemas.access import Role
from marey_server.http.declarations import Access

FORM = {"Content-Type": "multipart/form-data; boundary=b"}
ANY = {"If-Match": "*"}


@dataclass
class Studio:
    """Project with the folders `team` and `other`, and two members, who may write in `team` only.

    `raised` is a reader with the role maintainer in `team`; `lowered` is a maintainer with the role reader in `other`.
    """

    server: Server
    owner: httpx.Client
    members: dict[str, httpx.Client]
    folders: dict[str, str] = field(default_factory=dict)
    clips: int = 0

    def clip(self, folder: str) -> str:
        """Create a clip as the owner; return its id."""
        self.clips += 1
        rig = self.make("skeletons", {"name": f"rig {self.clips}", "parts": {"hierarchy": HIERARCHY}})
        parts = {"motion": {**MOTION, "skeleton": {"item": rig, "revision": 1}}}
        return self.make("clips", {"name": f"clip {self.clips}", "collection": folder, "parts": parts})

    def layer(self, folder: str) -> str:
        """Create an annotation as the owner; return its id."""
        tree = {"schema": "marey/annotation@1", "clip": {"item": self.clip(""), "revision": 1}, "layer": "l"}
        name = f"layer {self.clips}"
        return self.make("annotations", {"name": name, "collection": folder, "parts": {"annotation": tree}})

    def folder(self, above: str) -> str:
        """Create a folder as the owner; return its id."""
        self.clips += 1
        return self.make("collections", {"path": f"{above}/folder {self.clips}"})

    def make(self, kind: str, body: dict[str, Any]) -> str:
        """Create something in the project as the owner; return its id."""
        made = self.owner.post(f"/projects/lab/{kind}", json=body)
        assert made.status_code == 201, made.text
        return str(made.json()["id"])

    def gone(self, path: str) -> str:
        """Delete the object at a path as the owner; return the path."""
        assert self.owner.delete(path, headers=ANY).status_code == 204
        return path


Sends = Callable[[Studio, httpx.Client, str], httpx.Response]
CLIPS, FOLDERS = "/projects/lab/clips", "/projects/lab/collections"
EXPORT = {"kind": "export", "cache": "off"}


def job_into(house: Studio, folder: str) -> dict[str, Any]:
    """Return the request for a job whose results go to a folder."""
    return {**EXPORT, "inputs": {"clips": [{"item": house.clip("")}]}, "into": folder}


REQUESTS: dict[str, Sends] = {
    "POST /projects/{project}/{kind}": lambda house, who, at: who.post(
        "/projects/lab/skeletons", json={"name": f"r {id(who)}", "collection": at, "parts": {"hierarchy": HIERARCHY}}
    ),
    "PATCH /projects/{project}/{kind}/{item}": lambda house, who, at: who.patch(
        f"{CLIPS}/{house.clip(at)}", json={"tags": ["t"]}, headers=ANY
    ),
    "DELETE /projects/{project}/{kind}/{item}": lambda house, who, at: who.delete(
        f"{CLIPS}/{house.clip(at)}", headers=ANY
    ),
    "POST /projects/{project}/{kind}/{item}/restore": lambda house, who, at: who.post(
        f"{house.gone(f'{CLIPS}/{house.clip(at)}')}/restore"
    ),
    "POST /projects/{project}/{kind}/{item}/revert": lambda house, who, at: who.post(
        f"{CLIPS}/{house.clip(at)}/revert", json={"revision": 1}, headers=ANY
    ),
    "PUT /projects/{project}/{kind}/{item}/parts/{part}": lambda house, who, at: who.put(
        f"{CLIPS}/{house.clip(at)}/parts/info", json={"schema": "marey/clip-info@1", "comment": "c"}, headers=ANY
    ),
    "POST /projects/{project}/{kind}/{item}/commands": lambda house, who, at: who.post(
        f"/projects/lab/annotations/{house.layer(at)}/commands",
        json={"commands": [{"command": "clear"}]},
        headers=ANY,
    ),
    "POST /projects/{project}/{kind}/{item}/annotations": lambda house, who, at: who.post(
        f"{CLIPS}/{house.clip(at)}/annotations", json={"document": {"sections": [{"start_idx": 0, "end_idx": 0}]}}
    ),
    "POST /projects/{project}/collections": lambda house, who, at: who.post(
        FOLDERS, json={"path": f"{at}/made by {id(who)}"}
    ),
    "PATCH /projects/{project}/collections/{collection}": lambda house, who, at: who.patch(
        f"{FOLDERS}/{house.folder(at)}", json={"path": f"team/moved from {at} by {id(who)}"}, headers=ANY
    ),
    "DELETE /projects/{project}/collections/{collection}": lambda house, who, at: who.delete(
        f"{FOLDERS}/{house.folder(at)}", headers=ANY
    ),
    "POST /projects/{project}/collections/{collection}/restore": lambda house, who, at: who.post(
        f"{house.gone(f'{FOLDERS}/{house.folder(at)}')}/restore"
    ),
    "POST /projects/{project}/imports": lambda house, who, at: who.post(
        "/projects/lab/imports",
        content=MULTIPART.replace(
            b"--b--", f"--b\r\nContent-Disposition: form-data; name=collection\r\n\r\n{at}\r\n--b--".encode()
        ),
        headers=FORM,
    ),
    "POST /projects/{project}/jobs": lambda house, who, at: who.post("/projects/lab/jobs", json=job_into(house, at)),
    "POST /projects/{project}/jobs/batch": lambda house, who, at: who.post(
        "/projects/lab/jobs/batch", json={"jobs": [job_into(house, "team"), job_into(house, at)]}
    ),
    "POST /projects/{project}/pipelines": lambda house, who, at: who.post(
        "/projects/lab/pipelines", json={"steps": {"only": job_into(house, at)}}
    ),
    "POST /projects/{project}/scripts/{script}/runs": lambda house, who, at: who.post(
        "/projects/lab/scripts/measure/runs", json={"into": at}
    ),
    "POST /projects/{project}/schedules": lambda house, who, at: schedule(who, job_into(house, at)),
    "PATCH /projects/{project}/schedules/{schedule}": lambda house, who, at: who.patch(
        own_schedule(house, who), json={"job": job_into(house, at)}
    ),
    "DELETE /projects/{project}/schedules/{schedule}": lambda house, who, at: who.delete(
        own_schedule(house, who if at == "team" else house.owner)
    ),
    "POST /jobs/{job}/cancel": lambda house, who, at: who.post(
        f"/jobs/{own_job(house, who if at == 'team' else house.owner)}/cancel"
    ),
    "POST /jobs/{job}/retry": lambda house, who, at: who.post(
        f"/jobs/{cancelled(house, who if at == 'team' else house.owner)}/retry"
    ),
}
"""For each operation that a role in a folder allows or forbids: a function that sends the operation for a folder.

Jobs and schedules are in no folder. So the last three functions use a job or a schedule of `who` in place of one in
`team`, and one of the owner in place of one in `other`.
"""

OF_NO_FOLDER = ("DELETE /projects/{project}/schedules/", "POST /jobs/")


def schedule(who: httpx.Client, job: dict[str, Any]) -> httpx.Response:
    """Create a schedule as somebody."""
    body = {"name": f"s-{time.monotonic_ns()}", "cron": "0 0 29 2 *", "job": job}
    return who.post("/projects/lab/schedules", json=body)


def own_schedule(house: Studio, who: httpx.Client) -> str:
    """Create a schedule as somebody; return its path."""
    return f"/projects/lab/schedules/{schedule(who, job_into(house, 'team')).json()['name']}"


def own_job(house: Studio, who: httpx.Client) -> str:
    """Submit a job as somebody; return its id."""
    return str(who.post("/projects/lab/jobs", json=job_into(house, "team")).json()["id"])


def cancelled(house: Studio, who: httpx.Client) -> str:
    """Submit a job as somebody and cancel it; return its id."""
    job = own_job(house, who)
    assert who.post(f"/jobs/{job}/cancel").status_code == 200
    return job


@pytest.fixture
def house(server: Server) -> Studio:
    tokens = {name: server.make_user(name) for name in ("raised", "lowered")}
    owner = server.client(server.make_project("lab", raised=Role.READER, lowered=Role.MAINTAINER))
    made = Studio(server, owner, {name: server.client(token) for name, token in tokens.items()})
    assert owner.post("/projects/lab/scripts", json=BODIES["ScriptCreate"] | {"name": "measure"}).status_code == 201
    for folder, user, role in (("team", "raised", "maintainer"), ("other", "lowered", "reader")):
        made.folders[folder] = made.make("collections", {"path": folder})
        put = owner.put(f"{FOLDERS}/{made.folders[folder]}/roles/{user}", json={"role": role})
        assert put.status_code == 200, put.text
    return made


def test_every_operation_in_folders_follows_the_roles_there(house: Studio) -> None:
    wrong = []
    for name, send in REQUESTS.items():
        for user, client in house.members.items():
            inside, outside = send(house, client, "team"), send(house, client, "other")
            if not inside.is_success:
                wrong.append(f"{name} in team as {user}: {inside.status_code} {inside.text}")
            if user == "lowered" and name.startswith(OF_NO_FOLDER):
                continue  # maintainers of the project may do this with all jobs and schedules
            if outside.status_code != 403 or outside.json()["code"] not in ("insufficient-role", "not-author"):
                wrong.append(f"{name} in other as {user}: {outside.status_code} {outside.text}")
    assert not wrong, "\n".join(wrong)


def test_every_operation_of_contributors_states_whether_roles_in_folders_count() -> None:
    in_folders, others = set(), set()
    for route in ROUTES:
        operation = route.operation
        name = f"{operation.method} {route.resource.path}"
        if operation.in_folders:
            assert operation.access in (Access.CONTRIBUTOR, Access.MAINTAINER), name
            in_folders.add(name)
        elif operation.access is Access.CONTRIBUTOR:
            others.add(name)
    assert in_folders == REQUESTS.keys()
    assert {name for name in others if not any(piece in name for piece in ("/datasets", "/coverage-streams"))} == set()


def test_a_role_is_put_read_listed_and_removed_with_its_rev(house: Studio) -> None:
    path = f"{FOLDERS}/{house.folders['team']}/roles/*"
    made = house.owner.put(path, json={"role": "contributor"}, headers={"If-None-Match": "*"})
    assert (made.status_code, made.json()["user"], made.json()["folder"]) == (200, "*", "team")
    assert house.owner.put(path, json={"role": "reader"}, headers={"If-None-Match": "*"}).status_code == 412
    changed = house.owner.put(path, json={"role": "reader"}, headers={"If-Match": made.headers["ETag"]})
    assert (changed.status_code, changed.json()["role"]) == (200, "reader")
    assert house.owner.put(path, json={"role": "owner"}).status_code == 422
    assert house.owner.put(f"{path[:-1]}nobody", json={"role": "reader"}).json()["code"] == "no-member"
    read = house.members["raised"].get(path.replace("*", "%2A"))
    assert (read.status_code, read.headers["ETag"]) == (200, changed.headers["ETag"])
    listed = house.members["raised"].get("/projects/lab/folder-roles").json()["items"]
    found = [(one["folder"], one["user"], one["role"]) for one in listed]
    assert found == [("other", "lowered", "reader"), ("team", "*", "reader"), ("team", "raised", "maintainer")]
    first = house.owner.get("/projects/lab/folder-roles", params={"limit": 2}).json()
    rest = house.owner.get("/projects/lab/folder-roles", params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert first["items"] + rest["items"] == listed
    assert house.owner.delete(path).status_code == 428
    assert house.owner.delete(path, headers={"If-Match": made.headers["ETag"]}).status_code == 412
    assert house.owner.delete(path, headers={"If-Match": changed.headers["ETag"]}).status_code == 204
    assert house.owner.get(path).status_code == 404


def test_folders_show_the_role_of_the_caller(house: Studio) -> None:
    def roles(client: httpx.Client) -> dict[str, str]:
        return {one["path"]: one["role"] for one in client.get(FOLDERS).json()["items"]}

    house.folder("team")
    assert set(roles(house.owner).values()) == {"owner"}
    assert roles(house.members["lowered"]) == {"other": "reader", "team": "maintainer", "team/folder 1": "maintainer"}
    assert roles(house.members["raised"]) == {"other": "reader", "team": "maintainer", "team/folder 1": "maintainer"}
    folder = house.members["raised"].get(f"{FOLDERS}/{house.folders['team']}")
    assert folder.json()["role"] == "maintainer"


def test_an_answer_with_another_role_of_the_caller_has_another_etag(house: Studio) -> None:
    """A role in the project or in a folder changes, but the `rev` of the project or folder stays the same."""
    raised, folder = house.members["raised"], f"{FOLDERS}/{house.folders['team']}"

    def read(path: str, known: httpx.Response | None = None) -> httpx.Response:
        return raised.get(path, headers={} if known is None else {"If-None-Match": known.headers["ETag"]})

    in_project, in_folder = read("/projects/lab"), read(folder)
    assert {read("/projects/lab", in_project).status_code, read(folder, in_folder).status_code} == {304}
    for path in (f"{folder}/roles/raised", "/projects/lab/members/raised"):
        assert house.owner.put(path, json={"role": "contributor"}, headers=ANY).status_code == 200
    assert read("/projects/lab", in_project).json()["role"] == read(folder, in_folder).json()["role"] == "contributor"
    state = {"If-Match": read(folder).headers["ETag"]}
    assert house.owner.patch(folder, json={"path": "moved"}, headers=state).status_code == 200


def test_a_token_for_a_project_uploads_for_a_member_with_one_folder(house: Studio) -> None:
    raised = house.members["raised"]
    made = raised.post("/tokens", json={"name": "t", "scopes": ["write!project=lab", "read!project=lab"]})
    bound = house.server.client(made.json()["secret"])
    digest = f"sha256:{hashlib.sha256(b'x').hexdigest()}"
    assert bound.put(f"/blobs/{digest}", content=b"x").status_code == 204
    gone = house.owner.delete(f"{FOLDERS}/{house.folders['team']}/roles/raised", headers=ANY)
    assert gone.status_code == 204
    assert bound.put(f"/blobs/{digest}", content=b"x").status_code == 403


def test_a_new_skeleton_needs_a_role_in_the_folder_of_skeletons(house: Studio) -> None:
    def send() -> dict[str, Any]:
        files = [("files", (f"walk.{kind}", text.encode())) for kind, text in (("asf", ASF), ("amc", AMC))]
        answer = house.members["raised"].post("/projects/lab/imports", data={"collection": "team"}, files=files)
        assert answer.status_code == 200, answer.text
        return next(dict(one) for one in answer.json()["entries"] if one["status"] != "companion")

    refused = send()
    assert (refused["status"], refused["error"]["code"]) == ("failed", "insufficient-role")
    assert "'skeletons'" in refused["error"]["detail"]
    skeletons = house.make("collections", {"path": "skeletons"})
    put = house.owner.put(f"{FOLDERS}/{skeletons}/roles/raised", json={"role": "contributor"})
    assert put.status_code == 200
    made = send()
    assert made["status"] == "created"
    assert house.owner.get(f"{CLIPS}/{made['item']}").json()["collection"] == "team"
    assert house.owner.delete(f"{FOLDERS}/{skeletons}/roles/raised", headers=ANY).status_code == 204
    assert send()["status"] == "unchanged"
