"""Readiness checks of the store."""

import shutil
from pathlib import Path

from marey_server.access.principal import SYSTEM
from marey_server.store.blob_backings import DirectoryBlobs
from marey_server.store.database.connections import Database
from marey_server.store.monitoring.readiness import find_faults


def test_a_store_that_can_serve_has_no_faults(database: Database) -> None:
    assert database.read(SYSTEM, find_faults) == []


def test_tables_of_another_version_are_told(database: Database) -> None:
    with database.engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '0001'")
    assert "marey db upgrade" in database.read(SYSTEM, find_faults)[0]


def test_blobs_that_cannot_be_written_are_told(database: Database, tmp_path: Path) -> None:
    database.blobs = DirectoryBlobs(tmp_path / "blobs")
    assert database.read(SYSTEM, find_faults) == []
    shutil.rmtree(tmp_path / "blobs")
    assert "blobs cannot be written" in database.read(SYSTEM, find_faults)[0]
