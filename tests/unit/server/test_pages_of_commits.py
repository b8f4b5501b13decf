"""Pages that one commit of a dataset writes to the log of an SQLite database, and the stored form of chunks."""

import struct
from collections import Counter
from pathlib import Path

import pytest
from sqlalchemy import select, text, update
from tests.support.committing_desk import CommittingDesk
from tests.support.queue_desk import document

from marey_schemas.datasets.commits import PutEntry
from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.store import datasets, fsck
from marey_server.store.database.write_ahead_log import HEADER_BYTES
from marey_server.store.datasets.chunks import chunk_in
from marey_server.store.items.drafts import Draft
from marey_server.store.tables import commit_parent, dataset_commit, tree_chunk
from marey_server.store.transaction import Transaction

ALLOWED = {
    "sqlite_schema": 1,  # the first page of the file, where SQLite counts pages
    "tree_chunk": 3,
    "sqlite_autoindex_tree_chunk_1": 3,
    "dataset_commit": 2,
    "dataset_ref": 1,
    "event": 1,
    "ix_event_feed": 1,
    "ix_event_subject": 1,
}
"""Greatest number of pages of each table and index that a commit of one change to 400 entries may write."""


def add(gaits: CommittingDesk, name: str, content: object) -> str:
    draft = Draft("d", Kind.CHARACTER, name, {"character": document(content=content, name=name)}, "raw")
    return gaits.desk.publish(draft)[0].item


def pages_of_last_transaction(file: Path) -> list[int]:
    """Return the numbers of the pages that the last transaction has appended to the log of a database."""
    data = Path(f"{file}-wal").read_bytes()
    (page_bytes,) = struct.unpack_from(">I", data, 8)
    transactions: list[list[int]] = [[]]
    for start in range(32, len(data), HEADER_BYTES + page_bytes):
        page, is_last = struct.unpack_from(">II", data, start)
        if data[start + 8 : start + 16] != data[16:24]:  # left from before the log was restarted
            break
        transactions[-1].append(page)
        if is_last:
            transactions.append([])
    return transactions[-2]


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_a_commit_of_one_change_writes_few_pages(gaits: CommittingDesk, tmp_path: Path) -> None:
    walk, run = add(gaits, "walk", 1), add(gaits, "run", 2)
    gaits.change(*(PutEntry(path=f"day {number:03}", item=walk) for number in range(400)))
    gaits.change(PutEntry(path="day 300", item=run))
    gaits.change(PutEntry(path="day 100", item=run))
    pages = pages_of_last_transaction(tmp_path / "marey.db")

    def names(tx: Transaction) -> dict[int, str]:
        return {row.pageno: row.name for row in tx.execute(text("SELECT pageno, name FROM dbstat"))}

    of_page = gaits.desk.database.read(SYSTEM, names)
    written = Counter(of_page[page] for page in pages)
    assert written["dataset_commit"] >= 1
    assert written <= Counter(ALLOWED)


def test_chunks_are_stored_compressed_and_those_of_earlier_versions_are_read(gaits: CommittingDesk) -> None:
    walk = add(gaits, "walk", 1)
    gaits.change(*(PutEntry(path=f"day {number:03}", item=walk) for number in range(100)))
    database = gaits.desk.database
    stored = {
        row.digest: bytes(row.data) for row in database.read(SYSTEM, lambda tx: tx.execute(select(tree_chunk)).all())
    }
    plain = {digest: chunk_in(data) for digest, data in stored.items()}
    assert all(digest_of(data) == digest for digest, data in plain.items())
    assert sum(map(len, stored.values())) < sum(map(len, plain.values())) / 2

    def store_plain(tx: Transaction) -> None:
        for digest, data in plain.items():
            tx.execute(update(tree_chunk).where(tree_chunk.c.digest == digest).values(data=data))

    database.write(SYSTEM, store_plain)
    gaits.change(PutEntry(path="day 100", item=walk))
    page = gaits.read(datasets.list_entries, "lab", "gaits", "main", path="", cursor=None, limit=1000)
    assert [one.path for one in page.items] == [f"day {number:03}" for number in range(101)]
    assert list(fsck.check_store(database)) == []


@pytest.mark.parametrize("cut", [5, 100], ids=["header", "data"])
def test_fsck_reports_a_compressed_chunk_that_is_cut_off(gaits: CommittingDesk, cut: int) -> None:
    gaits.change(*(PutEntry(path=f"day {number:03}", item=add(gaits, f"{number}", number)) for number in range(9)))

    def damage(tx: Transaction) -> None:
        data = tx.execute(select(tree_chunk.c.data)).scalars().all()
        tx.execute(update(tree_chunk).values(data=bytes(data[0])[:cut]))

    database = gaits.desk.database
    database.write(SYSTEM, damage)
    assert {one.code for one in fsck.check_store(database)} == {"chunk-corrupt"}


def test_fsck_reports_a_first_parent_that_is_missing(gaits: CommittingDesk) -> None:
    gaits.change(PutEntry(path="walk", item=add(gaits, "walk", 1)))
    first = gaits.commit().digest
    gaits.change(PutEntry(path="run", item=add(gaits, "run", 2)))
    database = gaits.desk.database
    assert database.read(SYSTEM, lambda tx: tx.execute(select(commit_parent)).all()) == []
    database.write(SYSTEM, lambda tx: tx.execute(dataset_commit.delete().where(dataset_commit.c.digest == first)))
    assert [(one.code, first in one.detail) for one in fsck.check_store(database)] == [("commit-lost", True)]
