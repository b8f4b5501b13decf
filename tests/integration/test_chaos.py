"""Fault injection into a server: a server without defects passes, and planted defects are found."""

import random
from collections.abc import Iterator

import pytest
from tests.support.rest_server import ALL_SCOPES, Server

from marey_client.chaos import running
from marey_client.chaos.hostile_attempts import HOSTILE_CASES, HostileAttempt
from marey_client.errors import MareyError
from marey_client.load.calling import LoadAnswer, connection
from marey_client.load.scratch import Scratch, scratch_project
from marey_client.marey import Marey
from marey_schemas.kinds import Kind

HIERARCHY = {"schema": "marey/skeleton@1", "joints": [{"name": "Hips", "parent": -1, "offset": [0.0, 1.0, 0.0]}]}


@pytest.fixture
def scratch(server: Server) -> Iterator[Scratch]:
    with (
        Marey(server.address, server.make_user("ada", administrator=True, scopes=ALL_SCOPES)) as marey,
        scratch_project(marey) as made,
    ):
        yield made


@pytest.mark.parametrize("name", HOSTILE_CASES)
def test_a_sound_server_passes_each_case_with_one_visible_result(scratch: Scratch, name: str) -> None:
    job = running._submit(scratch, "there")
    found = running._attempt(scratch, job, name, random.Random(1))
    assert found.fault == ""
    assert running._check(scratch, job, Kind.SKELETON).fault == ""


def test_a_result_that_is_visible_twice_is_a_fault(scratch: Scratch) -> None:
    job = running._submit(scratch, "there")
    running._attempt(scratch, job, "double completion", random.Random(1))
    scratch.project.skeletons.create("another", {"hierarchy": HIERARCHY}, collection="there")
    assert "instead of one item with one revision" in running._check(scratch, job, Kind.SKELETON).fault


def test_a_job_that_has_not_succeeded_is_a_fault(scratch: Scratch) -> None:
    job = running._submit(scratch, "there")
    fault = running._check(scratch, job, Kind.SKELETON).fault
    for part in ("the job is queued", "0 attempts succeeded", "nothing", "no skeleton as its output"):
        assert part in fault


@pytest.mark.parametrize("name", ["double completion", "completion with a stale fence"])
def test_a_server_that_accepts_late_writes_is_found(
    scratch: Scratch, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = HostileAttempt.post

    def accepting(
        attempt: HostileAttempt, lease: dict[str, object], what: str, document: dict[str, object]
    ) -> LoadAnswer:
        answer = send(attempt, lease, what, document)
        return LoadAnswer(200, "", {}) if answer.status in (401, 409) else answer

    monkeypatch.setattr(HostileAttempt, "post", accepting)
    job = running._submit(scratch, "there")
    assert "but answered 200" in running._attempt(scratch, job, name, random.Random(1)).fault


def test_a_repeated_claim_that_gets_another_attempt_is_found(scratch: Scratch, monkeypatch: pytest.MonkeyPatch) -> None:
    claim, fences = HostileAttempt.claim, iter((1, 2))
    monkeypatch.setattr(HostileAttempt, "claim", lambda *given: claim(*given) | {"fence": next(fences)})
    job = running._submit(scratch, "there")
    found = running._attempt(scratch, job, "lost answers to claim and completion", random.Random(1))
    assert "got another attempt" in found.fault


def test_only_the_scratch_project_can_be_reached_with_the_token_of_the_test(scratch: Scratch) -> None:
    with scratch_project(scratch.marey) as other, connection(scratch.url, scratch.token) as caller:
        theirs = running._submit(other, "there")
        assert caller.post(f"/projects/{other.project.name}/jobs", scratch.job(own_workers=True)).status in (403, 404)
        with pytest.raises(MareyError, match="0 leases"):
            HostileAttempt(scratch, caller, theirs, random.Random(1)).claim()


def test_each_case_happens_and_equal_seeds_draw_equal_orders() -> None:
    cases = ["a", "b", "c"]
    assert sorted(running._drawn(cases, 0, random.Random(1))) == cases
    many = [running._drawn(cases, 17, random.Random(seed)) for seed in (1, 1, 2)]
    assert many[0] == many[1] != many[2]
    assert len(many[0]) == 20
    assert set(many[0]) == set(cases)
