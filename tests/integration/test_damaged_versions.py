"""Stored chunks of versions whose members have other types: every reader answers that the dataset is damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import orjson
import pytest
from sqlalchemy import select, update
from tests.integration.test_rest_datasets import GAITS, LAB, change, ok, refused
from tests.integration.test_rest_datasets import gaits as gaits
from tests.support.rest_server import Server

from marey_client import Marey
from marey_client.errors import RequestFailed
from marey_schemas.encoding.digests import digest_of
from marey_server.access.principal import SYSTEM
from marey_server.store.database.connections import Database
from marey_server.store.datasets.chunks import chunk_in
from marey_server.store.datasets.committing import insert_commit
from marey_server.store.fsck import check_store
from marey_server.store.tables import dataset, dataset_commit, dataset_ref, tree_chunk
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord
from marey_versions.tree.chunks import Branch, Child, Leaf, decode, encode

DAMAGED = "dataset-damaged"


def replaced(*place: Any) -> Callable[[Any], None]:
    """Return a function that replaces the member of a chunk at the place `place[:-1]` by `place[-1]`."""

    def replace(content: Any) -> None:
        for step in place[:-2]:
            content = content[step]
        content[place[-2]] = place[-1]

    return replace


def without(*place: Any) -> Callable[[Any], None]:
    """Return a function that removes the member of a chunk at a place."""

    def remove(content: Any) -> None:
        for step in place[:-1]:
            content = content[step]
        del content[place[-1]]

    return remove


LAST = ("entries", -1)
OF_ALL = [
    without("schema"), replaced("schema", 1), replaced("schema", "marey/commit@1"),
    without("level"), replaced("level", "0"), replaced("level", None), replaced("level", True), replaced("level", -1),
]  # fmt: skip
OF_LEAVES = [
    *OF_ALL, without("entries"), replaced("entries", 5), replaced("entries", None),
    replaced(*LAST, "ab"), replaced(*LAST, 7), replaced(*LAST, {"b": 1}), replaced(*LAST, []),
    replaced(*LAST, ["b\tskeleton", {}, 1]), replaced(*LAST, 0, 12), replaced(*LAST, 0, None),
    replaced(*LAST, 0, ["b"]), replaced(*LAST, 0, ""), replaced(*LAST, 0, "A\tskeleton"),
    replaced(*LAST, 1, None), replaced(*LAST, 1, []), replaced(*LAST, 1, "parts"),
]  # fmt: skip
OF_NAMES = [replaced(*LAST, 0, "b"), replaced(*LAST, 0, "b\tpainting")]
OF_VALUES = [
    without(*LAST, 1, "parts"), replaced(*LAST, 1, "parts", ["hierarchy"]), replaced(*LAST, 1, "parts", None),
    replaced(*LAST, 1, "parts", "hierarchy", 1), replaced(*LAST, 1, "parts", "hierarchy", ["sha256:00"]),
    replaced(*LAST, 1, "parts", "hierarchy", None),
    without(*LAST, 1, "tags"), replaced(*LAST, 1, "tags", "slow"), replaced(*LAST, 1, "tags", [3]),
    replaced(*LAST, 1, "tags", [["slow"]]), replaced(*LAST, 1, "tags", None),
]  # fmt: skip
CHILD = ("children", -1)
OF_BRANCHES = [
    *OF_ALL, without("children"), replaced("children", 5), replaced("children", []),
    replaced(*CHILD, "abc"), replaced(*CHILD, ["b\tskeleton"]), replaced(*CHILD, 0, 1), replaced(*CHILD, 0, None),
    replaced(*CHILD, 0, "A"), replaced(*CHILD, 1, 5), replaced(*CHILD, 1, ["sha256:00"]), replaced(*CHILD, 1, None),
    replaced(*CHILD, 2, "1"), replaced(*CHILD, 2, None), replaced(*CHILD, 2, 1.0), replaced(*CHILD, 2, True),
    replaced(*CHILD, 2, -1), replaced(*CHILD, 2, 0), replaced(*CHILD, 2, 2**62),
]  # fmt: skip
OF_MANIFESTS = [
    *OF_LEAVES,
    replaced(*LAST, 0, "other"),
    *(change for name in ("commit", "tree", "query", "paths")
      for change in (without(*LAST, 1, name), replaced(*LAST, 1, name, 5))),
    replaced(*LAST, 1, "paths", [5]), replaced(*LAST, 1, "more", 5),
]  # fmt: skip


class Versions:
    """Dataset `gaits` with two versions; the tree of the newest one can be replaced by another."""

    def __init__(self, database: Database, head: str) -> None:
        self._database, self._head = database, head
        self.tree: str = self._read(select(dataset_commit.c.tree).where(dataset_commit.c.digest == head))
        """Root of the undamaged tree."""

    def _read(self, statement: Any) -> Any:
        return self._database.read(SYSTEM, lambda tx: tx.execute(statement).scalar_one())

    def chunk(self, digest: str) -> bytes:
        return chunk_in(self._read(select(tree_chunk.c.data).where(tree_chunk.c.digest == digest)))

    def store(self, data: bytes) -> str:
        """Store the bytes of a chunk and return their digest."""
        row = {"digest": digest_of(data), "data": data, "created_us": 1}
        self._write(lambda tx: tx.execute(tx.insert_or_ignore(tree_chunk, row)))
        return row["digest"]

    def show(self, root: str) -> None:
        """Let the newest version have the tree `root`."""
        self._write(lambda tx: tx.execute(
            update(dataset_commit).where(dataset_commit.c.digest == self._head).values(tree=root)
        ))  # fmt: skip

    def commit(self, root: str) -> None:
        """Add a version with the tree `root` to the branch `main`; its commit has the right digest."""
        self._write(self._commit, root)

    def _commit(self, tx: Transaction, root: str) -> None:
        (row,) = tx.execute(select(dataset_commit).where(dataset_commit.c.digest == self._head)).mappings()
        record = CommitRecord(root, (self._head,), row["author"], "third", row["at"])
        insert_commit(tx, row["dataset_id"], record, entries=2)
        tx.execute(update(dataset_ref).where(dataset_ref.c.name == "main").values(digest=record.digest))

    def branching(self) -> bytes:
        """Return the bytes of a root that refers to one chunk for each entry of the undamaged tree."""
        leaf = decode(self.tree, self.chunk(self.tree))
        assert isinstance(leaf, Leaf)
        parts = [encode(Leaf((entry,))) for entry in leaf.entries]
        for _, data in parts:
            self.store(data)
        children = [Child(entry[0], digest, 1) for entry, (digest, _) in zip(leaf.entries, parts, strict=True)]
        return encode(Branch(1, tuple(children)))[1]

    def _write(self, function: Callable[..., Any], *args: Any) -> None:
        self._database.write(SYSTEM, function, *args)


@pytest.fixture
def versions(owner: httpx.Client, gaits: Callable[..., Any], database: Database) -> Versions:
    """Two versions that differ in the entry `b`, and a branch `side` that differs from the first in the entry `a`."""
    (first,) = ok(owner.get(f"{GAITS}/commits"))["items"]
    change(owner, "gaits/b", tags=["slow"])
    head = gaits("second")["digest"]
    ok(owner.post(f"{GAITS}/refs", json={"name": "side", "kind": "branch", "at": first["digest"]}), 201)
    removal = [{"change": "remove", "path": "a", "kind": "skeleton"}]
    ok(owner.post(f"{GAITS}/commits", json={"message": "m", "branch": "side", "changes": removal}), 201)
    return Versions(database, head)


READERS = {
    "list", "list of a folder", "difference", "log of an entry", "blame", "merge", "revert", "cherry-pick", "commit",
    "checkout", "checkout of a part", "input of a job",
}  # fmt: skip
"""Names of the requests of `readers_of`."""


def readers_of(owner: httpx.Client) -> dict[str, Callable[[], httpx.Response]]:
    """Return requests that read the entry `b` of the newest version, by what they do."""
    move = {"change": "move", "path": "b", "kind": "skeleton", "to": "c"}
    job = {"kind": "export", "inputs": {"clips": [{"dataset": "gaits"}]}}
    return {
        "list": lambda: owner.get(f"{GAITS}/entries"),
        "list of a folder": lambda: owner.get(f"{GAITS}/entries", params={"path": "b"}),
        "difference": lambda: owner.get(f"{GAITS}/difference"),
        "log of an entry": lambda: owner.get(f"{GAITS}/commits", params={"path": "b"}),
        "blame": lambda: owner.get(f"{GAITS}/blame", params={"entry": "b", "kind": "skeleton"}),
        "merge": lambda: owner.post(f"{GAITS}/merges", json={"version": "side"}),
        "revert": lambda: owner.post(f"{GAITS}/reverts", json={"version": "main"}),
        "cherry-pick": lambda: owner.post(f"{GAITS}/cherry-picks", json={"version": "main", "into": "side"}),
        "commit": lambda: owner.post(f"{GAITS}/commits", json={"message": "m", "changes": [move]}),
        "checkout": lambda: owner.post(f"{GAITS}/checkout", json={"discard": True}),
        "checkout of a part": lambda: owner.post(f"{GAITS}/checkout", json={"paths": ["b"], "discard": True}),
        "input of a job": lambda: owner.post(f"{LAB}/jobs", json=job),
    }


def wrong_answers(
    owner: httpx.Client,
    versions: Versions,
    chunk: bytes,
    changes: list[Callable[[Any], None]],
    names: Callable[[int], set[str]],
) -> list[str]:
    """Damage a root in each of the given ways; return the answers that do not say that the dataset is damaged.

    `names` returns the names of the readers that are tried after the damage with this number.
    """
    wrong = []
    readers = readers_of(owner)
    for number, damage in enumerate(changes):
        content = orjson.loads(chunk)
        damage(content)
        versions.show(versions.store(orjson.dumps(content, option=orjson.OPT_SORT_KEYS)))
        for name in sorted(names(number)):
            answer = readers[name]()
            if (answer.status_code, answer.json().get("code")) != (500, DAMAGED):
                wrong.append(f"{name} after damage {number} {content}: {answer.status_code} {answer.text[:200]}")
    return wrong


def in_turn(number: int) -> set[str]:
    """Return the names of two readers; a chunk is decoded in one place, so that it does not matter who reads it."""
    names = sorted(READERS)
    return {names[(2 * number + step) % len(names)] for step in (0, 1)}


def test_every_reader_names_damage_of_chunks_with_entries(owner: httpx.Client, versions: Versions) -> None:
    wrong = wrong_answers(owner, versions, versions.chunk(versions.tree), OF_LEAVES, in_turn)
    assert not wrong, "\n".join(wrong)


def test_every_reader_names_damage_of_entries(owner: httpx.Client, versions: Versions) -> None:
    by_path = {"list of a folder", "log of an entry", "blame", "commit", "checkout of a part"}
    whole = versions.chunk(versions.tree)
    wrong = wrong_answers(owner, versions, whole, OF_NAMES, lambda _: READERS - by_path)
    wrong += wrong_answers(owner, versions, whole, OF_VALUES[:1], lambda _: READERS - {"checkout of a part"})
    wrong += wrong_answers(
        owner, versions, whole, OF_VALUES[1:], lambda number: in_turn(number) - {"checkout of a part"}
    )
    assert not wrong, "\n".join(wrong)


def test_every_reader_names_damage_of_references_to_chunks(owner: httpx.Client, versions: Versions) -> None:
    whole = versions.branching()
    versions.show(versions.store(whole))
    assert [one["path"] for one in ok(owner.get(f"{GAITS}/entries"))["items"]] == ["a", "b"]
    wrong = wrong_answers(owner, versions, whole, OF_BRANCHES, in_turn)
    assert not wrong, "\n".join(wrong)


def test_an_archive_of_a_damaged_version_is_refused(
    server: Server, owner: httpx.Client, versions: Versions, tmp_path: Path
) -> None:
    content = orjson.loads(versions.chunk(versions.tree))
    content["entries"][-1][1]["parts"] = {"hierarchy": 5}
    versions.commit(versions.store(orjson.dumps(content, option=orjson.OPT_SORT_KEYS)))
    token = owner.headers["Authorization"].removeprefix("Bearer ")
    with Marey(server.address, token) as marey, pytest.raises(RequestFailed) as caught:
        marey.project("lab").datasets.at("gaits").archive(tmp_path / "gaits.tar")
    assert caught.value.code == DAMAGED


@pytest.mark.parametrize("changes", [OF_LEAVES, OF_NAMES + OF_VALUES], ids=["chunks", "entries"])
def test_the_check_of_the_store_names_the_damage(
    database: Database, versions: Versions, changes: list[Callable[[Any], None]]
) -> None:
    code = "chunk-corrupt" if changes is OF_LEAVES else "entry-corrupt"
    assert not list(check_store(database))
    for count, damage in enumerate(changes, start=1):
        content = orjson.loads(versions.chunk(versions.tree))
        damage(content)
        digest = versions.store(orjson.dumps(content, option=orjson.OPT_SORT_KEYS))
        versions.show(digest)
        found = [one for one in check_store(database) if one.code == code and digest in f"{one.subject} {one.detail}"]
        assert len(found) == 1, (count, content)


def _check_out(tx: Transaction, manifest: str) -> None:
    tx.execute(update(dataset).values(folder_commit=manifest))


def test_damage_of_the_record_of_what_is_checked_out_is_named(
    owner: httpx.Client, versions: Versions, database: Database
) -> None:
    ok(owner.post(f"{GAITS}/checkout", json={"paths": ["b"]}))
    there = database.read(SYSTEM, lambda tx: tx.execute(select(dataset.c.folder_commit)).scalar_one())
    for damage in OF_MANIFESTS:
        content = orjson.loads(versions.chunk(there))
        damage(content)
        damaged = versions.store(orjson.dumps(content, option=orjson.OPT_SORT_KEYS))
        database.write(SYSTEM, _check_out, damaged)
        refused(owner.post(f"{GAITS}/checkout", json={}), 500, DAMAGED)
        refused(owner.post(f"{GAITS}/commits", json={"message": "m"}), 500, DAMAGED)
        assert [one["checked_out"] for one in ok(owner.get(f"{LAB}/datasets"))["items"]] == [None], content
        assert "folder-unknown" in {one.code for one in check_store(database)}, content
