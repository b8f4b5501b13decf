"""Measurement of a job with many outputs, which are committed to a dataset when the last task of the job ends.

The outputs are written directly to the database, in the form in which tasks leave them. While the job ends, another
client makes one small write after another.
"""

from __future__ import annotations

import resource
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import insert, update

from benchmarks.local_server import PROJECT
from marey_schemas.datasets.commits import CommitCreate
from marey_schemas.datasets.naming import MAIN, DatasetCreate
from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.store import datasets, users
from marey_server.store.database.connections import Database
from marey_server.store.ids import new_id
from marey_server.store.jobs.endings import Ended
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.projects import require
from marey_server.store.tables import collection, document, item, job, revision, revision_part
from marey_server.store.transaction import Transaction
from marey_versions.records import revision_content

TASKS = 1000
DATASET = "made"
PLAIN = "plain"
FOLDER = "results"


@dataclass(frozen=True)
class EndOfJob:
    """Measured end of a job that commits its outputs."""

    seconds: float
    longest_wait_ms: float
    """Longest duration of a small write by another client."""
    memory_mb: float
    """Growth of the peak memory of the process, in MiB."""


def measure_end(database: Database, size: int) -> EndOfJob:
    """Create a job with `size` outputs, end its last task, and measure until the job has ended."""
    last = database.write(SYSTEM, _create_job, size)
    done = threading.Event()
    waits: list[float] = []
    writer = threading.Thread(target=_write_until, args=(database, done, waits))
    writer.start()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = time.perf_counter()
    database.submit_write(SYSTEM, _end_task, last).result()
    commit_deferred(database)
    seconds = time.perf_counter() - begun
    done.set()
    writer.join()
    database.read(SYSTEM, _require_committed, size)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
    return EndOfJob(seconds, max(waits) * 1e3, grown / 1024)


def measure_plain_commit(database: Database) -> float:
    """After `measure_end`, commit the same folder as a user would; return how many seconds this commit takes.

    Raises `RuntimeError` if this commit and the commit of the job have different entries.
    """
    administrator = database.read(SYSTEM, users.administrator_principal)
    create = datasets.create_dataset
    database.write(administrator, create, PROJECT, DatasetCreate(name=PLAIN, collection=FOLDER))
    request = CommitCreate(message="plain")
    begun = time.perf_counter()
    prepared = database.read(administrator, datasets.prepare_commit, PROJECT, PLAIN, request)
    made = database.write(administrator, datasets.record_commit, PROJECT, PLAIN, prepared)
    seconds = time.perf_counter() - begun
    if made.tree != database.read(administrator, datasets.read_commit, PROJECT, DATASET, MAIN).tree:
        raise RuntimeError("the commit of the job and the plain commit have different trees")
    return seconds


def _write_until(database: Database, done: threading.Event, waits: list[float]) -> None:
    while not done.is_set():
        begun = time.perf_counter()
        database.submit_write(SYSTEM, _write_little).result()
        waits.append(time.perf_counter() - begun)
        done.wait(0.002)


def _write_little(tx: Transaction) -> None:
    tx.principal = users.administrator_principal(tx)
    row = require(tx, PROJECT)
    now = {"created_us": tx.now_us, "updated_us": tx.now_us}
    tx.execute(insert(collection).values(id=new_id("col"), project_id=row.id, path=new_id("path"), **now))


def _create_job(tx: Transaction, size: int) -> Ended:
    tx.principal = users.administrator_principal(tx)
    row = require(tx, PROJECT)
    made = datasets.create_dataset(tx, PROJECT, DatasetCreate(name=DATASET))
    target = {
        "dataset": DATASET, "branch": MAIN, "folder": None, "message": "", "replace": False, "dataset_id": made.id,
        "base": None, "within": "", "kinds": ["study"],
    }  # fmt: skip
    above = {"id": new_id("col"), "project_id": row.id, "path": FOLDER}
    tx.execute(insert(collection).values(**above, created_us=tx.now_us, updated_us=tx.now_us))
    outputs = list(_create_outputs(tx, row.id, size))
    common = {
        "project_id": row.id, "kind": "import", "params": {}, "inputs": {}, "time_limit_s": 60, "memory_limit_mb": 512,
        "run_at_us": tx.now_us, "created_us": tx.now_us, "commit_to": target, "author_id": tx.principal.user_id,
    }  # fmt: skip
    head = {**common, "id": new_id("job"), "state": "running", "size": TASKS, "dependencies_left": 1}
    tx.execute(insert(job).values(**head))
    share = -(-size // TASKS)
    tasks = [
        {
            **common, "id": new_id("job"), "state": "succeeded", "parent_id": head["id"], "position": place,
            "outputs": (some := outputs[place * share : (place + 1) * share]), "result": {"outputs": len(some)},
        }
        for place in range(TASKS)
    ]  # fmt: skip
    tx.execute(insert(job), tasks)
    tx.execute(update(job).where(job.c.id == tasks[-1]["id"]).values(state="running"))
    return Ended(str(tasks[-1]["id"]), row.id, "succeeded", str(head["id"]))


def _create_outputs(tx: Transaction, project_id: str, size: int) -> Iterator[dict[str, Any]]:
    """Store small items in folders of a thousand; yield them as outputs of a job."""
    at = tx.now_us
    for start in range(0, size, 1000):
        folder = {"id": new_id("col"), "project_id": project_id, "path": f"{FOLDER}/subject-{start // 1000:04d}"}
        tx.execute(insert(collection).values(**folder, created_us=at, updated_us=at))
        ids = {number: new_id("study") for number in range(start, min(size, start + 1000))}
        digests = {number: digest_of(f"document {number}".encode()) for number in ids}
        tx.execute(insert(document), [
            {"digest": digest, "schema": "marey/study@1", "body": {}, "size_bytes": 2, "created_us": at}
            for digest in digests.values()
        ])  # fmt: skip
        tx.execute(insert(item), [
            {
                "id": one, "project_id": project_id, "collection_id": folder["id"], "kind": "study", "head": 1,
                "name": f"take-{number:06d}", "name_folded": f"take-{number:06d}", "summary": {}, "created_us": at,
                "updated_us": at,
            }
            for number, one in ids.items()
        ])  # fmt: skip
        tx.execute(insert(revision), [
            {
                "item_id": one, "number": 1, "created_us": at,
                "content": revision_content("study", {"study": digests[number]}),
            }
            for number, one in ids.items()
        ])  # fmt: skip
        tx.execute(insert(revision_part), [
            {"item_id": one, "number": 1, "part": "study", "document_digest": digests[number]}
            for number, one in ids.items()
        ])  # fmt: skip
        for number, one in ids.items():
            yield {
                "name": f"o{number}", "item": one, "kind": Kind.STUDY.value, "revision": 1, "created": True,
                "entry": f"{folder['path'].removeprefix(f'{FOLDER}/')}/take-{number:06d}",
            }  # fmt: skip


def _end_task(tx: Transaction, task: Ended) -> None:
    tx.execute(update(job).where(job.c.id == task.id).values(state="succeeded"))
    propagate_ends(tx, [task])


def _require_committed(tx: Transaction, size: int) -> None:
    tx.principal = users.administrator_principal(tx)
    made = datasets.read_commit(tx, PROJECT, DATASET, MAIN)
    if made.entries != size:
        raise RuntimeError(f"the commit has {made.entries} entries instead of {size}")
