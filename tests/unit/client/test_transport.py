"""Requests of the client: retries, and errors of answers."""

import json
import logging
import os
import pickle
import socket
import ssl
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.scripted_server import ScriptedServer, problem

from marey_client import errors, transport
from marey_client.credentials import trusted_authorities
from marey_client.marey import Marey
from marey_client.retries import ONCE, Retries
from marey_schemas.access import Login, NewToken, ProjectCreate, TokenCreate
from marey_schemas.encoding.codecs import encode_tree
from marey_schemas.items import ItemChange

PROJECT = {
    "id": "project_1", "name": "lab", "visibility": "private", "created_at": "2026-01-01T00:00:00Z",
    "updated_at": "2026-01-01T00:00:00Z", "rev": 1,
}  # fmt: skip
ITEM = {
    "id": "clip_1", "kind": "clip", "name": "walk", "collection": "raw", "revision": 1, "rev": 4,
    "created_at": "2026-01-01T00:00:00Z", "updated_at": "2026-01-01T00:00:00Z",
}  # fmt: skip
LOST = httpx.ReadError("connection reset")
NEVER_CONNECTED = httpx.ConnectError("refused")
ROOT = Path(__file__).parents[2] / "support" / "root_of_nobody.pem"


def ok(document: dict[str, Any], status: int = 200) -> httpx.Response:
    return httpx.Response(status, json=document)


def test_a_read_is_sent_again_when_the_connection_is_lost(script: ScriptedServer) -> None:
    script.answers = [LOST, NEVER_CONNECTED, ok(PROJECT)]
    assert script.marey().project("lab").read().name == "lab"
    assert len(script.waited) == 2


def test_a_request_of_a_closed_client_is_refused_in_plain_words(script: ScriptedServer) -> None:
    marey = script.marey()
    marey.close()
    marey.close()  # closing twice does no harm
    with pytest.raises(errors.ConnectionClosed, match="the client is closed; keep it open"):
        marey.project("lab").read()


@pytest.mark.parametrize("broken", [LOST, httpx.RemoteProtocolError("Server disconnected")])
def test_a_server_that_stops_during_the_first_request_is_waited_for(script: ScriptedServer, broken: Exception) -> None:
    script.answers = [broken, *[NEVER_CONNECTED] * transport.TRIES_TO_REACH, ok(PROJECT)]
    assert script.marey().project("lab").read().name == "lab"


@pytest.mark.parametrize("name", ["a\n", "a?b=c", "a#b", "a%00", "é", "a b"])
def test_a_name_of_any_characters_stands_in_the_address_as_it_is(script: ScriptedServer, name: str) -> None:
    script.answers = [ok(PROJECT)]
    script.marey().project(name).read()
    assert script.requests[0].url.path == f"/api/v1/projects/{name}"
    assert not script.requests[0].url.query


@pytest.mark.parametrize("name", [".", ".."])
def test_a_name_never_leads_to_another_address(script: ScriptedServer, name: str) -> None:
    lab = script.marey().project("lab")
    with pytest.raises(errors.BadArgument, match="a name cannot be"):
        lab.members.remove(name)  # with the name .., this deleted the project
    assert not script.requests


@pytest.mark.parametrize("name", [".", ".."])
def test_no_item_is_called_by_dots_alone(script: ScriptedServer, name: str) -> None:
    script.answers = [ok({"items": []})]
    assert name not in script.marey().project("lab").clips


def test_a_post_is_sent_again_under_the_same_idempotency_key(script: ScriptedServer) -> None:
    script.answers = [LOST, ok(PROJECT, 201), ok(PROJECT)]
    script.marey().create_project(ProjectCreate(name="lab"))
    keys = {request.headers["Idempotency-Key"] for request in script.requests}
    assert len(script.requests) == 2
    assert len(keys) == 1


def test_two_posts_have_two_keys(script: ScriptedServer) -> None:
    script.answers = [ok(PROJECT, 201), ok(PROJECT, 201)]
    marey = script.marey()
    for _ in range(2):
        marey.create_project(ProjectCreate(name="lab"))
    assert len({request.headers["Idempotency-Key"] for request in script.requests}) == 2


def test_a_change_whose_answer_was_lost_is_not_sent_twice(script: ScriptedServer) -> None:
    script.answers = [ok(ITEM), LOST]
    clip = script.marey().project("lab").clips.get("clip_1")
    with pytest.raises(errors.Unreachable):
        clip.change(ItemChange(name="run"))
    assert len(script.requests) == 2


def test_a_change_that_never_arrived_is_sent_again(script: ScriptedServer) -> None:
    script.answers = [ok(ITEM), NEVER_CONNECTED, ok({**ITEM, "name": "run", "rev": 5})]
    clip = script.marey().project("lab").clips.get("clip_1")
    assert clip.change(ItemChange(name="run")).name == "run"
    assert script.requests[-1].headers["If-Match"] == '"4.json"'


def test_a_token_is_not_made_twice(script: ScriptedServer) -> None:
    script.answers = [LOST]
    with pytest.raises(errors.Unreachable):
        script.marey().tokens.create(TokenCreate(name="ci"))


def test_a_busy_server_is_waited_for_as_long_as_it_asks(script: ScriptedServer) -> None:
    script.answers = [
        problem(503, "unavailable", retry_after=7),
        problem(429, "too-many-requests"),
        ok(PROJECT),
    ]
    script.marey().project("lab").read()
    assert script.waited[0] >= 7
    assert script.waited[1] < 7


def test_trying_again_ends(script: ScriptedServer) -> None:
    script.answers = [ok(PROJECT), *[LOST] * 10]
    project = script.marey(retries=Retries(tries=5, sleep=script.waited.append)).project("lab")
    project.read()
    with pytest.raises(errors.Unreachable, match=r"http://server\.test does not answer"):
        project.read()
    assert len(script.requests) == 1 + 5


def test_a_server_that_was_never_there_is_given_up_sooner(script: ScriptedServer) -> None:
    script.answers = [NEVER_CONNECTED] * 10
    with pytest.raises(errors.Unreachable):
        script.marey().project("lab").read()
    assert len(script.requests) == 3


@pytest.mark.parametrize(
    ("status", "code", "expected"),
    [
        (401, "unauthenticated", errors.Unauthenticated),
        (403, "forbidden", errors.Forbidden),
        (404, "not-found", errors.NotFound),
        (409, "conflict", errors.Conflict),
        (409, "lease-lost", errors.LeaseLost),
        (412, "precondition-failed", errors.PreconditionFailed),
        (422, "invalid", errors.Invalid),
        (418, "teapot", errors.RequestFailed),
        (500, "internal", errors.ServerFailed),
        (507, "storage-full", errors.StorageFull),
    ],
)
def test_problems_become_errors_by_code_and_status(
    script: ScriptedServer, status: int, code: str, expected: type[errors.RequestFailed]
) -> None:
    field = {"pointer": "/name", "code": "taken", "detail": "is taken"}
    script.answers = [problem(status, code, errors=[field], context={"revision": 3})]
    with pytest.raises(expected) as caught:
        script.marey().project("lab").read()
    assert type(caught.value) is expected
    assert (caught.value.code, caught.value.request_id) == (code, "req-1")
    assert caught.value.errors[0].pointer == "/name"
    assert caught.value.context == {"revision": 3}


def test_an_error_of_something_in_between_is_told_too(script: ScriptedServer) -> None:
    script.answers = [httpx.Response(413, text="<html>too large</html>")]
    with pytest.raises(errors.TooLarge, match="413"):
        script.marey().project("lab").read()


@pytest.mark.parametrize("media_type", ["text/html", "application/problem+json"])
def test_an_error_of_another_server_names_the_address_and_asks_about_it(
    script: ScriptedServer, media_type: str
) -> None:
    script.answers = [httpx.Response(404, content=b'{"title": "?"}', headers={"Content-Type": media_type})]
    with pytest.raises(errors.NotFound, match=r"http://server\.test answered 404 .*check the address of the server"):
        script.marey().project("lab").read()


def test_errors_survive_the_way_from_one_process_to_another(script: ScriptedServer) -> None:
    wrong = [{"pointer": "/name", "code": "bad", "detail": "too long"}]
    script.answers = [problem(422, "invalid", detail="No.", errors=wrong)]
    with pytest.raises(errors.Invalid) as refused:
        script.marey().project("lab").read()
    again = pickle.loads(pickle.dumps(refused.value))
    assert (str(again), again.code, again.anonymous) == ("No. /name: too long", "invalid", False)
    ended = pickle.loads(pickle.dumps(errors.JobUnsuccessful("it failed", {"id": "job_1"})))
    assert (str(ended), ended.job) == ("it failed", {"id": "job_1"})


def test_an_answer_of_something_else_is_no_traceback(script: ScriptedServer) -> None:
    script.answers = [httpx.Response(200, text="<html>hello</html>")]
    with pytest.raises(errors.UnexpectedAnswer, match=r"answered 200 OK .* not an answer of a Marey server"):
        script.marey().project("lab").read()


def test_fields_that_a_newer_server_adds_are_ignored(script: ScriptedServer) -> None:
    script.answers = [ok({**PROJECT, "colour": "green"})]
    assert script.marey().project("lab").read().name == "lab"


def test_lists_are_read_page_by_page(script: ScriptedServer) -> None:
    script.answers = [ok({"items": [ITEM], "next_cursor": "c1"}), ok({"items": [{**ITEM, "id": "clip_2"}]})]
    clips = script.marey().project("lab").clips.list(collection="raw", filters={"frames.gte": 10, "tag.in": None})
    assert [clip.id for clip in clips] == ["clip_1", "clip_2"]
    assert script.requests[1].url.params["cursor"] == "c1"
    assert script.requests[1].url.params["frames.gte"] == "10"
    assert "tag.in" not in script.requests[1].url.params


def test_poses_come_as_arrays_in_blocks(script: ScriptedServer) -> None:
    poses = np.arange(22, dtype="<f4").reshape(2, 11)
    motion = {
        "schema": "marey/motion@1", "skeleton": {"item": "skeleton_1", "revision": 1}, "frame_rate_hz": 30.0,
        "joints": ["Hips", "Spine"], "poses": poses, "added later": 1,
    }  # fmt: skip
    body = encode_tree(motion, "application/msgpack", arrays="blocks")
    answer = httpx.Response(200, content=body, headers={"Content-Type": "application/msgpack; arrays=blocks"})
    script.answers = [ok(ITEM), answer]
    read = script.marey().project("lab").clips.get("clip_1").motion(frames=slice(4, 6), joints=["Hips", "Spine"])
    assert np.array_equal(read.root_translations, poses[:, :3])
    assert np.array_equal(read.rotations, poses[:, 3:].reshape(2, 2, 4))
    assert dict(script.requests[-1].url.params) == {"frames": "4:6", "joints": "Hips,Spine"}
    assert "arrays=blocks" in script.requests[-1].headers["Accept"]


@pytest.mark.parametrize("frames", [slice(0, 10, 2), slice(-5, None)])
def test_frames_that_a_query_cannot_say_are_refused(script: ScriptedServer, frames: slice) -> None:
    script.answers = [ok(ITEM)]
    with pytest.raises(ValueError, match=r"frames|negative"):
        script.marey().project("lab").clips.get("clip_1").motion(frames=frames)


def test_the_token_is_sent_and_shown_nowhere(script: ScriptedServer, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    script.answers = [NEVER_CONNECTED, ok(PROJECT)]
    marey = script.marey()
    project = marey.project("lab")
    project.read()
    assert script.requests[0].headers["Authorization"] == "Bearer marey_secret"
    shown = [repr(marey), repr(project), repr(vars(marey.transport)), repr(script.requests[0].headers), caplog.text]
    assert not any("marey_secret" in text for text in shown)
    assert "secret" not in str(script.requests[0].url)


@pytest.mark.parametrize("token", ["marey_secret\n", " marey_secret\r\n"])
def test_a_token_is_sent_without_the_end_of_its_line(script: ScriptedServer, token: str) -> None:
    script.answers = [ok({"items": [], "next_cursor": None})]
    list(Marey("http://server.test", token, http=httpx.MockTransport(script)).projects())
    assert script.requests[0].headers["Authorization"] == "Bearer marey_secret"


@pytest.mark.parametrize("token", ["marey_secret and more", "marey_secret\nmore", "m\u00e4rey_secret", "\x1b", "  "])
def test_what_is_no_token_is_refused_before_it_is_sent_and_shown_nowhere(script: ScriptedServer, token: str) -> None:
    with pytest.raises(errors.BadToken) as refused:
        Marey("http://server.test", token, http=httpx.MockTransport(script))
    assert "secret" not in str(refused.value)
    assert script.requests == []


@pytest.mark.parametrize(
    "url",
    [
        "127.0.0.1:8460", "marey.example.org", "ftp://marey.example.org", "http://", "http://127.0.0.256:8000",
        "http://999.1.1.1", "http://127.0.0.1:8460?x=1", "http://marey.example.org/#top",
    ],
)  # fmt: skip
def test_what_is_no_address_is_refused_before_anything_is_sent(url: str) -> None:
    with pytest.raises(errors.BadAddress, match="not the address of a server"):
        Marey(url, "marey_secret")


@pytest.mark.parametrize(
    "url",
    [
        "http://ada:enigma@127.0.0.1:8460",
        "http://ada:enigma@127.0.0.1:port",
        "ada:enigma@127.0.0.1",
        "http://a:enigma@[",
    ],
)
def test_an_address_with_a_password_is_refused_without_repeating_it(url: str) -> None:
    with pytest.raises(errors.BadAddress, match="must not contain a user name or a password") as refused:
        Marey(url, "marey_secret")
    assert "enigma" not in str(refused.value)


def test_authorities_of_the_house_are_trusted_beside_the_public_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    public = len(trusted_authorities().get_ca_certs())
    monkeypatch.setenv("SSL_CERT_FILE", str(ROOT))
    trusted = trusted_authorities()
    authorities: list[dict[str, Any]] = trusted.get_ca_certs()
    names = [dict(part[0] for part in one["subject"]).get("commonName") for one in authorities]
    assert "Root of the tests" in names
    assert public > 50
    assert len(names) > 50
    assert trusted.verify_mode is ssl.CERT_REQUIRED
    assert trusted.check_hostname


def test_certificates_are_read_by_the_first_request_with_tls(monkeypatch: pytest.MonkeyPatch) -> None:
    contexts: list[ssl.SSLContext] = []

    def read() -> ssl.SSLContext:
        contexts.append(trusted_authorities())
        return contexts[-1]

    monkeypatch.setattr(transport, "trusted_authorities", read)
    with socket.socket() as closed:  # refuses connections, because it does not listen
        closed.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{closed.getsockname()[1]}"
        for scheme, count in (("http", 0), ("https", 1)):
            with Marey(f"{scheme}://{place}", "marey_secret", retries=ONCE) as marey:
                assert contexts == []
                for _ in range(2):
                    with pytest.raises(errors.Unreachable):
                        list(marey.projects())
            assert len(contexts) == count
    assert contexts[0].verify_mode is ssl.CERT_REQUIRED


def test_a_password_is_sent_though_it_hides_itself(script: ScriptedServer) -> None:
    token = {"id": "token_1", "name": "x", "prefix": "p", "scopes": ["read"], "created_at": "2026-01-01T00:00:00Z"}
    script.answers = [ok({**token, "expires_at": None, "secret": "s"})]
    login = Login(name="ada", password="correct horse")
    assert isinstance(script.marey().sign_in(login), NewToken)
    assert b"correct horse" in script.requests[0].content
    assert "correct horse" not in repr(login)


def test_a_server_that_starts_again_is_waited_for() -> None:
    restart_s = 15.0
    patient = Retries(random_unit=lambda: 1.0)  # even where every wait is as short as can be
    assert sum(patient.delay_s(tried, None) for tried in range(1, patient.tries)) > restart_s


def test_a_long_wait_for_the_server_is_told_with_the_time_that_is_left(script: ScriptedServer) -> None:
    told: list[str] = []
    retries = Retries(tries=5, total_s=40.0, sleep=script.waited.append, notice=told.append)
    script.answers = [ok({"user": None, "scopes": []}), LOST, LOST, LOST, LOST, ok({"user": None, "scopes": []})]
    marey = script.marey(retries=retries)
    marey.me()
    assert told == []
    marey.me()
    assert [text.rpartition("//")[2].partition(" ")[2] for text in told] == [
        "does not answer; trying again for 40 s"
    ] * 2


def test_a_rotation_whose_answer_was_lost_is_repeated_with_the_same_id(script: ScriptedServer) -> None:
    made = {
        "id": "token_2", "name": "w", "prefix": "bbb", "scopes": ["work"], "expires_at": None,
        "created_at": "2026-01-01T00:00:00Z", "successor_of": "token_1", "secret": "marey_bbb_new",
    }  # fmt: skip
    script.answers = [ok({"user": None, "scopes": ["work"], "token": "token_1"}), LOST, ok(made)]
    assert script.marey().tokens.rotate(grace=timedelta(minutes=5)).secret == "marey_bbb_new"
    first, again = (json.loads(one.content) for one in script.requests[1:])
    assert first == again
    assert (len(first["rotation_id"]), first["grace_s"]) == (32, 300)


def test_a_server_that_does_not_name_the_token_is_not_asked_to_rotate_it(script: ScriptedServer) -> None:
    script.answers = [ok({"user": None, "scopes": ["work"]})]
    with pytest.raises(errors.UnexpectedAnswer, match="upgrade"):
        script.marey().tokens.rotate()
    assert len(script.requests) == 1


def test_a_forked_process_opens_connections_of_its_own(script: ScriptedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    transport = script.marey().transport
    before = transport._client
    assert transport._client is before
    monkeypatch.setattr(os, "getpid", lambda: -1)
    assert transport._client is transport.with_token("marey_other")._client is not before


@pytest.mark.parametrize("name", ["", "bob/identities/id", "/bob", "bob/"])
def test_a_name_that_would_lead_to_another_resource_is_refused(name: str) -> None:
    """`marey user disable bob/identities/ID` removed a link of bob, and said that a user is disabled."""
    sent: list[httpx.Request] = []

    def note(request: httpx.Request) -> httpx.Response:
        sent.append(request)
        return httpx.Response(204)

    with Marey("http://server.test", "token", http=httpx.MockTransport(note)) as marey:
        lab = marey.project("lab")
        for act in (
            marey.users.disable, marey.tokens.revoke, lab.members.remove, lab.clips.restore,
            lab.datasets.at("gaits").delete_ref,
        ):  # fmt: skip
            with pytest.raises(errors.BadArgument, match="is neither a name nor an id"):
                act(name)
    assert sent == []
