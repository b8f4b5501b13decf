"""Requests that are sent again after a lost answer, with the same key: the answer is the same as the first time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest
from tests.support.store_fixtures import skeleton_tree

LAB = "/projects/lab"
GAITS = f"{LAB}/datasets/gaits"
ANY = {"If-Match": "*"}
KEY = {"Idempotency-Key": "restoration-1"}


def deleted(client: httpx.Client, url: str) -> str:
    assert client.delete(url, headers=ANY).is_success
    return f"{url}/restore"


def deleted_item(client: httpx.Client) -> str:
    made = client.post(f"{LAB}/skeletons", json={"name": "rig", "parts": {"hierarchy": skeleton_tree(2)}})
    return deleted(client, f"{LAB}/skeletons/{made.json()['id']}")


def deleted_folder(client: httpx.Client) -> str:
    made = client.post(f"{LAB}/collections", json={"path": "raw"})
    return deleted(client, f"{LAB}/collections/{made.json()['id']}")


def deleted_project(client: httpx.Client) -> str:
    return deleted(client, LAB)


def send_twice(client: httpx.Client, url: str, **options: Any) -> tuple[Any, Any]:
    """Send a POST request twice; return the status, the body and the ETag of each answer."""
    found = [client.post(url, **options) for _ in range(2)]
    first, second = ((one.status_code, one.content, one.headers.get("ETag")) for one in found)
    return first, second


@pytest.mark.parametrize("delete", [deleted_item, deleted_folder, deleted_project], ids=lambda one: one.__name__)
def test_a_repeated_restoration_has_the_same_answer(owner: httpx.Client, delete: Callable[[httpx.Client], str]) -> None:
    first, second = send_twice(owner, delete(owner), headers=KEY)
    assert first == second
    assert first[0] == 200


def test_a_repeated_return_to_an_earlier_revision_has_the_same_answer(owner: httpx.Client) -> None:
    made = owner.post(f"{LAB}/skeletons", json={"name": "rig", "parts": {"hierarchy": skeleton_tree(2)}})
    item = f"{LAB}/skeletons/{made.json()['id']}"
    changed = owner.put(f"{item}/parts/hierarchy", json=skeleton_tree(3), headers=ANY)
    state = {"If-Match": changed.headers["ETag"]}
    first, second = send_twice(owner, f"{item}/revert", json={"revision": 1}, headers=KEY | state)
    assert first == second
    assert (first[0], owner.get(item).json()["revision"]) == (200, 3)


def commit(client: httpx.Client, branch: str, path: str) -> None:
    """Commit a new skeleton to a branch of the dataset `gaits`."""
    made = client.post(f"{LAB}/skeletons", json={"name": path, "parts": {"hierarchy": skeleton_tree(2)}}).json()
    put = {"change": "put", "path": path, "item": made["id"]}
    sent = client.post(f"{GAITS}/commits", json={"branch": branch, "message": "m", "changes": [put]})
    assert sent.status_code == 201, sent.text


@pytest.fixture
def head(owner: httpx.Client) -> str:
    """Newest commit of `main` in the dataset `gaits`.

    `main` and `trial` each have one commit after their common commit.
    """
    assert owner.post(f"{LAB}/datasets", json={"name": "gaits"}).status_code == 201
    commit(owner, "main", "a")
    assert owner.post(f"{GAITS}/refs", json={"name": "trial", "kind": "branch"}).status_code == 201
    commit(owner, "main", "b")
    commit(owner, "trial", "c")
    return str(owner.get(f"{GAITS}/commits/main").json()["digest"])


@pytest.mark.parametrize("kind", ["commits", "merges", "cherry-picks", "reverts"])
def test_a_repeated_change_of_a_branch_has_the_same_answer(owner: httpx.Client, head: str, kind: str) -> None:
    """The preparation refuses the repeated request, because the first one has changed the branch."""
    removal = {"change": "remove", "path": "a", "kind": "skeleton"}
    bodies: dict[str, dict[str, Any]] = {
        "commits": {"message": "m", "expected": head, "changes": [removal]}, "merges": {"version": "trial"},
        "cherry-picks": {"version": "trial"}, "reverts": {"version": head},
    }  # fmt: skip
    url, body = f"{GAITS}/{kind}", bodies[kind]
    first, second = send_twice(owner, url, json=body, headers=KEY)
    assert first == second
    assert first[0] in (200, 201)
    assert owner.post(url, json=body).status_code in (409, 422)
    other = owner.post(url, json={**body, "message": "other"}, headers=KEY)
    assert other.json()["code"] == "idempotency-key-reused"
