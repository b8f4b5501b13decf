"""List of workers: the facts that claims and attempts reveal about workers, and who may read the list."""

import pytest
from pydantic import ValidationError
from tests.support.queue_desk import Desk

from marey_schemas.queue.worker_protocol import ClaimRequest
from marey_schemas.queue.workers import Worker
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ForbiddenProblem, TooManyRequestsProblem
from marey_server.store.monitoring.workers import (
    ALIVE_S,
    FORGOTTEN_AFTER_S,
    LARGEST_CLAIM_BYTES,
    MOST_REMEMBERED,
    WorkerKey,
    WorkerMemory,
    list_workers,
)


class Seconds:
    """Clock that tests set."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def claim_of(name: str, **fields: object) -> ClaimRequest:
    return ClaimRequest.model_validate({"worker": name, "kinds": ["errand"]} | fields)


def workers(desk: Desk, memory: WorkerMemory) -> dict[str, Worker]:
    return {one.name: one for one in desk.database.read(SYSTEM, list_workers, memory.heard())}


def test_a_waiting_worker_is_alive_until_it_is_silent_and_forgotten_after_a_day(desk: Desk) -> None:
    clock = Seconds()
    memory = WorkerMemory(clock)
    memory.hear("usr_1", "tok_1", claim_of("host:1", labels={"gpu": "a100"}, version="0.1.0"))
    shown = workers(desk, memory)["host:1"]
    assert (shown.alive, shown.running, shown.version) == (True, 0, "0.1.0")
    assert (shown.kinds, shown.labels) == (("errand",), {"gpu": "a100"})
    clock.now += ALIVE_S + 1
    assert not workers(desk, memory)["host:1"].alive
    clock.now += FORGOTTEN_AFTER_S
    assert workers(desk, memory) == {}


@pytest.mark.parametrize("field", ["worker", "version", "kinds"])
@pytest.mark.parametrize("character", ["\x1b", "\n", "\x9b", "\x7f"])
def test_a_worker_cannot_announce_what_would_control_the_terminal_of_an_administrator(
    field: str, character: str
) -> None:
    text = f"host{character}]0;title"
    with pytest.raises(ValidationError, match="pattern"):
        claim_of("host", **{field: [text] if field == "kinds" else text})
    assert claim_of("Ångström-🦾:7").worker == "Ångström-🦾:7"


def test_a_worker_of_another_server_is_shown_while_it_runs_jobs(desk: Desk) -> None:
    desk.submit()
    desk.submit()
    desk.claim_many(2)
    (shown,) = workers(desk, WorkerMemory()).values()
    assert (shown.alive, shown.running) == (True, 2)
    assert (shown.version, shown.kinds, shown.labels) == (None, None, None)
    desk.clock.advance(61)
    assert workers(desk, WorkerMemory()) == {}


def test_only_administrators_see_workers(desk: Desk) -> None:
    owner = Principal("user", "usr_1", "ada", scopes=("read", "write", "jobs", "work", "admin"))
    with pytest.raises(ForbiddenProblem):
        desk.database.read(owner, list_workers, [])


def test_the_memory_of_workers_is_limited() -> None:
    memory = WorkerMemory()
    for number in range(MOST_REMEMBERED + 10):
        memory.hear("usr_1", "tok_1", claim_of(f"host:{number}"))
    memory.hear("usr_1", "tok_1", claim_of("long", kinds=["x" * LARGEST_CLAIM_BYTES]))
    names = {one.key.name for one in memory.heard()}
    assert len(names) == MOST_REMEMBERED
    assert not names & {"host:0", "long"}


def test_a_user_with_many_names_of_workers_displaces_only_workers_of_the_same_user() -> None:
    memory = WorkerMemory()
    memory.hear("usr_1", "tok_1", claim_of("quiet"))
    for number in range(MOST_REMEMBERED + 10):
        memory.hear("usr_2", f"tok_{number}", claim_of(f"host:{number}"))
    assert WorkerKey("tok_1", "quiet") in {one.key for one in memory.heard()}


def test_the_workers_of_a_user_that_are_alive_are_limited_and_may_be_replaced_by_others() -> None:
    clock = Seconds()
    memory = WorkerMemory(clock, most_of_user=3)
    for name in ("a", "b", "c"):
        memory.require_place("usr_1", "tok_1", name)
        memory.hear("usr_1", "tok_1", claim_of(name))
        clock.now += 10
    memory.require_place("usr_1", "tok_1", "a")  # which is alive already
    memory.require_place("usr_2", "tok_2", "d")
    with pytest.raises(TooManyRequestsProblem, match="3 workers with different names") as refused:
        memory.require_place("usr_1", "tok_3", "d")  # another token of the same user does not help
    assert (refused.value.error_code, refused.value.headers) == ("too-many-workers", {"Retry-After": "30"})
    clock.now += 31  # "a" is silent, as a pod that was replaced by another one
    memory.require_place("usr_1", "tok_1", "d")
