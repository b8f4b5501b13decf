"""The check of the store (`marey db fsck`) finds every kind of damage, and no damage in an intact store."""

from typing import Any

import numpy as np
import pytest
import sqlalchemy
import sqlalchemy.exc
from sqlalchemy import ScalarSelect
from tests.support.kept_rows import made_once
from tests.support.present import present
from tests.support.store_fixtures import Lab

from marey_schemas.encoding import blocks
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_server.store import blobs, fsck, items, uploads
from marey_server.store.database.connections import Database
from marey_server.store.tables import (
    blob,
    blob_chunk,
    collection,
    document,
    document_blob,
    item,
    lineage,
    revision,
    revision_part,
    upload,
)

pytestmark = pytest.mark.every_database

FILE = b"HIERARCHY" * 1000


class FullLab(Lab):
    """Project that contains at least one row of every table that is checked."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self.write(blobs.put_blob, FILE)
        self.rig = self.add_skeleton()
        clip = self.add_clip(self.rig, collection="a/b", info={"source": {"file": digest_of(FILE)}}, tags=("t",))
        self.write(items.put_part, "lab", Kind.CLIP, clip.id, "info", {"subject": "x"}, expected_rev=None)
        study = {"schema": "marey/document@1", "x": np.arange(5.0), "blob": digest_of(FILE)}
        self.write(items.create_item, "lab", Kind.CHARACTER, ItemCreate(name="s", parts={"character": study}))
        sent = self.write(uploads.create_upload, 10)
        self.write(uploads.append, sent.id, 0, b"12345")


@pytest.fixture
def full(database: Database) -> FullLab:
    return made_once(FullLab, database)


def findings(lab: Lab) -> set[str]:
    return {finding.code for finding in fsck.check_store(lab.database)}


def damage(lab: Lab, *statements: Any) -> None:
    """Run statements that damage the database; foreign keys are not checked."""
    with lab.database.engine.connect() as connection:
        driver = connection.connection.driver_connection
        if lab.database.is_sqlite:
            present(driver).execute("PRAGMA foreign_keys = OFF")
        with connection.begin():
            for statement in statements:
                assert connection.execute(statement).rowcount > 0
        if lab.database.is_sqlite:
            present(driver).execute("PRAGMA foreign_keys = ON")


def test_a_sound_store_has_no_findings(full: FullLab) -> None:
    seen = []
    assert list(fsck.check_store(full.database, progress=lambda what, count: seen.append((what, count)))) == []
    assert dict(seen)["items"] == 3
    assert dict(seen).keys() == {"blobs", "documents", "items", "collections", "uploads", "projects", "users"}


def motion_blob() -> ScalarSelect[Any]:
    digests = sqlalchemy.select(document_blob.c.blob_digest).where(document_blob.c.pointer == "/poses")
    return digests.scalar_subquery()


DAMAGES = {
    "changed bytes": (
        "blob-corrupt",
        sqlalchemy.update(blob_chunk).where(blob_chunk.c.digest == digest_of(FILE)).values(data=b"X" * len(FILE)),
    ),
    "are missing on the server": (
        "blob-incomplete",
        sqlalchemy.delete(blob_chunk).where(blob_chunk.c.digest == digest_of(FILE)),
    ),
    "shortened bytes": (
        "blob-incomplete",
        sqlalchemy.update(blob_chunk).where(blob_chunk.c.digest == digest_of(FILE)).values(data=b"X"),
    ),
    "wrong size": (
        "blob-incomplete",
        sqlalchemy.update(blob).where(blob.c.digest == digest_of(FILE)).values(size_bytes=10**6),
    ),
    "another array of the same shape": (
        "array-corrupt",
        sqlalchemy.update(blob_chunk)
        .where(blob_chunk.c.digest == motion_blob())
        .values(data=blocks.encode(np.zeros((5, 15), "<f4"))),
    ),
    "another array of another shape": (
        "array-corrupt",
        sqlalchemy.update(blob_chunk)
        .where(blob_chunk.c.digest == motion_blob())
        .values(data=blocks.encode(np.zeros((2, 15), "<f4"))),
    ),
    "an array of rubbish": (
        "array-corrupt",
        sqlalchemy.update(blob_chunk).where(blob_chunk.c.digest == motion_blob()).values(data=b"rubbish"),
    ),
    "changed text": (
        "document-corrupt",
        sqlalchemy.update(document).where(document.c.schema == "marey/skeleton@1").values(body={"joints": []}),
    ),
    "a reference without its blob": (
        "document-reference",
        sqlalchemy.delete(document_blob).where(document_blob.c.pointer == "/poses"),
    ),
    "a file without its blob": (
        "document-reference",
        sqlalchemy.delete(document_blob).where(document_blob.c.pointer == "/source/file"),
    ),
    "a file held by another blob": (
        "document-reference",
        sqlalchemy.update(document_blob)
        .where(document_blob.c.pointer == "/source/file")
        .values(blob_digest=motion_blob()),
    ),
    "a lost revision": ("revisions-lost", sqlalchemy.update(item).where(item.c.kind == "clip").values(head=3)),
    "a lost part": ("part-lost", sqlalchemy.delete(revision_part).where(revision_part.c.part == "hierarchy")),
    "a wrong summary": ("summary-wrong", sqlalchemy.update(item).where(item.c.kind == "clip").values(frames=99)),
    "a deleted folder with a living item": (
        "misplaced-item",
        sqlalchemy.update(collection).where(collection.c.path == "a/b").values(deleted_us=1),
    ),
    "a folder in nothing": (
        "orphan-collection",
        sqlalchemy.update(collection).where(collection.c.path == "a").values(deleted_us=1),
    ),
    "a half upload": ("upload-incomplete", sqlalchemy.update(upload).values(offset=7)),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_each_kind_of_damage_is_found(full: FullLab, name: str) -> None:
    code, statement = DAMAGES[name]
    damage(full, statement)
    assert code in findings(full)


def test_lost_rows_that_others_refer_to_are_found_on_sqlite(full: FullLab) -> None:
    if not full.database.is_sqlite:
        with pytest.raises(sqlalchemy.exc.IntegrityError):  # Postgres does not let it happen
            damage(full, sqlalchemy.delete(document))
        return
    damage(full, sqlalchemy.delete(document).where(document.c.schema == "marey/skeleton@1"))
    assert {"dangling-reference", "document-lost"} <= findings(full)


def test_a_motion_whose_skeleton_is_gone_is_found(full: FullLab) -> None:
    on_rig = (lineage, revision_part, revision)
    statements = [sqlalchemy.delete(table).where(table.c.item_id == full.rig.id) for table in on_rig[1:]]
    damage(full, *statements)
    assert "dangling-reference" in findings(full)


def test_checking_changes_nothing_and_works_beside_writers(full: FullLab) -> None:
    first = fsck.check_store(full.database)
    next(first, None)
    full.add_skeleton("another", joints=4)
    assert list(first) == []
    assert findings(full) == set()
