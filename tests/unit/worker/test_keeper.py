"""Renewal of a job's lease by heartbeats, and checks before results are published."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import cast

import httpx
import pytest
from tests.support.present import present

from marey_client.errors import LeaseLost, Unavailable, Unreachable
from marey_client.retries import Retries
from marey_client.transport import Transport
from marey_schemas.problems import Problem
from marey_schemas.queue.jobs import Progress, Resources
from marey_schemas.queue.worker_protocol import HeartbeatAnswer, Lease
from marey_worker import attempt_api, heartbeats
from marey_worker.attempt_api import AttemptApi
from marey_worker.heartbeats import LeaseKeeper

LOST = LeaseLost(Problem(type="", title="", status=409, detail="lost", instance="r", code="lease-lost"))


class Api:
    """Simulated server that answers heartbeats."""

    def __init__(self) -> None:
        self.heard: list[Progress | None] = []
        self.error: Exception | None = None
        self.cancel = False
        self.beat = threading.Event()

    def heartbeat(self, progress: Progress | None, *, patiently: bool = False) -> HeartbeatAnswer:
        self.heard.append(progress)
        self.beat.set()
        if self.error is not None:
            raise self.error
        return HeartbeatAnswer(lease_ttl_s=60.0, cancel_requested=self.cancel)


def lease(*, heartbeat_s: float = 0.01, ttl_s: float = 60.0) -> Lease:
    return Lease(
        job="job_1", project="lab", kind="add", params={}, inputs={}, into="", seed=0, resources=Resources(), fence=1,
        attempt=1, attempt_token="t", lease_ttl_s=ttl_s, heartbeat_s=heartbeat_s,
    )  # fmt: skip


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> Api:
    monkeypatch.setattr(heartbeats, "TICK_S", 0.005)
    monkeypatch.setattr(heartbeats, "RETRY_S", 0.01)
    return Api()


@pytest.fixture
def keep(api: Api) -> Iterator[Callable[..., LeaseKeeper]]:
    started = []

    def keep(**figures: float) -> LeaseKeeper:
        started.append(LeaseKeeper(cast(AttemptApi, api), lease(**figures)))
        return started[-1]

    yield keep
    for one in started:
        one.stop()


def has_ended(keeper: LeaseKeeper) -> bool:
    """Wait for the end of the thread that sends heartbeats; return whether it has ended."""
    keeper._thread.join(60)
    return not keeper._thread.is_alive()


def test_heartbeats_go_on_until_stopped(api: Api, keep: Callable[..., LeaseKeeper]) -> None:
    one = keep()
    while len(api.heard) < 5:
        assert api.beat.wait(60)
        api.beat.clear()
    one.stop()
    assert has_ended(one)


def test_progress_is_reported_before_the_next_heartbeat_is_due(
    api: Api, keep: Callable[..., LeaseKeeper], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(heartbeats, "PROGRESS_EVERY_S", 0.02)
    keep(heartbeat_s=1000).set_progress(Progress(done=1, total=2))
    assert api.beat.wait(60)
    assert present(api.heard[0]).done == 1


def test_a_lost_lease_ends_the_heartbeats(api: Api, keep: Callable[..., LeaseKeeper]) -> None:
    api.error = LOST
    one = keep()
    assert one.lost.wait(60)
    assert has_ended(one)
    assert len(api.heard) == 1
    with pytest.raises(LeaseLost):
        one.confirm(patiently=False)


def test_a_request_to_cancel_is_heard(api: Api, keep: Callable[..., LeaseKeeper]) -> None:
    api.cancel = True
    assert keep().cancelled.wait(60)


def test_a_server_that_is_away_is_asked_again_and_the_lease_is_not_given_up(
    api: Api, keep: Callable[..., LeaseKeeper]
) -> None:
    api.error = Unreachable("away")
    one = keep()
    while len(api.heard) < 3:
        time.sleep(0.005)
    assert not one.lost.is_set()
    api.error = None
    one.confirm(patiently=False)


def test_nothing_is_confirmed_after_a_long_silence_without_asking(api: Api, keep: Callable[..., LeaseKeeper]) -> None:
    one = keep(heartbeat_s=1000, ttl_s=0.03)
    time.sleep(0.05)
    one.confirm(patiently=False)
    assert len(api.heard) == 1
    one.confirm(patiently=False)
    assert len(api.heard) == 1


@pytest.mark.parametrize("patiently", [True, False])
def test_a_result_waits_longer_for_a_server_that_is_away_than_a_failure_does(
    monkeypatch: pytest.MonkeyPatch, patiently: bool
) -> None:
    asked = []

    def server(request: httpx.Request) -> httpx.Response:
        asked.append(request.url.path)
        if len(asked) < 20:
            return httpx.Response(503)
        return httpx.Response(200, json={"lease_ttl_s": 60.0, "cancel_requested": False})

    monkeypatch.setattr(attempt_api, "PATIENT", Retries(tries=100, sleep=lambda _: None))
    hasty = Retries(tries=3, sleep=lambda _: None)
    held = lease(heartbeat_s=1000, ttl_s=0)
    with_server = Transport("http://server.test", "t", retries=hasty, http=httpx.MockTransport(server))
    one = LeaseKeeper(attempt_api.AttemptApi(with_server, held), held)
    try:
        if patiently:
            one.confirm(patiently=True)
            assert len(asked) == 20
        else:
            with pytest.raises(Unavailable):
                one.confirm(patiently=False)
            assert len(asked) == 3
    finally:
        one.stop()
