"""Versions of datasets of up to a million entries and copies between servers, compared with Git, DVC and Oxen."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.job_commits import measure_end, measure_plain_commit
from benchmarks.seeding import fill
from benchmarks.timing import Row
from benchmarks.versions.collection import CLIPS, measure_collection
from benchmarks.versions.copies import measure_copies
from benchmarks.versions.operations import measure_operations
from benchmarks.versions.peers import FILES, measure_peers
from marey_server.app import open_database
from marey_server.process.settings import Settings


def run() -> list[Row]:
    """Measure operations at several sizes, a collection, copies, and the commit of a job's outputs."""
    peers = measure_peers((FILES, CLIPS))
    return [*measure_operations(peers), *measure_collection(), *measure_copies(), _row_of_job(CLIPS)]


def _row_of_job(size: int) -> Row:
    """Measure the commit of the outputs of a job with many outputs, and the plain commit of the same entries."""
    with tempfile.TemporaryDirectory() as folder:
        fill(Path(folder), 0)
        database = open_database(Settings(data=Path(folder)))
        try:
            end = measure_end(database, size)
            plain_s = measure_plain_commit(database)
        finally:
            database.close()
    return Row(
        "commit of a job's outputs", f"{size:,} entries",
        f"{size / end.seconds:,.0f} entries/s; other writers wait {end.longest_wait_ms:.0f} ms at most",
        f"plain commit: {size / plain_s:,.0f} entries/s", plain_s / end.seconds,
    )  # fmt: skip
