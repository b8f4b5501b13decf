"""Exports over HTTP of clips whose consent has ended: refused, or allowed by a maintainer and recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from tests.support.rest_server import Server
from tests.support.store_fixtures import skeleton_tree

from marey_schemas.access import Role
from marey_schemas.encoding.digests import digest_of
from marey_schemas.formats import EXPORT_FORMATS
from marey_versions.records import revision_content

LAB = "/projects/lab"
ALLOWED = {"allow_expired_consent": "true", "consent_reason": "The estate has agreed by letter."}


def ok(response: httpx.Response, status: int = 200) -> Any:
    assert response.status_code == status, response.text
    return response.json()


def refused(response: httpx.Response, status: int, code: str) -> Any:
    assert (response.status_code, response.json().get("code")) == (status, code), response.text
    return response.json()


def day(ahead: int) -> str:
    return (datetime.now(UTC).date() + timedelta(days=ahead)).isoformat()


def motion(rig: str, place: float = 0.0) -> dict[str, Any]:
    row = [place, 1.0, 0.0] + 3 * [1.0, 0.0, 0.0, 0.0]
    return {
        "schema": "marey/motion@1", "frame_rate_hz": 30, "joints": ["j0", "j1", "j2"],
        "skeleton": {"item": rig, "revision": 1},
        "poses": {"dtype": "<f4", "shape": [2, 15], "data": [row, row]},
    }  # fmt: skip


def info(until: str | None, **more: Any) -> dict[str, Any]:
    return {"schema": "marey/clip-info@1", **({} if until is None else {"consent_until": until}), **more}


@dataclass
class Studio:
    """The project `lab` with a skeleton, and the clients of its members."""

    server: Server
    owner: httpx.Client
    rig: str

    def client(self, role: Role | None) -> httpx.Client:
        """Return the client of a new user with a role in the project."""
        name = "stranger" if role is None else role.value
        token = self.server.make_user(name)
        if role is not None:
            ok(self.owner.put(f"{LAB}/members/{name}", json={"role": name}))
        return self.server.client(token)

    def clip(self, name: str, until: str | None, **more: Any) -> str:
        parts = {"motion": motion(self.rig, float(len(name))), "info": info(until, **more)}
        body = {"name": name, "collection": "raw", "parts": parts}
        return ok(self.owner.post(f"{LAB}/clips", json=body), 201)["id"]

    def aligned(self, name: str, source: str) -> str:
        said = {
            "schema": "marey/alignment@1", "clip": {"item": source, "revision": 1}, "frame_rate_hz": 30,
            "source_frames": 2, "time_function": {"dtype": "<f8", "shape": [2], "data": [0, 1]},
        }  # fmt: skip
        body = {"name": name, "collection": "aligned", "parts": {"motion": motion(self.rig), "info": said}}
        return ok(self.owner.post(f"{LAB}/processed", json=body), 201)["id"]

    def record(self, clip: str, until: str | None) -> None:
        ok(self.owner.put(f"{LAB}/clips/{clip}/parts/info", json=info(until), headers={"If-Match": "*"}))

    def overrides(self) -> list[Any]:
        found = ok(self.owner.get(f"{LAB}/events", params={"limit": 1000}))
        return [one for one in found["items"] if one["kind"] == "consent.overridden"]


@pytest.fixture
def studio(server: Server) -> Studio:
    owner = server.client(server.make_project())
    body = {"name": "rig", "collection": "raw", "parts": {"hierarchy": skeleton_tree()}}
    return Studio(server, owner, ok(owner.post(f"{LAB}/skeletons", json=body), 201)["id"])


@pytest.fixture
def export(studio: Studio) -> Callable[..., httpx.Response]:
    def send(item: str, client: httpx.Client | None = None, *, kind: str = "clips", **params: Any) -> httpx.Response:
        query = {"format": "bvh", **params}
        return (client or studio.owner).get(f"{LAB}/{kind}/{item}/export", params=query)

    return send


Export = Callable[..., httpx.Response]


@pytest.mark.parametrize("file_format", EXPORT_FORMATS)
def test_no_format_is_exported_after_the_last_day(studio: Studio, export: Export, file_format: str) -> None:
    file = b"HIERARCHY"
    digest = digest_of(file)
    assert studio.owner.put(f"/blobs/{digest}", content=file).is_success
    source = {"file": digest, "file_name": "walk.bvh"}
    walk = studio.clip("walk", day(-1), source=source)
    problem = refused(export(walk, format=file_format), 409, "consent-expired")
    assert f"the clip 'raw/walk' ended; its last day was {day(-1)}." in problem["detail"]
    for remedy in ("consent_until", "maintainer", "allow_expired_consent"):
        assert remedy in problem["detail"]
    assert problem["context"] == {
        "clips": [{"item": walk, "path": "raw/walk", "consent_until": day(-1)}],
        "count": 1,
    }
    assert export(walk, format=file_format, **ALLOWED).status_code == 200


def test_the_last_day_itself_and_a_missing_record_allow_the_export(studio: Studio, export: Export) -> None:
    for name, until in (("last", day(0)), ("later", day(400)), ("open", None)):
        assert export(studio.clip(name, until)).status_code == 200, name


def test_the_newest_record_counts_for_every_revision(studio: Studio, export: Export) -> None:
    walk = studio.clip("walk", day(9))
    studio.record(walk, day(-1))
    for revision in (1, 2):
        refused(export(walk, revision=revision), 409, "consent-expired")
    studio.record(walk, day(9))
    for revision in (1, 2, 3):
        assert export(walk, revision=revision).status_code == 200


def test_an_aligned_clip_follows_the_record_of_its_source(studio: Studio, export: Export) -> None:
    walk = studio.clip("walk", None)
    aligned = studio.aligned("walk", walk)
    assert export(aligned, kind="processed").status_code == 200
    studio.record(walk, day(-1))
    for file_format in ("bvh", "npz", "predecessor", "json"):
        problem = refused(export(aligned, kind="processed", format=file_format), 409, "consent-expired")
        assert "'raw/walk'" in problem["detail"]
    assert export(aligned, kind="processed", **ALLOWED).status_code == 200
    assert [(one["subject"], one["body"]["clips"][0]["path"]) for one in studio.overrides()] == [(aligned, "raw/walk")]
    deleted = studio.owner.delete(f"{LAB}/clips/{walk}", headers={"If-Match": "*"})
    assert deleted.status_code == 204
    refused(export(aligned, kind="processed"), 409, "consent-expired")


def test_a_reference_to_a_clip_of_another_project_reveals_nothing_about_it(studio: Studio, export: Export) -> None:
    secret = studio.clip("secret", day(-1))
    other = studio.server.client(studio.server.make_user("eve"))
    ok(other.post("/projects", json={"name": "eves"}), 201)
    body = {"name": "rig", "parts": {"hierarchy": skeleton_tree()}}
    rig = ok(other.post("/projects/eves/skeletons", json=body), 201)["id"]
    said = {
        "schema": "marey/alignment@1", "clip": {"item": secret, "revision": 1}, "frame_rate_hz": 30,
        "source_frames": 2, "time_function": {"dtype": "<f8", "shape": [2], "data": [0, 1]},
    }  # fmt: skip
    body = {"name": "probe", "parts": {"motion": motion(rig), "info": said}}
    probe = ok(other.post("/projects/eves/processed", json=body), 201)["id"]
    answer = other.get(f"/projects/eves/processed/{probe}/export", params={"format": "bvh"})
    assert (answer.status_code, "secret" in answer.text) == (200, False)


# -- permissions -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("role", [Role.READER, Role.CONTRIBUTOR, None])
def test_who_is_no_maintainer_cannot_allow_an_export(studio: Studio, export: Export, role: Role | None) -> None:
    walk, client = studio.clip("walk", day(-1)), studio.client(role)
    if role is None:
        refused(export(walk, client, **ALLOWED), 404, "no-project")
    else:
        problem = refused(export(walk, client, **ALLOWED), 403, "insufficient-role")
        assert "maintainer" in problem["detail"]
        refused(export(walk, client), 409, "consent-expired")
    assert studio.overrides() == []


def test_a_maintainer_with_a_token_that_only_reads_cannot_allow_an_export(studio: Studio, export: Export) -> None:
    walk = studio.clip("walk", day(-1))
    reader = studio.server.client(studio.server.make_user("max", scopes=("read",)))
    assert studio.owner.put(f"{LAB}/members/max", json={"role": "maintainer"}).is_success
    refused(export(walk, reader, **ALLOWED), 403, "insufficient-scope")
    ok(studio.owner.post(f"{LAB}/datasets", json={"name": "raw", "collection": "raw"}), 201)
    body = {"contents": contents_of(studio), "allow_expired_consent": True, "consent_reason": "why"}
    refused(reader.post(f"{LAB}/datasets/raw/export-checks", json=body), 403, "insufficient-scope")
    assert studio.overrides() == []


def test_no_cache_answers_for_an_export_without_asking_the_server(studio: Studio, export: Export) -> None:
    file = b"HIERARCHY"
    assert studio.owner.put(f"/blobs/{digest_of(file)}", content=file).is_success
    walk = studio.clip("walk", day(9), source={"file": digest_of(file), "file_name": "walk.bvh"})
    for file_format in ("original", "bvh"):
        assert export(walk, format=file_format).headers["Cache-Control"] == "private, no-cache"


def test_guests_of_a_public_project_are_asked_to_sign_in(studio: Studio, export: Export) -> None:
    walk, guest = studio.clip("walk", day(-1)), studio.server.client()
    ok(studio.owner.patch(LAB, json={"visibility": "public"}, headers={"If-Match": "*"}))
    refused(export(walk, guest), 409, "consent-expired")
    refused(export(walk, guest, **ALLOWED), 401, "unauthenticated")
    refused(export(walk, studio.client(None), **ALLOWED), 403, "insufficient-role")
    assert studio.overrides() == []


def test_a_maintainer_allows_an_export_with_a_reason_which_an_event_records(studio: Studio, export: Export) -> None:
    walk, maintainer = studio.clip("walk", day(-1)), studio.client(Role.MAINTAINER)
    assert export(walk, maintainer, **ALLOWED).content.startswith(b"HIERARCHY")
    (event,) = studio.overrides()
    assert (event["subject"], event["actor"]) == (walk, "maintainer")
    assert event["body"] == {
        "reason": ALLOWED["consent_reason"],
        "clips": [{"item": walk, "path": "raw/walk", "consent_until": day(-1)}],
        "count": 1,
    }


def test_a_permission_that_is_not_needed_is_not_recorded(studio: Studio, export: Export) -> None:
    assert export(studio.clip("walk", day(0)), **ALLOWED).status_code == 200
    assert studio.overrides() == []


@pytest.mark.parametrize(
    "params",
    [
        {"allow_expired_consent": "true"},
        {"consent_reason": "why"},
        {"allow_expired_consent": "true", "consent_reason": ""},
        {"allow_expired_consent": "true", "consent_reason": "x" * 501},
        {"allow_expired_consent": "perhaps", "consent_reason": "why"},
    ],
)
def test_a_permission_without_a_reason_is_refused(studio: Studio, export: Export, params: dict[str, str]) -> None:
    refused(export(studio.clip("walk", day(-1)), **params), 400, "bad-query")
    assert studio.overrides() == []


# -- archives ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def check(studio: Studio) -> Callable[..., httpx.Response]:
    """Function that asks whether contents may be exported, and returns the answer.

    By default, these are all entries of the new dataset `raw`.
    """
    ok(studio.owner.post(f"{LAB}/datasets", json={"name": "raw", "collection": "raw"}), 201)

    def send(client: httpx.Client | None = None, contents: list[str] | None = None, **fields: Any) -> httpx.Response:
        body = {"contents": contents if contents is not None else contents_of(studio), **fields}
        return (client or studio.owner).post(f"{LAB}/datasets/raw/export-checks", json=body)

    return send


def contents_of(studio: Studio) -> list[str]:
    """Commit the folder `raw`, and return the content digests of the entries of all versions."""
    url = f"{LAB}/datasets/raw"
    ok(studio.owner.post(f"{url}/commits", json={"message": "m"}), 201)
    found = set()
    for commit in ok(studio.owner.get(f"{url}/commits"))["items"]:
        listed = ok(studio.owner.get(f"{url}/entries", params={"version": commit["digest"]}))["items"]
        found |= {revision_content(one["kind"], one["parts"]) for one in listed}
    return sorted(found)


def test_an_archive_with_a_clip_whose_consent_has_ended_is_refused(studio: Studio, check: Export) -> None:
    walk = studio.clip("walk", day(9))
    studio.clip("open", None)
    contents = contents_of(studio)
    assert ok(check(contents=contents)) == {"ended": []}
    studio.record(walk, day(-1))
    problem = refused(check(contents=contents), 409, "consent-expired")
    assert [one["path"] for one in problem["context"]["clips"]] == ["raw/walk"]
    assert "'raw/walk'" in problem["detail"]
    deleted = studio.owner.delete(f"{LAB}/clips/{walk}", headers={"If-Match": "*"})
    assert deleted.status_code == 204
    refused(check(contents=contents), 409, "consent-expired")


def test_an_archive_of_several_such_clips_names_their_number(studio: Studio, check: Export) -> None:
    for number in range(3):
        studio.clip(f"walk-{number}", day(-1))
    problem = refused(check(), 409, "consent-expired")
    assert "The consent for 2 other clips ended, too" in problem["detail"]
    assert (problem["context"]["count"], len(problem["context"]["clips"])) == (3, 3)


def test_maintainers_allow_an_archive_and_others_do_not(studio: Studio, check: Export) -> None:
    walk = studio.clip("walk", day(-1))
    contents = contents_of(studio)
    allowed = {**ALLOWED, "allow_expired_consent": True}
    contributor, maintainer = studio.client(Role.CONTRIBUTOR), studio.client(Role.MAINTAINER)
    refused(check(contributor, contents, **allowed), 403, "insufficient-role")
    assert studio.overrides() == []
    assert ok(check(maintainer, contents, **allowed)) == {"ended": [walk]}
    (event,) = studio.overrides()
    assert [one["item"] for one in event["body"]["clips"]] == [walk]
    assert event["body"]["reason"] == ALLOWED["consent_reason"]
    assert ok(check(maintainer, ["sha256:" + "0" * 64], **allowed)) == {"ended": []}
    assert len(studio.overrides()) == 1


def test_a_check_is_bounded_and_of_a_dataset(studio: Studio, check: Export) -> None:
    for contents in ([], ["sha256:" + "0" * 64] * 501, ["walk"]):
        refused(check(contents=contents), 422, "invalid-body")
    body = {"contents": ["sha256:" + "0" * 64]}
    refused(studio.owner.post(f"{LAB}/datasets/none/export-checks", json=body), 404, "no-dataset")


def test_the_day_of_a_record_has_one_form(studio: Studio) -> None:
    """The server compares days as texts, so a day in another form would be compared wrongly."""
    walk = studio.clip("walk", None)
    for until in ("2026-01-31T00:00:00", 1769817600, "31.1.2026", "20260131", "2026-02-30"):
        body = {"schema": "marey/clip-info@1", "consent_until": until}
        answer = studio.owner.put(f"{LAB}/clips/{walk}/parts/info", json=body, headers={"If-Match": "*"})
        problem = refused(answer, 422, "invalid")
        assert problem["errors"][0]["pointer"] == "/info/consent_until", until
