"""Searches by example through a server: processor time of all its processes, and elapsed time, per request.

`python -m benchmarks.similar_server [POSES]` writes an index of takes and changed copies (3,000,000 poses are 100,000 s
and 2 GB), stores it on a server of this machine, and repeats searches for frames of real or generated takes.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil

from benchmarks.bench_similar import GOAL_MS, GOAL_POSES, POSES, THREADS
from benchmarks.local_server import PROJECT, LocalServer, clip_parts, local_server
from benchmarks.similar_material import takes, with_copies
from marey_client import Marey
from marey_motion.documents import skeleton_to_document
from marey_motion.gait import generate_gait
from marey_motion.similarity.features import JOINTS, Rows
from marey_motion.similarity.shards import FULL_SHARD_ROWS, presence, write_shard
from marey_schemas.access import ProjectCreate
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.digests import digest_of

METRICS = ("published/positions-sigmoid", "published/sigmoid")
LENGTHS_S = (0.0, 1.0, 3.0)
SEARCHES, CLIPS, CLIP_S, RATE_HZ = 12, 6, 12.0, 60.0
_ALL = (1 << len(JOINTS)) - 1

Shard = tuple[Path, list[int]]
"""File of a shard, and the number of rows of each of its runs."""


def written(folder: Path, poses: int) -> list[Shard]:
    """Write shards of takes and changed copies with at least `poses` poses."""
    shards: list[Shard] = []
    runs: list[Rows] = []

    def write() -> None:
        path = folder / str(len(shards))
        write_shard(path, runs)
        shards.append((path, [len(run) for run in runs]))
        runs.clear()

    for features in with_copies([one for one in takes() if presence(one) == _ALL], poses):
        runs.append(features.rows)
        if sum(map(len, runs)) >= FULL_SHARD_ROWS:
            write()
    if runs:
        write()
    return shards


def measure(shards: Sequence[Shard]) -> Iterator[str]:
    """Store an index of the shards on a new server, and yield a line for each metric and length of examples."""
    with local_server() as server, server.client() as marey, _rest(server) as rest:
        clips = _make_clips(marey)
        _make_index(rest, shards, clips)
        for metric in METRICS:
            for seconds in LENGTHS_S:
                yield _line(server, rest, clips, metric, seconds, sum(sum(lengths) for _, lengths in shards))


def _rest(server: LocalServer) -> httpx.Client:
    return httpx.Client(
        base_url=f"{server.url}/api/v1", headers={"Authorization": f"Bearer {server.token}"}, timeout=600.0
    )


def _make_clips(marey: Marey) -> list[str]:
    """Create a project with some generated walks, and return the ids of their items."""
    project = marey.create_project(ProjectCreate(name=PROJECT))
    walks = [generate_gait(0.8 + 0.2 * number, 0.1 * number, CLIP_S, RATE_HZ) for number in range(CLIPS)]
    hierarchy = skeleton_to_document(walks[0].skeleton).model_dump(by_alias=True)
    skeleton = RevisionRef(item=project.skeletons.create("rig", {"hierarchy": hierarchy}).id, revision=1)
    return [project.clips.create(f"walk {n}", clip_parts(walk, skeleton)).item.id for n, walk in enumerate(walks)]


def _make_index(rest: httpx.Client, shards: Sequence[Shard], clips: Sequence[str]) -> None:
    """Store the shards as an index whose runs belong to the clips in turn."""
    entries: list[dict[str, Any]] = []
    for path, lengths in shards:
        count = len(lengths)
        listed = {
            "items": [clips[number % len(clips)] for number in range(count)], "revisions": [1] * count,
            "rows": lengths, "joints": [_ALL] * count, "frames": lengths, "rates_hz": [30.0] * count,
        }  # fmt: skip
        files = {"poses": _stored(rest, path.read_bytes()), "clips": _stored(rest, json.dumps(listed).encode())}
        entries.append({"rows": sum(lengths), **files})
    rows = sum(one["rows"] for one in entries)
    index = {"schema": "marey/motion-index@1", "clips": len(clips), "rows": rows, "shards": entries}
    rest.post(f"/projects/{PROJECT}/indexes", json={"name": "index", "parts": {"index": index}}).raise_for_status()


def _stored(rest: httpx.Client, content: bytes) -> dict[str, Any]:
    digest = digest_of(content)
    rest.put(f"/blobs/{digest}", content=content).raise_for_status()
    return {"blob": digest, "size_bytes": len(content)}


def _line(
    server: LocalServer, rest: httpx.Client, clips: Sequence[str], metric: str, seconds: float, poses: int
) -> str:
    frames = int(seconds * RATE_HZ) + 1
    used, elapsed = [], []
    for number in range(SEARCHES + 2):
        first = 30 + 20 * number
        body = {"clip": clips[number % CLIPS], "frames": [first, first + frames], "metric": metric, "results": 10}
        before, began = _processor_s(server), time.perf_counter()
        answer = rest.post(f"/projects/{PROJECT}/similar", json=body)
        elapsed.append(time.perf_counter() - began)
        used.append(_processor_s(server) - before)
        answer.raise_for_status()
        assert len(answer.json()["moments"]) == 10, "an exact search finds ten moments"
    used, elapsed = used[2:], elapsed[2:]  # the first copy and map the files of the index
    goal = f", goal {GOAL_MS} ms" if poses >= GOAL_POSES else ""
    return (
        f"{poses:,} poses, {metric}, {seconds:g} s: processor time {1e3 * np.median(used):.0f} ms, at most "
        f"{1e3 * max(used):.0f} ms, over {THREADS} threads; elapsed {1e3 * np.median(elapsed):.0f} ms, at least "
        f"{1e3 * min(elapsed):.0f} ms{goal}"
    )


def _processor_s(server: LocalServer) -> float:
    """Return the processor time of the server and its child processes, in seconds."""
    process = psutil.Process(server.pid)
    times = [one.cpu_times() for one in (process, *process.children(recursive=True))]
    return float(sum(one.user + one.system for one in times))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as name:
        for line in measure(written(Path(name), int(sys.argv[1]) if len(sys.argv) > 1 else POSES)):
            print(line, flush=True)
