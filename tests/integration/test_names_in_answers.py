"""Tokens that may write but not read: no answer names what the request does not name."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import httpx
import pytest
from tests.support.furnished_house import ROUTES, House, build_house
from tests.support.rest_server import Server

from marey_schemas.access import Role

SECRET = "secret-7b1d"
LAB = "/projects/lab"
GAITS = f"{LAB}/datasets/gaits"
ANY = {"If-Match": "*"}


def ok(response: httpx.Response) -> Any:
    assert response.is_success, response.text
    return response.json() if response.content else None


def without_read(server: Server, client: httpx.Client) -> httpx.Client:
    """Return a client of the same user with a token that has the scopes `write` and `jobs` only."""
    made = ok(client.post("/tokens", json={"name": "t", "scopes": ["write", "jobs"]}))
    return server.client(made["secret"])


def skeleton(name: str, joint: str = "Hips", folder: str = SECRET) -> dict[str, Any]:
    joints = [{"name": joint, "parent": -1, "offset": [0, 1, 0]}]
    hierarchy = {"schema": "marey/skeleton@1", "joints": joints}
    return {"name": name, "collection": folder, "parts": {"hierarchy": hierarchy}}


class Team:
    """Project `lab` with the dataset `gaits`; all names that requests do not contain are secret."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.maintainer = server.make_user("mia")
        self.owner = server.client(server.make_project("lab", owner=SECRET, mia=Role.MAINTAINER))
        self.items = [ok(self.owner.post(f"{LAB}/skeletons", json=skeleton(f"{SECRET}-{name}")))["id"] for name in "ab"]
        ok(self.owner.post(f"{LAB}/datasets", json={"name": "gaits", "collection": SECRET}))
        self.first = self.commit(message=SECRET)

    def commit(self, **fields: Any) -> str:
        return str(ok(self.owner.post(f"{GAITS}/commits", json={"message": "m", **fields}))["digest"])

    def branch(self, name: str, kind: str = "branch", at: str = "main") -> None:
        ok(self.owner.post(f"{GAITS}/refs", json={"name": name, "kind": kind, "at": at}))

    def put(self, joint: str, branch: str = "main") -> None:
        """Commit another skeleton at the path of the first one to a branch."""
        made = ok(self.owner.post(f"{LAB}/skeletons", json=skeleton(f"{joint}-x", joint, "elsewhere")))["id"]
        change = {"change": "put", "path": f"{SECRET}-a", "item": made}
        self.commit(branch=branch, changes=[change])

    def rename(self, item: str, name: str) -> None:
        ok(self.owner.patch(f"{LAB}/skeletons/{item}", json={"name": name}, headers=ANY))

    def delete(self, item: str) -> None:
        ok(self.owner.delete(f"{LAB}/skeletons/{item}", headers=ANY))


Request = tuple[str, str, dict[str, Any] | None]
"""Method, path and body of a request."""


def uncommitted_changes(team: Team) -> Request:
    team.rename(team.items[0], f"{SECRET}-c")
    return "POST", f"{GAITS}/checkout", {}


def folder_elsewhere(team: Team) -> Request:
    team.put("Pelvis")
    return "POST", f"{GAITS}/commits", {"message": "m"}


def not_checked_out(team: Team) -> Request:
    ok(team.owner.post(f"{GAITS}/checkout", json={"paths": [f"{SECRET}-a"]}))
    ok(team.owner.post(f"{LAB}/skeletons", json=skeleton(f"{SECRET}-b", "Pelvis")))
    return "POST", f"{GAITS}/commits", {"message": "m"}


def folder_deleted(team: Team) -> Request:
    (folder,) = ok(team.owner.get(f"{LAB}/collections"))["items"]
    ok(team.owner.delete(f"{LAB}/collections/{folder['id']}", headers=ANY))
    return "POST", f"{GAITS}/commits", {"message": "m"}


def merge_conflicts(team: Team) -> Request:
    team.branch("side")
    team.put("Pelvis")
    team.put("Chest", "side")
    return "POST", f"{GAITS}/merges", {"version": "side"}


def revert_with_conflicts(team: Team) -> Request:
    team.put("Pelvis")
    team.put("Chest")
    return "POST", f"{GAITS}/reverts", {"version": "main~1"}


def pick_with_conflicts(team: Team) -> Request:
    merge_conflicts(team)
    return "POST", f"{GAITS}/cherry-picks", {"version": "side"}


def conflicts_of_a_proposal(team: Team) -> Request:
    merge_conflicts(team)
    ok(team.owner.post(f"{GAITS}/proposals", json={"title": SECRET, "source": "side"}))
    return "POST", f"{GAITS}/proposals/1/merge", {}


def proposal_that_lacks_a_check(team: Team) -> Request:
    team.branch("side")
    team.put("Chest", "side")
    rule = {"approvals": 0, "checks": [SECRET]}
    ok(team.owner.put(f"{GAITS}/refs/main/protection", json=rule, headers=ANY))
    ok(team.owner.post(f"{GAITS}/proposals", json={"title": SECRET, "source": "side"}))
    return "POST", f"{GAITS}/proposals/1/merge", {}


def proposal_that_was_closed(team: Team) -> Request:
    team.branch("side")
    team.put("Chest", "side")
    ok(team.owner.post(f"{GAITS}/proposals", json={"title": SECRET, "source": "side"}))
    ok(team.owner.post(f"{GAITS}/proposals/1/close"))
    return "POST", f"{GAITS}/proposals/1/comments", {"text": "late"}


def protected_branch_of_a_dataset(team: Team) -> Request:
    team.branch(SECRET)
    ok(team.owner.put(f"{GAITS}/refs/{SECRET}/protection", json={"approvals": 1}, headers=ANY))
    return "DELETE", GAITS, None


def name_taken_by_a_restored_item(team: Team) -> Request:
    team.delete(team.items[0])
    ok(team.owner.post(f"{LAB}/skeletons", json=skeleton(f"{SECRET}-a")))
    return "POST", f"{LAB}/skeletons/{team.items[0]}/restore", None


def role_in_a_folder(team: Team) -> Request:
    (folder,) = ok(team.owner.get(f"{LAB}/collections"))["items"]
    ok(team.owner.put(f"{LAB}/collections/{folder['id']}/roles/mia", json={"role": "reader"}, headers=ANY))
    return "PATCH", f"{LAB}/skeletons/{team.items[0]}", {"name": "c"}


def results_in_one_place(team: Team) -> Request:
    clip = {"schema": "marey/motion@1", "frame_rate_hz": 30, "joints": ["Hips"],
            "skeleton": {"item": team.items[0], "revision": 1},
            "poses": {"dtype": "<f4", "shape": [1, 7], "data": [[0, 1, 0, 1, 0, 0, 0]]}}  # fmt: skip
    body = {"name": f"{SECRET}-walk", "parts": {"motion": clip}}
    made = ok(team.owner.post(f"{LAB}/clips", json=body))["id"]
    info = {"schema": "marey/clip-info@1", "comment": "second"}
    ok(team.owner.put(f"{LAB}/clips/{made}/parts/info", json=info, headers=ANY))
    clips = [{"item": made, "revision": number} for number in (1, 2)]
    inputs = {"clips": clips, "skeleton": {"item": team.items[1]}}
    return "POST", f"{LAB}/jobs", {"kind": "retarget", "inputs": inputs}


REFUSALS: dict[str, tuple[Callable[[Team], Request], str]] = {
    "uncommitted changes": (uncommitted_changes, "uncommitted-changes"),
    "folder elsewhere": (folder_elsewhere, "folder-elsewhere"),
    "not checked out": (not_checked_out, "not-checked-out"),
    "folder deleted": (folder_deleted, "folder-deleted"),
    "merge conflicts": (merge_conflicts, "merge-conflicts"),
    "conflicts of a revert": (revert_with_conflicts, "merge-conflicts"),
    "conflicts of a cherry-pick": (pick_with_conflicts, "merge-conflicts"),
    "conflicts of a proposal": (conflicts_of_a_proposal, "merge-conflicts"),
    "proposal that lacks a check": (proposal_that_lacks_a_check, "proposal-not-green"),
    "closed proposal": (proposal_that_was_closed, "proposal-closed"),
    "protected branch": (protected_branch_of_a_dataset, "branch-protected"),
    "name taken": (name_taken_by_a_restored_item, "name-taken"),
    "role in a folder": (role_in_a_folder, "insufficient-role"),
    "results of a job in one place": (results_in_one_place, "invalid"),
}


@pytest.fixture
def team(server: Server) -> Team:
    return Team(server)


@pytest.mark.parametrize("refusal", REFUSALS)
def test_a_refusal_names_hidden_things_only_to_readers(server: Server, team: Team, refusal: str) -> None:
    prepare, code = REFUSALS[refusal]
    method, path, body = prepare(team)
    user = server.client(team.maintainer) if refusal == "role in a folder" else team.owner
    headers = {} if method == "POST" and not path.endswith("/restore") else ANY
    writer = without_read(server, user)
    answers = [one.request(method, path, json=body, headers=headers) for one in (user, writer, user)]
    assert [one.json()["code"] for one in answers] == [code] * 3, [one.text for one in answers]
    assert [SECRET in one.text for one in answers] == [True, False, True], [one.text for one in answers]
    assert answers[1].json()["context"] == {}
    assert answers[1].json()["detail"] not in ("", answers[1].json()["title"])


def test_a_branch_that_has_moved_is_not_shown_to_writers(server: Server, team: Team) -> None:
    head = team.first
    team.put("Pelvis")
    body = {"message": "m", "changes": [{"change": "remove", "path": "x", "kind": "clip"}], "expected": head}
    shown = [one.post(f"{GAITS}/commits", json=body).json() for one in (team.owner, without_read(server, team.owner))]
    assert [one["code"] for one in shown] == ["branch-moved"] * 2
    assert "commit" in shown[0]["context"]
    assert shown[1]["context"] == {}


@pytest.mark.parametrize("scopes", [["write", "read!project=lab"], ["write", "read"]])
def test_a_token_that_may_also_read_the_project_gets_names(server: Server, team: Team, scopes: list[str]) -> None:
    _, path, body = uncommitted_changes(team)
    reader = server.client(ok(team.owner.post("/tokens", json={"name": "t", "scopes": scopes}))["secret"])
    assert SECRET in reader.post(path, json=body).text


def test_a_preview_is_not_shown_to_writers(server: Server, team: Team) -> None:
    writer = without_read(server, team.owner)
    _, path, body = merge_conflicts(team)
    preview = {**(body or {}), "preview": True}
    assert SECRET in team.owner.post(path, json=preview).text
    answer = writer.post(path, json=preview)
    assert (answer.status_code, answer.content) == (204, b"")


def _with_secret_names(server: Server) -> tuple[House, httpx.Client]:
    """Return a furnished house whose items, folder and proposal have secret names, and a client that may only write."""
    house = build_house(server)
    owner = server.client(house.tokens["owner"])
    lab, known = LAB, house.variables
    for place in (f"clips/{known['item']}", f"annotations/{known['annotation']}"):
        ok(owner.patch(f"{lab}/{place}", json={"name": SECRET, "tags": [SECRET]}, headers=ANY))
    ok(owner.patch(f"{lab}/collections/{known['collection']}", json={"path": SECRET}, headers=ANY))
    ok(owner.patch(f"{lab}/webhooks/{known['webhook']}", json={"description": SECRET}, headers=ANY))
    dataset = f"{lab}/datasets/{known['dataset']}"
    ok(owner.post(f"{lab}/skeletons", json=skeleton(SECRET)))
    ok(owner.post(f"{dataset}/commits", json={"message": SECRET}))
    ok(owner.post(f"{dataset}/refs", json={"name": SECRET, "kind": "branch"}))
    ok(owner.post(f"{dataset}/proposals", json={"title": SECRET, "source": SECRET, "target": "main"}))
    return house, without_read(server, owner)


def test_no_answer_of_any_route_names_hidden_things_to_writers(server: Server) -> None:
    house, writer = _with_secret_names(server)
    leaks = []
    for precondition, route in product(('"999999.json"', "*"), ROUTES):  # the first one is never met
        operation = route.operation
        if operation.scope != "write":
            continue
        if precondition == "*" and (operation.method == "DELETE" or operation.precondition == "none"):
            continue
        request = house.plan(route)
        headers = {name: precondition if name == "If-Match" else text for name, text in request.headers.items()}
        answer = writer.request(request.method, server.address + request.path, headers=headers, content=request.content)
        if SECRET in answer.text + str(answer.headers):
            leaks.append(f"{request.method} {route.template} {precondition}: {answer.status_code} {answer.text[:500]}")
    assert not leaks, "\n".join(leaks)
