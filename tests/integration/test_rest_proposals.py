"""Proposals over HTTP: protection, comments, reviews, checks and merges, with several users."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock

import httpx
import pytest
from sqlalchemy import update
from tests.support.database_fixtures import BACKENDS, copied_sqlite, database_address, new_postgres_database
from tests.support.furnished_house import MOTION
from tests.support.rest_server import Server, running

from marey_server.access.principal import SYSTEM
from marey_server.errors import ConflictProblem, QuotaExceededProblem
from marey_server.process import housekeeping
from marey_server.store.database.connections import Database
from marey_server.store.datasets import proposals
from marey_server.store.datasets.merging import record_merge
from marey_server.store.datasets.proposals import WaitingMerges, accepting
from marey_server.store.datasets.proposals import waiting as waiting_module
from marey_server.store.fsck import check_store
from marey_server.store.tables import job, proposal
from marey_server.store.transaction import Quotas, Transaction
from marey_versions.tree.chunks import DamagedChunk

LAB = "/projects/lab"
GAITS = f"{LAB}/datasets/gaits"
MAIN = f"{GAITS}/refs/main"
PROPOSALS = f"{GAITS}/proposals"
ANY = {"If-Match": "*"}
on_sqlite = pytest.mark.parametrize("server", ["sqlite"], indirect=True)
"""Mark of tests of rules that do not depend on the kind of database."""


def ok(response: httpx.Response, status: int = 200) -> Any:
    assert response.status_code == status, response.text
    return response.json()


def refused(response: httpx.Response, status: int, code: str) -> Any:
    assert (response.status_code, response.json().get("code")) == (status, code), response.text
    return response.json()


@dataclass(frozen=True)
class Team:
    """Clients of members with every role and of a stranger (`eve`), and items for commits."""

    olga: httpx.Client
    mia: httpx.Client
    ada: httpx.Client
    ben: httpx.Client
    rita: httpx.Client
    eve: httpx.Client
    items: tuple[str, ...]

    def put(self, branch: str, path: str, item: int, **fields: Any) -> httpx.Response:
        """Commit an entry with the item number `item` at `path` to a branch; return the answer."""
        change = {"change": "put", "path": path, "item": self.items[item]}
        return self.ada.post(f"{GAITS}/commits", json={"branch": branch, "message": path, "changes": [change]})

    def propose(self, **fields: Any) -> int:
        number: int = ok(self.ada.post(PROPOSALS, json={"title": "Trim", "source": "trial", **fields}), 201)["number"]
        return number

    def protect(self, **rule: Any) -> None:
        ok(self.mia.put(f"{MAIN}/protection", json=rule, headers=ANY))

    def missing(self, number: int) -> list[str]:
        found = ok(self.rita.get(f"{PROPOSALS}/{number}"))["mergeability"]
        return [one["code"] for one in found["missing"]]


def skeleton(name: str) -> dict[str, Any]:
    joints = [{"name": name, "parent": -1, "offset": [0, 1, 0]}]
    return {"name": name, "parts": {"hierarchy": {"schema": "marey/skeleton@1", "joints": joints}}}


@pytest.fixture(scope="module", params=BACKENDS)
def server(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that all tests with one kind of database share; each test has its own project `lab`.

    The server's housekeeping does not merge waiting proposals, so that tests decide when these are merged.
    """
    folder = tmp_path_factory.mktemp("server")
    with contextlib.ExitStack() as after:
        patched = after.enter_context(pytest.MonkeyPatch.context())
        patched.setattr(housekeeping, "_merge_waiting", AsyncMock())
        if request.param == "sqlite":
            url = copied_sqlite(request.getfixturevalue("sqlite_template"), folder)
        else:
            postgres = request.getfixturevalue("postgres_url")
            url = database_address(after.enter_context(new_postgres_database(postgres, "proposals")))
        database = Database(url)
        after.callback(database.close)
        yield after.enter_context(running(database, folder))


@pytest.fixture(scope="module")
def people(server: Server) -> dict[str, httpx.Client]:
    """The clients of all users, by name."""
    return {name: server.client(server.make_user(name)) for name in ("olga", "mia", "ada", "ben", "rita", "eve")}


@pytest.fixture
def team(people: dict[str, httpx.Client]) -> Iterator[Team]:
    """The users and the dataset `gaits`, which has one commit on `main` and another one on the branch `trial`."""
    olga, ada = people["olga"], people["ada"]
    ok(olga.post("/projects", json={"name": "lab"}), 201)
    for name, role in (("mia", "maintainer"), ("ada", "contributor"), ("ben", "contributor"), ("rita", "reader")):
        ok(olga.put(f"{LAB}/members/{name}", json={"role": role}))
    items = tuple(ok(ada.post(f"{LAB}/skeletons", json=skeleton(name)), 201)["id"] for name in ("a", "b", "c"))
    ok(ada.post(f"{LAB}/datasets", json={"name": "gaits"}), 201)
    made = Team(**people, items=items)
    ok(made.put("main", "a", 0), 201)
    ok(ada.post(f"{GAITS}/refs", json={"name": "trial", "kind": "branch"}), 201)
    ok(made.put("trial", "b", 1), 201)
    yield made
    olga.delete(LAB, headers=ANY)


def head(team: Team, branch: str) -> str:
    commit: str = ok(team.rita.get(f"{GAITS}/refs/{branch}"))["commit"]
    return commit


def approve(client: httpx.Client, number: int, verdict: str = "approve", **fields: Any) -> Any:
    return ok(client.post(f"{PROPOSALS}/{number}/reviews", json={"verdict": verdict, **fields}), 201)


def check(client: httpx.Client, number: int, state: str, **fields: Any) -> httpx.Response:
    return client.post(f"{PROPOSALS}/{number}/checks", json={"name": "evaluation", "state": state, **fields})


def test_a_proposal_is_reviewed_checked_and_merged(team: Team, server: Server) -> None:
    team.protect(approvals=1, checks=["evaluation"])
    number = team.propose(description="why")
    assert number == 1
    assert team.missing(1) == ["approvals", "check-missing"]
    early = refused(team.ada.post(f"{PROPOSALS}/1/merge", json={}), 409, "proposal-not-green")
    assert [one["code"] for one in early["context"]["missing"]] == ["approvals", "check-missing"]
    approve(team.ada, 1)
    assert "approvals" in team.missing(1)
    approve(team.ben, 1)
    ok(check(team.ben, 1, "failed"))
    assert team.missing(1) == ["check-failed"]
    ok(check(team.ben, 1, "succeeded", link="https://example.org/1"))
    shown = ok(team.rita.get(f"{PROPOSALS}/1"))
    assert (shown["mergeability"]["missing"], shown["mergeability"]["changes"]) == ([], 1)
    before, proposed = head(team, "main"), head(team, "trial")
    merged = ok(team.ada.post(f"{PROPOSALS}/1/merge", json={}))
    assert (merged["state"], merged["merged"], merged["ended_by"]) == ("merged", head(team, "main"), "ada")
    assert (merged["head"], merged["target_commit"]) == (proposed, before)
    refused(team.ben.post(f"{PROPOSALS}/1/merge", json={}), 409, "proposal-merged")
    refused(team.ada.post(f"{PROPOSALS}/1/close"), 409, "proposal-merged")
    refused(team.ben.post(f"{PROPOSALS}/1/comments", json={"text": "late"}), 409, "proposal-merged")
    after = ok(team.rita.get(f"{PROPOSALS}/1"))
    assert ([one["author"] for one in after["reviews"]], after["mergeability"]) == (["ada", "ben"], None)
    assert not list(check_store(server.database))


def test_a_protected_branch_moves_by_proposals_alone(team: Team) -> None:
    team.protect()
    refused(team.put("main", "c", 2), 409, "branch-protected")
    ok(team.put("trial", "c", 2), 201)
    refused(team.mia.post(f"{GAITS}/merges", json={"version": "trial"}), 409, "branch-protected")
    refused(team.mia.post(f"{GAITS}/cherry-picks", json={"version": "trial"}), 409, "branch-protected")
    refused(team.mia.post(f"{GAITS}/reverts", json={"version": "main"}), 409, "branch-protected")
    refused(team.mia.patch(MAIN, json={"at": "trial"}, headers=ANY), 409, "branch-protected")
    refused(team.mia.delete(GAITS, headers=ANY), 409, "branch-protected")
    assert ok(team.rita.get(MAIN))["protection"]["direct_commits"] is False
    team.propose()
    ok(team.ada.post(f"{PROPOSALS}/1/merge", json={}))
    assert head(team, "main") == head(team, "trial")
    refused(team.ada.delete(f"{MAIN}/protection", headers=ANY), 403, "insufficient-role")
    assert ok(team.mia.delete(f"{MAIN}/protection", headers=ANY))["protection"] is None
    ok(team.ben.post(f"{GAITS}/reverts", json={"version": "main"}))


@on_sqlite
def test_a_rule_names_the_least_role_and_protects_from_deletion(team: Team) -> None:
    trial = f"{GAITS}/refs/trial"
    ok(team.mia.put(f"{trial}/protection", json={"role": "maintainer", "direct_commits": True}, headers=ANY))
    refused(team.put("trial", "c", 2), 403, "branch-protected")
    ok(team.mia.post(f"{GAITS}/reverts", json={"version": "trial", "into": "trial"}))
    refused(team.mia.delete(trial, headers=ANY), 409, "branch-protected")
    for wrong in ({"role": "reader"}, {"direct_commits": True, "approvals": 1}):
        assert team.mia.put(f"{trial}/protection", json=wrong, headers=ANY).status_code == 422
    ok(team.ada.post(f"{GAITS}/refs", json={"name": "v1", "kind": "tag"}), 201)
    refused(team.mia.put(f"{GAITS}/refs/v1/protection", json={}, headers=ANY), 422, "is-tag")
    ok(team.ada.post(f"{LAB}/datasets", json={"name": "empty"}), 201)
    refused(team.mia.put(f"{LAB}/datasets/empty/refs/main/protection", json={}, headers=ANY), 422, "no-commits")
    refused(team.mia.put(f"{GAITS}/refs/v2/protection", json={}, headers=ANY), 404, "no-version")


def test_a_later_commit_makes_approvals_and_checks_stale(team: Team) -> None:
    team.protect(approvals=1, checks=["evaluation"])
    team.propose()
    approve(team.ben, 1)
    ok(check(team.ben, 1, "succeeded"))
    assert team.missing(1) == []
    old = head(team, "trial")
    ok(team.mia.put(f"{MAIN}/protection", json={"approvals": 2, "checks": ["evaluation"]}, headers=ANY))
    assert ok(team.ada.post(f"{PROPOSALS}/1/merge", json={"when_green": True, "commit": old}))["when_green"] == "ada"
    ok(team.mia.put(f"{MAIN}/protection", json={"approvals": 1, "checks": ["evaluation"]}, headers=ANY))
    ok(team.put("trial", "c", 2), 201)
    assert team.missing(1) == ["approvals", "check-missing"]
    assert [one["stale"] for one in ok(team.rita.get(f"{PROPOSALS}/1"))["reviews"]] == [True]
    for late in (
        team.ben.post(f"{PROPOSALS}/1/reviews", json={"verdict": "approve", "commit": old}),
        check(team.ben, 1, "succeeded", commit=old[7:15]),
        team.ada.post(f"{PROPOSALS}/1/merge", json={"commit": old}),
    ):
        refused(late, 409, "proposal-moved")
    approve(team.ben, 1, commit=head(team, "trial"))
    ok(check(team.ben, 1, "succeeded"))
    waiting = ok(team.rita.get(f"{PROPOSALS}/1"))
    assert (waiting["state"], waiting["when_green"], waiting["mergeability"]["missing"]) == ("open", None, [])


@on_sqlite
def test_a_request_for_changes_holds_until_its_author_approves(team: Team) -> None:
    team.propose()
    approve(team.ben, 1, "request-changes", text="too short")
    ok(team.put("trial", "c", 2), 201)
    approve(team.ben, 1, "comment")
    refused(team.ada.post(f"{PROPOSALS}/1/merge", json={}), 409, "proposal-not-green")
    approve(team.ben, 1)
    ok(team.ada.post(f"{PROPOSALS}/1/merge", json={}))
    assert len(ok(team.rita.get(f"{PROPOSALS}/1/reviews"))["items"]) == 3


@on_sqlite
def test_an_approval_counts_only_while_its_author_may_write(team: Team) -> None:
    team.protect(approvals=1)
    team.propose()
    approve(team.ben, 1)
    assert team.missing(1) == []
    ok(team.olga.put(f"{LAB}/members/ben", json={"role": "reader"}))
    assert team.missing(1) == ["approvals"]
    assert [one["author"] for one in ok(team.rita.get(f"{PROPOSALS}/1"))["reviews"]] == ["ben"]


@on_sqlite
def test_conflicts_are_listed_and_decided(team: Team) -> None:
    ok(team.put("main", "b", 2), 201)
    team.propose()
    found = ok(team.rita.get(f"{PROPOSALS}/1"))["mergeability"]
    assert ([one["code"] for one in found["missing"]], found["conflict_count"]) == (["merge-conflicts"], 1)
    refused(team.ada.post(f"{PROPOSALS}/1/merge", json={}), 409, "merge-conflicts")
    resolution = {"path": "b", "kind": "skeleton", "take": "theirs"}
    merged = ok(team.ada.post(f"{PROPOSALS}/1/merge", json={"resolutions": [resolution]}))
    assert len(ok(team.rita.get(f"{GAITS}/commits/{merged['merged']}"))["parents"]) == 2


@on_sqlite
def test_an_up_to_date_proposal_contains_the_newest_commit(team: Team) -> None:
    ok(team.put("main", "c", 2), 201)
    team.protect(up_to_date=True)
    team.propose()
    assert team.missing(1) == ["not-up-to-date"]
    ok(team.ada.post(f"{GAITS}/merges", json={"version": "main", "into": "trial"}))
    assert team.missing(1) == []
    merged = ok(team.ada.post(f"{PROPOSALS}/1/merge", json={}))
    assert merged["merged"] == merged["head"]


def test_a_proposal_is_merged_when_the_last_thing_arrives(team: Team, server: Server) -> None:
    team.protect(approvals=1, checks=["evaluation"], role="maintainer")
    team.propose()
    refused(team.ada.post(f"{PROPOSALS}/1/merge", json={"when_green": True}), 403, "branch-protected")
    waiting = ok(team.mia.post(f"{PROPOSALS}/1/merge", json={"when_green": True}))
    assert (waiting["state"], waiting["when_green"]) == ("open", "mia")
    approve(team.ben, 1)
    assert ok(team.ada.delete(f"{PROPOSALS}/1/merge"))["when_green"] is None
    ok(team.mia.post(f"{PROPOSALS}/1/merge", json={"when_green": True}))
    ok(check(team.ben, 1, "succeeded"))
    merged = ok(team.rita.get(f"{PROPOSALS}/1"))
    assert (merged["state"], merged["ended_by"]) == ("merged", "mia")
    assert ok(team.rita.get(MAIN))["commit"] == merged["merged"]
    assert not list(check_store(server.database))


def test_a_waiting_proposal_is_merged_when_its_rule_changes(team: Team, server: Server) -> None:
    """The server's periodic housekeeping then makes the merge, in the name of the user who requested it."""
    team.protect(approvals=2)
    team.propose()
    approve(team.ben, 1)
    ok(team.ada.post(f"{PROPOSALS}/1/merge", json={"when_green": True}))
    waiting = WaitingMerges(server.database)
    assert waiting.attempt() == 0
    team.protect(approvals=1)
    assert waiting.attempt() == 1
    merged = ok(team.rita.get(f"{PROPOSALS}/1"))
    assert (merged["state"], merged["ended_by"], head(team, "main")) == ("merged", "ada", merged["merged"])
    assert ok(team.rita.get(f"{GAITS}/commits"))["items"][0]["author"] == "ada"
    assert waiting.attempt() == 0
    assert not list(check_store(server.database))


def test_a_waiting_proposal_is_merged_when_its_conflict_is_gone(
    team: Team, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The merge is computed again only after a branch has moved."""
    ok(team.put("main", "b", 2), 201)
    team.propose()
    ok(team.ada.post(f"{PROPOSALS}/1/merge", json={"when_green": True}))
    waiting, computed, prepare = WaitingMerges(server.database), list[Any](), proposals.prepare_waiting

    def prepare_and_count(*arguments: Any) -> Any:
        computed.append(arguments)
        return prepare(*arguments)

    monkeypatch.setattr(waiting_module, "prepare_waiting", prepare_and_count)
    assert [waiting.attempt() for _ in range(3)] == [0, 0, 0]
    assert len(computed) == 1
    ok(team.ada.post(f"{GAITS}/reverts", json={"version": head(team, "main"), "into": "main"}))
    assert (waiting.attempt(), waiting.attempt()) == (1, 0)
    assert ok(team.rita.get(f"{PROPOSALS}/1"))["state"] == "merged"


@on_sqlite
def test_a_waiting_proposal_is_not_merged_for_a_user_who_lost_the_right(team: Team, server: Server) -> None:
    team.protect(approvals=1)
    team.propose()
    ok(team.ada.post(f"{PROPOSALS}/1/merge", json={"when_green": True}))
    ok(team.olga.put(f"{LAB}/members/ada", json={"role": "reader"}))
    approve(team.ben, 1)
    waiting = WaitingMerges(server.database)
    assert waiting.attempt() == 0
    assert ok(team.rita.get(f"{PROPOSALS}/1"))["state"] == "open"
    ok(team.olga.put(f"{LAB}/members/ada", json={"role": "contributor"}))
    assert waiting.attempt() == 1


def test_more_proposals_wait_than_one_attempt_examines(
    team: Team, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waiting_module, "EXAMINED_AT_ONCE", 2)
    team.protect(approvals=1)
    for branch in ("one", "two", "three"):
        ok(team.ada.post(f"{GAITS}/refs", json={"name": branch, "kind": "branch"}), 201)
        ok(team.put(branch, branch, 1), 201)
        ok(team.ada.post(f"{PROPOSALS}/{team.propose(source=branch)}/merge", json={"when_green": True}))
    waiting = WaitingMerges(server.database)
    assert waiting.attempt() == 0
    ok(team.mia.delete(f"{MAIN}/protection", headers=ANY))
    assert (waiting.attempt(), waiting.attempt(), waiting.attempt()) == (1, 2, 0)


def wait_on_branches(team: Team, *branches: str) -> None:
    """Propose new branches, and request merges that wait for an approval.

    Then change the rule so that it requires no approval.
    """
    team.protect(approvals=1)
    for branch in branches:
        ok(team.ada.post(f"{GAITS}/refs", json={"name": branch, "kind": "branch"}), 201)
        ok(team.put(branch, branch, 1), 201)
        ok(team.ada.post(f"{PROPOSALS}/{team.propose(source=branch)}/merge", json={"when_green": True}))
    ok(team.mia.delete(f"{MAIN}/protection", headers=ANY))


@on_sqlite
def test_a_proposal_that_cannot_be_computed_does_not_delay_the_others(
    team: Team, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_on_branches(team, "one", "two")
    prepare = proposals.prepare_waiting

    def prepare_second(tx: Transaction, project: str, name: str, number: int) -> Any:
        if number == 1:
            raise DamagedChunk("a chunk is missing")
        return prepare(tx, project, name, number)

    monkeypatch.setattr(waiting_module, "prepare_waiting", prepare_second)
    assert WaitingMerges(server.database).attempt() == 1
    assert [ok(team.rita.get(f"{PROPOSALS}/{number}"))["state"] for number in (1, 2)] == ["open", "merged"]


@on_sqlite
@pytest.mark.parametrize(("code", "computed"), [("quota-exceeded", 1), ("purged-meanwhile", 3)])
def test_a_merge_that_was_refused_is_computed_again_after_a_pause(
    team: Team, server: Server, monkeypatch: pytest.MonkeyPatch, code: str, computed: int
) -> None:
    """After a purge, the merge is computed again without the pause."""
    wait_on_branches(team, "one")
    prepare, prepared = proposals.prepare_waiting, list[Any]()

    def prepare_and_count(*arguments: Any) -> Any:
        prepared.append(arguments)
        return prepare(*arguments)

    def refuse(*_: Any) -> Any:
        raise ConflictProblem("There is no room.", code=code)

    monkeypatch.setattr(waiting_module, "prepare_waiting", prepare_and_count)
    waiting = WaitingMerges(server.database)
    with monkeypatch.context() as patch:
        patch.setattr(waiting_module, "merge_if_green", refuse)
        assert [waiting.attempt() for _ in range(3)] == [0, 0, 0]
        assert len(prepared) == computed
    later_s = time.monotonic() + waiting_module.REFUSED_PAUSE_S
    monkeypatch.setattr(waiting_module, "time", SimpleNamespace(monotonic=lambda: later_s))
    assert waiting.attempt() == 1


@on_sqlite
def test_a_right_that_is_lost_for_a_moment_is_no_lasting_obstacle(
    team: Team, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the moment when the merge would be recorded, the user who requested it has no right to write."""
    wait_on_branches(team, "one")
    prepare = proposals.prepare_waiting

    def prepare_and_lose(*arguments: Any) -> Any:
        ok(team.olga.put(f"{LAB}/members/ada", json={"role": "reader"}))
        return prepare(*arguments)

    waiting = WaitingMerges(server.database)
    with monkeypatch.context() as patch:
        patch.setattr(waiting_module, "prepare_waiting", prepare_and_lose)
        assert waiting.attempt() == 0
    ok(team.olga.put(f"{LAB}/members/ada", json={"role": "contributor"}))
    assert waiting.attempt() == 1


@pytest.mark.parametrize("last", ["review", "check"])
def test_a_refused_merge_does_not_refuse_the_review_or_check(
    team: Team, server: Server, monkeypatch: pytest.MonkeyPatch, last: str
) -> None:
    """The merge exceeds the quota of another user, who requested it. Nothing of the merge is stored."""
    team.protect(**({"approvals": 1} if last == "review" else {"checks": ["evaluation"]}))
    team.propose()
    ok(team.ada.post(f"{PROPOSALS}/1/merge", json={"when_green": True}))
    before = head(team, "main")

    def record_and_refuse(*arguments: Any) -> Any:
        record_merge(*arguments)
        raise QuotaExceededProblem("The user who created the items has too many.")

    with monkeypatch.context() as patch:
        patch.setattr(accepting, "record_merge", record_and_refuse)
        if last == "review":
            approve(team.ben, 1)
        else:
            ok(check(team.ben, 1, "succeeded"))
    found = ok(team.rita.get(f"{PROPOSALS}/1"))
    assert (found["state"], found["when_green"], head(team, "main")) == ("open", "ada", before)
    assert found["mergeability"]["missing"] == []
    assert WaitingMerges(server.database).attempt() == 1
    assert not list(check_store(server.database))


@on_sqlite
def test_a_merge_that_waits_is_prepared_again_if_a_branch_moves(
    team: Team, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    team.propose()
    approve(team.ben, 1, "request-changes")
    ok(team.ada.post(f"{PROPOSALS}/1/merge", json={"when_green": True}))
    prepare, earlier = proposals.prepare_waiting, list[Any]()

    def prepare_late(*arguments: Any) -> Any:
        """Return the result of the first call at the second call, too, as if the branch moved after the preparation."""
        earlier.append(prepare(*arguments))
        return earlier[0 if len(earlier) == 2 else -1]

    monkeypatch.setattr(proposals, "prepare_waiting", prepare_late)
    approve(team.ben, 1, "comment")
    ok(team.put("main", "c", 2), 201)
    approve(team.ben, 1)
    merged = ok(team.rita.get(f"{PROPOSALS}/1"))
    assert (merged["state"], len(earlier)) == ("merged", 3)


@on_sqlite
def test_comments_name_entries_and_frames(team: Team) -> None:
    team.propose()
    url = f"{PROPOSALS}/1/comments"
    about = ok(team.ben.post(url, json={"text": "left foot", "path": "b", "kind": "skeleton"}), 201)
    assert (about["number"], about["author"], about["commit"]) == (1, "ben", head(team, "trial"))
    refused(team.ben.post(url, json={"text": "x", "path": "z", "kind": "skeleton"}), 404, "no-entry")
    refused(team.ben.post(url, json={"text": "x", "path": "b", "kind": "clip", "frames": [3, 9]}), 404, "no-entry")
    for wrong in (
        {"path": "b"}, {"frames": [3, 9]}, {"path": "b", "kind": "skeleton", "frames": [3, 9]},
        {"path": "b", "kind": "clip", "frames": [9, 3]}, {"text": "y" * 10_001},
    ):  # fmt: skip
        assert team.ben.post(url, json={"text": "x", **wrong}).status_code == 422
    assert [one["text"] for one in ok(team.rita.get(url))["items"]] == ["left foot"]


def test_lists_filter_by_state_and_numbers_count_up(team: Team) -> None:
    assert [team.propose(), team.propose(source="trial~1"), team.propose()] == [1, 2, 3]
    refused(team.ben.post(f"{PROPOSALS}/2/close"), 403, "not-author")
    closed = ok(team.ada.post(f"{PROPOSALS}/2/close"))
    assert (closed["state"], closed["head"]) == ("closed", head(team, "main"))
    refused(team.mia.post(f"{PROPOSALS}/2/merge", json={}), 409, "proposal-closed")
    assert [one["number"] for one in ok(team.rita.get(PROPOSALS))["items"]] == [3, 2, 1]
    found = ok(team.rita.get(PROPOSALS, params={"state": "open", "limit": 1}))
    assert [one["number"] for one in found["items"]] == [3]
    rest = ok(team.rita.get(PROPOSALS, params={"state": "open", "cursor": found["next_cursor"]}))
    assert [one["number"] for one in rest["items"]] == [1]
    refused(team.rita.get(f"{PROPOSALS}/9"), 404, "no-proposal")


def test_branches_of_open_proposals_stay(team: Team) -> None:
    team.propose()
    trial = f"{GAITS}/refs/trial"
    refused(team.mia.delete(trial, headers=ANY), 409, "proposal-open")
    ok(team.ada.post(f"{PROPOSALS}/1/close"))
    proposed = head(team, "trial")
    assert team.mia.delete(trial, headers=ANY).status_code == 204
    assert ok(team.rita.get(f"{PROPOSALS}/1"))["head"] == proposed


@on_sqlite
def test_wrong_versions_and_full_lists_are_refused(team: Team, monkeypatch: pytest.MonkeyPatch) -> None:
    def propose(**fields: Any) -> httpx.Response:
        return team.ada.post(PROPOSALS, json={"title": "t", "source": "trial", **fields})

    refused(propose(source="main"), 422, "same-branch")
    refused(propose(source="nothing"), 404, "no-version")
    refused(propose(target="nothing"), 404, "no-version")
    assert propose(title="").status_code == 422
    refused(team.rita.post(PROPOSALS, json={"title": "t", "source": "trial"}), 403, "insufficient-role")
    monkeypatch.setattr("marey_server.store.datasets.proposals.opening.MOST_OPEN", 1)
    monkeypatch.setattr("marey_server.store.datasets.proposals.discussing.MOST_OF_EACH", 1)
    ok(propose(source="main~0", target="trial"), 201)
    assert team.missing(1) == ["already-merged"]
    refused(propose(), 409, "too-many-proposals")
    for _ in range(2):
        ok(check(team.ben, 1, "pending"))
    refused(check(team.ben, 1, "pending", name="other"), 409, "long-proposal")


def test_the_texts_of_proposals_have_limits(team: Team, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each text counts 200 bytes more than its size, so empty texts are limited, too.

    A quarter of each limit is reserved for maintainers.
    """
    texts = "marey_server.store.datasets.proposals.texts"
    monkeypatch.setattr(f"{texts}.MOST_TEXT_OF_PROPOSAL", 1334)
    monkeypatch.setattr(server.database, "quotas", Quotas(project_proposal_bytes=2000))

    def propose(text: str) -> httpx.Response:
        return team.ada.post(PROPOSALS, json={"title": "t", "source": "trial", "description": text})

    def comment(number: int, text: str) -> httpx.Response:
        return team.ben.post(f"{PROPOSALS}/{number}/comments", json={"text": text})

    ok(propose("ü" * 50), 201)  # 300 bytes
    ok(comment(1, "x" * 100), 201)
    ok(check(team.ben, 1, "pending", text="x" * 150))
    problem = refused(comment(1, "x"), 409, "long-proposal")
    assert problem["context"] == {"used": 950, "limit": 1000}
    refused(check(team.ben, 1, "pending", text="x" * 201), 409, "long-proposal")
    ok(check(team.ben, 1, "pending", text="x" * 200))  # instead of the earlier report
    ok(propose("x" * 300), 201)
    exceeded = refused(propose("x"), 409, "quota-exceeded")
    assert exceeded["context"] == {"quota": "project_proposal_bytes", "used": 1500, "limit": 1500}
    refused(comment(2, "x"), 409, "quota-exceeded")
    review = {"verdict": "approve", "text": ""}
    ok(team.mia.post(f"{PROPOSALS}/1/reviews", json=review), 201)
    refused(team.mia.post(f"{PROPOSALS}/1/reviews", json=review), 409, "long-proposal")
    assert ok(team.rita.get(f"{PROPOSALS}/2"))["comments"] == 0


@on_sqlite
@pytest.mark.parametrize("count", [1, 33], ids=["one job", "a fan-out"])
def test_a_check_by_a_job_succeeds_only_with_a_job_that_read_the_commit(team: Team, server: Server, count: int) -> None:
    motion = {**MOTION, "skeleton": {"item": team.items[0], "revision": 1}, "joints": ["a"]}
    changes = []
    for place in range(count):
        parts = {"motion": {**motion, "frame_rate_hz": 30 + place}}
        clip = ok(team.ben.post(f"{LAB}/clips", json={"name": f"w{place}", "parts": parts}), 201)["id"]
        changes.append({"change": "put", "path": f"walk{place}", "item": clip})
    ok(team.ada.post(f"{GAITS}/commits", json={"branch": "trial", "message": "m", "changes": changes}), 201)
    team.propose()
    inputs = {"clips": [{"dataset": "gaits", "version": "trial"}], "skeleton": {"item": team.items[0]}}
    wanted = {"kind": "retarget", "inputs": inputs, "into": "retargeted"}
    created = ok(team.ben.post(f"{LAB}/jobs", json=wanted), 202)
    assert (created["size"] is None) == (count == 1)
    made = created["id"]
    ok(check(team.ben, 1, "pending", job=made))
    refused(check(team.ben, 1, "succeeded", job=made), 409, "job-not-succeeded")
    refused(check(team.ben, 1, "pending", job="job_of_nobody"), 404, "no-job")
    done = update(job).where(job.c.id == made).values(state="succeeded")
    server.database.write(SYSTEM, lambda tx: tx.execute(done))
    ok(check(team.ben, 1, "succeeded", job=made))
    ok(team.put("trial", "c", 2), 201)
    refused(check(team.ben, 1, "succeeded", job=made), 409, "job-of-another-commit")


def test_of_two_who_merge_or_close_at_once_one_wins(team: Team, server: Server) -> None:
    team.propose()
    requests = [partial(client.post, f"{PROPOSALS}/1/merge", json={}) for client in (team.ada, team.ben)]
    requests += [partial(client.post, f"{PROPOSALS}/1/close") for client in (team.ada, team.mia)]
    with ThreadPoolExecutor(4) as threads:
        answers = [one.result() for one in [threads.submit(request) for request in requests]]
    assert sorted(one.status_code for one in answers) == [200, 409, 409, 409]
    (won,) = (one.json() for one in answers if one.status_code == 200)
    lost = {one.json()["code"] for one in answers if one.status_code == 409}
    assert lost <= {f"proposal-{won['state']}", "branch-moved"}
    assert (head(team, "main") == head(team, "trial")) == (won["state"] == "merged")
    assert not list(check_store(server.database))


def test_a_repeated_request_gets_the_same_answer(team: Team) -> None:
    team.protect(approvals=1)
    for url, body in (
        (PROPOSALS, {"title": "t", "source": "trial"}),
        (f"{PROPOSALS}/1/comments", {"text": "x"}),
        (f"{PROPOSALS}/1/reviews", {"verdict": "approve"}),
        (f"{PROPOSALS}/1/merge", {}),
    ):
        client = team.ada if url == PROPOSALS else team.ben
        answers = [client.post(url, json=body, headers={"Idempotency-Key": url}) for _ in range(2)]
        assert answers[0].is_success
        assert answers[0].json() == answers[1].json()
    assert len(ok(team.rita.get(f"{PROPOSALS}/1/comments"))["items"]) == 1


@on_sqlite
def test_a_hidden_project_hides_its_proposals(team: Team) -> None:
    team.propose()
    for url in (PROPOSALS, f"{PROPOSALS}/1", f"{PROPOSALS}/1/comments", f"{PROPOSALS}/1/reviews", MAIN):
        refused(team.eve.get(url), 404, "no-project")
    refused(team.eve.post(f"{PROPOSALS}/1/merge", json={}), 404, "no-project")


def test_damaged_proposals_are_found(team: Team, server: Server) -> None:
    team.propose()

    def damage(tx: Transaction) -> None:
        tx.execute(update(proposal).where(proposal.c.head.is_(None)).values(source="gone"))

    server.database.write(SYSTEM, damage)
    assert {one.code for one in check_store(server.database)} == {"proposal-corrupt"}
    server.database.write(SYSTEM, lambda tx: tx.execute(update(proposal).values(source="trial")))
