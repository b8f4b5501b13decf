"""Durable job cycles on Postgres, compared with procrastinate, a job queue that stores its jobs in Postgres.

Both write every step of a job to the disk: submission, claim and completion. Marey's client sends requests to a server
by HTTP, which checks tokens, roles, quotas and inputs, and records events; procrastinate's client runs its own three
SQL functions over a connection to Postgres. Rounds of both alternate, in separate processes that share the processors
of this machine, so only the ratio of each pair is meaningful.
"""

from __future__ import annotations

import asyncio
import secrets
import statistics
import threading
import time
from typing import Any

from sqlalchemy import make_url

from benchmarks import load
from benchmarks.load import Load
from benchmarks.local_postgres import local_postgres, new_database
from benchmarks.local_server import PROJECT, local_server, seed
from benchmarks.timing import Row
from benchmarks.wire import Connection

CONNECTIONS = 8
ROUNDS, ROUND_S = 7, 3.0
RATE_PER_S, RATE_S = 100, 6.0
CLAIMERS = 4
GOAL_RATIO, GOAL_START_MS = 1.5, 50


def run() -> list[Row]:
    """Measure the rates of single cycles in alternating rounds, then how soon a job starts."""
    with local_postgres() as postgres, load.in_processes(1) as start:
        peer = make_url(new_database(postgres, "peer")).set(drivername="postgresql").render_as_string(False)
        address = new_database(postgres, "marey")
        with local_server(MAREY_WARM_UP="false", MAREY_DATABASE_URL=address) as server:  # cycles need no kernels
            job = {"kind": "export", "inputs": {"clips": [{"item": seed(server, 4, 26).clip}]}, "cache": "off"}
            start(prepare_peer, peer).result()
            rounds = []
            for _ in range(ROUNDS):
                before_s = server.processor_s()
                ours = start(
                    load.cycle_jobs, server.port, server.token, job, connections=CONNECTIONS, seconds=ROUND_S
                ).result()
                share = ROUND_S / (ROUND_S + load.WARM_UP_S)
                server_ms = 1e3 * share * (server.processor_s() - before_s) / len(ours.latencies_s)
                theirs = start(cycle_with_peer, peer, connections=CONNECTIONS, seconds=ROUND_S).result()
                rounds.append((ours, theirs, server_ms))
            delays_s = start(delays_to_start, server.port, server.token, job).result()
    return [_row_of_cycles(rounds), _row_of_starts(Load(RATE_S, delays_s))]


def _row_of_cycles(rounds: list[tuple[Load, Load, float]]) -> Row:
    ratios = sorted(ours.per_second / theirs.per_second for ours, theirs, _ in rounds)
    ours_per_s = statistics.median(ours.per_second for ours, _, _ in rounds)
    theirs_per_s = statistics.median(theirs.per_second for _, theirs, _ in rounds)
    server_ms = statistics.median(server_ms for _, _, server_ms in rounds)
    ratio = statistics.median(ratios)
    return Row(
        "durable job cycles on Postgres, one by one",
        f"{CONNECTIONS} connections, {ROUNDS} pairs of rounds; the server's processor: {server_ms:.2f} ms each",
        f"{ours_per_s:.0f}/s",
        f"procrastinate, without HTTP: {theirs_per_s:.0f}/s; pairs {ratios[0]:.2f} to {ratios[-1]:.2f}",
        ratio,
        f"≥ {GOAL_RATIO}x",
        ratio >= GOAL_RATIO,
    )


def _row_of_starts(starts: Load) -> Row:
    p95_ms = starts.percentile_ms(95)
    return Row(
        "from the submission of a job to its start, on Postgres",
        f"{RATE_PER_S} jobs/s, {CLAIMERS} waiting workers",
        f"p50 {starts.percentile_ms(50):.1f} ms, p95 {p95_ms:.1f} ms",
        goal=f"p95 < {GOAL_START_MS} ms",
        met=p95_ms < GOAL_START_MS,
    )


# -- procrastinate -----------------------------------------------------------------------------------------------------


def _app(address: str) -> tuple[Any, Any]:
    """Return an application of procrastinate with as many connections as Marey's clients have, and its task."""
    from procrastinate import App, PsycopgConnector

    app = App(connector=PsycopgConnector(conninfo=address, min_size=CONNECTIONS, max_size=CONNECTIONS))

    @app.task(name="export")
    def export(clip: str) -> None:
        """Do nothing: the benchmark claims and completes jobs without running them."""

    return app, export


def prepare_peer(address: str) -> None:
    """Create the tables of procrastinate."""

    async def apply() -> None:
        app, _ = _app(address)
        async with app.open_async():
            await app.schema_manager.apply_schema_async()

    asyncio.run(apply())


def cycle_with_peer(address: str, *, connections: int, seconds: float) -> Load:
    """Submit, claim and complete one job with procrastinate, again and again, in as many tasks as `connections`."""
    return asyncio.run(_cycle_with_peer(address, connections, seconds))


async def _cycle_with_peer(address: str, connections: int, seconds: float) -> Load:
    from procrastinate.jobs import Status

    app, export = _app(address)
    start = time.perf_counter() + load.WARM_UP_S
    latencies: list[float] = []

    async def work() -> None:
        worker = await app.job_manager.register_worker()
        while (begun := time.perf_counter()) < start + seconds:
            await export.defer_async(clip="clip_0123456789")
            while (job := await app.job_manager.fetch_job(None, worker)) is None:
                pass  # another task claimed the job that this statement had found
            await app.job_manager.finish_job(job, Status.SUCCEEDED, delete_job=False)
            if begun >= start:
                latencies.append(time.perf_counter() - begun)

    async with app.open_async():
        await asyncio.gather(*(work() for _ in range(connections)))
    return Load(seconds, latencies)


# -- from the submission to the start ----------------------------------------------------------------------------------


def delays_to_start(port: int, token: str, job: dict[str, Any]) -> list[float]:
    """Submit jobs at a steady rate while workers wait for them; return the delay from request to claim of each job."""
    submitted: dict[str, float] = {}
    started: dict[str, float] = {}
    stop = threading.Event()

    def work() -> None:
        with Connection(port, token) as connection:
            while not stop.is_set():
                wanted = {"worker": "bench", "kinds": [job["kind"]], "wait_s": 1}
                for lease in connection.call("/leases", wanted)["leases"]:
                    started[lease["job"]] = time.perf_counter()
                    path = f"/jobs/{lease['job']}/attempts/{lease['fence']}/complete"
                    connection.call(path, {"write_id": secrets.token_hex(8)}, token=lease["attempt_token"])

    workers = [threading.Thread(target=work) for _ in range(CLAIMERS)]
    for worker in workers:
        worker.start()
    begun = time.perf_counter()
    with Connection(port, token) as connection:
        for number in range(round(RATE_PER_S * RATE_S)):
            time.sleep(max(0.0, begun + number / RATE_PER_S - time.perf_counter()))
            asked = time.perf_counter()
            submitted[connection.call(f"/projects/{PROJECT}/jobs", job)["id"]] = asked
    stop.set()
    for worker in workers:
        worker.join()
    return [started[one] - asked for one, asked in submitted.items() if one in started]
