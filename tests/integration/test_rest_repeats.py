"""Requests that are sent again after a lost answer, with the same key: the answer is the same as the first time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest
from tests.support.store_fixtures import skeleton_tree

LAB = "/projects/lab"
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
