"""A server under load, on this machine: reading clips alone and beside uploads, and cycles of jobs.

Server, readers and uploader are processes of their own; all share this machine's cores.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from benchmarks import load
from benchmarks.load import Load
from benchmarks.local_server import PROJECT, LocalServer, Seeded, local_server, seed
from benchmarks.timing import Row

FRAMES, JOINTS = 1040, 63
"""About 500 kB as stored."""
CONNECTIONS = 8
SECONDS = 5.0
BATCH = 250
GOAL_READS_PER_S, GOAL_P99_MS = 999, 20
GOAL_CYCLES_PER_S, GOAL_BATCHED_PER_S = 300, 1500

Start = Callable[..., Future[Any]]


def run() -> list[Row]:
    """All on one server."""
    with local_server() as server, load.in_processes(2) as start:
        seeded = seed(server, FRAMES, JOINTS)
        return [*_reading(server, seeded, start), *_jobs(server, seeded, start)]


def _reading(server: LocalServer, seeded: Seeded, start: Start) -> list[Row]:
    path = f"/projects/{PROJECT}/clips/{seeded.clip}/parts/motion"
    size = f"{seeded.stored_bytes / 1e3:.0f} kB, {CONNECTIONS} connections"

    def reading() -> Future[Load]:
        return start(
            load.read_steadily,
            server.port, server.token, path, accept=load.BLOCKS, connections=CONNECTIONS, seconds=SECONDS,
        )  # fmt: skip

    alone: Load = reading().result()
    uploading = start(
        load.upload_steadily,
        server.port, server.token, seeded.skeleton, frames=FRAMES, joints=JOINTS, seconds=SECONDS,
    )  # fmt: skip
    beside, uploads = reading().result(), uploading.result()
    rate, p99_ms = alone.per_second, beside.percentile_ms(99)
    return [
        Row(
            "read a clip over HTTP",
            size,
            f"{rate:.0f}/s, {_spread(alone)}",
            "the predecessor's, as measured elsewhere: 767-999/s",
            rate / GOAL_READS_PER_S,
            f"> {GOAL_READS_PER_S}/s",
            rate > GOAL_READS_PER_S,
        ),
        Row(
            "… beside uploads of clips",
            f"{size}, {uploads.per_second:.0f} uploads/s",
            f"{beside.per_second:.0f}/s, {_spread(beside)}",
            "the predecessor's, as measured elsewhere: p99 160 ms",
            160 / p99_ms,
            f"p99 < {GOAL_P99_MS} ms",
            p99_ms < GOAL_P99_MS,
        ),
    ]


def _spread(load: Load) -> str:
    return f"p50 {load.percentile_ms(50):.1f} ms, p99 {load.percentile_ms(99):.1f} ms"


def _jobs(server: LocalServer, seeded: Seeded, start: Start) -> list[Row]:
    job = {"kind": "export", "inputs": {"clips": [{"item": seeded.clip}]}, "cache": "off"}
    where = (server.port, server.token, job)
    singly: Load = start(load.cycle_jobs, *where, connections=CONNECTIONS, seconds=SECONDS).result()
    batched: Load = start(load.cycle_job_batches, *where, size=BATCH, seconds=SECONDS).result()
    in_batches = BATCH * batched.per_second
    return [
        Row(
            "durable job cycles: submit, claim, complete",
            f"one by one, {CONNECTIONS} connections",
            f"{singly.per_second:.0f}/s, {_spread(singly)}",
            goal=f"≥ {GOAL_CYCLES_PER_S}/s",
            met=singly.per_second >= GOAL_CYCLES_PER_S,
        ),
        Row(
            "durable job cycles: submit, claim, complete",
            f"{BATCH} at once, 1 connection",
            f"{in_batches:.0f}/s",
            goal=f"≥ {GOAL_BATCHED_PER_S}/s",
            met=in_batches >= GOAL_BATCHED_PER_S,
        ),
    ]
