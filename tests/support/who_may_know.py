"""Model of what callers may know: all contents of projects in memory, and the answers that each caller gets.

Projects, users, items and files have marks in their contents. The answer to each call must have the status that the
model expects, contain what the caller asked for, and contain no mark of a project that the caller may not read.
"""

from __future__ import annotations

import hashlib
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import httpx
from sqlalchemy import update
from tests.support.furnished_house import HIERARCHY, MOTION
from tests.support.rest_server import ALL_SCOPES, USER_SCOPES, People
from tests.support.who_may import RANK

from marey_schemas.access import Role
from marey_server.access.principal import SYSTEM
from marey_server.store.tables import token

PROJECTS = ("red", "green", "blue")
USERS = ("ann", "bob", "cleo", "dora")
BLOBS = tuple(f"bytes {number}".encode() for number in range(6))
DIGESTS = tuple(f"sha256:{hashlib.sha256(data).hexdigest()}" for data in BLOBS)


@dataclass(frozen=True)
class Caller:
    """Credential of a user; if it is bound to a project, it is valid only there."""

    user: str | None
    bound: str | None = None
    scopes: tuple[str, ...] = USER_SCOPES

    @property
    def name(self) -> str:
        return f"{self.user or 'anonymous'} {self.bound or ''} {','.join(self.scopes)}"


ROOT = Caller("root", scopes=ALL_SCOPES)
WORKER = Caller("root", scopes=("work",))
EXPIRED = Caller("dora", scopes=("read", "jobs"))
ATTEMPTS = {state: Caller(f"{state} attempt", scopes=()) for state in ("running", "ended")}
"""Attempts of jobs in the first project."""
CALLERS = (
    Caller(None),
    *(Caller(user) for user in USERS),
    *(Caller(user, bound) for user in USERS[:2] for bound in PROJECTS[:2]),
    Caller("ann", scopes=("read",)),
    Caller("cleo", scopes=("write",)),
    ROOT,
    WORKER,
    EXPIRED,
    *ATTEMPTS.values(),
)


@dataclass
class World:
    """Expected contents of the server, and the roles of its users."""

    public: set[str] = field(default_factory=set)
    roles: dict[tuple[str, str], Role] = field(default_factory=dict)
    disabled: set[str] = field(default_factory=set)
    held: set[tuple[str, str | None, int]] = field(default_factory=set)
    stored: set[int] = field(default_factory=set)
    jobs: dict[str, set[str]] = field(default_factory=lambda: {name: set() for name in PROJECTS})
    uploads: dict[str, Caller] = field(default_factory=dict)
    items: dict[str, dict[str, int | None]] = field(default_factory=lambda: {name: {} for name in PROJECTS})

    def refusal(self, caller: Caller) -> int:
        """Return the status with which every operation refuses a credential; 0 if the credential is valid."""
        if caller.user in self.disabled or caller == EXPIRED:
            return 401
        return 409 if caller == ATTEMPTS["ended"] else 0

    def has(self, caller: Caller, scope: str, project: str | None = None) -> bool:
        """Return whether the credential includes a scope, in a project if one is named."""
        return scope in caller.scopes and caller.bound in (None, project or caller.bound)

    def role(self, caller: Caller, project: str) -> Role | None:
        """Return the caller's role, or None if the caller has none or the token is not valid for the project."""
        if caller.user is None or caller.bound not in (None, project):
            return None
        return Role.OWNER if caller.user == "root" else self.roles.get((project, caller.user))

    def knows(self, caller: Caller, project: str) -> bool:
        """Return whether the caller may know that a project exists."""
        return project in self.public or self.role(caller, project) is not None

    def status(self, caller: Caller, project: str, least: Role, scope: str, *, guests: bool = True) -> int:
        """Return the status with which an operation of a project refuses a caller; 0 if it does not."""
        if refusal := self.refusal(caller):
            return refusal
        reads = least is Role.READER and guests
        if caller.user is None and not reads:
            return 401
        if caller.user is not None and scope not in caller.scopes:
            return 403
        role = self.role(caller, project)
        if role is None:
            if project not in self.public:
                return 404
            return 0 if reads else 403
        if RANK[role] < RANK[least]:
            return 403
        return 0

    def sees_contents(self, caller: Caller, project: str) -> bool:
        """Return whether the caller may read the contents of a project."""
        mine = self.role(caller, project) is not None and self.has(caller, "read", project)
        return project in self.public or mine

    def referring(self, caller: Caller, blob: int) -> bool:
        """Return whether a document that the caller may read refers to a blob."""
        return any(self.sees_contents(caller, project) and blob in self.items[project].values() for project in PROJECTS)

    def may_refer(self, caller: Caller, blob: int) -> bool:
        """Return whether the caller may read a blob and refer to it; with a bound token, only in its project."""
        places = (caller.bound,) if caller.bound else (None, *PROJECTS)
        held = any((caller.user, place, blob) in self.held for place in places)
        if caller in ATTEMPTS.values():  # whose inputs name no blob
            return held
        return held or self.referring(caller, blob)


Call = Callable[[Caller, str], None]


class Program:
    """Random calls to a server and to the model; `differences` collects the calls with different results."""

    def __init__(self, people: People, seed: int) -> None:
        self.people = people
        self.chance = random.Random(seed)
        self.world = World()
        self.differences: list[str] = []
        self.calls = 0
        self._made = 0
        self.skeletons: dict[str, dict[str, Any]] = {}
        self._furnish()

    def _furnish(self) -> None:
        root = self.people.make_user("root", administrator=True, scopes=ALL_SCOPES)
        self.tokens: dict[Caller, str | None] = {CALLERS[0]: None, ROOT: root}
        for user in USERS:
            self.tokens[Caller(user)] = self.people.make_user(user)
        owners = {
            name: self.people.client(self.tokens[Caller(user)]) for name, user in zip(PROJECTS, USERS, strict=False)
        }
        for (
            project,
            owner,
        ) in owners.items():  # public until tokens for them were made: only a known project can be named
            made = {"name": project, "description": f"mark-{project}", "visibility": "public"}
            assert owner.post("/projects", json=made).is_success
        self._make_tokens()
        for (project, owner), user in zip(owners.items(), USERS, strict=False):
            changed = owner.patch(f"/projects/{project}", json={"visibility": "private"}, headers={"If-Match": "*"})
            assert changed.is_success, changed.text
            body: dict[str, Any] = {"name": f"mark-{project}-rig", "parts": {"hierarchy": HIERARCHY}}
            rig = owner.post(f"/projects/{project}/skeletons", json=body)
            self.skeletons[project] = {"item": rig.json()["id"], "revision": 1}
            self.world.roles[project, user] = Role.OWNER
            self._submit_jobs(project)
        end = update(token).where(token.c.name == EXPIRED.name)
        self.people.database.write(SYSTEM, lambda tx: tx.execute(end.values(expires_us=tx.now_us)))

    def _make_tokens(self) -> None:
        for caller in CALLERS:
            if caller not in self.tokens and caller not in ATTEMPTS.values():
                bound = f"!project={caller.bound}" if caller.bound else ""
                maker = ROOT if caller.user == ROOT.user else Caller(caller.user)
                wanted = {"name": caller.name, "scopes": [scope + bound for scope in caller.scopes]}
                made = self.people.client(self.tokens[maker]).post("/tokens", json=wanted)
                self.tokens[caller] = made.json()["secret"]

    def _submit_jobs(self, project: str) -> None:
        """Submit two jobs with marks and claim them; one attempt continues, the other ends."""
        root, worker = (self.people.client(self.tokens[caller]) for caller in (ROOT, WORKER))
        name = f"mark-{project}-walk"
        parts = {"motion": {**MOTION, "skeleton": self.skeletons[project]}}
        clip = root.post(f"/projects/{project}/clips", json={"name": name, "parts": parts}).json()["id"]
        self.world.items[project][name] = None
        for state in ATTEMPTS:
            body = {"kind": "export", "inputs": {"clips": [{"item": clip}]}, "cache": "refresh", "message": name}
            self.world.jobs[project].add(root.post(f"/projects/{project}/jobs", json=body).json()["id"])
            claim = {"worker": f"mark-{project}", "kinds": ["export"], "max": 1}
            lease = worker.post("/leases", json=claim).json()["leases"][0]
            attempt = self.people.client(lease["attempt_token"])
            path = f"/jobs/{lease['job']}/attempts/{lease['fence']}"
            assert attempt.post(f"{path}/log", content=name.encode(), headers={"Upload-Offset": "0"}).is_success
            if state == "ended":
                failure = {"write_id": "12345678", "code": name, "retryable": False}
                assert attempt.post(f"{path}/fail", json=failure).is_success
            if project == PROJECTS[0]:
                self.tokens[ATTEMPTS[state]] = lease["attempt_token"]

    def run(self, count: int) -> None:
        """Make calls until the server and the model differ, or all calls are made."""
        kinds = self.kinds
        while self.calls < count and not self.differences:
            self.chance.choice(kinds)(self.chance.choice(CALLERS), self.chance.choice(PROJECTS))

    @property
    def kinds(self) -> tuple[Call, ...]:
        """The kinds of calls; a kind that is listed twice is chosen twice as often."""
        return (
            self.read_project, self.list_projects, self.list_items, self.list_items, self.create_item, self.create_item,
            self.send_blob, self.read_blob, self.read_blob, self.ask_missing, self.put_member, self.remove_member,
            self.change_visibility, self.list_members, self.list_events, self.list_tokens, self.disable, self.list_jobs,
            self.read_job, self.read_quotas, self.begin_upload, self.read_upload, self.claim, self.list_audit,
        )  # fmt: skip

    # -- calls --------------------------------------------------------------------------------------------------------

    def read_project(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.READER, "read")
        self._call(caller, "GET", f"/projects/{project}", expected or 200)

    def list_projects(self, caller: Caller, _project: str) -> None:
        attempt = caller in ATTEMPTS.values()  # to which the list is always empty
        answer = self._call(caller, "GET", "/projects", 200 if attempt else self._anyone(caller, "read"))
        listed = {name for name in PROJECTS if not attempt and self.world.sees_contents(caller, name)}
        self._compare(answer, caller, listed)

    def list_items(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.READER, "read")
        answer = self._call(caller, "GET", f"/projects/{project}/clips?count=exact&limit=1000", expected or 200)
        self._compare(answer, caller, set(self.world.items[project]))
        if answer.is_success and answer.json()["count"] != len(self.world.items[project]):
            self._differ(answer, caller, f"counted {answer.json()['count']}")

    def create_item(self, caller: Caller, project: str) -> None:
        blob = self.chance.choice([None, *range(len(BLOBS))])
        self._made += 1
        name = f"mark-{project}-{self._made}"
        info: dict[str, Any] = {"schema": "marey/clip-info@1", "comment": name}
        if blob is not None:
            info["source"] = {"file": DIGESTS[blob], "file_name": name}
        expected = self.world.status(caller, project, Role.CONTRIBUTOR, "write")
        if not expected:
            unknown = blob is not None and not self.world.may_refer(caller, blob)
            expected = 409 if unknown else self._changed(caller, project, 201)
        body = {"name": name, "parts": {"motion": {**MOTION, "skeleton": self.skeletons[project]}, "info": info}}
        if self._call(caller, "POST", f"/projects/{project}/clips", expected, json=body).is_success:
            self.world.items[project][name] = blob

    def send_blob(self, caller: Caller, _project: str) -> None:
        blob = self.chance.randrange(len(BLOBS))
        expected = self._sends(caller) or 204
        if self._call(caller, "PUT", f"/blobs/{DIGESTS[blob]}", expected, content=BLOBS[blob]).is_success:
            self.world.held.add((str(caller.user), caller.bound, blob))

    def read_blob(self, caller: Caller, _project: str) -> None:
        blob = self.chance.randrange(len(BLOBS))
        known = 200 if self.world.may_refer(caller, blob) else 404
        expected = 200 if caller == ATTEMPTS["running"] else self._anyone(caller, "read")
        self._call(caller, "GET", f"/blobs/{DIGESTS[blob]}", known if expected == 200 else expected)

    def ask_missing(self, caller: Caller, _project: str) -> None:
        answer = self._call(
            caller, "POST", "/blobs/missing", self._user(caller, "read") or 200, json={"digests": DIGESTS}
        )
        if answer.is_success:
            expected = [digest for blob, digest in enumerate(DIGESTS) if not self.world.may_refer(caller, blob)]
            if answer.json()["missing"] != expected:
                self._differ(answer, caller, "other blobs are missing")

    def put_member(self, caller: Caller, project: str) -> None:
        user, role = self.chance.choice(USERS), self.chance.choice(list(Role))
        expected = self.world.status(caller, project, Role.OWNER, "write")
        if not expected and user in self.world.disabled:
            expected = 404
        if not expected and role is not Role.OWNER and self._last_owner(project, user):
            expected = 409
        body = {"role": role.value}
        path = f"/projects/{project}/members/{user}"
        expected = expected or self._changed(caller, project, 200)
        if self._call(caller, "PUT", path, expected, json=body).is_success:
            self.world.roles[project, user] = role

    def remove_member(self, caller: Caller, project: str) -> None:
        user = self.chance.choice(USERS)
        expected = self.world.status(caller, project, Role.OWNER, "write")
        if not expected:
            there = (project, user) in self.world.roles
            expected = 404 if not there else 409 if self._last_owner(project, user) else 204
        path = f"/projects/{project}/members/{user}"
        if self._call(caller, "DELETE", path, expected, headers={"If-Match": "*"}).is_success:
            del self.world.roles[project, user]

    def change_visibility(self, caller: Caller, project: str) -> None:
        public = self.chance.random() < 0.4
        expected = self.world.status(caller, project, Role.OWNER, "write") or self._changed(caller, project, 200)
        body = {"visibility": "public" if public else "private"}
        path = f"/projects/{project}"
        if self._call(caller, "PATCH", path, expected, json=body, headers={"If-Match": "*"}).is_success:
            (self.world.public.add if public else self.world.public.discard)(project)

    def list_members(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.READER, "read", guests=False)
        answer = self._call(caller, "GET", f"/projects/{project}/members", expected or 200)
        self._compare(answer, caller, {user for place, user in self.world.roles if place == project}, "user")

    def list_events(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.READER, "read", guests=False)
        self._call(caller, "GET", f"/projects/{project}/events?limit=1000", expected or 200)

    def list_audit(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.OWNER, "read", guests=False)
        self._call(caller, "GET", f"/projects/{project}/audit?limit=1000", expected or 200)

    def list_tokens(self, caller: Caller, _project: str) -> None:
        expected = self._user(caller, "read")
        if not expected and caller.bound is not None:
            expected = 403
        answer = self._call(caller, "GET", "/tokens", expected or 200)
        own = {one.name for one in CALLERS if one.user == caller.user and one.name != Caller(one.user).name}
        self._compare(answer, caller, {*own, "test"} - {ROOT.name})

    def list_jobs(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.READER, "read")
        answer = self._call(caller, "GET", f"/projects/{project}/jobs?count=exact", expected or 200)
        self._compare(answer, caller, self.world.jobs[project], "id")
        if answer.is_success and answer.json()["count"] != len(self.world.jobs[project]):
            self._differ(answer, caller, f"counted {answer.json()['count']}")

    def read_job(self, caller: Caller, project: str) -> None:
        """Read a job, or its log or events, which only members may read."""
        job = self.chance.choice(sorted(self.world.jobs[project]))
        what = self.chance.choice(("", "/attempts", "/outputs", "/log", "/events"))
        guests = what not in ("/log", "/events")
        expected = self.world.status(caller, project, Role.READER, "read", guests=guests)
        self._call(caller, "GET", f"/jobs/{job}{what}", expected or 200)

    def read_quotas(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.READER, "read", guests=False)
        self._call(caller, "GET", f"/projects/{project}/quotas", expected or 200)
        user = self.chance.choice(USERS)
        expected = self._user(caller, "read")
        if not expected and caller.bound:
            expected = 403
        known = 200 if caller == ROOT or caller.user == user else 404
        self._call(caller, "GET", f"/users/{user}/quotas", expected or known)

    def begin_upload(self, caller: Caller, _project: str) -> None:
        expected = self._sends(caller) or 201
        answer = self._call(caller, "POST", "/uploads", expected, json={"length": 5})
        if answer.is_success:
            self.world.uploads[answer.json()["id"]] = caller

    def read_upload(self, caller: Caller, _project: str) -> None:
        """Read an upload with the credential that began the upload, or with a credential of another user."""
        upload = self.chance.choice([*self.world.uploads, "upload_of_nobody"])
        sender = self.world.uploads.get(upload)
        if sender is not None and sender.user == caller.user and sender != caller:
            return
        expected = 0 if caller == ATTEMPTS["running"] else self._user(caller, "read")
        self._call(caller, "GET", f"/uploads/{upload}", expected or (200 if sender == caller else 404))

    def claim(self, caller: Caller, _project: str) -> None:
        expected = self._user(caller, "work") or 200
        self._call(caller, "POST", "/leases", expected, json={"worker": "w", "kinds": ["no-such-kind"]})

    def disable(self, _caller: Caller, _project: str) -> None:
        user, disabled = self.chance.choice(USERS), self.chance.random() < 0.3
        path = f"/users/{user}"
        self._call(ROOT, "PATCH", path, 200, json={"disabled": disabled}, headers={"If-Match": "*"})
        (self.world.disabled.add if disabled else self.world.disabled.discard)(user)

    # -- comparing ----------------------------------------------------------------------------------------------------

    def _anyone(self, caller: Caller, scope: str) -> int:
        if refusal := self.world.refusal(caller):
            return refusal
        return 200 if caller.user is None or scope in caller.scopes else 403

    def _changed(self, caller: Caller, project: str, status: int) -> int:
        """Return the status of a successful change: `status`, or 204 if the caller may not read the result."""
        return status if self.world.has(caller, "read", project) else 204

    def _user(self, caller: Caller, scope: str) -> int:
        if caller.user is None:
            return 401
        return self.world.refusal(caller) or (0 if scope in caller.scopes else 403)

    def _sends(self, caller: Caller) -> int:
        """Return the status with which uploaded bytes are refused, or 0. A bound token uploads bytes to its project."""
        if caller == ATTEMPTS["running"]:
            return 0
        role = self.world.role(caller, caller.bound) if caller.bound else Role.OWNER
        return self._user(caller, "write") or (403 if role is None or RANK[role] < RANK[Role.CONTRIBUTOR] else 0)

    def _last_owner(self, project: str, user: str) -> bool:
        owners = [name for (place, name), role in self.world.roles.items() if (place, role) == (project, Role.OWNER)]
        return owners == [user]

    def _call(self, caller: Caller, method: str, path: str, expected: int, **rest: Any) -> httpx.Response:
        """Send a request and return the answer; record a difference if the answer has an unexpected status or mark."""
        self.calls += 1
        answer = self.people.client(self.tokens[caller]).request(method, path, **rest)
        if answer.status_code != expected:
            self._differ(answer, caller, f"expected {expected}")
        for project in re.findall(r"mark-(\w+)", answer.text):
            if not self.world.sees_contents(caller, project) and f"mark-{project}" not in str(rest):
                self._differ(answer, caller, f"a mark of {project} leaked")
        return answer

    def _compare(self, answer: httpx.Response, caller: Caller, expected: set[str], key: str = "name") -> None:
        found = {one[key] for one in answer.json()["items"]} if answer.is_success else expected
        if found != expected:
            self._differ(answer, caller, f"listed {sorted(found)} in place of {sorted(expected)}")

    def _differ(self, answer: httpx.Response, caller: Caller, what: str) -> None:
        request = answer.request
        self.differences.append(
            f"call {self.calls}: {request.method} {request.url.path} as {caller.name}: {answer.status_code}, {what}: "
            f"{answer.text[:200]}"
        )
