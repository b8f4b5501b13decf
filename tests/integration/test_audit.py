"""Audit log over HTTP: the entries that each request makes, who may read entries, filters, and no secrets."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from sqlalchemy import select
from tests.support.furnished_house import BODIES
from tests.support.rest_server import ALL_SCOPES, Server
from tests.support.studying import make_study

from marey_schemas.access import Role
from marey_schemas.audit import AUDIT_WORDS
from marey_schemas.event_kinds import AUDIT_KINDS
from marey_server.access.principal import SYSTEM
from marey_server.handlers.catalogue import RESOURCES
from marey_server.store.tables import event, token, user, webhook
from marey_server.store.transaction import Transaction

ANY_STATE = {"If-Match": "*"}
PASSWORDS = ("ben's first password", "ben's second password")
SECRET_PATH = "services/T0/key-9c1f"
LAB = "/projects/lab"
GAITS = f"{LAB}/datasets/gaits"

Made = tuple[str, str, str, str | None]
"""Expected audit entry: its kind, actor, `about` and project."""


@dataclass
class Story:
    """Requests by an administrator, an owner and a new user, and the entries that they must make, in order."""

    server: Server
    administrator: httpx.Client
    owner: httpx.Client
    expected: list[Made] = field(default_factory=list)
    secrets: list[str] = field(default_factory=list)

    def send(
        self, client: httpx.Client, method: str, path: str, body: Any, *made: Made, headers: dict[str, str] = ANY_STATE
    ) -> Any:
        """Send a request that must succeed, and return its answer.

        Record the secret in the answer, and the expected entry `made`.
        """
        answer = client.request(method, path, json=body, headers=headers)
        assert answer.is_success, (method, path, answer.text)
        self.expected += made
        shown = answer.json() if answer.content else {}
        self.secrets += [shown["secret"]] if "secret" in shown else []
        return shown

    def entries(self, client: httpx.Client | None = None, path: str = "/audit", **params: Any) -> list[dict[str, Any]]:
        """Return the entries of a log, oldest first, page by page."""
        found: list[dict[str, Any]] = []
        cursor: dict[str, str] = {}
        while True:
            answer = (client or self.administrator).get(path, params={"limit": 7, **params, **cursor})
            assert answer.status_code == 200, answer.text
            found += answer.json()["items"]
            if (following := answer.json().get("next_cursor")) is None:
                return found[::-1]
            cursor = {"cursor": following}


@pytest.fixture
def story(server: Server) -> Story:
    administrator = server.client(server.make_user("root", administrator=True, scopes=ALL_SCOPES))
    return Story(server, administrator, server.client(server.make_project()))


def change_users_and_tokens(story: Story) -> None:
    root, ben = story.administrator, ("ben", None)
    story.secrets += PASSWORDS
    name, password = "ben", {"password": PASSWORDS[0]}
    story.send(root, "POST", "/users", {"name": name, **password}, ("user.created", "root", *ben))
    story.send(root, "PATCH", "/users/ben/quotas", {"items": 5}, ("user.limited", "root", *ben))
    session = story.send(root, "POST", "/login", {"name": name, **password}, ("token.created", "ben", *ben))
    client = story.server.client(session["secret"])
    rotation = {"rotation_id": "0123456789abcdef" * 2, "grace_s": 600}
    path = f"/tokens/{session['id']}/rotate"
    story.secrets += [session["secret"], "0123456789abcdef" * 2]
    successor = story.send(client, "POST", path, rotation, ("token.rotated", "ben", *ben))
    ended = [("token.revoked", "root", *ben)] * 2
    change = {"password": PASSWORDS[1], "administrator": True}
    story.send(root, "PATCH", "/users/ben", change, *ended, ("user.changed", "root", *ben))
    assert story.server.client(successor["secret"]).get("/me").status_code == 401
    made = story.send(
        root, "POST", "/tokens", {"name": "ci", "scopes": ["read"]}, ("token.created", "root", "root", None)
    )
    story.send(root, "DELETE", f"/tokens/{made['id']}", None, ("token.revoked", "root", "root", None))
    story.send(root, "DELETE", "/users/ben", None, ("user.changed", "root", *ben))
    story.send(root, "PATCH", "/users/ben", {"disabled": False}, ("user.changed", "root", *ben))
    person, path = {"issuer": "https://login.invalid", "subject": "sub-ben"}, "/users/ben/identities"
    linked = story.send(root, "POST", path, person, ("identity.linked", "root", *ben))
    story.send(root, "DELETE", f"{path}/{linked['id']}", None, ("identity.unlinked", "root", *ben))


def change_projects_and_members(story: Story) -> None:
    owner, lab, spare = story.owner, ("lab", "lab"), ("spare", "spare")
    story.send(owner, "POST", "/projects", {"name": "spare"}, ("project.created", "olga", *spare))
    story.send(owner, "DELETE", "/projects/spare", None, ("project.deleted", "olga", *spare))
    story.send(owner, "POST", "/projects/spare/restore", None, ("project.restored", "olga", *spare))
    story.send(owner, "PATCH", LAB, {"visibility": "public"}, ("project.changed", "olga", *lab))
    story.send(story.administrator, "PATCH", f"{LAB}/quotas", {"items": 50}, ("project.limited", "root", *lab))
    ben, member = ("ben", "lab"), f"{LAB}/members/ben"
    story.send(owner, "PUT", member, {"role": "reader"}, ("member.added", "olga", *ben), headers={})
    story.send(owner, "PUT", member, {"role": "maintainer"}, ("member.changed", "olga", *ben))
    story.send(owner, "DELETE", member, None, ("member.removed", "olga", *ben))


def delete_and_restore(story: Story) -> None:
    owner = story.owner
    hierarchy = {"schema": "marey/skeleton@1", "joints": [{"name": "Hips", "parent": -1, "offset": [0, 1, 0]}]}
    body = {"name": "biped", "collection": "raw", "parts": {"hierarchy": hierarchy}}
    item = f"{LAB}/skeletons/{story.send(owner, 'POST', f'{LAB}/skeletons', body)['id']}"
    story.send(owner, "DELETE", item, None, ("item.deleted", "olga", "biped", "lab"))
    story.send(owner, "POST", f"{item}/restore", None, ("item.restored", "olga", "biped", "lab"))
    row = [0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    motion = {
        "schema": "marey/motion@1", "frame_rate_hz": 30, "joints": ["Hips"],
        "skeleton": {"item": item.rpartition("/")[2], "revision": 1},
        "poses": {"dtype": "<f4", "shape": [1, 7], "data": [row]},
    }  # fmt: skip
    info = {"schema": "marey/clip-info@1", "consent_until": "2020-01-01"}
    body = {"name": "walk", "collection": "raw", "parts": {"motion": motion, "info": info}}
    clip = story.send(owner, "POST", f"{LAB}/clips", body)["id"]
    allowed = "allow_expired_consent=true&consent_reason=agreed"
    path = f"{LAB}/clips/{clip}/export?format=bvh&{allowed}"
    exported = owner.get(path)
    assert exported.is_success, exported.text
    story.expected.append(("consent.overridden", "olga", "walk", "lab"))
    [folder] = [one for one in owner.get(f"{LAB}/collections").json()["items"] if one["path"] == "raw"]
    path = f"{LAB}/collections/{folder['id']}"
    story.send(owner, "DELETE", path, None, ("collection.deleted", "olga", "raw", "lab"))
    story.send(owner, "POST", f"{path}/restore", None, ("collection.restored", "olga", "raw", "lab"))


def purge(story: Story) -> None:
    """Purge an item; this also replaces the item's name in the audit entry about its deletion."""
    owner = story.owner
    hierarchy = {"schema": "marey/skeleton@1", "joints": [{"name": "Hips", "parent": -1, "offset": [0, 1, 0]}]}
    body = {"name": "gone", "collection": "raw", "parts": {"hierarchy": hierarchy}}
    item = story.send(owner, "POST", f"{LAB}/skeletons", body)["id"]
    story.send(owner, "DELETE", f"{LAB}/skeletons/{item}", None, ("item.deleted", "olga", item, "lab"))
    story.send(owner, "POST", f"{LAB}/purges", {"item": item}, ("item.purged", "olga", item, "lab"))


def invite(story: Story) -> None:
    owner, path = story.owner, f"{LAB}/invitations"
    created, withdrawn = (owner.post(path, json={"role": "reader"}).json() for _ in range(2))
    story.secrets += [created["code"], withdrawn["code"]]
    story.expected += [("invitation.created", "olga", one["prefix"], "lab") for one in (created, withdrawn)]
    gone = ("invitation.withdrawn", "olga", withdrawn["prefix"], "lab")
    story.send(owner, "DELETE", f"{path}/{withdrawn['id']}", None, gone)
    sign_in = {"name": "ben", "password": PASSWORDS[1]}
    session = story.send(owner, "POST", "/login", sign_in, ("token.created", "ben", "ben", None))
    accepted = [("member.added", "ben", "ben", "lab"), ("invitation.accepted", "ben", created["prefix"], "lab")]
    ben = story.server.client(session["secret"])
    story.send(ben, "POST", "/invitations/accept", {"code": created["code"]}, *accepted)


def conduct_study(story: Story) -> None:
    owner = story.owner
    study = make_study(owner, 4)
    path, named = f"{LAB}/studies/{study}/participants", ("olga", "walks", "lab")
    made = story.send(owner, "POST", path, {}, ("study.invited", *named))
    story.secrets += [made["links"][0]["code"]]
    [one] = owner.get(path).json()["items"]
    story.send(owner, "DELETE", f"{path}/{one['id']}", None, ("study.withdrawn", *named))


def change_folder_roles(story: Story) -> None:
    owner, everybody = story.owner, ("olga", "*", "lab")
    [folder] = [one for one in owner.get(f"{LAB}/collections").json()["items"] if one["path"] == "raw"]
    path = f"{LAB}/collections/{folder['id']}/roles/*"
    story.send(owner, "PUT", path, {"role": "reader"}, ("folder_role.added", *everybody))
    story.send(owner, "PUT", path, {"role": "contributor"}, ("folder_role.changed", *everybody))
    story.send(owner, "DELETE", path, None, ("folder_role.removed", *everybody))


def change_datasets(story: Story) -> None:
    owner, gaits = story.owner, ("olga", "gaits", "lab")
    story.send(owner, "POST", f"{LAB}/datasets", {"name": "gaits", "collection": "raw"})
    first = story.send(owner, "POST", f"{GAITS}/commits", {"message": "first"})
    for name, kind in (("spare", "branch"), ("v1", "tag")):
        story.send(owner, "POST", f"{GAITS}/refs", {"name": name, "kind": kind})
    story.send(owner, "PATCH", f"{GAITS}/refs/spare", {"at": first["digest"]}, ("branch.reset", *gaits))
    story.send(owner, "PUT", f"{GAITS}/refs/main/protection", {"approvals": 1}, ("branch.protected", *gaits))
    story.send(owner, "DELETE", f"{GAITS}/refs/main/protection", None, ("branch.unprotected", *gaits))
    story.send(owner, "DELETE", f"{GAITS}/refs/spare", None, ("branch.deleted", *gaits))
    story.send(owner, "DELETE", f"{GAITS}/refs/v1", None, ("tag.deleted", *gaits))
    story.send(owner, "DELETE", GAITS, None, ("dataset.deleted", *gaits))
    story.send(owner, "POST", f"{LAB}/dataset-purges", {"dataset": "gaits"}, ("dataset.purged", *gaits))


def change_webhooks(story: Story) -> None:
    owner, hook = story.owner, ("olga", "hooks.example.org", "lab")
    story.secrets.append(SECRET_PATH)
    body = {"url": f"https://hooks.example.org/{SECRET_PATH}"}
    made = story.send(owner, "POST", f"{LAB}/webhooks", body, ("webhook.created", *hook))
    path = f"{LAB}/webhooks/{made['id']}"
    story.send(owner, "PATCH", path, {"paused": True}, ("webhook.changed", *hook))
    story.send(owner, "POST", f"{path}/rotate", {"grace_s": 60}, ("webhook.rotated", *hook))
    story.secrets += _stored_secrets(story)
    story.send(owner, "DELETE", path, None, ("webhook.deleted", *hook))


def change_schedules(story: Story) -> None:
    owner, nightly = story.owner, ("olga", "nightly", "lab")
    job = {"kind": "import", "params": {"files": [{"name": "walk.bvh", "blob": f"sha256:{'0' * 64}"}]}}
    body = {"name": "nightly", "cron": "0 3 * * *", "job": job}
    story.send(owner, "POST", f"{LAB}/schedules", body, ("schedule.created", *nightly))
    path = f"{LAB}/schedules/nightly"
    story.send(owner, "PATCH", path, {"paused": True}, ("schedule.changed", *nightly))
    story.send(owner, "DELETE", path, None, ("schedule.deleted", *nightly))


def change_scripts(story: Story) -> None:
    owner, measure = story.owner, ("olga", "measure", "lab")
    body = BODIES["ScriptCreate"] | {"name": "measure"}
    story.send(owner, "POST", f"{LAB}/scripts", body, ("script.registered", *measure))
    story.send(owner, "DELETE", f"{LAB}/scripts/measure", None, ("script.deleted", *measure))


def _stored_secrets(story: Story) -> list[str]:
    """Return all secrets and hashes of secrets that the tables contain."""

    def read(tx: Transaction) -> Iterator[str | None]:
        columns = (
            token.c.secret_hash, token.c.rotation_hash, user.c.password_hash, webhook.c.secret, webhook.c.old_secret,
        )  # fmt: skip
        for column in columns:
            yield from tx.execute(select(column)).scalars()

    return [one for one in story.server.database.read(SYSTEM, lambda tx: list(read(tx))) if one]


CHAPTERS = (
    change_users_and_tokens, change_projects_and_members, delete_and_restore, purge, invite, change_folder_roles,
    change_datasets, change_webhooks, change_schedules, change_scripts, conduct_study,
)  # fmt: skip


def tell(story: Story) -> list[dict[str, Any]]:
    """Send all requests, and check that none changes an existing entry; return the entries that existed before."""
    before = known = story.entries()
    for chapter in CHAPTERS:
        chapter(story)
        found = story.entries()
        assert found[: len(known)] == known
        known = found
    return before


def test_each_kind_of_entry_is_made_by_a_request_and_can_be_found(story: Story) -> None:
    """One test examines all entries, because making them takes long."""
    before = tell(story)
    check_that_each_kind_was_made_without_secrets(story, before)
    check_details(story)
    check_filters(story)
    check_who_sees_what(story)


def check_that_each_kind_was_made_without_secrets(story: Story, before: list[dict[str, Any]]) -> None:
    """Check that the entries after those of `before` are the expected ones, and that the log contains no secret."""
    found = story.entries()
    made = [(one["kind"], one["actor"], one["about"], one["project"]) for one in found[len(before) :]]
    assert made == story.expected
    assert {kind for kind, *_ in made} == set(AUDIT_KINDS)
    assert all(one["token"] for one in found[len(before) :] if not _is_sign_in(one))

    def stored(tx: Transaction) -> str:
        return json.dumps([list(map(str, row)) for row in tx.execute(select(event))])

    text = json.dumps(found) + story.server.database.read(SYSTEM, stored)
    secrets = story.secrets + _stored_secrets(story)
    assert len(secrets) > 12
    parts = {part for secret in secrets for part in (secret, *re.findall(r"[0-9a-zA-Z+/=]{32,}", secret))}
    assert [secret for secret in parts if secret in text] == []


def _is_sign_in(entry: dict[str, Any]) -> bool:
    return bool(entry["body"].get("session"))


def check_details(story: Story) -> None:
    """Check that the bodies of entries state the changes."""
    bodies = {(one["kind"], one["about"]): one["body"] for one in story.entries()}
    assert bodies["project.changed", "lab"] == {"fields": ["visibility"], "visibility": "public"}
    assert bodies["project.limited", "lab"] == {"limits": {"items": 50}}
    assert bodies["member.changed", "ben"] == {"user": "ben", "role": "maintainer", "was": "reader"}
    assert bodies["member.removed", "ben"] == {"user": "ben", "was": "maintainer"}
    assert bodies["branch.reset", "gaits"]["branch"] == "spare"
    assert bodies["branch.reset", "gaits"]["was"] == bodies["branch.deleted", "gaits"]["commit"]
    assert bodies["branch.protected", "gaits"]["rule"]["approvals"] == 1
    changes = [one["body"] for one in story.entries(kind="user.changed", subject="ben")]
    assert changes[0] == {"fields": ["administrator", "password"], "administrator": True, "ended_tokens": "sessions"}
    assert [one.get("disabled") for one in changes] == [None, True, False]


def test_each_kind_has_words() -> None:
    assert set(AUDIT_WORDS) == set(AUDIT_KINDS)
    assert len(set(AUDIT_WORDS.values())) == len(AUDIT_KINDS)


def check_filters(story: Story) -> None:
    """Check that filters select entries by kind, actor, subject and time."""
    whole = story.entries()
    assert story.entries(kind="member.added") == [one for one in whole if one["kind"] == "member.added"]
    assert story.entries(actor="olga") == [one for one in whole if one["actor"] == "olga"] != whole
    ben = story.entries(subject="ben")
    assert ben == [one for one in whole if one["about"] == "ben"]
    assert {one["kind"].partition(".")[0] for one in ben} == {"user", "token", "member", "identity"}
    lab_id = next(one["subject"] for one in whole if one["kind"] == "project.changed")
    assert story.entries(subject=lab_id) == [one for one in whole if one["subject"] == lab_id] != []
    assert story.entries(subject="ben", actor="olga", kind="member.removed") == [
        one for one in ben if one["kind"] == "member.removed"
    ]
    middle = whole[len(whole) // 2]["at"]
    assert story.entries(until=middle) + story.entries(since=middle) == whole
    later = datetime.now(UTC) + timedelta(days=1)
    assert story.entries(since=later.isoformat()) == story.entries(actor="nobody") == []


def test_filters_that_cannot_be_read_are_refused(story: Story) -> None:
    for query in ("kind=member", "since=yesterday", "until=2026-11-23T10:00:00", "subject=", "limit=1001", "actr=x"):
        refused = story.administrator.get(f"/audit?{query}")
        assert refused.status_code in (400, 422), (query, refused.text)
        assert query.partition("=")[0] in refused.text, query


def test_a_cursor_belongs_to_its_log_and_filters(story: Story) -> None:
    for role in ("reader", "maintainer", "contributor"):
        story.server.make_user(role)
        story.send(story.owner, "PUT", f"{LAB}/members/{role}", {"role": role}, headers={})
    first = story.owner.get(f"{LAB}/audit", params={"limit": 2}).json()
    assert len(first["items"]) == 2
    cursor = {"cursor": first["next_cursor"]}
    of_members = {**cursor, "kind": "member.added"}
    for client, path, params in ((story.owner, f"{LAB}/audit", of_members), (story.administrator, "/audit", cursor)):
        refused = client.get(path, params=params)
        assert (refused.status_code, refused.json()["code"]) == (400, "bad-cursor")


def check_who_sees_what(story: Story) -> None:
    """Check that owners see the entries of their project, and administrators all entries."""
    whole, of_lab = story.entries(), story.entries(story.owner, f"{LAB}/audit")
    assert of_lab == [one for one in whole if one["project"] == "lab"]
    assert story.entries(story.administrator, f"{LAB}/audit") == of_lab
    assert {one["project"] for one in whole} == {"lab", "spare", None}


def test_nobody_else_may_read_the_log_even_of_a_public_project(story: Story) -> None:
    story.send(story.owner, "PATCH", LAB, {"visibility": "public"})
    clients = {None: story.server.client(None), "stranger": story.server.client(story.server.make_user("stranger"))}
    for role in (Role.READER, Role.CONTRIBUTOR, Role.MAINTAINER):
        clients[role.value] = story.server.client(story.server.make_user(role.value))
        story.send(story.owner, "PUT", f"{LAB}/members/{role}", {"role": role.value}, headers={})
    answers = {name: client.get(f"{LAB}/audit").status_code for name, client in clients.items()}
    assert answers == {None: 401, "stranger": 403, "reader": 403, "contributor": 403, "maintainer": 403}
    assert {name: client.get("/audit").status_code for name, client in clients.items()} == answers
    assert story.owner.get("/audit").status_code == 403
    story.send(story.owner, "PATCH", LAB, {"visibility": "private"})
    assert clients["stranger"].get(f"{LAB}/audit").status_code == 404


def test_the_feed_of_a_project_does_not_show_where_webhooks_are_sent(story: Story) -> None:
    change_webhooks(story)
    feed = story.owner.get(f"{LAB}/events", params={"limit": 1000}).text
    assert "webhook.created" in feed
    assert "hooks.example.org" not in feed


def test_no_request_changes_or_deletes_an_entry() -> None:
    of_log = [resource for resource in RESOURCES if "audit" in resource.path]
    assert len(of_log) == 2
    assert {method for resource in of_log for method in resource.operations} == {"GET"}
