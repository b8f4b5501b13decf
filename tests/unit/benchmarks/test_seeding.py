"""Clips with which benchmarks fill a project."""

from __future__ import annotations

from pathlib import Path

from benchmarks.seeding import fill
from sqlalchemy import func, select

from marey_server.access.principal import SYSTEM
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store.tables import revision_part


def test_each_clip_that_fills_a_project_is_accepted_and_differs_from_the_others(tmp_path: Path) -> None:
    fill(tmp_path, 3)
    database = open_database(Settings(data=tmp_path))
    try:
        motions = select(func.count(revision_part.c.document_digest.distinct())).where(revision_part.c.part == "motion")
        assert database.read(SYSTEM, lambda tx: tx.execute(motions).scalar_one()) == 3
    finally:
        database.close()
