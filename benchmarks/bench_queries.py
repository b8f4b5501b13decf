"""Queries over as many clips as the largest public collection of motion has, and the cost of indexes for queries."""

from __future__ import annotations

import json
import sqlite3
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import insert, select

from benchmarks.local_server import PROJECT, LocalServer, local_server
from benchmarks.seeding import fill
from benchmarks.timing import Row
from benchmarks.wire import Connection
from marey_server.access.principal import SYSTEM
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store.ids import new_id
from marey_server.store.tables import item, revision, revision_part
from marey_server.store.transaction import Transaction

CLIPS = 142_220
NO_SLIDE = "instr(warnings, 'foot-slide') = 0"
QUERIES = {
    "a rare value": (
        "subject = 0412 and frames > 120 and not warning = foot-slide",
        f"subject = '0412' AND frames > 120 AND {NO_SLIDE}",
    ),
    "a rare and a common value": (
        "action = walk and subject = 0412 and select = best",
        "action = 'walk' AND subject = '0412' AND choice = 'best'",
    ),
    "one of several rare values": (
        "subject in (0007, 0412, 0633) and frames > 120 and not warning = foot-slide",
        f"subject IN ('0007', '0412', '0633') AND frames > 120 AND {NO_SLIDE}",
    ),
    "one of several common values": (
        "action in (walk, crawl) and frames > 120 and not warning = foot-slide",
        f"action IN ('walk', 'crawl') AND frames > 120 AND {NO_SLIDE}",
    ),
    "values of many clips": (
        "action = walk and frames > 120 and not warning = foot-slide",
        f"action = 'walk' AND frames > 120 AND {NO_SLIDE}",
    ),
    "a value of most clips": (
        'licence = CC0 and duration > 2 and not select = "no good"',
        "licence = 'CC0' AND duration_s > 2 AND choice <> 'no good'",
    ),
    "common values that few clips share": (
        "action = crawl and licence = CC0 and frames > 622",
        "action = 'crawl' AND licence = 'CC0' AND frames > 622",
    ),
    "common facts that few clips share": (
        "action = crawl and licence = CC0 and duration > 10.38",
        "action = 'crawl' AND licence = 'CC0' AND duration_s > 10.38",
    ),
    "no clip": (
        "subject = nobody and frames > 120 and not warning = foot-slide",
        f"subject = 'nobody' AND frames > 120 AND {NO_SLIDE}",
    ),
    "no value of an index": (
        "duration > 5 and not select = best and not warning = foot-slide",
        f"duration_s > 5 AND choice <> 'best' AND {NO_SLIDE}",
    ),
    "a part of few names": (
        "name ~ 4142 and frames > 120 and not warning = foot-slide",
        f"name LIKE '%4142%' AND frames > 120 AND {NO_SLIDE}",
    ),
    "a range of few clips": (
        "frames >= 623 and select = best and not warning = foot-slide",
        f"frames >= 623 AND choice = 'best' AND {NO_SLIDE}",
    ),
}
"""Queries of three conditions each, with the same conditions in SQL; the keys describe what a query selects."""
REQUESTS = 30
GOAL_MS = 50.0
ROWS_PER_WRITE = 10_000


def run() -> list[Row]:
    """Measure the first page of each query, ordered by time and ordered by name.

    For comparison, Python's `sqlite3` reads the same page from one table with the same facts in columns and an index
    for each column that Marey has an index for, in this process and without HTTP.
    """
    with (
        local_server(_prepare) as server,
        Connection(server.port, server.token) as connection,
        closing(_plain_table()) as table,
    ):
        orders = {"": ("", "created_us DESC"), ", by name": ("&sort=name", "name")}
        return [
            _row(server, connection, f"query for {what}{shown}", f"{quote(query)}{order}", plain)
            for what, (query, sql) in QUERIES.items()
            for shown, (order, columns) in orders.items()
            for plain in [partial(_plain_page_ms, table, sql, columns)]
        ]


# -- the same clips in one table --------------------------------------------------------------------------------------

INDEXED = ("subject", "action", "take", "shoot_day", "licence", "name", "frames", "created_us")


def _plain_table() -> sqlite3.Connection:
    """Return a database in memory with the facts of all clips in columns."""
    rows: list[dict[str, Any]] = [
        {"created_us": number, "name": f"copy {number:06d}", **_facts(number)} for number in range(CLIPS)
    ]
    table = sqlite3.connect(":memory:")
    table.execute(f"CREATE TABLE clip ({', '.join(rows[0])})")
    values = ", ".join(f":{column}" for column in rows[0])
    table.executemany(
        f"INSERT INTO clip VALUES ({values})", [{**row, "warnings": str(row["warnings"])} for row in rows]
    )
    for column in INDEXED:
        table.execute(f"CREATE INDEX by_{column} ON clip ({column}, created_us)")
    table.execute("ANALYZE")
    return table


def _plain_page_ms(table: sqlite3.Connection, condition: str, order: str) -> float:
    """Return the median time of reading the first page of a query from the table."""
    statement = f"SELECT * FROM clip WHERE {condition} ORDER BY {order} LIMIT 50"
    times = []
    for _ in range(REQUESTS):
        begun = time.perf_counter()
        table.execute(statement).fetchall()
        times.append((time.perf_counter() - begun) * 1e3)
    return statistics.median(times)


# -- clips ------------------------------------------------------------------------------------------------------------


def _prepare(data: Path) -> None:
    fill(data, 1)
    database = open_database(Settings(data=data))
    try:
        for start in range(0, CLIPS, ROWS_PER_WRITE):
            database.write(SYSTEM, _copy_clips, range(start, min(CLIPS, start + ROWS_PER_WRITE)))
    finally:
        database.close()


def _copy_clips(tx: Transaction, numbers: range) -> None:
    """Insert copies of the first clip; their summaries state other facts."""
    first = tx.execute(select(item).where(item.c.kind == "clip").order_by(item.c.id).limit(1)).one()._mapping
    parts = tx.execute(select(revision_part).where(revision_part.c.item_id == first["id"])).all()
    ids = sorted(new_id("clip") for _ in numbers)
    rows = [
        {
            **first, "id": at, "name": f"copy {number:06d}", "name_folded": f"copy {number:06d}",
            "created_us": first["created_us"] + number, "summary": _summary(first["summary"], number),
            "frames": 24 + number * 7 % 600,
        }
        for at, number in zip(ids, numbers, strict=True)
    ]  # fmt: skip
    tx.execute(insert(item), rows)
    tx.execute(insert(revision), [{"item_id": at, "number": 1, "created_us": tx.now_us} for at in ids])
    tx.execute(insert(revision_part), [{**part._mapping, "item_id": at} for at in ids for part in parts])


def _summary(of_first: dict[str, Any], number: int) -> dict[str, Any]:
    facts = _facts(number)
    facts["select"] = facts.pop("choice")
    return {**of_first, **facts}


def _facts(number: int) -> dict[str, Any]:
    """Return the facts about the clip `number`; in all clips together, each performer has 200 takes, mostly walks."""
    mixed = number * 2_654_435_761 % 2**32 >> 8  # a fixed value that looks random
    frames = 24 + number * 7 % 600
    return {
        "frames": frames, "duration_s": frames / 60, "warnings": ["foot-slide"] if mixed % 9 == 0 else [],
        "subject": f"{number // 200:04d}", "take": str(number % 200),
        "action": ("walk", "walk", "walk", "run", "turn", "jump", "reach", "crawl")[mixed % 8],
        "choice": ("best", "good", "good", "good", "no good")[mixed // 8 % 5], "licence": "CC0",
        "shoot_day": f"2025-{1 + number // 12_000:02d}-{1 + number // 1000 % 12:02d}", "capture_system": "optical",
    }  # fmt: skip


# -- measurements -----------------------------------------------------------------------------------------------------


def _row(server: LocalServer, connection: Connection, what: str, query: str, plain_page_ms: Callable[[], float]) -> Row:
    request = connection.head("GET", f"/projects/{PROJECT}/clips?limit=50&query={query}")
    found = len(json.loads(bytes(connection.exchange(request)))["items"])
    used_s = server.processor_s()
    median = statistics.median(_latencies_ms(connection, request))
    used_ms = (server.processor_s() - used_s) / REQUESTS * 1e3
    plain_ms = plain_page_ms()
    return Row(
        what,
        f"{CLIPS:,} clips",
        f"p50 {median:.1f} ms, processor {used_ms:.1f} ms, {found} on the page",
        peer=f"sqlite3 {plain_ms:.2f} ms",
        ratio=plain_ms / median,
        goal=f"p50 < {GOAL_MS:.0f} ms",
        met=median < GOAL_MS,
    )


def _latencies_ms(connection: Connection, request: bytes) -> Iterator[float]:
    for _ in range(REQUESTS):
        begun = time.perf_counter()
        connection.exchange(request)
        yield (time.perf_counter() - begun) * 1e3
