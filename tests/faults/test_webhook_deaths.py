"""Servers that are killed while they send to webhooks: no delivery is lost, and few are repeated."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.server_process import ServerProcess
from tests.support.webhook_receiver import Open, Receiver, open_receiver

from marey_client import Marey
from marey_client.errors import MareyError
from marey_client.handles.webhooks import WebhookHandle
from marey_client.project import ProjectHandle
from marey_schemas.access import ProjectCreate
from marey_schemas.webhooks import WebhookChange

pytestmark = pytest.mark.timeout(600)
__all__ = ["open_receiver"]

EVENTS = 8
LOOPBACK = {"MAREY_WEBHOOK_NETWORKS": '["127.0.0.0/8"]'}


@pytest.fixture
def server(tmp_path: Path, database_url: str) -> Iterator[ServerProcess]:
    process = ServerProcess(tmp_path, database_url, **LOOPBACK)
    yield process
    process.stop()


def make_paused(marey: Marey, receiver: Receiver) -> tuple[ProjectHandle, WebhookHandle]:
    """Create a project and a paused webhook for new folders."""
    lab = marey.create_project(ProjectCreate(name="lab"))
    made = lab.webhooks.create(receiver.url, ["collection.created"])
    hook = lab.webhooks.at(made.id)
    hook.change(WebhookChange(paused=True))
    return lab, hook


def add_folders(lab: ProjectHandle, *names: str) -> None:
    for name in names:
        lab.collections.create(name)


def first_arrivals(receiver: Receiver) -> list[int]:
    """Return the numbers of the received events without repetitions, in the order in which the events first arrived."""
    return list(dict.fromkeys(one.message["seq"] for one in receiver.received))


@pytest.mark.every_nth(3)
@pytest.mark.parametrize(("place", "repeated"), [("before_record", 1), ("after_record", 0)])
@pytest.mark.parametrize("nth", [1, 3])
def test_a_server_killed_around_a_record_loses_no_delivery(
    server: ServerProcess, open_receiver: Open, place: str, repeated: int, nth: int
) -> None:
    receiver = open_receiver()
    server.start(fault=f"webhook.{place}@{nth}:kill")
    with server.client(patient=False) as marey:
        lab, hook = make_paused(marey, receiver)
        add_folders(lab, *(f"folder-{number}" for number in range(EVENTS)))
        with contextlib.suppress(MareyError):  # the server may die before it answers
            hook.change(WebhookChange(paused=False))
        server.wait_until_dead()
    assert len(receiver.received) == nth
    server.start()
    count = EVENTS + 1  # the root is a folder, too
    received = receiver.wait_for(lambda found: len(found) >= count + repeated)
    seqs = first_arrivals(receiver)
    assert len(seqs) == count
    assert seqs == sorted(seqs)
    assert len(received) == count + repeated
    with server.client() as marey:
        [hooked] = marey.project("lab").webhooks.list()
        assert hooked.failures == 0
    server.check_database()


def test_another_server_takes_over_and_only_one_delivers(
    server: ServerProcess, database_url: str, tmp_path_factory: pytest.TempPathFactory, open_receiver: Open
) -> None:
    receiver = open_receiver()
    other = ServerProcess(tmp_path_factory.mktemp("other"), database_url, **LOOPBACK)
    server.start()
    try:
        with server.client() as marey:
            lab, hook = make_paused(marey, receiver)
            hook.change(WebhookChange(paused=False))
            add_folders(lab, "one")
            receiver.wait_for(lambda found: len(found) >= 2)
            token = server.token
            other.start()
            add_folders(lab, *(f"folder-{number}" for number in range(EVENTS)))
            receiver.wait_for(lambda found: len(found) >= 2 + EVENTS)
        server.kill()
        with Marey(other.url, token) as marey:
            add_folders(marey.project("lab"), "after")
            receiver.wait_for(lambda _: len(first_arrivals(receiver)) >= 3 + EVENTS)
    finally:
        other.stop()
    seqs = first_arrivals(receiver)
    assert seqs == sorted(seqs)
    assert len(receiver.received) <= len(seqs) + 1  # the last outcome of the killed server may not have been recorded
