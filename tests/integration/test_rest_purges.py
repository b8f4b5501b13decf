"""Purges over REST: the answers, and the bytes that the database and the folder of blobs really lose."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy
from tests.support.rest_server import USER_SCOPES, Server
from tests.support.store_fixtures import Lab

from marey_schemas.kinds import Kind
from marey_server.store import fsck, garbage, items
from marey_server.store.blob_backings import DirectoryBlobs
from marey_server.store.transaction import Transaction

FRAMES = 20_000
MOTION_BYTES = FRAMES * 15 * 4
"""Size of the poses of a clip, which are random and can be compressed to four fifths."""


@pytest.fixture
def lab(server: Server) -> Lab:
    return Lab(server.database)


@pytest.fixture
def owner(server: Server, lab: Lab) -> httpx.Client:
    name = str(lab.owner.user_name)
    return server.client(server.make_token(str(lab.owner.user_id), name, scopes=USER_SCOPES))


def remove(owner: httpx.Client, *ids: str) -> None:
    for one in ids:
        kind = Kind(one.partition("_")[0]).plural
        assert owner.delete(f"/projects/lab/{kind}/{one}", headers={"If-Match": "*"}).status_code == 204


def purge(owner: httpx.Client, **body: Any) -> httpx.Response:
    return owner.post("/projects/lab/purges", json=body)


def bytes_in_database(tx: Transaction) -> int:
    """Return the size in bytes of the used pages of SQLite, or of the rows with content in Postgres."""
    if not tx.is_postgres:
        pages, free, size = (
            tx.execute(sqlalchemy.text(f"PRAGMA {name}")).scalar_one()
            for name in ("page_count", "freelist_count", "page_size")
        )
        return int((pages - free) * size)
    tables = ("document", "document_blob", "document_item", "blob", "blob_chunk", "revision_part")
    sums = (f"(SELECT coalesce(sum(pg_column_size(t.*)), 0) FROM {name} t)" for name in tables)
    return int(tx.execute(sqlalchemy.text(f"SELECT {' + '.join(sums)}")).scalar_one())


def bytes_in(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("backing", ["rows", "files"])
def test_bytes_of_the_database_and_the_folder_of_blobs_shrink_after_a_purge(
    server: Server, lab: Lab, owner: httpx.Client, tmp_path: Path, backing: str
) -> None:
    folder = tmp_path / "blobs"
    if backing == "files":
        server.database.blobs = DirectoryBlobs(folder)
    measure: Callable[[], int] = (
        (lambda: bytes_in(folder)) if backing == "files" else lambda: int(lab.read(bytes_in_database))
    )
    rig = lab.add_skeleton()
    clips = [lab.add_clip(rig, f"walk {number}", seed=number, frames=FRAMES).id for number in range(3)]
    before = measure()
    assert before > 2.4 * MOTION_BYTES
    remove(owner, *clips[:2])
    garbage.collect_garbage(lab.database, grace_us=-1)
    assert measure() >= before - 100_000

    answer = purge(owner, collection="").json()
    assert {one["item"] for one in answer["purged"]} == set(clips[:2])
    garbage.collect_garbage(lab.database, grace_us=-1)
    shrunk = before - measure()
    assert shrunk == pytest.approx(answer["freed_bytes"], rel=0.1)
    assert shrunk > 1.6 * MOTION_BYTES
    assert list(fsck.check_store(lab.database)) == []
    part = owner.get(f"/projects/lab/clips/{clips[2]}/parts/motion", params={"frames": "0:2"})
    assert part.status_code == 200
    remove(owner, clips[2], rig.id)
    assert len(purge(owner, collection="").json()["purged"]) == 2
    garbage.collect_garbage(lab.database, grace_us=-1)
    assert before - measure() > 2.4 * MOTION_BYTES
    assert list(fsck.check_store(lab.database)) == []


def test_a_preview_does_not_show_names_to_a_token_that_may_not_read(server: Server, owner: httpx.Client) -> None:
    writer = server.client(server.make_user("willa", scopes=("write",)))
    assert owner.put("/projects/lab/members/willa", json={"role": "owner"}).is_success
    refused = purge(writer, collection="", preview=True)
    assert (refused.status_code, refused.json()["code"]) == (403, "insufficient-scope")


def test_freed_bytes_do_not_reveal_what_hidden_projects_contain(server: Server, lab: Lab, owner: httpx.Client) -> None:
    clip = lab.add_clip(lab.add_skeleton(), seed=5, frames=FRAMES).id
    remove(owner, clip)
    before = purge(owner, item=clip, preview=True).json()["freed_bytes"]
    hidden = Lab(server.database, "hidden")
    hidden.add_clip(hidden.add_skeleton(), seed=5, frames=FRAMES)
    assert purge(owner, item=clip, preview=True).json()["freed_bytes"] == before > MOTION_BYTES / 2


def test_a_saved_edit_holds_the_clips_that_its_commands_name(lab: Lab, owner: httpx.Client) -> None:
    clip = lab.add_clip(lab.add_skeleton()).id
    edit = {"schema": "marey/edit@1", "commands": [{"command": "concatenate", "source": clip}]}
    made = owner.post("/projects/lab/edits", json={"name": "longer", "parts": {"edit": edit}})
    assert made.status_code == 201, made.text
    remove(owner, clip)
    answer = purge(owner, item=clip)
    assert (answer.status_code, answer.json()["code"]) == (409, "still-held")
    assert list(fsck.check_store(lab.database)) == []


def test_an_item_that_is_held_is_refused_with_its_holders(lab: Lab, owner: httpx.Client) -> None:
    rig = lab.add_skeleton()
    clip = lab.add_clip(rig)
    remove(owner, rig.id)
    answer = purge(owner, item=rig.id)
    assert answer.status_code == 409
    problem = answer.json()
    assert problem["code"] == "still-held"
    assert problem["detail"] == (
        f"The skeleton 'rig' cannot be purged, because it is still needed by the clip walk ({clip.id})."
    )
    holder = {"type": "item", "item": clip.id, "kind": "clip", "path": "walk", "deleted": False}
    assert problem["context"]["holders"] == [holder]
    many = purge(owner, collection="")
    assert many.status_code == 200
    assert many.json()["purged"] == []
    assert many.json()["refused"] == [
        {"item": rig.id, "kind": "skeleton", "path": "rig", "holders": [holder], "others": 0}
    ]
    assert owner.post(f"/projects/lab/skeletons/{rig.id}/restore").status_code == 200


def test_a_repeated_purge_gets_the_same_answer_and_a_new_one_hears_that_the_item_is_gone(
    lab: Lab, owner: httpx.Client
) -> None:
    clip = lab.add_clip(lab.add_skeleton()).id
    remove(owner, clip)
    key = {"Idempotency-Key": "a" * 32}
    first, second = (owner.post("/projects/lab/purges", json={"item": clip}, headers=key) for _ in range(2))
    assert first.status_code == second.status_code == 200
    assert first.json() == second.json()
    assert first.json()["purged"] == [{"item": clip, "kind": "clip", "path": ""}]
    for answer in (purge(owner, item=clip), owner.post(f"/projects/lab/clips/{clip}/restore")):
        assert (answer.status_code, answer.json()["code"]) == (410, "purged")
    assert owner.get(f"/projects/lab/clips/{clip}").status_code == 404
    assert owner.get("/projects/lab/clips", params={"deleted": "true"}).json()["items"] == []


def test_a_preview_changes_nothing_and_events_record_the_purge(lab: Lab, owner: httpx.Client) -> None:
    clip = lab.add_clip(lab.add_skeleton()).id
    remove(owner, clip)
    preview = purge(owner, collection="", preview=True).json()
    assert [one["path"] for one in preview["purged"]] == ["walk"]
    assert [one.kind for one in lab.events() if one.subject == clip] == ["item.created", "item.deleted"]
    assert purge(owner, collection="").json()["freed_bytes"] == preview["freed_bytes"]
    last = [one for one in lab.events() if one.subject == clip][-1]
    assert (last.kind, last.actor) == ("item.purged", lab.owner.user_name)


WRONG: list[Any] = [
    ({}, 422, "give an item, a path, a collection or a query"),
    ({"preview": True}, 422, "an empty collection means the whole project"),
    ({"collection": "raw", "older_than_days": -1}, 422, "older_than_days"),
    ({"collection": "raw", "oldr_than_days": 1}, 422, "oldr_than_days"),
    ({"collection": "raw", "kind": "stone"}, 422, "kind"),
    ({"query": "frames >"}, 400, "column 9"),
    ({"collection": "", "after": "x"}, 400, "must be the value of `next`"),
    ({"item": "clip_nobody"}, 404, "There is no item 'clip_nobody'"),
]


def test_wrong_requests_are_told_what_is_wrong(lab: Lab, owner: httpx.Client) -> None:
    for body, status, told in WRONG:
        answer = purge(owner, **body)
        assert (answer.status_code, told in answer.text) == (status, True), (body, answer.text)


def test_an_item_that_is_not_deleted_is_refused_and_stays(lab: Lab, owner: httpx.Client) -> None:
    clip = lab.add_clip(lab.add_skeleton()).id
    answer = purge(owner, item=clip)
    assert (answer.status_code, answer.json()["code"]) == (409, "not-deleted")
    assert lab.read(items.read_item, "lab", Kind.CLIP, clip).parts


def test_the_purge_of_a_dataset_is_for_owners_and_names_what_cites_it(
    server: Server, lab: Lab, owner: httpx.Client
) -> None:
    path = "/projects/lab/dataset-purges"
    clip = lab.add_clip(lab.add_skeleton())
    owner.post("/projects/lab/datasets", json={"name": "gaits"}).raise_for_status()
    changes = [{"change": "put", "path": "walk", "item": clip.id}]
    made = owner.post("/projects/lab/datasets/gaits/commits", json={"message": "m", "changes": changes})
    assert made.status_code == 201, made.text
    assert owner.post(path, json={"dataset": "gaits"}).json()["code"] == "not-deleted"
    inputs = {"clips": [{"dataset": "gaits", "version": "main"}]}
    job = owner.post("/projects/lab/jobs", json={"kind": "export", "inputs": inputs})
    assert job.status_code == 202, job.text
    assert owner.delete("/projects/lab/datasets/gaits", headers={"If-Match": "*"}).status_code == 204
    refused = owner.post(path, json={"dataset": "gaits"})
    assert (refused.status_code, refused.json()["code"]) == (409, "still-held")
    assert refused.json()["context"]["holders"] == [
        {"type": "job", "job": job.json()["id"], "kind": "export", "state": "queued"}
    ]
    shown = owner.post(path, json={"dataset": "gaits", "preview": True}).json()
    assert (shown["commits"], shown["holders"]) == (1, refused.json()["context"]["holders"])
    maintainer = server.client(server.make_token(str(lab.maintainer.user_id), "m", scopes=USER_SCOPES))
    assert maintainer.post(path, json={"dataset": "gaits"}).status_code == 403
    stranger = server.client(server.make_token(str(lab.stranger.user_id), "s", scopes=USER_SCOPES))
    assert stranger.post(path, json={"dataset": "gaits"}).status_code == 404
    assert owner.post(f"/jobs/{job.json()['id']}/cancel").is_success
    answer = owner.post(path, json={"dataset": "gaits"})
    assert (answer.status_code, answer.json()["holders"]) == (200, [])
    assert list(fsck.check_store(lab.database)) == []
