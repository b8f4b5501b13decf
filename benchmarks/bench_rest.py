"""A server under load, on this machine: reading clips, with and without uploads at the same time, and cycles of jobs.

Server, readers and uploader are separate processes, which share the cores of this machine.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from benchmarks import load
from benchmarks.bare_server import bare_server
from benchmarks.load import Load
from benchmarks.local_server import PROJECT, LocalServer, Seeded, local_server, seed
from benchmarks.timing import Row

FRAMES, JOINTS = 1040, 63
"""Numbers of frames and joints of a clip whose stored form has about 500 kB."""
CONNECTIONS = 8
SECONDS = 6.0
ROUNDS = 4
"""Number of rounds; each reads from the bare server, then from Marey."""
BATCH = 250
PREDECESSOR_MS = 160
GOAL_READS_PER_S, GOAL_OF_BARE, GOAL_P99_MS = 999, 0.7, 20
GOAL_CYCLES_PER_S, GOAL_BATCHED_PER_S = 300, 1500

Start = Callable[..., Future[Any]]


def run() -> list[Row]:
    """Measure a server that answers repeated reads from memory; then the same reads on a server without this cache."""
    with load.in_processes(2) as start:
        with local_server() as server:
            seeded = seed(server, FRAMES, JOINTS)
            with bare_server(seeded.stored_bytes) as bare_port:
                rows = _reading(server, seeded, bare_port, start)
            jobs = _jobs(server, seeded, start)
        with local_server(MAREY_ANSWER_CACHE_BYTES="0") as server:
            return [*rows, _reading_from_database(server, seed(server, FRAMES, JOINTS), start), *jobs]


def _reading(server: LocalServer, seeded: Seeded, bare_port: int, start: Start) -> list[Row]:
    size = _size(seeded)

    def read(port: int, seconds: float = SECONDS) -> Load:
        return _read(port, server, seeded, start, seconds)

    bare_rounds, rounds = [], []
    for _ in range(ROUNDS):
        bare_rounds.append(read(bare_port, SECONDS / ROUNDS))
        rounds.append(_with_processor_ms(server, lambda: read(server.port, SECONDS / ROUNDS)))
    bare, alone = Load.joined(bare_rounds), Load.joined([measured for measured, _ in rounds])
    alone_ms = statistics.median(processor_ms for _, processor_ms in rounds)
    upload = {"frames": FRAMES, "joints": JOINTS, "seconds": SECONDS}
    uploading = start(load.upload_steadily, server.port, server.token, seeded.skeleton, **upload)
    beside, uploads = read(server.port), uploading.result()
    p99_ms = beside.percentile_ms(99)
    return [
        Row(
            "read a clip over HTTP, one that was read before",
            f"{size}; the server's processor: {alone_ms:.2f} ms each",
            f"{alone.per_second:.0f}/s, {_spread(alone)}",
            f"bare Tornado, bytes from memory: {bare.per_second:.0f}/s, {_spread(bare)}",
            alone.per_second / bare.per_second,
            f"> {GOAL_READS_PER_S}/s, ≥ {GOAL_OF_BARE}x",
            alone.per_second > max(GOAL_READS_PER_S, GOAL_OF_BARE * bare.per_second),
        ),
        Row(
            "… beside uploads of clips",
            f"{size}, {uploads.per_second:.0f} uploads/s",
            f"{beside.per_second:.0f}/s, {_spread(beside)}",
            f"the predecessor's, as measured elsewhere: {PREDECESSOR_MS} ms",
            PREDECESSOR_MS / p99_ms,
            f"p99 < {GOAL_P99_MS} ms",
            p99_ms < GOAL_P99_MS,
        ),
    ]


def _reading_from_database(server: LocalServer, seeded: Seeded, start: Start) -> Row:
    measured, processor_ms = _with_processor_ms(server, lambda: _read(server.port, server, seeded, start, SECONDS))
    return Row(
        "… and one that was not: each time from the database",
        f"{_size(seeded)}; the server's processor: {processor_ms:.2f} ms each",
        f"{measured.per_second:.0f}/s, {_spread(measured)}",
    )


def _read(port: int, server: LocalServer, seeded: Seeded, start: Start, seconds: float) -> Load:
    path = f"/projects/{PROJECT}/clips/{seeded.clip}/parts/motion"
    reading = {"accept": load.BLOCKS, "connections": CONNECTIONS, "seconds": seconds}
    result: Load = start(load.read_steadily, port, server.token, path, **reading).result()
    return result


def _size(seeded: Seeded) -> str:
    return f"{seeded.stored_bytes / 1e3:.0f} kB, {CONNECTIONS} connections"


def _with_processor_ms(server: LocalServer, measure: Callable[[], Load]) -> tuple[Load, float]:
    """Return a measurement, and the processor time of the server in milliseconds per request.

    The processor time includes the requests of the warm-up.
    """
    before_s = server.processor_s()
    measured = measure()
    share = measured.seconds / (measured.seconds + load.WARM_UP_S)
    return measured, 1e3 * share * (server.processor_s() - before_s) / len(measured.latencies_s)


def _spread(load: Load) -> str:
    return f"p50 {load.percentile_ms(50):.1f} ms, p99 {load.percentile_ms(99):.1f} ms"


def _jobs(server: LocalServer, seeded: Seeded, start: Start) -> list[Row]:
    job = {"kind": "export", "inputs": {"clips": [{"item": seeded.clip}]}, "cache": "off"}
    where = (server.port, server.token, job)
    singly, singly_ms = _with_processor_ms(
        server, lambda: start(load.cycle_jobs, *where, connections=CONNECTIONS, seconds=SECONDS).result()
    )
    batched, batch_ms = _with_processor_ms(
        server, lambda: start(load.cycle_job_batches, *where, size=BATCH, seconds=SECONDS).result()
    )
    in_batches = BATCH * batched.per_second
    return [
        Row(
            "durable job cycles: submit, claim, complete",
            f"one by one, {CONNECTIONS} connections; the server's processor: {singly_ms:.2f} ms each",
            f"{singly.per_second:.0f}/s, {_spread(singly)}",
            goal=f"≥ {GOAL_CYCLES_PER_S}/s",
            met=singly.per_second >= GOAL_CYCLES_PER_S,
        ),
        Row(
            "durable job cycles: submit, claim, complete",
            f"{BATCH} at once, 1 connection; the server's processor: {batch_ms / BATCH:.2f} ms each",
            f"{in_batches:.0f}/s",
            goal=f"≥ {GOAL_BATCHED_PER_S}/s",
            met=in_batches >= GOAL_BATCHED_PER_S,
        ),
    ]
