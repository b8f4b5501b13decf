"""HTTP protocol of the server: media types, preconditions, pages, byte ranges, errors."""

import contextlib
import errno
import gzip
import hashlib
import json
import logging
import socket
import time
from asyncio import Future
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import bson
import httpx
import msgpack
import numpy as np
import pytest
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server
from tests.support.store_fixtures import random_poses
from tornado.iostream import IOStream

from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.codecs import MEDIA_TYPES, decode_tree
from marey_server.access.principal import SYSTEM
from marey_server.errors import UnavailableProblem
from marey_server.handlers.uploads import LONG_BODY_BYTES
from marey_server.http import reply
from marey_server.http.exchange import JOINED_BYTES
from marey_server.http.negotiation import MediaType
from marey_server.process.observe import without_received_text
from marey_server.store import projects, uploads
from marey_server.store.blob_backings import DirectoryBlobs, Spool
from marey_server.store.database.connections import Database
from marey_server.store.items.facets import publish_facets
from marey_server.store.transaction import Transaction

OCTETS = {"Content-Type": "application/octet-stream"}
JOINTS = ("hips", "knee", "foot")
HIERARCHY = {
    "schema": "marey/skeleton@1",
    "joints": [{"name": name, "parent": index - 1, "offset": [0, -0.4, 0]} for index, name in enumerate(JOINTS)],
}


def motion(skeleton: str, frames: int = 40) -> dict[str, Any]:
    poses = random_poses(frames, len(JOINTS), 7)
    return {
        "schema": "marey/motion@1",
        "skeleton": {"item": skeleton, "revision": 1},
        "frame_rate_hz": 30.0,
        "joints": list(JOINTS),
        "poses": {"dtype": "<f4", "shape": list(poses.shape), "data": poses.tobytes()},
    }


def make(client: httpx.Client, kind: str, name: str, **parts: dict[str, Any]) -> dict[str, Any]:
    body = msgpack.packb({"name": name, "parts": parts})
    made = client.post(f"/projects/lab/{kind}", content=body, headers={"Content-Type": "application/msgpack"})
    assert made.status_code == 201, made.text
    return made.json()


@pytest.fixture
def clip(owner: httpx.Client) -> str:
    """The path of a clip."""
    skeleton = make(owner, "skeletons", "three joints", hierarchy=HIERARCHY)
    return f"/projects/lab/clips/{make(owner, 'clips', 'walk', motion=motion(skeleton['id']))['id']}"


# -- forms ----------------------------------------------------------------------------------------------------------


def test_a_part_says_the_same_in_every_form(owner: httpx.Client, clip: str) -> None:
    trees = {}
    for name in (*MEDIA_TYPES, "application/msgpack; arrays=blocks", "application/bson; arrays=blocks"):
        answer = owner.get(f"{clip}/parts/motion", headers={"Accept": name})
        assert answer.headers["Content-Type"] == name
        assert "Accept" in answer.headers["Vary"]
        trees[name] = decode_tree(answer.content, name.partition(";")[0])
    first = trees.pop("application/json")
    for tree in trees.values():
        np.testing.assert_array_equal(tree.pop("poses"), first["poses"])
        assert tree == {key: value for key, value in first.items() if key != "poses"}


def test_blocks_are_the_stored_bytes(owner: httpx.Client, clip: str) -> None:
    answer = owner.get(f"{clip}/parts/motion", headers={"Accept": "application/msgpack; arrays=blocks"})
    leaf = msgpack.unpackb(answer.content)["poses"]
    assert leaf["encoding"] == "blocks"
    stored = EncodedArray(leaf["dtype"], tuple(leaf["shape"]), leaf["data"])
    whole = owner.get(f"{clip}/parts/motion", headers={"Accept": "application/bson"})
    assert stored.decode().tobytes() == bson.decode(whole.content)["poses"]["data"]


@pytest.mark.parametrize("accept", [*MEDIA_TYPES, "application/msgpack; arrays=blocks"])
def test_frames_and_joints_cut_as_slicing_does(owner: httpx.Client, clip: str, accept: str) -> None:
    def read(query: str) -> dict[str, Any]:
        answer = owner.get(f"{clip}/parts/motion{query}", headers={"Accept": accept})
        assert answer.status_code == 200, answer.text
        assert answer.headers["Content-Type"] == accept
        return decode_tree(answer.content, accept.partition(";")[0])

    whole = read("")["poses"]
    np.testing.assert_array_equal(read("?frames=10:15")["poses"], whole[10:15])
    np.testing.assert_array_equal(read("?frames=:3")["poses"], whole[:3])
    cut = read("?joints=hips,foot&frames=5:")
    assert cut["joints"] == ["hips", "foot"]
    np.testing.assert_array_equal(cut["poses"], np.delete(whole, slice(7, 11), axis=1)[5:])


@pytest.mark.parametrize(
    ("query", "remedy"),
    [
        ("joints=hip", "has no joint 'hip'; did you mean 'hips'?"),
        ("joints=Q", "has no joint 'Q'; its joints are hips,"),
        ("frames=9:3", "Write first:end"),
    ],
)
def test_a_refused_cut_says_what_can_be_cut(owner: httpx.Client, clip: str, query: str, remedy: str) -> None:
    answer = owner.get(f"{clip}/parts/motion?{query}")
    assert answer.status_code == 422
    assert remedy in answer.text


def test_models_come_in_every_form(owner: httpx.Client, clip: str) -> None:
    shown = owner.get(clip).json()
    assert msgpack.unpackb(owner.get(clip, headers={"Accept": "application/msgpack"}).content) == shown
    assert bson.decode(owner.get(clip, headers={"Accept": "application/bson"}).content) == shown


def test_a_form_nobody_offers_is_refused_with_a_list(owner: httpx.Client, clip: str) -> None:
    refused = owner.get(clip, headers={"Accept": "image/png"})
    assert refused.status_code == 406
    assert refused.json()["context"]["offered"] == list(MEDIA_TYPES)


def test_bodies_of_unknown_form_or_compressed_are_refused(owner: httpx.Client) -> None:
    assert owner.post("/projects", content=b"x", headers={"Content-Type": "text/csv"}).status_code == 415
    body = gzip.compress(json.dumps({"name": "zipped"}).encode())
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
    assert owner.post("/projects", content=body, headers=headers).status_code == 415


# -- states and preconditions ---------------------------------------------------------------------------------------


def test_what_the_caller_holds_already_is_not_sent_again(owner: httpx.Client, clip: str) -> None:
    for path in (clip, f"{clip}/parts/motion"):
        etag = owner.get(path).headers["ETag"]
        again = owner.get(path, headers={"If-None-Match": etag})
        assert (again.status_code, again.content, again.headers["ETag"]) == (304, b"", etag)
        other_form = owner.get(path, headers={"If-None-Match": etag, "Accept": "application/msgpack"})
        assert other_form.status_code == 200


def test_an_item_with_new_facets_is_sent_again(server: Server, owner: httpx.Client, clip: str) -> None:
    def publish(value: float) -> None:
        def publish_usage(tx: Transaction) -> None:
            publish_facets(tx, projects.require(tx, "lab").id, [[clip.rpartition("/")[2], 1, {"usage": value}]])

        server.database.write(SYSTEM, publish_usage)

    held = owner.get(clip).headers["ETag"]
    for value in (0.0, 0.5):
        publish(value)
        answer = owner.get(clip, headers={"If-None-Match": held})
        assert (answer.status_code, answer.json()["facets"]) == (200, {"usage": value})
        held = answer.headers["ETag"]
        publish(value)
        assert owner.get(clip, headers={"If-None-Match": held}).status_code == 304
    publish(1.0)
    changed = owner.patch(clip, json={"name": "run"}, headers={"If-Match": held})
    assert (changed.status_code, changed.json()["facets"]) == (200, {"usage": 1.0})
    assert owner.get(clip, headers={"If-None-Match": changed.headers["ETag"]}).status_code == 304


def test_what_has_moved_along_with_its_folder_is_sent_again(owner: httpx.Client, clip: str) -> None:
    """The paths of items and datasets contain the paths of folders, which change without a new `rev`."""
    folder = owner.post("/projects/lab/collections", json={"path": "takes"}).json()["id"]
    assert owner.patch(clip, json={"collection": "takes"}, headers={"If-Match": "*"}).status_code == 200
    assert owner.post("/projects/lab/datasets", json={"name": "takes", "collection": "takes"}).status_code == 201
    held = {path: owner.get(path).headers["ETag"] for path in (clip, "/projects/lab/datasets/takes")}
    url = f"/projects/lab/collections/{folder}"
    assert owner.patch(url, json={"path": "walks"}, headers={"If-Match": "*"}).status_code == 200
    for path, etag in held.items():
        answer = owner.get(path, headers={"If-None-Match": etag})
        assert (answer.status_code, answer.json()["collection"]) == (200, "walks")
        assert owner.get(path, headers={"If-None-Match": answer.headers["ETag"]}).status_code == 304


def test_a_change_says_which_state_it_changes(owner: httpx.Client, clip: str) -> None:
    etag = owner.get(clip).headers["ETag"]
    change = {"name": "run"}
    assert owner.patch(clip, json=change).status_code == 428
    changed = owner.patch(clip, json=change, headers={"If-Match": etag})
    assert changed.status_code == 200
    assert changed.headers["ETag"] != etag
    late = owner.patch(clip, json={"name": "jump"}, headers={"If-Match": etag})
    assert late.status_code == 412
    assert late.headers["ETag"] == f'"{changed.json()["rev"]}.json"'
    assert owner.get(clip).json()["name"] == "run"
    assert owner.patch(clip, json=change, headers={"If-Match": late.headers["ETag"]}).status_code == 200
    assert owner.patch(clip, json={"name": "jump"}, headers={"If-Match": "*"}).status_code == 200


def test_one_of_several_states_is_enough_for_a_change(owner: httpx.Client, clip: str) -> None:
    first = owner.get(clip).headers["ETag"]
    second = owner.patch(clip, json={"name": "run"}, headers={"If-Match": f'{first}, "77.json"'}).headers["ETag"]
    assert owner.patch(clip, json={"name": "jump"}, headers={"If-Match": f'{first}, "77.json"'}).status_code == 412
    assert owner.get(clip).json()["name"] == "run"
    info = {"schema": "marey/clip-info@1", "subject": "somebody"}
    assert owner.put(f"{clip}/parts/info", json=info, headers={"If-Match": f"{first}"}).status_code == 412
    third = owner.put(f"{clip}/parts/info", json=info, headers={"If-Match": f"{first}, {second}"})
    assert third.json()["revision"] == 2
    assert owner.get(clip, headers={"If-None-Match": f"{first}, {third.headers['ETag']}"}).status_code == 304
    assert owner.delete(clip, headers={"If-Match": f"{first}, {second}"}).status_code == 412
    assert owner.delete(clip, headers={"If-Match": f"{second}, {third.headers['ETag']}"}).status_code == 204


def test_a_member_at_one_of_several_states_is_changed_and_removed(server: Server, owner: httpx.Client) -> None:
    server.make_user("ben")
    ben = "/projects/lab/members/ben"
    owner.put(ben, json={"role": "reader"}).raise_for_status()
    for states, status in (('"2.json", "3.json"', 412), ('"1.json", "3.json"', 200)):
        assert owner.put(ben, json={"role": "contributor"}, headers={"If-Match": states}).status_code == status
    for states, status in (('"1.json", "3.json"', 412), ('"1.json", "2.json"', 204)):
        assert owner.delete(ben, headers={"If-Match": states}).status_code == status


def test_a_part_read_as_msgpack_can_be_replaced_with_json(owner: httpx.Client, clip: str) -> None:
    etag = owner.get(f"{clip}/parts/motion", headers={"Accept": "application/msgpack"}).headers["ETag"]
    info = {"schema": "marey/clip-info@1", "subject": "somebody"}
    put = owner.put(f"{clip}/parts/info", json=info, headers={"If-Match": etag}, params={"message": "who it is"})
    assert put.json()["revision"] == 2
    history = owner.get(f"{clip}/revisions").json()["items"]
    assert [(entry["revision"], entry["message"]) for entry in history] == [(2, "who it is"), (1, "")]
    assert history[0]["parts"]["motion"] == history[1]["parts"]["motion"]


def test_a_pinned_revision_never_changes_and_says_so(owner: httpx.Client, clip: str) -> None:
    before = owner.get(f"{clip}/parts/motion", params={"revision": 1})
    owner.put(f"{clip}/parts/info", json={"schema": "marey/clip-info@1"}, headers={"If-Match": "*"})
    after = owner.get(f"{clip}/parts/motion", params={"revision": 1})
    assert (before.content, before.headers["ETag"]) == (after.content, after.headers["ETag"])
    assert "immutable" in after.headers["Cache-Control"]


def test_members_can_be_made_only_where_there_is_none(server: Server, owner: httpx.Client) -> None:
    server.make_user("ben")
    put: dict[str, Any] = {"json": {"role": "reader"}, "headers": {"If-None-Match": "*"}}
    assert owner.put("/projects/lab/members/ben", **put).status_code == 200
    assert owner.put("/projects/lab/members/ben", **put).status_code == 412


# -- idempotency ----------------------------------------------------------------------------------------------------


def test_the_same_request_with_the_same_key_is_done_once(owner: httpx.Client) -> None:
    key = {"Idempotency-Key": "make-walks"}
    first = owner.post("/projects/lab/collections", json={"path": "walks"}, headers=key)
    again = owner.post("/projects/lab/collections", json={"path": "walks"}, headers=key)
    assert first.status_code == 201
    for name in ("ETag", "Location"):
        assert again.headers[name] == first.headers[name]
    assert (again.status_code, again.content) == (201, first.content)
    assert again.headers["Idempotent-Replayed"] == "true"
    other = owner.post("/projects/lab/collections", json={"path": "runs"}, headers=key)
    assert (other.status_code, other.json()["code"]) == (422, "idempotency-key-reused")
    assert owner.post("/projects/lab/collections", json={"path": "walks"}).status_code == 409


def test_a_token_of_other_scopes_does_not_hear_what_the_first_was_answered(server: Server, owner: httpx.Client) -> None:
    def token(*scopes: str) -> httpx.Client:
        return server.client(owner.post("/tokens", json={"name": "t", "scopes": scopes}).json()["secret"])

    def send(client: httpx.Client) -> httpx.Response:
        return client.post("/projects/lab/collections", json={"path": "walks"}, headers={"Idempotency-Key": "walks"})

    owner.post("/projects", json={"name": "run"}).raise_for_status()
    assert send(token("read", "write")).status_code == 201
    for scopes, answer in (
        (("write!project=run", "read!project=run"), (404, "no-project")),
        (("write!project=lab", "read!project=lab"), (422, "idempotency-key-reused")),
    ):
        other = send(token(*scopes))
        assert (other.status_code, other.json()["code"]) == answer
        assert "walks" not in other.text
    assert send(token("write", "read")).headers["Idempotent-Replayed"] == "true"


def test_who_has_left_a_project_does_not_hear_his_answers_again(server: Server, owner: httpx.Client) -> None:
    ben = server.client(server.make_user("ben"))
    owner.put("/projects/lab/members/ben", json={"role": "contributor"}).raise_for_status()

    def send() -> httpx.Response:
        return ben.post("/projects/lab/collections", json={"path": "walks"}, headers={"Idempotency-Key": "walks"})

    first = send()
    assert (first.status_code, send().content) == (201, first.content)
    owner.put("/projects/lab/members/ben", json={"role": "reader"}).raise_for_status()
    assert (send().status_code, send().json()["code"]) == (403, "insufficient-role")
    owner.delete("/projects/lab/members/ben", headers={"If-Match": "*"}).raise_for_status()
    assert (send().status_code, send().json()["code"]) == (404, "no-project")


# -- lists ----------------------------------------------------------------------------------------------------------


def test_pages_follow_each_other_and_lose_nothing_while_things_are_added(owner: httpx.Client) -> None:
    for number in range(7):
        make(owner, "skeletons", f"s{number}", hierarchy=HIERARCHY)
    seen = []
    answer = owner.get("/projects/lab/skeletons", params={"limit": 3, "sort": "name", "count": "exact"})
    assert answer.json()["count"] == 7
    while True:
        seen += [item["name"] for item in answer.json()["items"]]
        if "next" not in answer.links:
            break
        make(owner, "skeletons", f"added after {seen[-1]}", hierarchy=HIERARCHY)
        address = httpx.URL(str(owner.base_url)).join(answer.links["next"]["url"])
        answer = owner.get(str(address))
    assert [name for name in seen if name.startswith("s")] == [f"s{number}" for number in range(7)]
    assert len(set(seen)) == len(seen)


def test_lists_are_filtered_and_show_the_fields_asked_for(owner: httpx.Client, clip: str) -> None:
    owner.patch(clip, json={"tags": ["raw", "checked"], "collection": "a/b"}, headers={"If-Match": "*"})
    for query in (
        "tag.in=raw,other",
        "collection=a",
        "directly_in=a/b",
        "path=a/b/walk",
        "name=wa*",
        "frames.gte=40",
        "q=ALK",
    ):
        found = owner.get(f"/projects/lab/clips?{query}&fields=name,tags").json()["items"]
        assert found == [{"name": "walk", "tags": ["checked", "raw"]}], query
    for query in (
        "tag.in=other",
        "collection=b",
        "directly_in=a",
        "directly_in=",
        "path=a/walk",
        "name=wal",
        "frames.gte=41",
        "frames.lte=39",
    ):
        assert owner.get(f"/projects/lab/clips?{query}").json()["items"] == [], query


def test_an_unknown_or_unfit_query_parameter_is_named(owner: httpx.Client) -> None:
    refused = owner.get("/projects/lab/clips", params={"limit": "many", "colour": "red"})
    assert refused.status_code == 400
    assert [error["pointer"] for error in refused.json()["errors"]] == ["colour"]
    refused = owner.get("/projects/lab/clips", params={"limit": "many", "frames.gte": "-1"})
    assert {error["pointer"] for error in refused.json()["errors"]} == {"limit", "frames.gte"}


def test_an_address_that_is_not_utf8_is_refused_with_the_part_that_is_not(owner: httpx.Client) -> None:
    refused = owner.get("/projects/lab/clips/%FF")
    assert (refused.status_code, refused.json()["code"]) == (400, "not-utf8")
    assert refused.json()["detail"] == "The part 'item' of the address must be percent-encoded UTF-8."


def test_a_cursor_of_another_list_or_made_up_is_refused(owner: httpx.Client) -> None:
    for number in range(3):
        make(owner, "skeletons", f"s{number}", hierarchy=HIERARCHY)
    cursor = owner.get("/projects/lab/skeletons", params={"limit": 1}).json()["next_cursor"]
    for params in ({"cursor": cursor, "q": "x"}, {"cursor": cursor[:-2] + "AA"}, {"cursor": "x"}):
        refused = owner.get("/projects/lab/skeletons", params=params)
        assert (refused.status_code, refused.json()["code"]) == (400, "bad-cursor")


# -- errors ---------------------------------------------------------------------------------------------------------


def test_every_error_is_a_problem_document_with_the_request_id(owner: httpx.Client, server: Server) -> None:
    answers = [
        owner.get("/nowhere"),
        owner.get("/projects/none"),
        owner.put("/projects"),
        owner.request("OPTIONS", "/projects"),
        owner.post("/projects", content=b"{"),
        server.client("marey_000000000000_wrong").get("/me"),
        owner.post("/projects", content=b"x" * 2_000_000),
    ]
    assert [answer.status_code for answer in answers] == [404, 404, 405, 405, 400, 401, 413]
    for answer in answers:
        problem = answer.json()
        assert answer.headers["Content-Type"] == "application/problem+json"
        assert problem["status"] == answer.status_code
        assert problem["instance"] == answer.headers["X-Request-Id"]
    assert answers[2].headers["Allow"] == "GET, HEAD, POST"
    assert "Bearer" in answers[5].headers["WWW-Authenticate"]


def test_a_mistyped_address_is_a_page_in_a_browser_and_a_problem_document_elsewhere(server: Server) -> None:
    browser = "text/html,application/xhtml+xml,application/xml;q=0.9,image/avif,image/webp,*/*;q=0.8"
    for path in ("/veiw?clip=lab/clip_a", "/nothing", "/api/v1/nothing", "/%00"):
        url = f"{server.address}{path}"
        shown = httpx.get(url, headers={"Accept": browser})
        assert shown.status_code == 404
        assert shown.headers["Content-Type"] == "text/html; charset=utf-8"
        assert "default-src 'none'" in shown.headers["Content-Security-Policy"]
        assert "<h1>No page at this address</h1>" in shown.text
        for accept in ("*/*", "application/json", "application/json, text/html;q=0.5", "image/png", "text/html;q=0"):
            refused = httpx.get(url, headers={"Accept": accept})
            assert refused.status_code == 404
            assert refused.headers["Content-Type"] == "application/problem+json"
            assert refused.json()["code"] == "not-found"
            assert "/api/v1/docs lists the addresses" in refused.json()["detail"]
    assert httpx.post(f"{server.address}/nothing", headers={"Accept": browser}, content=b"x").status_code == 404
    missing = httpx.get(f"{server.api}/projects/nothing", headers={"Accept": browser})
    assert missing.headers["Content-Type"] == "application/problem+json", "a resource has one form of errors"


def test_what_is_wrong_with_a_body_is_pointed_at(owner: httpx.Client) -> None:
    body = {"name": "UPPER", "visibility": "secret", "colour": "red", "title": 5}
    refused = owner.post("/projects", json=body)
    assert refused.status_code == 422
    assert {error["pointer"] for error in refused.json()["errors"]} == {"/name", "/visibility", "/colour", "/title"}


def test_numbers_are_not_guessed_from_texts(owner: httpx.Client) -> None:
    assert owner.post("/uploads", json={"length": "5"}).status_code == 422
    assert owner.post("/uploads", json={"length": True}).status_code == 422


@pytest.mark.parametrize("text", ["a\0b", "\0"])
def test_a_nul_is_refused_wherever_it_stands(owner: httpx.Client, text: str) -> None:
    refused = owner.patch("/projects/lab", json={"title": text}, headers={"If-Match": "*"})
    assert (refused.status_code, refused.json()["errors"][0]["pointer"]) == (422, "/title")
    assert owner.get("/projects/lab/clips", params={"q": text}).status_code == 400
    assert owner.get("/projects/%00").status_code == 404


def test_a_sane_request_id_is_kept_and_another_replaced(owner: httpx.Client) -> None:
    assert owner.get("/me", headers={"X-Request-Id": "trace-0123.abc"}).headers["X-Request-Id"] == "trace-0123.abc"
    assert owner.get("/me", headers={"X-Request-Id": "<b>"}).headers["X-Request-Id"] != "<b>"


def test_a_body_sent_in_chunks_is_stopped_at_its_limit(owner: httpx.Client) -> None:
    refused = owner.post("/projects", content=(b"x" * 65536 for _ in range(40)))
    assert (refused.status_code, refused.json()["code"]) == (413, "too-large")
    assert owner.get("/me").status_code == 200


def test_a_fault_of_ours_shows_nothing_of_its_inside(
    server: Server, owner: httpx.Client, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_args: Any, **_kwargs: Any) -> None:
        raise RuntimeError("the secret inside")

    monkeypatch.setattr("marey_server.handlers.projects.projects.read_project", fail)
    failed = owner.get("/projects/lab")
    assert failed.status_code == 500
    assert "secret" not in failed.text
    assert failed.json()["instance"] == failed.headers["X-Request-Id"]
    assert "the secret inside" in caplog.text


# -- a connection ---------------------------------------------------------------------------------------------------


def talk(server: Server, data: bytes) -> bytes:
    """Send raw bytes, and return the answer of the server, which must then close the connection."""
    address = urlsplit(server.address)
    said = b""
    connecting = socket.create_connection((address.hostname, address.port), timeout=PATIENCE_S)
    with (
        connecting as connection,
        contextlib.suppress(ConnectionError),
    ):
        connection.sendall(data)  # the server may hang up before it has read everything
        while chunk := connection.recv(65536):
            said += chunk
    return said


def test_a_refused_sender_who_waits_for_a_go_is_told_at_once(server: Server) -> None:
    head = b"POST /api/v1/projects HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999\r\nExpect: 100-continue\r\n"
    said = talk(server, head + b"Connection: close\r\n\r\n")
    assert said.startswith(b"HTTP/1.1 401")
    assert b"100 (Continue)" not in said


@pytest.mark.parametrize("length", ["15, 15", "15\r\nContent-Length: 15", "0" * 50 + "15"])
def test_a_length_that_is_said_twice_or_at_length_is_one_length(server: Server, length: str) -> None:
    assert talk_of_a_project(server, length).startswith(b"HTTP/1.1 201")


@pytest.mark.parametrize("length", ["\xb2", "15, 16", "+15", "-1", "9" * 5000])
def test_a_length_that_is_no_number_is_refused(server: Server, length: str) -> None:
    assert talk_of_a_project(server, length).startswith(b"HTTP/1.1 400")


def talk_of_a_project(server: Server, length: str) -> bytes:
    """Send a body of 15 bytes whose Content-Length is `length`, and return the bytes of the answer."""
    head = f"POST /api/v1/projects HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {server.make_user('olga')}\r\n"
    return talk(
        server, f'{head}Connection: close\r\nContent-Length: {length}\r\n\r\n{{"name":"loft"}}'.encode("latin-1")
    )


def test_the_headers_of_a_stream_of_events_come_without_its_body(server: Server) -> None:
    token = server.make_project()
    asked = f"Host: x\r\nAuthorization: Bearer {token}\r\nAccept: text/event-stream\r\n"
    first = f"HEAD /api/v1/projects/lab/events HTTP/1.1\r\n{asked}\r\n"
    said = talk(server, f"{first}GET /healthz HTTP/1.1\r\n{asked}Connection: close\r\n\r\n".encode())
    head, _, following = said.partition(b"\r\n\r\n")
    assert b"Content-Type: text/event-stream" in head
    assert following.startswith(b"HTTP/1.1 406")  # what was asked next over the same connection


def test_a_head_without_end_is_cut_off(server: Server) -> None:
    said = talk(server, b"GET /healthz HTTP/1.1\r\n" + b"X-Filler: " + b"y" * 100_000)
    assert b"200 OK" not in said


def test_security_headers_are_on_every_answer(owner: httpx.Client) -> None:
    for answer in (owner.get("/me"), owner.get("/nowhere"), owner.get("/docs")):
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        assert "Access-Control-Allow-Origin" not in answer.headers


def test_a_large_answer_is_sent_from_the_memory_that_holds_it(
    owner: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    skeleton = make(owner, "skeletons", "three joints", hierarchy=HIERARCHY)
    path = f"/projects/lab/clips/{make(owner, 'clips', 'long', motion=motion(skeleton['id'], 4000))['id']}/parts/motion"
    bodies: list[bytes] = []
    written: list[object] = []
    encode, write = reply.encode, IOStream.write

    def encoding(content: reply.Content, media: MediaType) -> bytes:
        bodies.append(encode(content, media))
        return bodies[-1]

    def writing(stream: IOStream, data: bytes | memoryview) -> Future[None]:
        written.append(data)
        return write(stream, data)

    monkeypatch.setattr(reply, "encode", encoding)
    monkeypatch.setattr(IOStream, "write", writing)
    answer = owner.get(path, headers={"Accept": "application/json"})
    (body,) = bodies
    assert len(body) > JOINED_BYTES
    assert any(data is body for data in written)
    assert answer.content == body
    assert answer.headers["Content-Length"] == str(len(body))
    head = owner.head(path, headers={"Accept": "application/json"})
    assert (head.content, head.headers["Content-Length"]) == (b"", str(len(body)))
    assert owner.get(path).status_code == 200


# -- bytes ----------------------------------------------------------------------------------------------------------


def put_bytes(client: httpx.Client, data: bytes) -> str:
    path = f"/blobs/sha256:{hashlib.sha256(data).hexdigest()}"
    assert client.put(path, content=data).status_code == 204
    return path


@pytest.mark.parametrize("size", [0, 1, 70_000, 3_500_000])
def test_bytes_come_back_whole_and_in_ranges(owner: httpx.Client, size: int) -> None:
    data = np.random.default_rng(size).bytes(size)
    path = put_bytes(owner, data)
    whole = owner.get(path)
    assert whole.content == data
    assert whole.headers["Repr-Digest"].startswith("sha-256=:")
    assert "immutable" in whole.headers["Cache-Control"]
    head = owner.head(path)
    assert (head.status_code, head.content, head.headers["Content-Length"]) == (200, b"", str(size))
    assert owner.get(path, headers={"If-None-Match": whole.headers["ETag"]}).status_code == 304
    if size > 1000:
        part = owner.get(path, headers={"Range": "bytes=500-", "If-Range": whole.headers["ETag"]})
        assert (part.status_code, part.content) == (206, data[500:])
        assert part.headers["Content-Range"] == f"bytes 500-{size - 1}/{size}"
        assert owner.get(path, headers={"Range": "bytes=0-9", "If-Range": '"other"'}).content == data
    beyond = owner.get(path, headers={"Range": f"bytes={size}-"})
    assert (beyond.status_code, beyond.headers["Content-Range"]) == (416, f"bytes */{size}")


def test_bytes_under_a_wrong_name_are_refused_and_not_kept(owner: httpx.Client) -> None:
    path = f"/blobs/sha256:{'0' * 64}"
    assert owner.put(path, content=b"other bytes").json()["code"] == "digest-mismatch"
    assert owner.get(path).status_code == 404


@pytest.mark.parametrize("size", [10, 70_000])
def test_a_disk_that_is_full_while_bytes_come_in_says_so(
    owner: httpx.Client, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    whole = hashlib.sha256(bytes(size)).hexdigest()

    def full(_spool: Spool, _data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Spool, "write", full)
    refused = owner.put(f"/blobs/sha256:{whole}", content=bytes(size))
    assert (refused.status_code, refused.json()["code"]) == (507, "storage-full")
    monkeypatch.undo()
    assert owner.head(f"/blobs/sha256:{whole}").status_code == 404


def test_an_upload_goes_on_where_it_broke_off(owner: httpx.Client, server: Server) -> None:
    data = np.random.default_rng(1).bytes(2_500_000)
    made = owner.post("/uploads", json={"length": len(data)})
    path = made.headers["Location"].removeprefix("/api/v1")
    address = urlsplit(server.address)
    token = owner.headers["Authorization"]
    with socket.create_connection((address.hostname, address.port)) as connection:
        head = f"PATCH /api/v1{path} HTTP/1.1\r\nHost: x\r\nAuthorization: {token}\r\nUpload-Offset: 0\r\n"
        connection.sendall(head.encode() + f"Content-Length: {len(data)}\r\n\r\n".encode() + data[:1_500_000])
        deadline = time.monotonic() + PATIENCE_S
        while owner.get(path).json()["offset"] == 0 and time.monotonic() < deadline:
            time.sleep(0.02)
    offset = int(owner.head(path).headers["Upload-Offset"])
    assert 0 < offset < len(data)
    answer = owner.patch(path, content=data, headers={"Upload-Offset": "7"})
    assert answer.status_code == 409
    while answer.status_code == 409:  # a piece of the broken connection may still be on its way into the database
        offset = int(answer.headers["Upload-Offset"])
        assert 0 < offset < len(data)
        answer = owner.patch(path, content=data[offset:], headers={"Upload-Offset": str(offset)})
    done = answer.json()
    assert done["offset"] == len(data)
    assert owner.get(f"/blobs/{done['digest']}").content == data


def test_the_copy_of_an_upload_that_ends_without_a_blob_is_removed_at_once(
    server: Server, owner: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.database.blobs = DirectoryBlobs(tmp_path / "blobs")
    incoming = tmp_path / "blobs" / "incoming"
    path = owner.post("/uploads", json={"length": 10}).headers["Location"].removeprefix("/api/v1")
    assert owner.patch(path, content=b"12345", headers={"Upload-Offset": "0", **OCTETS}).status_code == 200
    assert [copy.read_bytes() for copy in incoming.iterdir()] == [b"12345"]
    assert owner.delete(path).status_code == 204
    assert list(incoming.iterdir()) == []

    def fail(*_: object) -> None:
        raise UnavailableProblem("The storage is away.")

    data = bytes(LONG_BODY_BYTES + 1)
    monkeypatch.setattr(uploads, "finish", fail)
    digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
    assert owner.put(f"/blobs/{digest}", content=data, headers=OCTETS).status_code == 503
    assert list(incoming.iterdir()) == []


def test_an_upload_waits_for_a_database_that_is_behind_but_not_for_ever(
    owner: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def is_always_behind(_database: Database) -> bool:
        asked.append(True)
        return True

    monkeypatch.setattr(Database, "is_behind", property(is_always_behind))
    path = owner.post("/uploads", json={"length": 5}).headers["Location"].removeprefix("/api/v1")
    answer = owner.patch(path, content=b"bytes", headers={"Upload-Offset": "0"})
    assert (answer.status_code, answer.json()["offset"]) == (200, 5)
    assert asked


@pytest.mark.parametrize(
    "header",
    [
        "Authorization: Bearer marey_secret\r",  # a token read from a file with DOS line ends
        "Authorization: Bearer marey_\x01secret",
        "Bearer marey_secret: x",
        "Content-Length: marey_secret",
        "Transfer-Encoding: marey_secret",
        "Host: marey_secret x",
    ],
)
def test_no_text_of_a_malformed_request_is_logged(
    server: Server, header: str, caplog: pytest.LogCaptureFixture
) -> None:
    general = logging.getLogger("tornado.general")
    general.addFilter(without_received_text)
    address = urlsplit(server.address)
    try:
        with caplog.at_level("INFO"), socket.create_connection((address.hostname, address.port), timeout=60) as sent:
            sent.sendall(f"GET /api/v1/me HTTP/1.1\r\nHost: x\r\n{header}\r\n\r\n".encode())
            while sent.recv(1024):  # to the end of the connection, which the server closes after it has logged
                pass
    finally:
        general.removeFilter(without_received_text)
    assert "Malformed HTTP message from 127.0.0.1" in caplog.text
    assert "secret" not in caplog.text
