"""Times of commits, differences, branches, lists and merges in datasets of several sizes, and how they grow."""

from __future__ import annotations

import json
import sqlite3
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import httpx
import psutil

from benchmarks.local_server import PROJECT, LocalServer, local_server
from benchmarks.timing import Row
from benchmarks.versions.filling import LARGE, fill_dataset, path_of
from benchmarks.versions.peers import BRANCH, COMMIT, DIFFERENCE, PeerTimes
from marey_schemas.datasets.naming import MAIN

SIZES = (1_000, 10_000, 142_220, 1_000_000)
"""Numbers of entries; 142,220 is the number of clips of the largest public collection."""
REPEATS, REPEATS_OF_P90 = 20, 60
SIDE = 1_000
"""Number of entries that each side of the measured merge changes."""
URL = f"/projects/{PROJECT}/datasets/{LARGE}"
GOAL_WRITTEN_BYTES = 64_000


@dataclass(frozen=True)
class Job:
    """One measured job, with its goal for the median, or for the 90th percentile."""

    name: str
    goal_ms: float
    of_p90: bool = False


MERGE = f"merge of 2 x {SIDE:,} changes"
JOBS = (
    Job(COMMIT, 50),
    Job(DIFFERENCE, 50),
    Job(BRANCH, 30, of_p90=True),
    Job("tag", 30, of_p90=True),
    Job("page of 20 commits", 10),
    Job("page of 1,000 entries", 75),
    Job(MERGE, 2000),
)


@dataclass(frozen=True)
class Written:
    """Mean number of bytes that a commit of one change adds to the tree, and that the server writes to files for it.

    `to_files` is None if the operating system does not count these bytes.
    """

    chunks: float
    to_files: float | None


@dataclass(frozen=True)
class Measured:
    """Times in ms of each job at one size; a job that is not possible at this size has none."""

    times: Mapping[str, Sequence[float]]
    written: Written


def measure_operations(peers: Mapping[int, Sequence[PeerTimes]]) -> list[Row]:
    """Measure all jobs at all sizes; `peers` are the times of peers by their number of files."""
    measured = {size: _measure(size) for size in SIZES}
    rows = [
        _row(job, size, measured, peers.get(size, ()))
        for job in JOBS
        for size in SIZES
        if measured[size].times.get(job.name)
    ]
    return [*rows, *(_row_of_written(size, one.written) for size, one in measured.items())]


# -- measurements -----------------------------------------------------------------------------------------------------


def _measure(size: int) -> Measured:
    with local_server(partial(fill_dataset, size=size)) as server:
        headers = {"Authorization": f"Bearer {server.token}"}
        with httpx.Client(base_url=f"{server.url}/api/v1", headers=headers, timeout=300) as client:
            return _Measurement(server, client, size).run()


class _Measurement:
    """Requests to a server whose dataset has `size` entries."""

    def __init__(self, server: LocalServer, client: httpx.Client, size: int) -> None:
        self._server, self._client, self._size = server, client, size
        clips = _answer(client.get(f"/projects/{PROJECT}/clips"))["items"]
        self._clips = [str(clip["id"]) for clip in clips]
        self._places = iter(range(0, size, size // 1000))
        self._names = count()

    def run(self) -> Measured:
        """Measure every job."""
        times: dict[str, list[float]] = {COMMIT: []}
        written = self._written(times[COMMIT])
        self._commit(places=range(next(self._places), self._size, self._size // 50)[:20])
        between = {"before": "main~1", "after": "main"}
        times[DIFFERENCE] = _times(partial(self._get, "difference", between))
        times[BRANCH] = _times(partial(self._create_ref, "branch"), REPEATS_OF_P90)
        times["tag"] = _times(partial(self._create_ref, "tag"), REPEATS_OF_P90)
        times["page of 20 commits"] = _times(partial(self._get, "commits", {"limit": 20}))
        times["page of 1,000 entries"] = _times(partial(self._get, "entries", {"limit": 1000}))
        if self._size >= 4 * SIDE:
            times[MERGE] = [self._merge_ms()]
        return Measured(times, written)

    def _written(self, times: list[float]) -> Written:
        """Measure commits of one change; append their times in ms to `times`, and return the bytes that they write."""
        begun_us, before = time.time() * 1e6, _bytes_to_files(self._server)
        times += _times(lambda: self._commit(places=[next(self._places)]))
        after, commits = _bytes_to_files(self._server), REPEATS + 1
        to_files = None if before is None or after is None else (after - before) / commits
        with closing(sqlite3.connect(f"file:{self._server.data / 'marey.db'}?mode=ro", uri=True)) as database:
            statement = "SELECT sum(length(data)) FROM tree_chunk WHERE created_us > ?"
            (stored,) = database.execute(statement, (int(begun_us),)).fetchone()
        return Written(stored / commits, to_files)

    def _merge_ms(self) -> float:
        self._create_ref("branch", "side")
        self._commit("side", range(self._size // 2, self._size // 2 + SIDE))
        self._commit(MAIN, range(self._size // 4, self._size // 4 + SIDE))
        return _times(partial(self._post, "merges", {"version": "side"}), 1)[0]

    def _commit(self, branch: str = MAIN, places: Sequence[int] = ()) -> None:
        changes = [
            {"change": "put", "path": path_of(place), "item": self._clips[place % len(self._clips)]} for place in places
        ]
        self._post("commits", {"message": "m", "branch": branch, "changes": changes})

    def _create_ref(self, kind: str, name: str | None = None) -> None:
        self._post("refs", {"name": name or f"{kind}-{next(self._names)}", "kind": kind})

    def _post(self, resource: str, body: object) -> None:
        _answer(self._client.post(f"{URL}/{resource}", json=body))

    def _get(self, resource: str, query: Mapping[str, str | int]) -> None:
        _answer(self._client.get(f"{URL}/{resource}", params=query))


def _answer(response: httpx.Response) -> Any:
    if response.is_error:
        raise RuntimeError(f"{response.request.url}: {response.text[:500]}")
    return json.loads(response.content)


def _bytes_to_files(server: LocalServer) -> int | None:
    """Return how many bytes the server has passed to the operating system for writing, to files and log."""
    counters = getattr(psutil.Process(server.pid), "io_counters", None)  # absent in macOS
    return None if counters is None else int(counters().write_chars)


def _times(action: Callable[[], object], repeats: int = REPEATS) -> list[float]:
    """Return the duration of each call in milliseconds; the first of several calls is a warm-up and is left out."""
    taken = []
    for _ in range(repeats + (repeats > 1)):
        begun = time.perf_counter()
        action()
        taken.append((time.perf_counter() - begun) * 1e3)
    return taken[repeats > 1 :]


# -- rows -------------------------------------------------------------------------------------------------------------


def _row(job: Job, size: int, measured: Mapping[int, Measured], peers: Sequence[PeerTimes]) -> Row:
    times = measured[size].times[job.name]
    median = statistics.median(times)
    p90 = statistics.quantiles(times, n=10, method="inclusive")[8] if len(times) > 1 else median
    judged = p90 if job.of_p90 else median
    least = min(one for one in SIZES if measured[one].times.get(job.name))
    ours = f"{median:.1f} ms" + (f", p90 {p90:.1f}" if len(times) > 1 else "")
    if size != least:
        ours += f"; {median / statistics.median(measured[least].times[job.name]):.1f}x that of {least:,}"
    found = [one for one in peers if job.name in one.shown]
    ratios = [taken / median for one in found if (taken := one.times_ms.get(job.name)) is not None]
    goal = f"{'p90 ' if job.of_p90 else ''}< {job.goal_ms:,.0f} ms"
    peer = "; ".join(one.shown[job.name] for one in found)
    return Row(job.name, f"{size:,} entries", ours, peer, min(ratios, default=None), goal, judged < job.goal_ms)


def _row_of_written(size: int, written: Written) -> Row:
    ours, met = f"{written.chunks / 1e3:.1f} kB of chunks", None
    if written.to_files is not None:
        ours += f"; {written.to_files / 1e3:.0f} kB to files, with pages, indexes and log"
        met = written.to_files < GOAL_WRITTEN_BYTES
    return Row(
        "bytes written by a commit of one change", f"{size:,} entries", ours,
        goal=f"< {GOAL_WRITTEN_BYTES / 1e3:.0f} kB", met=met,
    )  # fmt: skip
