"""Deliveries of webhooks to real receivers on this machine: order, retries, requests, pauses, refused addresses."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server, running
from tests.support.webhook_receiver import SELF_SIGNED, Open

from marey_schemas.backoff import Backoff
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Quotas
from marey_server.store.webhooks import outbox
from marey_server.webhooks import delivering


@pytest.fixture
def server(database: Database, tmp_path: Path) -> Iterator[Server]:
    """A server that may send to this machine."""
    with running(database, tmp_path, webhook_networks=("127.0.0.0/8",)) as one:
        yield one


def make_webhook(owner: httpx.Client, url: str, **values: Any) -> dict[str, Any]:
    made = owner.post("/projects/lab/webhooks", json={"url": url, "kinds": ["collection.created"], **values})
    assert made.status_code == 201, made.text
    return dict(made.json())


def add_folders(owner: httpx.Client, *names: str) -> None:
    for name in names:
        assert owner.post("/projects/lab/collections", json={"path": name}).is_success


def test_events_are_delivered_in_order_with_signatures(owner: httpx.Client, open_receiver: Open) -> None:
    receiver = open_receiver()
    made = make_webhook(owner, receiver.url)
    names = [f"folder-{number:02d}" for number in range(20)]
    add_folders(owner, *names)
    events = owner.get("/projects/lab/events", params={"limit": 1000}).json()["items"]
    expected = [one["seq"] for one in events if one["kind"] == "collection.created"]
    received = receiver.wait_for(lambda found: len(found) >= len(expected))
    assert len(expected) > 20
    assert [one.message["seq"] for one in received] == expected
    assert all(one.is_signed_with(made["secret"]) for one in received)
    first = received[0]
    assert first.headers["webhook-id"] == first.message["id"] == f"{made['id']}-{expected[0]}"
    assert first.headers["marey-event"] == "collection.created"
    assert abs(int(first.headers["webhook-timestamp"]) - time.time()) < 60
    [event] = owner.get(first.message["links"]["event"].removeprefix("/api/v1")).json()["items"]
    assert (event["seq"], event["subject"]) == (expected[0], first.message["subject"])


@pytest.fixture
def quick_retries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Repeat failed deliveries after some milliseconds, and stop after three attempts."""
    monkeypatch.setattr(outbox, "RETRY", Backoff(first_s=0.02, longest_s=0.1))
    monkeypatch.setattr(outbox, "MOST_ATTEMPTS", 3)


def read(owner: httpx.Client, hook: dict[str, Any], what: str = "") -> dict[str, Any]:
    found = owner.get(f"/projects/lab/webhooks/{hook['id']}{what}")
    assert found.is_success, found.text
    return dict(found.json())


def send(owner: httpx.Client, hook: dict[str, Any], what: str, body: Any = None) -> httpx.Response:
    return owner.post(f"/projects/lab/webhooks/{hook['id']}/{what}", json=body)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


def test_a_failed_delivery_is_repeated_and_later_ones_wait_for_it(
    owner: httpx.Client, open_receiver: Open, quick_retries: None
) -> None:
    receiver = open_receiver(status=500)
    hook = make_webhook(owner, receiver.url, kinds=["collection.moved", "collection.deleted"])
    add_folders(owner, "one")
    [folder] = [one for one in owner.get("/projects/lab/collections").json()["items"] if one["path"] == "one"]
    at = f"/projects/lab/collections/{folder['id']}"
    assert owner.patch(at, json={"path": "two"}, headers={"If-Match": "*"}).is_success
    receiver.wait_for(lambda found: len(found) >= 2)
    receiver.status = 200
    assert owner.delete(at, headers={"If-Match": "*"}).is_success
    received = receiver.wait_for(lambda found: found[-1].message["kind"] == "collection.deleted")
    assert [one.message["kind"] for one in received[:-1]] == ["collection.moved"] * (len(received) - 1)
    assert len({one.headers["webhook-id"] for one in received}) == 2
    wait_until(lambda: read(owner, hook)["failures"] == 0)
    [noted] = read(owner, hook, "/deliveries")["items"]
    assert (noted["state"], noted["attempts"], noted["last_error"]) == ("delivered", len(received) - 1, None)
    assert "marey_webhook_deliveries_total" in owner.get(str(owner.base_url).replace("/api/v1/", "/metrics")).text


def test_a_delivery_that_fails_too_often_is_given_up_and_can_be_sent_again(
    owner: httpx.Client, open_receiver: Open, quick_retries: None
) -> None:
    receiver = open_receiver(status=503, answer=b"the password is 1234")
    hook = make_webhook(owner, receiver.url, kinds=["collection.moved"])
    add_folders(owner, "one")
    [folder] = [one for one in owner.get("/projects/lab/collections").json()["items"] if one["path"] == "one"]
    owner.patch(f"/projects/lab/collections/{folder['id']}", json={"path": "two"}, headers={"If-Match": "*"})
    wait_until(lambda: read(owner, hook)["dead"] == 1)
    [dead] = read(owner, hook, "/deliveries?state=dead")["items"]
    assert (dead["attempts"], dead["last_status"]) == (3, 503)
    assert dead["last_error"] == "the answer has the status 503"
    assert "1234" not in json.dumps(dead) + json.dumps(read(owner, hook))
    receiver.status = 200
    asked = send(owner, hook, f"deliveries/{dead['id']}/redeliver")
    assert (asked.status_code, asked.json()["state"]) == (202, "waiting")
    wait_until(lambda: read(owner, hook, f"/deliveries/{dead['id']}")["state"] == "delivered")
    assert {one.headers["webhook-id"] for one in receiver.received} == {dead["id"]}
    assert len(receiver.received) == 4


def test_a_test_is_sent_once_and_its_failure_is_reported(owner: httpx.Client, open_receiver: Open) -> None:
    receiver = open_receiver(status=404)
    hook = make_webhook(owner, receiver.url)
    asked = send(owner, hook, "test").json()
    wait_until(lambda: read(owner, hook, f"/deliveries/{asked['id']}")["state"] == "dead")
    assert receiver.kinds == ["webhook.test"]
    assert read(owner, hook, f"/deliveries/{asked['id']}")["last_status"] == 404
    assert read(owner, hook)["failures"] == 0


def test_a_slow_receiver_does_not_delay_another_one(owner: httpx.Client, open_receiver: Open) -> None:
    slow, fast = open_receiver(silent=True), open_receiver()
    make_webhook(owner, slow.url)
    make_webhook(owner, fast.url)
    add_folders(owner, *(f"folder-{number}" for number in range(10)))
    fast.wait_for(lambda found: len(found) >= 10)
    assert slow.received == []  # its first request still waits for its answer


def test_a_redirect_is_a_failure_and_is_not_followed(owner: httpx.Client, open_receiver: Open) -> None:
    target = open_receiver()
    receiver = open_receiver(status=307, headers={"Location": target.url})
    hook = make_webhook(owner, receiver.url)
    add_folders(owner, "one")
    wait_until(lambda: read(owner, hook)["failures"] == 1)
    assert read(owner, hook)["last_error"] == "the answer has the status 307; redirects are not followed"
    assert target.received == []


def test_a_receiver_whose_certificate_nobody_vouches_for_gets_nothing(
    owner: httpx.Client, open_receiver: Open, tmp_path: Path
) -> None:
    certificate = tmp_path / "self-signed.pem"
    certificate.write_text(SELF_SIGNED)
    receiver = open_receiver(certificate=certificate)
    hook = make_webhook(owner, receiver.url)
    add_folders(owner, "one")
    wait_until(lambda: read(owner, hook)["failures"] == 1)
    assert read(owner, hook)["last_error"].startswith("the certificate is not valid: self")
    assert receiver.received == []


def test_a_long_answer_is_not_read_to_its_end(owner: httpx.Client, open_receiver: Open) -> None:
    receiver = open_receiver(status=200, answer=b"x" * (1 << 20))
    hook = make_webhook(owner, receiver.url)
    add_folders(owner, "one")
    wait_until(lambda: read(owner, hook)["delivered_at"] is not None)
    assert read(owner, hook)["last_error"] is None


def test_a_paused_webhook_sends_nothing_and_continues_where_it_stopped(
    owner: httpx.Client, open_receiver: Open
) -> None:
    receiver = open_receiver()
    hook = make_webhook(owner, receiver.url)
    at = f"/projects/lab/webhooks/{hook['id']}"
    assert owner.patch(at, json={"paused": True}).json()["paused"]
    add_folders(owner, "one", "two")
    assert send(owner, hook, "test").json()["code"] == "webhook-paused"
    time.sleep(0.3)
    assert receiver.received == []
    assert not owner.patch(at, json={"paused": False}).json()["paused"]
    receiver.wait_for(lambda found: len(found) >= 2)


def test_a_webhook_that_fails_for_days_is_paused_with_the_reason(
    owner: httpx.Client, open_receiver: Open, quick_retries: None, clock: AdjustableClock
) -> None:
    receiver = open_receiver(status=500)
    hook = make_webhook(owner, receiver.url)
    add_folders(owner, "one")
    wait_until(lambda: read(owner, hook)["failures"] >= 1)
    clock.advance(6 * 86400)
    add_folders(owner, "two", "three")
    wait_until(lambda: bool(read(owner, hook)["paused"]))
    reason = read(owner, hook)["paused_reason"]
    assert reason == "every attempt has failed for 5 days; the last error: the answer has the status 500"
    resumed = owner.patch(f"/projects/lab/webhooks/{hook['id']}", json={"paused": False}).json()
    assert (resumed["paused"], resumed["paused_reason"], resumed["failing_since"]) == (False, None, None)


def test_for_a_time_deliveries_are_signed_with_the_old_and_the_new_secret(
    owner: httpx.Client, open_receiver: Open, clock: AdjustableClock
) -> None:
    receiver = open_receiver()
    hook = make_webhook(owner, receiver.url)
    rotated = send(owner, hook, "rotate", {"grace_s": 3600})
    assert rotated.headers["Cache-Control"] == "no-store"
    new = rotated.json()["secret"]
    assert new != hook["secret"]
    send(owner, hook, "test")
    [both] = receiver.wait_for(lambda found: len(found) == 1)
    assert both.is_signed_with(new)
    assert both.is_signed_with(hook["secret"])
    clock.advance(3601)
    send(owner, hook, "test")
    [_, one] = receiver.wait_for(lambda found: len(found) == 2)
    assert one.is_signed_with(new)
    assert not one.is_signed_with(hook["secret"])


def test_the_secret_is_in_no_list_event_url_or_log(
    owner: httpx.Client, open_receiver: Open, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG")
    receiver = open_receiver(status=500)
    hook = make_webhook(owner, f"{receiver.url}?key=in-the-address")
    rotated = send(owner, hook, "rotate", {}).json()["secret"]
    add_folders(owner, "one")
    wait_until(lambda: read(owner, hook)["failures"] >= 1)
    shown = owner.get("/projects/lab/webhooks").text + json.dumps(read(owner, hook)) + caplog.text
    shown += owner.get("/projects/lab/events", params={"limit": 1000}).text
    shown += json.dumps(read(owner, hook, "/deliveries"))
    for secret in (hook["secret"], rotated):
        assert secret.removeprefix("whsec_") not in shown
    assert "in-the-address" not in caplog.text.replace(f"{owner.base_url}", "")


REFUSED_URLS = (
    "http://127.0.0.1/", "http://localhost:1/", "http://[::1]/", "http://10.1.2.3/", "http://169.254.169.254/latest",
    "http://0x7f.1/", "http://2130706433/", "https://[::ffff:10.0.0.1]/", "http://[fe80::1]/", "http://100.64.0.1/",
)  # fmt: skip
MALFORMED_URLS = (
    "ftp://example.org/", "//example.org", "https://", "https://ada:pw@example.org/", "https://example.org/#part",
    "https://example.org:99999/", "https://exa mple.org/", "https://bücher.example/",
    f"https://example.org/{'x' * 2048}",
)  # fmt: skip


def test_urls_that_no_webhook_may_have_are_refused(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path) as server:
        owner = server.client(server.make_project())
        for url in REFUSED_URLS:
            answer = owner.post("/projects/lab/webhooks", json={"url": url})
            assert (answer.status_code, answer.json()["code"]) == (422, "private-address"), url
        for url in MALFORMED_URLS:
            assert owner.post("/projects/lab/webhooks", json={"url": url}).status_code == 422, url
        hook = make_webhook(owner, "https://example.invalid/")
        answer = owner.patch(f"/projects/lab/webhooks/{hook['id']}", json={"url": REFUSED_URLS[0]})
        assert answer.json()["code"] == "private-address"


def test_a_name_that_resolves_to_a_private_address_is_refused_at_delivery(
    database: Database, tmp_path: Path, open_receiver: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    receiver = open_receiver()
    port = int(receiver.url.split(":")[2].split("/")[0])
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("127.0.0.1", port))]
    resolved: list[str] = []

    def look_up(host: str, *args: Any) -> list[Any]:
        if host != "inside.example.org":
            return list(original(host, *args))
        resolved.append(host)
        return found

    original = socket.getaddrinfo
    with running(database, tmp_path) as server:
        owner = server.client(server.make_project())
        monkeypatch.setattr(socket, "getaddrinfo", look_up)
        hook = make_webhook(owner, f"http://inside.example.org:{port}/")
        asked = send(owner, hook, "test").json()
        wait_until(lambda: read(owner, hook, f"/deliveries/{asked['id']}")["state"] == "dead")
        assert "no public address" in read(owner, hook, f"/deliveries/{asked['id']}")["last_error"]
    assert resolved
    assert receiver.received == []


def test_a_project_has_a_limited_number_of_webhooks(database: Database, tmp_path: Path) -> None:
    database.quotas = Quotas(project_webhooks=2)
    with running(database, tmp_path) as server:
        owner = server.client(server.make_project())
        for number in range(2):
            make_webhook(owner, f"https://example.invalid/{number}")
        answer = owner.post("/projects/lab/webhooks", json={"url": "https://example.invalid/"})
        assert (answer.status_code, answer.json()["code"]) == (409, "quota-exceeded")
        assert answer.json()["context"] == {"quota": "project_webhooks", "used": 2, "limit": 2}


def test_a_deleted_webhook_sends_nothing_more(owner: httpx.Client, open_receiver: Open) -> None:
    receiver = open_receiver(status=500)
    hook = make_webhook(owner, receiver.url)
    add_folders(owner, "one")
    receiver.wait_for(lambda found: len(found) >= 1)
    assert owner.delete(f"/projects/lab/webhooks/{hook['id']}").status_code == 204
    assert owner.get(f"/projects/lab/webhooks/{hook['id']}").json()["code"] == "no-webhook"
    assert owner.get("/projects/lab/webhooks").json()["items"] == []


def test_deliveries_continue_after_the_server_could_not_renew_its_lead(
    owner: httpx.Client, open_receiver: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivering, "RENEW_EVERY_S", 0.2)
    receiver = open_receiver()
    make_webhook(owner, receiver.url)
    send_one = delivering.Deliverer._send
    doubts = iter(range(3))

    async def send_if_leading(self: Any, *args: Any) -> Any:
        return await send_one(self, *args) if next(doubts, None) is None else None

    monkeypatch.setattr(delivering.Deliverer, "_send", send_if_leading)
    add_folders(owner, "first")
    receiver.wait_for(lambda found: len(found) == 2)


def test_a_delivery_that_is_interrupted_during_a_search_for_work_is_sent(
    owner: httpx.Client, open_receiver: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search has read the database before the interruption, so it does not find the interrupted delivery."""
    monkeypatch.setattr(delivering, "RENEW_EVERY_S", 0.2)
    receiver = open_receiver()
    make_webhook(owner, receiver.url)
    sending, searched, interrupted = threading.Event(), threading.Event(), threading.Event()
    send_batch, find_work = delivering.Deliverer._send_batch, outbox.find_work

    async def interrupt_once(self: Any, *args: Any) -> Any:
        if interrupted.is_set():
            return await send_one(self, *args)
        sending.set()
        await asyncio.to_thread(searched.wait, PATIENCE_S)
        return None

    async def note_interruption(self: Any, *args: Any) -> bool:
        try:
            return await send_batch(self, *args)
        finally:
            if sending.is_set():
                interrupted.set()

    def search(*args: Any) -> outbox.Work:
        found = find_work(*args)
        if sending.is_set():
            searched.set()
            interrupted.wait(PATIENCE_S)
        return found

    send_one = delivering.Deliverer._send
    monkeypatch.setattr(delivering.Deliverer, "_send", interrupt_once)
    monkeypatch.setattr(delivering.Deliverer, "_send_batch", note_interruption)
    monkeypatch.setattr(outbox, "find_work", search)
    add_folders(owner, "first")
    received = receiver.wait_for(lambda found: len(found) == 2)
    assert {one.message["kind"] for one in received} == {"collection.created"}
