"""Pages of a list of 10,000 clips, which one client requests one after another."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Iterator

from benchmarks.local_server import PROJECT, local_server
from benchmarks.seeding import fill
from benchmarks.timing import Row
from benchmarks.wire import Connection

CLIPS = 10_000
PAGES = {
    "first page of 50": "",
    "… by name": "sort=name",
    "… below a folder": "collection=day%205",
    "… whose name contains a text": "q=0777",
}
REQUESTS = 200
GOAL_MS = 5.0
PREDECESSOR_MS = 145


def run() -> list[Row]:
    """Measure the first page in several orders, and a page in the middle."""
    with local_server(lambda data: fill(data, CLIPS)) as server, Connection(server.port, server.token) as connection:
        pages = PAGES | {"page 100 of 200": f"cursor={_cursor_in_the_middle(connection)}"}
        return [_row(name, list(_latencies_ms(connection, query))) for name, query in pages.items()]


def _get(connection: Connection, query: str) -> memoryview:
    path = f"/projects/{PROJECT}/clips?limit=50&{query}".rstrip("&")
    return connection.exchange(connection.head("GET", path))


def _cursor_in_the_middle(connection: Connection) -> str:
    cursor = ""
    for _ in range(99):
        cursor = json.loads(bytes(_get(connection, f"cursor={cursor}" if cursor else "")))["next_cursor"]
    return cursor


def _latencies_ms(connection: Connection, query: str) -> Iterator[float]:
    for number in range(REQUESTS + 20):
        begun = time.perf_counter()
        _get(connection, query)
        if number >= 20:
            yield (time.perf_counter() - begun) * 1e3


def _row(name: str, latencies_ms: list[float]) -> Row:
    median = statistics.median(latencies_ms)
    p99 = statistics.quantiles(latencies_ms, n=100)[98]
    return Row(
        f"list of clips, {name}",
        f"{CLIPS:,} clips",
        f"p50 {median:.1f} ms, p99 {p99:.1f} ms",
        f"the predecessor's, as measured elsewhere: {PREDECESSOR_MS} ms",
        PREDECESSOR_MS / median,
        f"p50 < {GOAL_MS:.0f} ms",
        median < GOAL_MS,
    )
