"""Versions of a dataset with as many entries as the largest public collection, and with a million.

For comparison, the same run times commits by Git of one changed file. The repository has as many small files as the
dataset has entries. The commands write only to the index, the objects and the branch, not to a working tree.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import insert, update

from benchmarks.job_commits import measure_end, measure_plain_commit
from benchmarks.local_server import PROJECT, LocalServer, local_server
from benchmarks.seeding import fill
from benchmarks.timing import Row
from marey_schemas.datasets.naming import MAIN, DatasetCreate
from marey_server.access.principal import SYSTEM
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store import datasets, users
from marey_server.store.datasets.chunks import StoredChunks, store_chunks
from marey_server.store.tables import dataset_commit, dataset_ref
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord, DatasetEntry
from marey_versions.tree.building import build
from marey_versions.tree.chunks import Entry, digest_of

SIZES = (142_220, 1_000_000)
REPEATS = 20
SIDE = 1_000
"""Number of entries that each side of the measured merge changes."""
URL = f"/projects/{PROJECT}/datasets/large"


def run() -> list[Row]:
    """Measure commits, differences, branches, lists and a merge, for each number of entries."""
    rows: list[Row] = []
    for size in SIZES:
        with local_server(partial(_prepare, size)) as server:
            rows += _rows(server, size)
    return [*rows, _row_of_job(SIZES[0])]


# -- a large dataset --------------------------------------------------------------------------------------------------


def _path(number: int) -> str:
    return f"subject-{number // 1000:04d}/take-{number % 1000:03d}-walk"


def _entries(size: int) -> Iterator[Entry]:
    for number in range(size):
        parts = {part: digest_of(f"{part} {number}".encode()) for part in ("info", "motion")}
        entry = DatasetEntry(_path(number), "clip", parts, ())
        yield entry.key, entry.value


def _prepare(size: int, data: Path) -> None:
    fill(data, 2)
    database = open_database(Settings(data=data))
    try:
        database.write(SYSTEM, _store, size)
    finally:
        database.close()


def _store(tx: Transaction, size: int) -> None:
    tx.principal = users.administrator_principal(tx)
    made = datasets.create_dataset(tx, PROJECT, DatasetCreate(name="large"))
    store = StoredChunks(tx)
    tree = build(store, _entries(size))
    store_chunks(tx, store.new)
    record = CommitRecord(tree, (), "bench", "first", "2026-01-01T00:00:00.000000Z")
    row = {
        "dataset_id": made.id, "digest": record.digest, "tree": tree, "author": "bench", "message": "first",
        "at": record.at, "entries": size, "generation": 0,
    }  # fmt: skip
    tx.execute(insert(dataset_commit).values(**row))
    of_branch = (dataset_ref.c.dataset_id == made.id, dataset_ref.c.name == MAIN)
    tx.execute(update(dataset_ref).where(*of_branch).values(digest=record.digest))


# -- measurements -----------------------------------------------------------------------------------------------------


def _rows(server: LocalServer, size: int) -> Iterator[Row]:
    headers = {"Authorization": f"Bearer {server.token}"}
    with httpx.Client(base_url=f"{server.url}/api/v1", headers=headers, timeout=300) as client:
        items = _ok(client.get(f"/projects/{PROJECT}/clips"))["items"]
        numbers = iter(range(0, size, size // 1000))

        def commit(branch: str = MAIN, count: int = 1, start: int | None = None) -> None:
            first = next(numbers) if start is None else start
            changes = [
                {"change": "put", "path": _path(first + place), "item": items[(first + place) % 2]["id"]}
                for place in range(count)
            ]
            _ok(client.post(f"{URL}/commits", json={"message": "m", "branch": branch, "changes": changes}))

        yield _row("commit of one change", size, _times(commit), 50, lambda: _git_commits(min(size, SIZES[0])))
        commit(count=20)
        difference = partial(client.get, f"{URL}/difference", params={"before": "main~1", "after": "main"})
        yield _row("difference of 20 changes", size, _times(lambda: _ok(difference())), 50)
        names = iter(range(10_000))
        branch = lambda: _ok(client.post(f"{URL}/refs", json={"name": f"b{next(names)}", "kind": "branch"}))  # noqa: E731
        yield _row("branch", size, _times(branch), 30)
        log = partial(client.get, f"{URL}/commits", params={"limit": 20})
        yield _row("page of 20 commits", size, _times(lambda: _ok(log())), 10)
        page = partial(client.get, f"{URL}/entries", params={"limit": 1000})
        yield _row("page of 1,000 entries", size, _times(lambda: _ok(page())), 75)
        _ok(client.post(f"{URL}/refs", json={"name": "side", "kind": "branch"}))
        commit("side", SIDE, size // 2)
        commit(MAIN, SIDE, size // 4)
        merge = partial(client.post, f"{URL}/merges", json={"version": "side"})
        yield _row(f"merge of 2 x {SIDE:,} changes", size, _times(lambda: _ok(merge()), repeats=1), 2000)


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


def _ok(response: httpx.Response) -> Any:
    response.raise_for_status()
    return json.loads(response.content)


def _times(action: Callable[[], object], repeats: int = REPEATS) -> list[float]:
    """Return the duration of each call in milliseconds; the first of several calls is a warm-up and is left out."""
    taken = []
    for _ in range(repeats + (repeats > 1)):
        begun = time.perf_counter()
        action()
        taken.append((time.perf_counter() - begun) * 1e3)
    return taken[repeats > 1 :]


def _row(
    job: str, size: int, times: list[float], goal_ms: float, peer: Callable[[], float | None] = lambda: None
) -> Row:
    median, slowest = statistics.median(times), max(times)
    ours = f"{median:.1f} ms, {slowest:.1f} at most" if len(times) > 1 else f"{median:.0f} ms"
    theirs = peer()
    shown = "" if theirs is None else f"Git: {theirs:.0f} ms"
    ratio = None if theirs is None else theirs / median
    return Row(job, f"{size:,} entries", ours, shown, ratio, f"< {goal_ms:,.0f} ms", median < goal_ms)


def _git_commits(files: int) -> float | None:
    """Return the median time in ms for a commit by Git of one of `files` small files; None if Git is not installed."""
    git = shutil.which("git")
    if git is None:
        return None
    with tempfile.TemporaryDirectory(prefix="marey-bench-git-") as folder:
        run = partial(_git, git, folder)
        run("init", "-q")
        run("fast-import", "--quiet", given=b"".join(_history(files)))
        run("read-tree", MAIN)
        taken = []
        for number in range(5):
            changed = run("hash-object", "-w", "--stdin", given=f"changed {number}".encode())
            begun = time.perf_counter()
            run("update-index", "--cacheinfo", f"100644,{changed},{_path(number)}")
            made = run("commit-tree", "-m", "m", "-p", MAIN, run("write-tree"))
            run("update-ref", f"refs/heads/{MAIN}", made)
            taken.append((time.perf_counter() - begun) * 1e3)
    return statistics.median(taken)


def _history(files: int) -> Iterator[bytes]:
    """Yield the input of `git fast-import` for one commit of `files` files."""
    yield f"commit refs/heads/{MAIN}\ncommitter bench <bench@localhost> 0 +0000\ndata 5\nfirst\n".encode()
    for number in range(files):
        content = f"take {number}"
        yield f"M 100644 inline {_path(number)}\ndata {len(content)}\n{content}\n".encode()


def _git(git: str, folder: str, *arguments: str, given: bytes | None = None) -> str:
    """Run Git and return what it prints."""
    person = {f"GIT_{role}_{what}": "bench@localhost" for role in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    environment = {**os.environ, **person}
    ran = subprocess.run([git, *arguments], cwd=folder, env=environment, check=True, input=given, capture_output=True)
    return ran.stdout.decode().strip()
