"""Dataset in the shape of the largest public collection: 142,220 clips, to which some are added from files.

The 142,220 clips are written directly to the database. They have names, folders and facts of their own, and digests of
motion that do not exist. The server is measured while it commits all clips, and while it checks out 300 of them.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from sqlalchemy import insert, select

from benchmarks.local_server import PROJECT, LocalServer, local_server, one_worker
from benchmarks.material import captured_walk
from benchmarks.seeding import fill
from benchmarks.timing import Row
from benchmarks.versions.filling import record_version
from marey_client import Marey
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_schemas.datasets.naming import DatasetCreate
from marey_schemas.encoding.digests import digest_of
from marey_schemas.imports import ImportEntry
from marey_schemas.options.imports import ImportOptions
from marey_server.access.principal import SYSTEM
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store.ids import new_id
from marey_server.store.projects import require
from marey_server.store.tables import collection, item, revision, revision_part
from marey_server.store.transaction import Transaction
from marey_versions.records import DatasetEntry

CLIPS, FEW = 142_220, 1_000
"""Number of clips of the collection, and of the small collection with which checkouts are compared."""
IMPORTED, JOINTS, RATE_HZ = 200, 77, 30.0
"""Number of clips that are imported from files, their number of joints, and their frame rate in Hz."""
SHORTEST_S, LONGEST_S = 15.0, 60.0
PER_SUBJECT = 300
"""Number of clips of each performer; each performer has a folder."""
ALL, IMPORTS = "all", "all/imported"
TIMEOUT_S = 600.0
ROWS_PER_WRITE = 10_000
GOAL_ENTRIES_PER_S, GOAL_GROWTH = 10_000, 2.0


@dataclass(frozen=True)
class Selection:
    """A way to select the clips of one performer by a query; `{folder}` stands for the folder of the dataset."""

    name: str
    query: str
    repeats: int


SELECTIONS = (
    Selection("content", "subject = {subject} and frames > 0", 1),
    Selection("folder", "folder = {folder}/subject-{subject}", 3),
)


def measure_collection() -> list[Row]:
    """Measure an import, the first commit of all clips, and checkouts of 300 clips from all clips and from few."""
    with local_server(partial(_prepare, FEW)) as server:
        few = _checkouts(server, FEW)
    with local_server(partial(_prepare, CLIPS)) as server:
        checkouts = _checkouts(server, CLIPS)
        return [*_import_and_commit(server), *map(_row_of_checkout, SELECTIONS, checkouts, few)]


# -- clips ------------------------------------------------------------------------------------------------------------


def _prepare(size: int, data: Path) -> None:
    fill(data, 1)
    database = open_database(Settings(data=data))
    try:
        for start in range(0, size, ROWS_PER_WRITE):
            database.write(SYSTEM, _insert_clips, range(start, min(size, start + ROWS_PER_WRITE)))
        wanted = [DatasetCreate(name=name, collection=name) for selection in SELECTIONS for name in _names(selection)]
        database.write(SYSTEM, record_version, wanted, map(_entry, range(size)), size)
    finally:
        database.close()


def _names(selection: Selection) -> list[str]:
    return [f"{selection.name}-{number}" for number in range(selection.repeats)]


def _entry(number: int) -> DatasetEntry:
    parts = {part: digest_of(f"{part} {number}".encode()) for part in ("info", "motion")}
    return DatasetEntry(f"{_folder(number)}/{_name(number)}", "clip", parts, ())


def _folder(number: int) -> str:
    return f"subject-{number // PER_SUBJECT:04d}"


def _name(number: int) -> str:
    return f"take-{number % PER_SUBJECT:03d}-walk"


def _insert_clips(tx: Transaction, numbers: range) -> None:
    """Insert copies of the first clip with other facts; their parts have content digests that differ from its own."""
    first = tx.execute(select(item).where(item.c.kind == "clip").order_by(item.c.id).limit(1)).one()._mapping
    parts = tx.execute(select(revision_part).where(revision_part.c.item_id == first["id"])).all()
    folders = _folders(tx, numbers)
    ids = sorted(new_id("clip") for _ in numbers)
    entries = [_entry(number) for number in numbers]
    rows = [
        {
            **first, "id": at, "name": _name(number), "name_folded": _name(number), "frames": 24 + number * 7 % 600,
            "collection_id": folders[_folder(number)], "created_us": first["created_us"] + number,
            "summary": {**first["summary"], "subject": f"{number // PER_SUBJECT:04d}", "action": "walk"},
        }
        for at, number in zip(ids, numbers, strict=True)
    ]  # fmt: skip
    tx.execute(insert(item), rows)
    tx.execute(
        insert(revision),
        [
            {"item_id": at, "number": 1, "created_us": tx.now_us, "content": entry.content}
            for at, entry in zip(ids, entries, strict=True)
        ],
    )
    tx.execute(
        insert(revision_part),
        [
            {**part._mapping, "item_id": at, "content": entry.parts[part.part]}
            for at, entry in zip(ids, entries, strict=True)
            for part in parts
        ],
    )


def _folders(tx: Transaction, numbers: Iterable[int]) -> dict[str, str]:
    """Return the id of the folder of each performer; create those that do not exist."""
    project_id = require(tx, PROJECT).id
    wanted = {f"{ALL}/{_folder(number)}" for number in numbers} | {ALL}
    known = select(collection.c.path, collection.c.id).where(
        collection.c.project_id == project_id, collection.c.path.in_(sorted(wanted))
    )
    ids = {row.path: row.id for row in tx.execute(known)}
    at = {"project_id": project_id, "created_us": tx.now_us, "updated_us": tx.now_us}
    made = [{**at, "id": new_id("col"), "path": path} for path in sorted(wanted - ids.keys())]
    if made:
        tx.execute(insert(collection), made)
    ids |= {str(row["path"]): row["id"] for row in made}
    return {path.removeprefix(f"{ALL}/"): one for path, one in ids.items()}


# -- measurements -----------------------------------------------------------------------------------------------------


def _checkouts(server: LocalServer, size: int) -> list[list[float]]:
    """Return the times in ms of checkouts for each way of selection, each into an empty folder."""
    subject = f"{size // PER_SUBJECT // 2:04d}"
    with Marey(server.url, server.token, timeout_s=TIMEOUT_S) as marey:
        project = marey.project(PROJECT)
        return [
            [_checkout_ms(project, name, selection.query.format(folder=name, subject=subject), size)
             for name in _names(selection)]
            for selection in SELECTIONS
        ]  # fmt: skip


def _checkout_ms(project: ProjectHandle, name: str, query: str, size: int) -> float:
    begun = time.perf_counter()
    answer = project.datasets.at(name).check_out(query=query)
    taken_ms = (time.perf_counter() - begun) * 1e3
    if (answer.added, answer.entries) != (PER_SUBJECT, size):
        raise RuntimeError(f"the checkout has taken {answer.added} of {answer.entries} entries")
    return taken_ms


def _row_of_checkout(selection: Selection, times: list[float], of_few: list[float]) -> Row:
    median, few = statistics.median(times), statistics.median(of_few)
    return Row(
        f"checkout by query on {selection.name}", f"{PER_SUBJECT} of {CLIPS:,} entries",
        f"{median:.0f} ms; {PER_SUBJECT} of {FEW:,} entries: {few:.0f} ms, so {median / few:.1f}x",
        goal=f"< {GOAL_GROWTH:.0f}x, the time of the {PER_SUBJECT}", met=median / few < GOAL_GROWTH,
    )  # fmt: skip


def _import_and_commit(server: LocalServer) -> Iterator[Row]:
    with Marey(server.url, server.token, timeout_s=TIMEOUT_S) as marey, one_worker(server):
        project = marey.project(PROJECT)
        seconds, entries = _import(project)
        dataset = project.datasets.create(ALL, collection=ALL)
        begun = time.perf_counter()
        made = dataset.commit("first")
        commit_s = time.perf_counter() - begun
    poses = sum(entry.frames or 0 for entry in entries)
    yield Row(
        "import of clips into the collection",
        f"{IMPORTED} BVH files of {SHORTEST_S:.0f} to {LONGEST_S:.0f} s, {JOINTS} joints, {RATE_HZ:.0f} Hz",
        f"{IMPORTED / seconds:.1f} clips/s, {poses / seconds:,.0f} poses/s",
    )
    yield Row(
        "first commit of the collection", f"{made.entries:,} entries",
        f"{made.entries / commit_s:,.0f} entries/s, {commit_s:.1f} s",
        goal=f"≥ {GOAL_ENTRIES_PER_S:,} entries/s", met=made.entries / commit_s >= GOAL_ENTRIES_PER_S,
    )  # fmt: skip


def _import(project: ProjectHandle) -> tuple[float, list[ImportEntry]]:
    """Import generated BVH files; return the duration in seconds, and one entry for each file."""
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
        for number, seconds in enumerate(np.linspace(SHORTEST_S, LONGEST_S, IMPORTED)):
            walk = captured_walk(round(seconds * RATE_HZ), JOINTS, number, frame_rate_hz=RATE_HZ)
            Path(folder, f"imported-{number:03d}.bvh").write_bytes(write_bvh(walk))
        begun = time.perf_counter()
        entries = project.imports.upload(find_files(Path(folder)).files, ImportOptions(collection=IMPORTS))
        seconds_taken = time.perf_counter() - begun
    if any(entry.frames is None for entry in entries):
        raise RuntimeError(f"a file was refused: {next(entry for entry in entries if entry.frames is None)}")
    return seconds_taken, entries
