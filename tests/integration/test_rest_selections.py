"""Checkouts of parts of versions: what a query and paths select, and commits that keep everything else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest
from sqlalchemy import delete as delete_rows
from sqlalchemy import select
from tests.integration.test_rest_datasets import (
    GAITS,
    LAB,
    change,
    delete,
    difference,
    entries,
    hierarchy,
    item_at,
    ok,
    put,
    refused,
    skeleton,
)

from marey_server.access.principal import SYSTEM
from marey_server.store import projects
from marey_server.store.database.connections import Database
from marey_server.store.datasets import selecting
from marey_server.store.datasets.chunks import chunk_in
from marey_server.store.fsck import check_store
from marey_server.store.items.facets import publish_facets
from marey_server.store.tables import tree_chunk
from marey_server.store.transaction import Transaction

PATHS = ("old/c", "raw/a", "raw/b")


@pytest.fixture
def gaits(owner: httpx.Client) -> Callable[..., Any]:
    """Function that commits the folder of the new dataset `gaits` with three skeletons; `raw/a` is tagged `night`."""
    for path in PATHS:
        folder, _, name = path.rpartition("/")
        body = {**skeleton(name, f"Joint {name}", folder=f"gaits/{folder}"), "tags": ["night"] if name == "a" else []}
        ok(owner.post(f"{LAB}/skeletons", json=body), 201)
    ok(owner.post(f"{LAB}/datasets", json={"name": "gaits", "collection": "gaits"}), 201)

    def commit(message: str = "m", **fields: Any) -> Any:
        return ok(owner.post(f"{GAITS}/commits", json={"message": message, **fields}), 201)

    commit("first")
    return commit


def check_out(owner: httpx.Client, **selection: Any) -> tuple[int, int]:
    """Check out a part of a version; return the numbers of entries in the folder and in the version."""
    found = ok(owner.post(f"{GAITS}/checkout", json=selection))
    return found["taken"], found["entries"]


def in_folder(owner: httpx.Client) -> list[str]:
    found = ok(owner.get(f"{LAB}/skeletons", params={"collection": "gaits"}))["items"]
    return sorted(f"{one['collection'].removeprefix('gaits').lstrip('/')}/{one['name']}" for one in found)


TAKEN: list[Any] = [
    ({"query": "tag = night"}, ["raw/a"]),
    ({"query": "folder = gaits/raw and not tag = night"}, ["raw/b"]),
    ({"query": "joints = 1 and name in (a, c)"}, ["old/c", "raw/a"]),
    ({"paths": ["old", "raw/b"]}, ["old/c", "raw/b"]),
    ({"paths": ["raw/a", "raw", "raw/b"]}, ["raw/a", "raw/b"]),
    ({"paths": ["raw"], "query": "path = gaits/old/c or path = gaits/raw/b"}, ["raw/b"]),
]


def test_only_the_selected_entries_are_taken(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    for selection, taken in TAKEN:
        assert check_out(owner, **selection) == (len(taken), 3), selection
        assert in_folder(owner) == taken, selection
        refused(owner.post(f"{GAITS}/commits", json={"message": "m"}), 422, "no-changes")
        assert check_out(owner) == (3, 3), selection
        assert in_folder(owner) == list(PATHS), selection


def test_a_commit_of_a_part_keeps_what_was_not_checked_out(
    owner: httpx.Client, gaits: Callable[..., Any], database: Database
) -> None:
    """The folder remembers its selection from commit to commit."""
    check_out(owner, paths=["raw"])
    put(owner, "gaits/raw/a", "Pelvis")
    ok(owner.post(f"{LAB}/skeletons", json=skeleton("d", folder="gaits/raw")), 201)
    assert gaits("changed and added")["entries"] == 4
    assert difference(owner, "main~1", "main") == [("changed", "raw/a", None), ("added", "raw/d", None)]
    change(owner, "gaits/raw/d", name="e")
    delete(owner, "gaits/raw/b")
    gaits("moved and removed")
    assert difference(owner, "main~1", "main") == [("removed", "raw/b", None), ("moved", "raw/e", "raw/d")]
    assert sorted(entries(owner)) == ["old/c", "raw/a", "raw/e"]
    head = ok(owner.get(f"{GAITS}/commits/main"))["digest"]
    shown = {"commit": head, "query": None, "paths": ["raw"]}
    assert ok(owner.get(GAITS))["checked_out"] == shown
    assert [one["checked_out"] for one in ok(owner.get(f"{LAB}/datasets"))["items"]] == [shown]
    assert check_out(owner, paths=["old"]) == (1, 3)
    assert check_out(owner) == (3, 3)
    assert ok(owner.get(GAITS))["checked_out"] == {**shown, "paths": []}
    delete(owner, "gaits/old/c")
    assert gaits("all of it")["entries"] == 2
    assert not list(check_store(database))


def test_an_item_in_the_place_of_an_entry_that_is_not_checked_out_is_refused(
    owner: httpx.Client, gaits: Callable[..., Any]
) -> None:
    check_out(owner, query="tag = night")
    ok(owner.post(f"{LAB}/skeletons", json=skeleton("b", "Other", folder="gaits/raw")), 201)
    problem = refused(owner.post(f"{GAITS}/commits", json={"message": "m"}), 409, "not-checked-out")
    assert problem["context"] == {"count": 1, "path": "raw/b", "kind": "skeleton"}
    refused(owner.post(f"{GAITS}/checkout", json={}), 409, "uncommitted-changes")
    change(owner, "gaits/raw/b", name="z")
    gaits("under another name")
    assert sorted(entries(owner)) == ["old/c", "raw/a", "raw/b", "raw/z"]


def test_a_selection_that_is_behind_its_branch_is_named(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    check_out(owner, query="tag = night", paths=["raw"])
    remove = {"message": "m", "changes": [{"change": "remove", "path": "old/c", "kind": "skeleton"}]}
    ok(owner.post(f"{GAITS}/commits", json=remove), 201)
    put(owner, "gaits/raw/a", "Pelvis")
    first = ok(owner.get(f"{GAITS}/commits/main~1"))["digest"]
    problem = refused(owner.post(f"{GAITS}/commits", json={"message": "m"}), 409, "folder-elsewhere")
    assert problem["context"]["folder_commit"] == first
    assert problem["context"]["checked_out"] == {"commit": first, "query": "tag = night", "paths": ["raw"]}


REFUSED: list[Any] = [
    ({"query": "tag = day"}, 422, "empty-selection"),
    ({"query": "tag ="}, 400, "bad-query"),
    ({"query": "like(a:1) < 1"}, 400, "bad-query"),
    ({"paths": ["raw", "ra"]}, 404, "no-entry"),
    ({"paths": [f"{number:03}{'x' * 130}" for number in range(500)]}, 422, "invalid-body"),
    ({"paths": ["raw", "raw/z"]}, 404, "no-entry"),
    ({"paths": ["../raw"]}, 404, "no-entry"),
    ({"query": "joints = 1", "version": "nothing"}, 404, "no-version"),
]


def test_a_selection_of_nothing_or_of_too_much_is_refused(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    for selection, status, code in REFUSED:
        answer = owner.post(f"{GAITS}/checkout", json=selection)
        assert (answer.status_code, answer.json()["code"]) == (status, code), (selection, answer.text)
        assert in_folder(owner) == list(PATHS), selection


def test_a_query_compares_the_content_of_the_version(
    owner: httpx.Client, gaits: Callable[..., Any], database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the commit of the version, the items have got other content, and one item other tags."""
    item = item_at(owner, "gaits/raw/a")["id"]

    def measure(tx: Transaction) -> None:
        publish_facets(tx, projects.require(tx, "lab").id, [[item, 1, {"usage": 0.5}]])

    database.write(SYSTEM, measure)
    two = hierarchy("Pelvis")
    two["joints"].append({"name": "Head", "parent": 0, "offset": [0, 1, 0]})
    ok(owner.put(f"{LAB}/skeletons/{item}/parts/hierarchy", json=two, headers={"If-Match": "*"}))
    change(owner, "gaits/raw/a", tags=[])
    gaits("second")
    monkeypatch.setattr(selecting, "SEARCHED_AT_ONCE", 1)
    assert check_out(owner, query="joints = 2") == (1, 3)
    assert in_folder(owner) == ["raw/a"]
    assert check_out(owner, query="joints = 1") == (2, 3)
    assert check_out(owner, query="joints = 1 and tag = night", version="main~1") == (1, 3)
    assert check_out(owner, query="facet.usage > 0 and revision = 1", version="main~1") == (1, 3)
    monkeypatch.setattr(selecting, "MOST_SEARCHED", 1)
    refused(owner.post(f"{GAITS}/checkout", json={"query": "joints = 1"}), 422, "large-selection")
    assert check_out(owner, query="name = c and joints = 1") == (1, 3)
    assert check_out(owner, query="not name = c and folder = gaits") == (2, 3)


def test_a_purge_deletes_what_former_selections_have_stored(
    owner: httpx.Client, gaits: Callable[..., Any], database: Database
) -> None:
    ok(owner.post(f"{LAB}/datasets", json={"name": "other", "collection": "gaits"}), 201)
    ok(owner.post(f"{LAB}/datasets/other/commits", json={"message": "m"}), 201)
    ok(owner.post(f"{LAB}/datasets/other/checkout", json={"paths": ["raw/b"]}))
    check_out(owner, discard=True)
    for path in PATHS:
        check_out(owner, paths=[path], discard=True)
    assert owner.delete(GAITS, headers={"If-Match": "*"}).status_code == 204
    ok(owner.post(f"{LAB}/dataset-purges", json={"dataset": "gaits", "preview": False}))

    def manifests(tx: Transaction) -> int:
        return sum(b'"manifest"' in chunk_in(data) for data in tx.execute(select(tree_chunk.c.data)).scalars())

    assert database.read(SYSTEM, manifests) == 1
    assert not list(check_store(database))
    assert ok(owner.post(f"{LAB}/datasets/other/checkout", json={"discard": True}))["taken"] == 3


def test_a_lost_record_of_what_is_checked_out_is_found(
    owner: httpx.Client, gaits: Callable[..., Any], database: Database
) -> None:
    check_out(owner, paths=["raw"])

    def lose(tx: Transaction) -> None:
        rows = tx.execute(select(tree_chunk)).all()
        (manifest,) = [row.digest for row in rows if b'"manifest"' in chunk_in(row.data)]
        tx.execute(delete_rows(tree_chunk).where(tree_chunk.c.digest == manifest))

    database.write(SYSTEM, lose)
    assert {one.code for one in check_store(database)} == {"folder-unknown"}
    assert [one["checked_out"] for one in ok(owner.get(f"{LAB}/datasets"))["items"]] == [None]
    refused(owner.post(f"{GAITS}/checkout", json={}), 500, "dataset-damaged")
    assert check_out(owner, discard=True) == (3, 3)
    assert not list(check_store(database))
