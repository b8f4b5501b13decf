"""Datasets with many entries, which are written directly to the database of a server that does not run yet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from sqlalchemy import insert, update

from benchmarks.local_server import PROJECT
from benchmarks.seeding import fill
from marey_schemas.datasets.naming import MAIN, DatasetCreate
from marey_schemas.encoding.digests import digest_of
from marey_server.access.principal import SYSTEM
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store import datasets, users
from marey_server.store.datasets.chunks import StoredChunks, store_chunks
from marey_server.store.tables import dataset_commit, dataset_ref
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord, DatasetEntry
from marey_versions.tree.building import build

LARGE = "large"
"""Name of the dataset with many entries."""


def path_of(number: int) -> str:
    """Return the path of an entry; each folder has a thousand entries."""
    return f"subject-{number // 1000:04d}/take-{number % 1000:03d}-walk"


def fill_dataset(data: Path, size: int) -> None:
    """Create a data folder with two clips, and a dataset of `size` entries whose content the project does not have."""
    fill(data, 2)
    database = open_database(Settings(data=data))
    try:
        database.write(SYSTEM, record_version, [DatasetCreate(name=LARGE)], _entries(size), size)
    finally:
        database.close()


def _entries(size: int) -> Iterator[DatasetEntry]:
    for number in range(size):
        parts = {part: digest_of(f"{part} {number}".encode()) for part in ("info", "motion")}
        yield DatasetEntry(path_of(number), "clip", parts, ())


def record_version(
    tx: Transaction, wanted: Sequence[DatasetCreate], entries: Iterable[DatasetEntry], size: int
) -> None:
    """Create datasets whose first version has the given entries, in the order of their keys."""
    tx.principal = users.administrator_principal(tx)
    store = StoredChunks(tx)
    tree = build(store, ((entry.key, entry.value) for entry in entries))
    store_chunks(tx, store.new)
    record = CommitRecord(tree, (), "bench", "first", "2026-01-01T00:00:00.000000Z")
    for one in wanted:
        made = datasets.create_dataset(tx, PROJECT, one)
        row = {
            "dataset_id": made.id, "digest": record.digest, "tree": tree, "author": "bench", "message": "first",
            "at": record.at, "entries": size, "generation": 0,
        }  # fmt: skip
        tx.execute(insert(dataset_commit).values(**row))
        of_branch = (dataset_ref.c.dataset_id == made.id, dataset_ref.c.name == MAIN)
        tx.execute(update(dataset_ref).where(*of_branch).values(digest=record.digest))
