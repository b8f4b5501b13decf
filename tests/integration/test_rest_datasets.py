"""Datasets over HTTP: commits, branches, tags, differences, merges and checkouts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import func, select, update
from tests.support.rest_server import Server

from marey_schemas.access import Role
from marey_schemas.encoding.canonical import document_digest
from marey_server.access.principal import SYSTEM
from marey_server.store import fsck
from marey_server.store.database.connections import Database
from marey_server.store.datasets import checkout
from marey_server.store.fsck import check_store
from marey_server.store.tables import dataset_commit, revision, tree_chunk
from marey_server.store.transaction import Transaction
from marey_versions.records import revision_content

LAB = "/projects/lab"
GAITS = f"{LAB}/datasets/gaits"


def ok(response: httpx.Response, status: int = 200) -> Any:
    assert response.status_code == status, response.text
    return response.json()


def refused(response: httpx.Response, status: int, code: str) -> Any:
    assert (response.status_code, response.json().get("code")) == (status, code), response.text
    return response.json()


def skeleton(name: str, joint: str = "Hips", *, folder: str = "gaits", mapped: bool = False) -> dict[str, Any]:
    """Return the body of a request that creates a skeleton with one joint."""
    parts: dict[str, Any] = {"hierarchy": hierarchy(joint)}
    if mapped:
        parts["mapping"] = {"schema": "marey/skeleton-mapping@1", "joints": {joint: "hips"}}
    return {"name": name, "collection": folder, "parts": parts}


def hierarchy(joint: str) -> dict[str, Any]:
    return {"schema": "marey/skeleton@1", "joints": [{"name": joint, "parent": -1, "offset": [0, 1, 0]}]}


def clip(used: str, place: float) -> dict[str, Any]:
    """Return the parts of a clip with one frame at x = `place` metres; `used` is the id of its skeleton."""
    motion = {
        "schema": "marey/motion@1", "frame_rate_hz": 30, "joints": ["Hips"],
        "skeleton": {"item": used, "revision": 1},
        "poses": {"dtype": "<f4", "shape": [1, 7], "data": [[place, 1, 0, 1, 0, 0, 0]]},
    }  # fmt: skip
    return {"motion": motion}


@pytest.fixture
def gaits(owner: httpx.Client) -> Callable[..., Any]:
    """Function that commits the folder of the new dataset `gaits`; the folder contains the skeletons `a` and `b`."""
    for name in ("a", "b"):
        ok(owner.post(f"{LAB}/skeletons", json=skeleton(name, f"Joint {name}")), 201)
    ok(owner.post(f"{LAB}/datasets", json={"name": "gaits", "collection": "gaits"}), 201)

    def commit(message: str = "m", **fields: Any) -> Any:
        return ok(owner.post(f"{GAITS}/commits", json={"message": message, **fields}), 201)

    commit("first")
    return commit


def item_at(owner: httpx.Client, path: str) -> Any:
    (found,) = ok(owner.get(f"{LAB}/skeletons", params={"path": path}))["items"]
    return found


def change(owner: httpx.Client, path: str, **fields: Any) -> Any:
    url = f"{LAB}/skeletons/{item_at(owner, path)['id']}"
    return ok(owner.patch(url, json=fields, headers={"If-Match": "*"}))


def delete(owner: httpx.Client, path: str) -> None:
    url = f"{LAB}/skeletons/{item_at(owner, path)['id']}"
    assert owner.delete(url, headers={"If-Match": "*"}).status_code == 204


def put(owner: httpx.Client, path: str, joint: str) -> Any:
    """Replace the only joint of the skeleton at a path; return the changed item."""
    url = f"{LAB}/skeletons/{item_at(owner, path)['id']}/parts/hierarchy"
    return ok(owner.put(url, json=hierarchy(joint), headers={"If-Match": "*"}))


def entries(owner: httpx.Client, version: str = "main") -> dict[str, Any]:
    found = ok(owner.get(f"{GAITS}/entries", params={"version": version, "limit": 1000}))["items"]
    return {one["path"]: one for one in found}


def difference(owner: httpx.Client, before: str, after: str) -> list[tuple[str, str, str | None]]:
    found = ok(owner.get(f"{GAITS}/difference", params={"before": before, "after": after}))
    return [(one["change"], one["path"], one.get("was")) for one in found["entries"]]


def test_commits_record_the_folder_and_name_its_items(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    first = entries(owner)
    assert sorted(first) == ["a", "b"]
    assert first["a"]["item"] == item_at(owner, "gaits/a")["id"]
    put(owner, "gaits/a", "Pelvis")
    change(owner, "gaits/b", name="c", tags=["slow"])
    ok(owner.post(f"{LAB}/skeletons", json=skeleton("d", folder="gaits/more")), 201)
    second = gaits("second")
    assert (second["entries"], len(second["parents"])) == (3, 1)
    assert difference(owner, "main~1", "main") == [
        ("changed", "a", None), ("moved", "c", "b"), ("added", "more/d", None),
    ]  # fmt: skip
    below = ok(owner.get(f"{GAITS}/difference", params={"path": "more"}))
    assert (below["counts"], below["folders"]) == ({"added": 1}, {"more": {"added": 1}})
    folders = ok(owner.get(f"{GAITS}/difference"))["folders"]
    assert folders == {"": {"changed": 1, "moved": 1}, "more": {"added": 1}}
    assert entries(owner, "main~1") == first
    log = ok(owner.get(f"{GAITS}/commits", params={"limit": 1}))
    assert [one["message"] for one in log["items"]] == ["second"]
    rest = ok(owner.get(f"{GAITS}/commits", params={"limit": 1, "cursor": log["next_cursor"]}))
    assert ([one["message"] for one in rest["items"]], rest["next_cursor"]) == (["first"], None)


def test_a_list_of_entries_ends_in_the_version_in_which_it_began(
    owner: httpx.Client, gaits: Callable[..., Any]
) -> None:
    page = ok(owner.get(f"{GAITS}/entries", params={"limit": 1}))
    delete(owner, "gaits/b")
    ok(owner.post(f"{LAB}/skeletons", json=skeleton("c")), 201)
    gaits("second")
    query = {"limit": 1, "cursor": page["next_cursor"]}
    rest = ok(owner.get(f"{GAITS}/entries", params=query))
    assert ([one["path"] for one in rest["items"]], rest["next_cursor"]) == (["b"], None)
    refused(owner.get(f"{GAITS}/entries", params={**query, "version": "main~1"}), 400, "bad-cursor")
    refused(owner.get(f"{GAITS}/entries", params={**query, "path": "b"}), 400, "bad-cursor")


def test_equal_content_has_the_same_tree_whatever_the_ids(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    for name in ("a", "b"):
        ok(owner.post(f"{LAB}/skeletons", json=skeleton(name, f"Joint {name}", folder="copy")), 201)
    ok(owner.post(f"{LAB}/datasets", json={"name": "copy", "collection": "copy"}), 201)
    copied = ok(owner.post(f"{LAB}/datasets/copy/commits", json={"message": "m"}), 201)
    assert copied["tree"] == ok(owner.get(f"{GAITS}/commits/main"))["tree"]


def test_references_are_named_by_content(owner: httpx.Client) -> None:
    """Clips on equal skeletons have equal content, although each refers to another skeleton id."""
    trees = []
    for folder in ("one", "two"):
        used = ok(owner.post(f"{LAB}/skeletons", json=skeleton("rig", folder=folder)), 201)["id"]
        ok(owner.post(f"{LAB}/clips", json={"name": "walk", "collection": folder, "parts": clip(used, 0)}), 201)
        ok(owner.post(f"{LAB}/datasets", json={"name": folder, "collection": folder}), 201)
        trees.append(ok(owner.post(f"{LAB}/datasets/{folder}/commits", json={"message": "m"}), 201)["tree"])
    assert trees[0] == trees[1]


def test_jobs_read_the_entries_of_a_version(owner: httpx.Client, database: Database) -> None:
    used = ok(owner.post(f"{LAB}/skeletons", json=skeleton("rig", folder="takes")), 201)["id"]
    made = ok(owner.post(f"{LAB}/clips", json={"name": "walk", "collection": "takes/raw", "parts": clip(used, 0)}), 201)
    ok(owner.post(f"{LAB}/datasets", json={"name": "takes", "collection": "takes"}), 201)
    url, tag = f"{LAB}/datasets/takes", {"name": "v1", "kind": "tag"}
    first = ok(owner.post(f"{url}/commits", json={"message": "m"}), 201)["digest"]
    ok(owner.post(f"{url}/refs", json=tag), 201)
    place = f"{LAB}/clips/{made['id']}"
    ok(owner.put(f"{place}/parts/motion", json=clip(used, 1)["motion"], headers={"If-Match": "*"}))
    ok(owner.patch(place, json={"name": "run"}, headers={"If-Match": "*"}))
    second = ok(owner.post(f"{url}/commits", json={"message": "m"}), 201)["digest"]

    def submit(status: int = 202, **version: str) -> Any:
        body = {"kind": "export", "inputs": {"clips": {"dataset": "takes", **version}}}
        return ok(owner.post(f"{LAB}/jobs", json=body), status)

    pinned = {"item": made["id"], "kind": "clip", "collection": "takes/raw"}
    assert submit(version="v1")["inputs"]["clips"] == [{**pinned, "name": "walk", "revision": 1, "commit": first}]
    assert submit(path="raw/run")["inputs"]["clips"] == [{**pinned, "name": "run", "revision": 2, "commit": second}]
    for version, code, pointer in (
        ({"version": "v2"}, "no-version", "/inputs/clips"),
        ({"dataset": "none"}, "no-dataset", "/inputs/clips"),
        ({"path": "raw/walk"}, "empty-version", "/inputs/clips/path"),
    ):
        (error,) = submit(422, **version)["errors"]
        assert (error["code"], error["pointer"]) == (code, pointer)
    database.write(SYSTEM, lambda tx: tx.execute(update(revision).values(content=None)))
    assert submit(422)["errors"][0]["code"] == "no-content"


def test_a_repeated_commit_is_made_once(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    change(owner, "gaits/a", tags=["slow"])
    request = {"message": "again", "write_id": "12345678"}
    first = ok(owner.post(f"{GAITS}/commits", json=request), 201)
    assert ok(owner.post(f"{GAITS}/commits", json=request), 201) == first
    refused(owner.post(f"{GAITS}/commits", json={"message": "nothing"}), 422, "no-changes")


def test_a_commit_for_another_state_of_the_branch_is_refused(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    before = ok(owner.get(f"{GAITS}/commits/main"))["digest"]
    change(owner, "gaits/a", tags=["slow"])
    gaits("second")
    change(owner, "gaits/a", tags=["fast"])
    moved = refused(owner.post(f"{GAITS}/commits", json={"message": "late", "expected": before}), 409, "branch-moved")
    assert moved["context"]["commit"] == ok(owner.get(f"{GAITS}/commits/main"))["digest"]


def test_explicit_changes_need_no_folder(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    a = item_at(owner, "gaits/a")["id"]
    ok(owner.post(f"{LAB}/datasets", json={"name": "chosen"}), 201)
    url = f"{LAB}/datasets/chosen"
    refused(owner.post(f"{url}/commits", json={"message": "m"}), 422, "no-folder")
    added = {"change": "put", "path": "best/a", "item": a}
    ok(owner.post(f"{url}/commits", json={"message": "m", "changes": [added]}), 201)
    moved = {"change": "move", "path": "best/a", "kind": "skeleton", "to": "a"}
    made = ok(owner.post(f"{url}/commits", json={"message": "m", "changes": [moved]}), 201)
    assert made["entries"] == 1
    missing = {"change": "remove", "path": "best/a", "kind": "skeleton"}
    refused(owner.post(f"{url}/commits", json={"message": "m", "changes": [missing]}), 404, "no-entry")
    other = {"change": "put", "path": "x", "item": "skeleton_of_nobody"}
    refused(owner.post(f"{url}/commits", json={"message": "m", "changes": [other]}), 404, "no-item")


def test_versions_are_named_by_branch_tag_digest_and_steps_back(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    first = ok(owner.get(f"{GAITS}/commits/main"))
    ok(owner.post(f"{GAITS}/refs", json={"name": "v1", "kind": "tag"}), 201)
    change(owner, "gaits/a", tags=["slow"])
    gaits("second")
    digits = first["digest"].removeprefix("sha256:")[:8]
    for version in ("v1", "main~1", digits, first["digest"]):
        assert ok(owner.get(f"{GAITS}/commits/{version}")) == first
    refused(owner.post(f"{GAITS}/refs", json={"name": "v1", "kind": "branch"}), 409, "name-taken")
    for version in ("v2", "main~2", "0" * 64, "main~x", "~1", "main~99999"):
        refused(owner.get(f"{GAITS}/commits/{version}"), 404, "no-version")
    refused(owner.post(f"{GAITS}/commits", json={"message": "m", "branch": "v1"}), 422, "is-tag")
    refused(owner.delete(f"{GAITS}/refs/main", headers={"If-Match": "*"}), 422, "is-main")
    assert owner.delete(f"{GAITS}/refs/v1", headers={"If-Match": "*"}).status_code == 204
    assert [one["name"] for one in ok(owner.get(f"{GAITS}/refs"))["items"]] == ["main"]


def test_a_checkout_gives_the_folder_a_version_and_keeps_ids(
    owner: httpx.Client, gaits: Callable[..., Any], database: Database
) -> None:
    ids = {name: item_at(owner, f"gaits/{name}")["id"] for name in ("a", "b")}
    put(owner, "gaits/a", "Pelvis")
    owner.delete(f"{LAB}/skeletons/{ids['b']}", headers={"If-Match": "*"})
    ok(owner.post(f"{LAB}/skeletons", json=skeleton("c")), 201)
    refused(owner.post(f"{GAITS}/checkout", json={}), 409, "uncommitted-changes")
    gaits("second")
    back = ok(owner.post(f"{GAITS}/checkout", json={"version": "main~1"}))
    assert {name: back[name] for name in ("added", "removed", "moved", "changed")} == {
        "added": 1, "removed": 1, "moved": 0, "changed": 1,
    }  # fmt: skip
    assert {name: item_at(owner, f"gaits/{name}")["id"] for name in ("a", "b")} == ids
    assert item_at(owner, "gaits/a")["revision"] == 3
    refused(owner.post(f"{GAITS}/commits", json={"message": "m"}), 409, "folder-elsewhere")
    ok(owner.post(f"{GAITS}/checkout", json={}))
    assert sorted(entries(owner)) == ["a", "c"]
    assert not list(check_store(database))


def test_a_version_with_a_path_that_no_item_can_have_is_not_checked_out(
    owner: httpx.Client, gaits: Callable[..., Any]
) -> None:
    """The path of the entry's folder is short enough, but not below the folder of the dataset."""
    folder = "/".join(["f" * 200] * 5 + ["f" * 17])
    move = {"change": "move", "path": "b", "kind": "skeleton", "to": f"{folder}/b"}
    ok(owner.post(f"{GAITS}/refs", json={"name": "deep", "kind": "branch"}), 201)
    gaits("deep", branch="deep", changes=[move])
    refused(owner.post(f"{GAITS}/checkout", json={"version": "deep"}), 422, "long-path")


def test_a_version_with_more_tags_than_an_item_can_have_is_not_checked_out(
    owner: httpx.Client, gaits: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    change(owner, "gaits/a", tags=["one", "two"])
    gaits("second")
    ok(owner.post(f"{GAITS}/checkout", json={"version": "main~1"}))
    monkeypatch.setattr(checkout, "MOST_TAGS", 1)
    answer = refused(owner.post(f"{GAITS}/checkout", json={}), 422, "too-many-tags")
    assert "'a' has 2 tags" in answer["detail"]


def test_a_checkout_swaps_names(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    ids = {name: item_at(owner, f"gaits/{name}")["id"] for name in ("a", "b")}
    change(owner, "gaits/a", name="x")
    change(owner, "gaits/b", name="a")
    change(owner, "gaits/x", name="b")
    gaits("swapped")
    ok(owner.post(f"{GAITS}/checkout", json={"version": "main~1"}))
    assert {name: item_at(owner, f"gaits/{name}")["id"] for name in ("a", "b")} == ids


@pytest.fixture
def two_branches(
    owner: httpx.Client, gaits: Callable[..., Any]
) -> Callable[[Callable[[], Any], Callable[[], Any]], None]:
    """Function that commits one change to the branch `trial` and one to `main`, and leaves `main` checked out."""

    def diverge(on_trial: Callable[[], Any], on_main: Callable[[], Any]) -> None:
        ok(owner.post(f"{GAITS}/refs", json={"name": "trial", "kind": "branch"}), 201)
        on_trial()
        gaits("on trial", branch="trial")
        ok(owner.post(f"{GAITS}/checkout", json={"version": "main"}))
        on_main()
        gaits("on main")

    return diverge


def test_a_merge_combines_changes_of_different_parts_of_an_entry(
    owner: httpx.Client, two_branches: Callable[..., None]
) -> None:
    two_branches(lambda: put(owner, "gaits/a", "Pelvis"), lambda: change(owner, "gaits/a", name="c", tags=["slow"]))
    preview = ok(owner.post(f"{GAITS}/merges", json={"version": "trial", "preview": True}))
    assert (preview["commit"], preview["changes"], preview["conflict_count"]) == (None, 1, 0)
    merged = ok(owner.post(f"{GAITS}/merges", json={"version": "trial"}))["commit"]
    assert merged["parents"] == [preview["ours"], preview["theirs"]]
    found = entries(owner)
    assert sorted(found) == ["b", "c"]
    assert found["c"]["tags"] == ["slow"]
    assert found["c"]["parts"] == entries(owner, "trial")["a"]["parts"]
    refused(owner.post(f"{GAITS}/merges", json={"version": "trial"}), 422, "already-merged")
    ok(owner.post(f"{GAITS}/checkout", json={}))
    joints = ok(owner.get(f"{LAB}/skeletons/{item_at(owner, 'gaits/c')['id']}/parts/hierarchy"))["joints"]
    assert [joint["name"] for joint in joints] == ["Pelvis"]


def put_mapping(owner: httpx.Client, path: str, joint: str) -> None:
    url = f"{LAB}/skeletons/{item_at(owner, path)['id']}/parts/mapping"
    mapping = {"schema": "marey/skeleton-mapping@1", "joints": {joint: "hips"}}
    ok(owner.put(url, json=mapping, headers={"If-Match": "*"}))


def test_an_entry_with_parts_of_both_sides_can_be_checked_out(
    owner: httpx.Client, two_branches: Callable[..., None], database: Database
) -> None:
    """Each part comes from another side, so no item has both parts before the merge stores them together."""
    two_branches(lambda: put_mapping(owner, "gaits/a", "Pelvis"), lambda: put(owner, "gaits/a", "Pelvis"))
    before = ok(owner.get(f"{LAB}/skeletons"))
    request = {"version": "trial", "write_id": "12345678"}
    ok(owner.post(f"{GAITS}/merges", json={**request, "preview": True}))
    assert database.read(SYSTEM, number_of_revisions) == 5
    merged = ok(owner.post(f"{GAITS}/merges", json=request))["commit"]
    assert ok(owner.post(f"{GAITS}/merges", json=request))["commit"] == merged
    assert database.read(SYSTEM, number_of_revisions) == 6
    entry = entries(owner)["a"]
    assert entry["parts"] == {
        "hierarchy": entries(owner, "main~1")["a"]["parts"]["hierarchy"],
        "mapping": entries(owner, "trial")["a"]["parts"]["mapping"],
    }
    assert entry["item"] is not None
    assert ok(owner.get(f"{LAB}/skeletons")) == before
    assert ok(owner.post(f"{GAITS}/checkout", json={}))["changed"] == 1
    found = item_at(owner, "gaits/a")
    joints = ok(owner.get(f"{LAB}/skeletons/{found['id']}/parts/hierarchy"))["joints"]
    mapping = ok(owner.get(f"{LAB}/skeletons/{found['id']}/parts/mapping"))["joints"]
    assert ([joint["name"] for joint in joints], mapping) == (["Pelvis"], {"Pelvis": "hips"})
    assert not list(check_store(database))


def number_of_revisions(tx: Transaction) -> int:
    return tx.execute(select(func.count()).select_from(revision)).scalar_one()


def test_an_entry_whose_content_nobody_has_is_named(
    owner: httpx.Client, gaits: Callable[..., Any], database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fsck, "PAGE", 1)  # the trees of the versions are read in several batches
    put(owner, "gaits/a", "Pelvis")
    gaits("second")
    database.write(SYSTEM, lose_contents)
    assert {one.code for one in check_store(database)} == {"entry-lost"}
    put(owner, "gaits/a", "Root")
    answer = refused(owner.post(f"{GAITS}/checkout", json={"discard": True, "version": "main~1"}), 422, "no-content")
    assert "'a'" in answer["detail"]


def lose_contents(tx: Transaction) -> None:
    tx.execute(update(revision).values(content="sha256:" + "0" * 64))


def test_a_conflict_is_listed_and_decided(owner: httpx.Client, two_branches: Callable[..., None]) -> None:
    two_branches(lambda: put(owner, "gaits/a", "Pelvis"), lambda: put(owner, "gaits/a", "Root"))
    before = ok(owner.get(f"{GAITS}/commits/main"))
    conflict = refused(owner.post(f"{GAITS}/merges", json={"version": "trial"}), 409, "merge-conflicts")["context"]
    assert [(one["path"], one["parts"]) for one in conflict["conflicts"]] == [("a", ["hierarchy"])]
    assert ok(owner.get(f"{GAITS}/commits/main")) == before
    other = [{"path": "b", "kind": "skeleton", "take": "ours"}]
    refused(owner.post(f"{GAITS}/merges", json={"version": "trial", "resolutions": other}), 422, "no-conflict")
    theirs = [{"path": "a", "kind": "skeleton", "take": "theirs"}]
    twice = [*theirs, {"path": "a", "kind": "skeleton", "take": "ours"}]
    refused(owner.post(f"{GAITS}/merges", json={"version": "trial", "resolutions": twice}), 422, "no-conflict")
    assert ok(owner.get(f"{GAITS}/commits/main")) == before
    ok(owner.post(f"{GAITS}/merges", json={"version": "trial", "resolutions": theirs}))
    assert entries(owner)["a"]["parts"] == entries(owner, "trial")["a"]["parts"]


def test_the_parts_of_a_conflict_are_taken_from_different_versions(
    owner: httpx.Client, two_branches: Callable[..., None], database: Database
) -> None:
    def edit(joint: str) -> None:
        put(owner, "gaits/a", joint)
        put_mapping(owner, "gaits/a", joint)

    put_mapping(owner, "gaits/a", "Joint a")
    ok(owner.post(f"{GAITS}/commits", json={"message": "with a mapping"}), 201)
    two_branches(lambda: edit("Pelvis"), lambda: edit("Root"))
    of = {"ours": entries(owner), "theirs": entries(owner, "trial"), "base": entries(owner, "main~1")}

    def merge(*taken: tuple[str | None, str], **fields: Any) -> httpx.Response:
        decided = [{"path": "a", "kind": "skeleton", "take": side, "part": part} for part, side in taken]
        return owner.post(f"{GAITS}/merges", json={"version": "trial", "resolutions": decided, **fields})

    conflict = refused(merge(("mapping", "theirs")), 409, "merge-conflicts")["context"]
    assert [(one["path"], one["parts"]) for one in conflict["conflicts"]] == [("a", ["hierarchy"])]
    apart = ("hierarchy", "ours"), ("mapping", "theirs")
    for extra in (("mapping", "ours"), ("path", "ours"), (None, "ours")):
        refused(merge(*apart, extra), 422, "no-conflict")
    ok(merge(("hierarchy", "ours"), ("mapping", "base"), preview=True))
    ok(merge(*apart))
    for part, side in apart:
        assert entries(owner)["a"]["parts"][part] == of[side]["a"]["parts"][part]
    ok(owner.post(f"{GAITS}/reverts", json={"version": "main", "parent": 1}))
    ok(owner.post(f"{GAITS}/refs", json={"name": "again", "kind": "branch", "at": "main~2"}), 201)
    mixed = [
        {"path": "a", "kind": "skeleton", "take": side, "part": part}
        for part, side in (("hierarchy", "ours"), ("mapping", "base"))
    ]
    ok(owner.post(f"{GAITS}/cherry-picks", json={"version": "trial", "into": "again", "resolutions": mixed}))
    assert entries(owner, "again")["a"]["parts"] == {
        "hierarchy": of["ours"]["a"]["parts"]["hierarchy"],
        "mapping": of["base"]["a"]["parts"]["mapping"],
    }
    assert not list(check_store(database))


def test_a_repeated_request_gets_its_commit_although_the_branches_are_gone(
    owner: httpx.Client, two_branches: Callable[..., None]
) -> None:
    two_branches(lambda: put(owner, "gaits/a", "Pelvis"), lambda: change(owner, "gaits/b", tags=["slow"]))
    ok(owner.post(f"{GAITS}/refs", json={"name": "work", "kind": "branch"}), 201)
    removal = {"change": "remove", "path": "b", "kind": "skeleton"}
    requests = {
        "merges": {"version": "trial", "into": "work", "write_id": "a merge of trial"},
        "commits": {"branch": "work", "message": "m", "changes": [removal], "write_id": "a commit of changes"},
    }
    first = {name: owner.post(f"{GAITS}/{name}", json=body) for name, body in requests.items()}
    made = {name: answer.json().get("commit") or answer.json() for name, answer in first.items()}
    for ref in ("trial", "work"):
        assert owner.delete(f"{GAITS}/refs/{ref}", headers={"If-Match": "*"}).status_code == 204
    for name, body in requests.items():
        again = owner.post(f"{GAITS}/{name}", json=body)
        assert again.is_success, again.text
        assert (again.json().get("commit") or again.json()) == made[name]


def test_no_branch_or_tag_hides_a_commit(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    """If a branch could have the first digits of a commit as its name, it would be used in place of this commit."""
    first = ok(owner.get(f"{GAITS}/commits/main"))["digest"].removeprefix("sha256:")
    put(owner, "gaits/a", "Pelvis")
    gaits("second")
    for name, kind in ((first, "branch"), (first[:12], "tag"), (first[:8], "branch")):
        refused(owner.post(f"{GAITS}/refs", json={"name": name, "kind": kind}), 409, "name-taken")
    ok(owner.post(f"{GAITS}/refs", json={"name": "20261127", "kind": "tag"}), 201)
    assert ok(owner.get(f"{GAITS}/commits/{first[:12]}"))["digest"] == f"sha256:{first}"


def test_two_conflicts_at_one_path_are_decided_one_after_the_other(
    owner: httpx.Client, two_branches: Callable[..., None]
) -> None:
    """Our side has removed `b` and moved `a` to its place; their side has changed `b`."""

    def replace() -> None:
        item = item_at(owner, "gaits/b")
        owner.delete(f"{LAB}/skeletons/{item['id']}", headers={"If-Match": "*"})
        change(owner, "gaits/a", name="b")

    two_branches(lambda: put(owner, "gaits/b", "Pelvis"), replace)
    ours = entries(owner)["b"]["parts"]
    restore = {"path": "b", "kind": "skeleton", "take": "theirs"}
    request = {"version": "trial", "resolutions": [restore]}
    conflict = refused(owner.post(f"{GAITS}/merges", json=request), 409, "merge-conflicts")["context"]
    assert [(one["path"], one["parts"], one["ours"]["parts"]) for one in conflict["conflicts"]] == [
        ("b", ["path"], ours)
    ]
    ok(owner.post(f"{GAITS}/merges", json={**request, "resolutions": [restore, restore]}))
    found, trial = entries(owner), entries(owner, "trial")
    assert {path: one["parts"] for path, one in found.items()} == {path: one["parts"] for path, one in trial.items()}
    assert found["a"]["parts"] == ours


def test_an_entry_that_cannot_go_back_to_its_place_stays_in_conflict(
    owner: httpx.Client, two_branches: Callable[..., None]
) -> None:
    """Each side has moved an entry to `z`. On their side, another entry is at the former path of the moved entry."""

    def shift() -> None:
        change(owner, "gaits/b", name="z")
        ok(owner.post(f"{LAB}/skeletons", json=skeleton("x")), 201)
        change(owner, "gaits/x", name="b")

    two_branches(shift, lambda: change(owner, "gaits/a", name="z"))
    take = [{"path": "z", "kind": "skeleton", "take": "ours"}]
    request = {"version": "trial", "resolutions": take}
    (conflict,) = refused(owner.post(f"{GAITS}/merges", json=request), 409, "merge-conflicts")["context"]["conflicts"]
    assert (conflict["path"], conflict["parts"]) == ("z", ["path"])
    assert "would return to 'b'" in conflict["reason"]


def put_labels(owner: httpx.Client, path: str, *segments: tuple[str, int, int]) -> None:
    """Replace the segments of an annotation."""
    (found,) = ok(owner.get(f"{LAB}/annotations", params={"path": path}))["items"]
    url = f"{LAB}/annotations/{found['id']}/parts/annotation"
    document = ok(owner.get(url))
    document["segments"] = [dict(zip(("label", "start", "end"), one, strict=True)) for one in segments]
    ok(owner.put(url, json=document, headers={"If-Match": "*"}))


def test_segments_that_exclude_each_other_are_listed(
    owner: httpx.Client, gaits: Callable[..., Any], two_branches: Callable[..., None]
) -> None:
    rig = ok(owner.post(f"{LAB}/skeletons", json=skeleton("rig", folder="raw")), 201)
    made = ok(owner.post(f"{LAB}/clips", json={"name": "walk", "parts": clip(rig["id"], 0)}), 201)
    document = {"schema": "marey/annotation@1", "clip": {"item": made["id"], "revision": 1}}
    body = {"name": "labels", "collection": "gaits", "parts": {"annotation": document}}
    ok(owner.post(f"{LAB}/annotations", json=body), 201)
    gaits("labels")
    two_branches(
        lambda: put_labels(owner, "gaits/labels", ("left", 0, 1)),
        lambda: put_labels(owner, "gaits/labels", ("right", 0, 1)),
    )
    refusal = refused(owner.post(f"{GAITS}/merges", json={"version": "trial"}), 409, "merge-conflicts")
    (conflict,) = refusal["context"]["conflicts"]
    assert (conflict["path"], conflict["parts"]) == ("labels", ["annotation"])
    assert conflict["reason"] == (
        "Both sides have labelled the same frames in different ways, the first in 'left' at 0:1."
    )
    assert conflict["segments"] == {
        "base": [],
        "ours": [{"label": "right", "start": 0, "end": 1}],
        "theirs": [{"label": "left", "start": 0, "end": 1}],
    }


def test_a_branch_that_has_not_moved_is_moved_by_a_merge(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    ok(owner.post(f"{GAITS}/refs", json={"name": "trial", "kind": "branch"}), 201)
    change(owner, "gaits/a", tags=["slow"])
    made = gaits("on trial", branch="trial")
    request = {"version": "trial", "write_id": "12345678"}
    assert ok(owner.post(f"{GAITS}/merges", json=request))["commit"] == made
    assert ok(owner.post(f"{GAITS}/merges", json=request))["commit"] == made
    refused(owner.post(f"{GAITS}/merges", json={"version": "trial"}), 422, "already-merged")
    change(owner, "gaits/a", tags=["fast"])
    gaits("later")
    assert ok(owner.post(f"{GAITS}/merges", json=request))["commit"] == made


def test_histories_that_crossed_are_not_merged(owner: httpx.Client, two_branches: Callable[..., None]) -> None:
    two_branches(lambda: change(owner, "gaits/a", tags=["x"]), lambda: change(owner, "gaits/b", tags=["y"]))
    ok(owner.post(f"{GAITS}/refs", json={"name": "old", "kind": "branch"}), 201)
    ok(owner.post(f"{GAITS}/merges", json={"version": "trial"}))
    ok(owner.post(f"{GAITS}/merges", json={"version": "old", "into": "trial"}))
    crossed = refused(owner.post(f"{GAITS}/merges", json={"version": "trial"}), 409, "several-bases")
    assert len(crossed["context"]["commits"]) == 2


def test_a_commit_is_undone_and_repeated_while_later_changes_stay(
    owner: httpx.Client, gaits: Callable[..., Any], database: Database
) -> None:
    put(owner, "gaits/a", "Pelvis")
    renamed = gaits("rename a joint")["digest"]
    change(owner, "gaits/a", tags=["slow"])
    gaits("tag")
    undone = ok(owner.post(f"{GAITS}/reverts", json={"version": renamed}))["commit"]
    assert (undone["message"], len(undone["parents"])) == ("Revert 'rename a joint'", 1)
    assert entries(owner)["a"]["parts"] == entries(owner, "main~3")["a"]["parts"]
    assert entries(owner)["a"]["tags"] == ["slow"]
    refused(owner.post(f"{GAITS}/reverts", json={"version": renamed}), 422, "no-changes")
    again = {"version": renamed, "write_id": "12345678"}
    repeated = ok(owner.post(f"{GAITS}/cherry-picks", json=again))["commit"]
    assert (repeated["message"], repeated["tree"]) == (
        "rename a joint", ok(owner.get(f"{GAITS}/commits/main~2"))["tree"],
    )  # fmt: skip
    assert ok(owner.post(f"{GAITS}/cherry-picks", json=again))["commit"] == repeated
    assert not list(check_store(database))


def test_a_commit_is_not_undone_over_a_later_change_of_the_same_part(
    owner: httpx.Client, gaits: Callable[..., Any]
) -> None:
    put(owner, "gaits/a", "Pelvis")
    gaits("second")
    put(owner, "gaits/a", "Root")
    gaits("third")
    conflict = refused(owner.post(f"{GAITS}/reverts", json={"version": "main~1"}), 409, "merge-conflicts")["context"]
    assert [(one["path"], one["parts"]) for one in conflict["conflicts"]] == [("a", ["hierarchy"])]
    theirs = [{"path": "a", "kind": "skeleton", "take": "theirs"}]
    ok(owner.post(f"{GAITS}/reverts", json={"version": "main~1", "resolutions": theirs}))
    assert entries(owner)["a"] == entries(owner, "main~3")["a"]
    first = ok(owner.post(f"{GAITS}/reverts", json={"version": "main~3", "preview": True}))
    assert (first["theirs"], first["changes"]) == (None, 2)


def test_the_changes_of_a_merge_are_those_since_a_chosen_parent(
    owner: httpx.Client, two_branches: Callable[..., None]
) -> None:
    two_branches(lambda: change(owner, "gaits/a", tags=["x"]), lambda: change(owner, "gaits/b", tags=["y"]))
    ok(owner.post(f"{GAITS}/merges", json={"version": "trial"}))
    refused(owner.post(f"{GAITS}/reverts", json={"version": "main"}), 422, "is-merge")
    refused(owner.post(f"{GAITS}/reverts", json={"version": "main~1", "parent": 2}), 422, "no-parent")
    ok(owner.post(f"{GAITS}/reverts", json={"version": "main", "parent": 1}))
    assert {path: one["tags"] for path, one in entries(owner).items()} == {"a": [], "b": ["y"]}


def test_a_branch_is_moved_back_to_an_earlier_version(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    change(owner, "gaits/a", tags=["slow"])
    second = gaits("second")["digest"]
    (main,) = ok(owner.get(f"{GAITS}/refs"))["items"]
    moved = owner.patch(f"{GAITS}/refs/main", json={"at": "main~1"}, headers={"If-Match": '"1"'})
    refused(moved, 412, "precondition-failed")
    moved = owner.patch(f"{GAITS}/refs/main", json={"at": "main~1"}, headers={"If-Match": f'"{main["rev"]}"'})
    assert ok(moved)["commit"] == ok(owner.get(f"{GAITS}/commits/{second}"))["parents"][0]
    ok(owner.post(f"{GAITS}/refs", json={"name": "v2", "kind": "tag", "at": second}), 201)
    refused(owner.patch(f"{GAITS}/refs/v2", json={"at": "main"}, headers={"If-Match": "*"}), 422, "is-tag")
    refused(owner.patch(f"{GAITS}/refs/v3", json={"at": "main"}, headers={"If-Match": "*"}), 404, "no-version")
    assert ok(owner.get(f"{GAITS}/commits/v2"))["digest"] == second


def test_the_commits_that_changed_a_path_are_listed(
    owner: httpx.Client, gaits: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    change(owner, "gaits/a", tags=["slow"])
    gaits("tag a")
    ok(owner.post(f"{LAB}/skeletons", json=skeleton("a", folder="gaits/a b")), 201)
    gaits("add a b/a")
    change(owner, "gaits/a", tags=[])
    gaits("untag a")

    def log(path: str) -> list[str]:
        found: list[str] = []
        cursor: str | None = None
        while True:
            query: dict[str, str | int] = {"path": path, "limit": 1}
            if cursor:
                query["cursor"] = cursor
            page = ok(owner.get(f"{GAITS}/commits", params=query))
            found += [one["message"] for one in page["items"]]
            cursor = page["next_cursor"]
            if cursor is None:
                return found

    assert (log("a"), log("a b"), log("nothing")) == (["untag a", "tag a", "first"], ["add a b/a"], [])
    monkeypatch.setattr("marey_server.store.datasets.history.MOST_EXAMINED", 2)
    assert (log("a"), log("a b"), log("b")) == (["untag a", "tag a", "first"], ["add a b/a"], ["first"])


def test_a_list_of_commits_says_what_each_did_at_the_path(
    owner: httpx.Client, gaits: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def log(path: str) -> list[tuple[Any, ...]]:
        found = ok(owner.get(f"{GAITS}/commits", params={"path": path}))["items"]
        return [(one["message"], one["changes"], one["moved_from"], one["moved_to"]) for one in found]

    change(owner, "gaits/a", tags=["slow"])
    gaits("tag a")
    change(owner, "gaits/a", name="c")
    gaits("rename a")
    change(owner, "gaits/c", collection="gaits/old")
    gaits("move c")
    delete(owner, "gaits/b")
    gaits("drop b")
    tagged, first = ("tag a", {"changed": 1}, None, None), ("first", {"added": 1}, None, None)
    assert log("a") == [("rename a", {"moved": 1}, None, "c"), tagged, first]
    assert log("c") == [("move c", {"moved": 1}, None, "old/c"), ("rename a", {"moved": 1}, "a", None)]
    assert log("old") == [("move c", {"moved": 1}, "c", None)]
    assert log("b") == [("drop b", {"removed": 1}, None, None), first]
    assert {one["changes"] for one in ok(owner.get(f"{GAITS}/commits"))["items"]} == {None}
    # Moved entries are searched for among a limited number of changes, and a page compares a limited number.
    monkeypatch.setattr("marey_server.store.datasets.history.MOST_DIFFERENCES", 1)
    assert log("a") == [("rename a", {"removed": 1}, None, None)]


def test_a_merge_is_listed_with_what_it_changed_on_its_branch(
    owner: httpx.Client, two_branches: Callable[..., None]
) -> None:
    two_branches(lambda: delete(owner, "gaits/b"), lambda: change(owner, "gaits/a", tags=["slow"]))
    ok(owner.post(f"{GAITS}/merges", json={"version": "trial", "message": "merge"}))
    found = ok(owner.get(f"{GAITS}/commits", params={"path": "b"}))["items"]
    assert [(one["message"], one["changes"]) for one in found] == [("merge", {"removed": 1}), ("first", {"added": 1})]


def test_the_origin_of_each_part_is_shown(owner: httpx.Client, two_branches: Callable[..., None]) -> None:
    two_branches(lambda: put(owner, "gaits/a", "Pelvis"), lambda: change(owner, "gaits/a", name="c", tags=["slow"]))
    ok(owner.post(f"{GAITS}/merges", json={"version": "trial"}))
    found = ok(owner.get(f"{GAITS}/blame", params={"entry": "c", "kind": "skeleton"}))
    assert (found["tags"]["commit"]["message"], found["place"]["commit"]["message"]) == ("on main", "on main")
    origin = found["parts"]["hierarchy"]
    assert (origin["commit"]["message"], origin["path"], origin["certain"]) == ("on trial", "a", True)


def test_an_entry_without_origins_is_named_with_the_commit_that_removed_it(
    owner: httpx.Client, gaits: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(entry: str, version: str = "main") -> Any:
        params = {"entry": entry, "kind": "skeleton", "version": version}
        answer = refused(owner.get(f"{GAITS}/blame", params=params), 404, "no-entry")
        return answer["detail"], answer["context"]

    delete(owner, "gaits/b")
    dropped = gaits("Leave out what slides\n\nSeen by Ada.")
    change(owner, "gaits/a", name="c")
    renamed = gaits("x" * 500)
    detail, context = missing("b")
    assert detail == (
        f"The version has no skeleton at 'b'; it was removed by the commit {dropped['digest']} "
        "('Leave out what slides')."
    )
    assert context == {"removed_by": dropped, "moved_to": None}
    detail, context = missing("a")
    assert f"at 'a'; it was moved to 'c' by the commit {renamed['digest']} ('{'x' * 200}…')." in detail
    assert context == {"removed_by": renamed, "moved_to": "c"}
    assert missing("c", "main~1") == ("The version has no skeleton at 'c'.", {})  # only a later version has it
    monkeypatch.setattr("marey_server.store.datasets.history.MOST_EXAMINED", 1)
    assert missing("b") == ("The version has no skeleton at 'b', and neither have the 1 versions before it.", {})


def test_an_entry_that_a_merge_removed_is_named_with_the_merge(
    owner: httpx.Client, two_branches: Callable[..., None]
) -> None:
    two_branches(lambda: delete(owner, "gaits/b"), lambda: change(owner, "gaits/a", tags=["slow"]))
    merge = ok(owner.post(f"{GAITS}/merges", json={"version": "trial", "message": "merge"}))["commit"]
    params = {"entry": "b", "kind": "skeleton"}
    answer = refused(owner.get(f"{GAITS}/blame", params=params), 404, "no-entry")
    assert answer["context"]["removed_by"] == merge


def test_readers_read_and_contributors_commit(server: Server, gaits: Callable[..., Any]) -> None:
    reader = server.client(server.make_user("rita"))
    refused(reader.get(f"{GAITS}/entries"), 404, "no-project")
    owner = server.client(next(token for token in server._clients if token and token.startswith("marey_")))
    ok(owner.put(f"{LAB}/members/rita", json={"role": Role.READER.value}))
    assert sorted(entries(reader)) == ["a", "b"]
    refused(reader.post(f"{GAITS}/commits", json={"message": "m"}), 403, "insufficient-role")
    refused(reader.post(f"{GAITS}/merges", json={"version": "main", "preview": True}), 403, "insufficient-role")


def test_a_deleted_folder_is_not_committed_as_empty(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    (folder,) = ok(owner.get(f"{LAB}/collections", params={"path": "gaits"}))["items"]
    assert owner.delete(f"{LAB}/collections/{folder['id']}", headers={"If-Match": "*"}).status_code == 204
    refused(owner.post(f"{GAITS}/commits", json={"message": "m"}), 422, "folder-deleted")
    assert sorted(entries(owner)) == ["a", "b"]


def test_damaged_versions_are_found(owner: httpx.Client, gaits: Callable[..., Any], database: Database) -> None:
    def damage(tx: Transaction) -> None:
        tx.execute(update(tree_chunk).values(data=b'{"level":0,"entries":[]}'))
        tx.execute(update(dataset_commit).values(message="forged"))

    assert not list(check_store(database))
    database.write(SYSTEM, damage)
    assert {one.code for one in check_store(database)} == {"chunk-corrupt", "commit-corrupt"}
    before = ok(owner.get(f"{GAITS}/refs/main"))
    refused(owner.get(f"{GAITS}/entries"), 500, "dataset-damaged")
    change = {"change": "put", "path": "c", "item": item_at(owner, "gaits/a")["id"]}
    refused(owner.post(f"{GAITS}/commits", json={"message": "m", "changes": [change]}), 500, "dataset-damaged")
    assert ok(owner.get(f"{GAITS}/refs/main")) == before


def test_a_tag_or_dataset_that_is_made_again_is_sent_again(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    (first,) = ok(owner.get(f"{GAITS}/commits"))["items"]
    change(owner, "gaits/a", tags=["slow"])
    second = gaits("second")
    tag = f"{GAITS}/refs/v1"

    def made_again(url: str, list_url: str, body: dict[str, Any]) -> Any:
        held = owner.get(url).headers["ETag"]
        assert owner.get(url, headers={"If-None-Match": held}).status_code == 304
        assert owner.delete(url, headers={"If-Match": held}).status_code == 204
        ok(owner.post(list_url, json=body), 201)
        return ok(owner.get(url, headers={"If-None-Match": held}))

    ok(owner.post(f"{GAITS}/refs", json={"name": "v1", "kind": "tag", "at": first["digest"]}), 201)
    body = {"name": "v1", "kind": "tag", "at": second["digest"]}
    assert made_again(tag, f"{GAITS}/refs", body)["commit"] == second["digest"]
    was = ok(owner.get(GAITS))["id"]
    assert made_again(GAITS, f"{LAB}/datasets", {"name": "gaits", "collection": "gaits"})["id"] != was


def test_the_numbers_of_datasets_and_of_tags_are_limited(
    owner: httpx.Client, gaits: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("marey_server.store.datasets.naming.MOST_DATASETS", 1)
    monkeypatch.setattr("marey_server.store.datasets.naming.MOST_REFS", 1)
    refused(owner.post(f"{LAB}/datasets", json={"name": "other"}), 409, "too-many-datasets")
    refused(owner.post(f"{GAITS}/refs", json={"name": "v1", "kind": "tag"}), 409, "too-many-refs")


def contents(client: httpx.Client, project: str = LAB, **request: Any) -> Any:
    return ok(client.post(f"{project}/contents", json=request))


def test_contents_are_the_same_documents_on_every_server(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    parts = clip(item_at(owner, "gaits/a")["id"], 1)
    parts["motion"]["joints"] = ["Joint a"]
    made = ok(owner.post(f"{LAB}/clips", json={"name": "c", "collection": "gaits", "parts": parts}), 201)
    gaits("a clip")
    entries = {one["path"]: one for one in ok(owner.get(f"{GAITS}/entries"))["items"]}
    motion = entries["c"]["parts"]["motion"]
    of_clip, of_skeleton = (revision_content(entries[one]["kind"], entries[one]["parts"]) for one in ("c", "a"))
    found = contents(owner, revisions=[of_clip, of_skeleton], documents=[{"content": of_clip, "part": "motion"}])
    assert [one["kind"] for one in found["revisions"]] == ["clip", "skeleton"]
    assert found["revisions"][0]["parts"] == {"motion": motion}
    (document,) = found["documents"]
    assert document["skeleton"] == {"content": of_skeleton}
    poses = np.array(document["poses"]["data"], dtype=np.float32)
    assert document_digest({**document, "poses": poses}) == motion
    assert owner.delete(f"{LAB}/clips/{made['id']}", headers={"If-Match": "*"}).is_success
    assert contents(owner, documents=[{"content": of_clip, "part": "motion"}])["documents"] == [document]


def test_contents_of_other_projects_and_unknown_ones_are_null(owner: httpx.Client, gaits: Callable[..., Any]) -> None:
    (entry, *_) = ok(owner.get(f"{GAITS}/entries"))["items"]
    content = revision_content(entry["kind"], entry["parts"])
    ok(owner.post("/projects", json={"name": "other"}), 201)
    wanted: dict[str, Any] = {"revisions": [content], "documents": [{"content": content, "part": "hierarchy"}]}
    nothing = {"revisions": [None], "documents": [None], "facets": [{}], "tiles": []}
    assert contents(owner, "/projects/other", **wanted) == nothing
    assert contents(owner, **wanted)["revisions"] != [None]
    unknown: dict[str, Any] = {
        "revisions": ["sha256:" + "0" * 64],
        "documents": [{"content": content, "part": "nothing"}],
    }
    assert contents(owner, **unknown) == nothing
    many = ["sha256:" + "0" * 64] * 257
    refused(owner.post(f"{LAB}/contents", json={"revisions": many}), 422, "invalid-body")


def test_references_to_other_projects_tell_nothing(
    owner: httpx.Client, gaits: Callable[..., Any], server: Server, database: Database
) -> None:
    """A stranger's documents refer to a revision of a private project, and to a revision that does not exist."""
    real = {"item": item_at(owner, "gaits/a")["id"], "revision": 1}
    absent = {**real, "revision": 2}
    stranger = server.client(server.make_user("stranger"))
    ok(stranger.post("/projects", json={"name": "own"}), 201)
    parts = {"character": {"schema": "marey/document@1", "real": real, "absent": absent}}
    ok(stranger.post("/projects/own/characters", json={"name": "spy", "collection": "c", "parts": parts}), 201)
    ok(stranger.post("/projects/own/datasets", json={"name": "spies", "collection": "c"}), 201)
    database.write(SYSTEM, lambda tx: tx.execute(update(revision).values(content=None)))
    ok(stranger.post("/projects/own/datasets/spies/commits", json={"message": "m"}), 201)
    (entry,) = ok(stranger.get("/projects/own/datasets/spies/entries"))["items"]
    content = revision_content(entry["kind"], entry["parts"])
    wanted = [{"content": content, "part": "character"}]
    (document,) = contents(stranger, "/projects/own", documents=wanted)["documents"]
    assert (document["real"], document["absent"]) == (real, absent)
    assert document_digest(document) == entry["parts"]["character"]
    stored = select(revision.c.content).where(revision.c.item_id == real["item"])
    assert database.read(SYSTEM, lambda tx: tx.execute(stored).scalars().all()) == [None]
