"""Ended jobs of a whole year with their attempts and events, written by a few SQL statements for each 100,000 jobs.

Of 100 jobs, 90 succeeded at their first attempt, 6 failed after two attempts, and 4 were cancelled before they started.
Every 100th job is of a rare kind. So 100 jobs leave 102 attempts and 298 events.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import Connection, NullPool, create_engine, select, text, update

from benchmarks.local_server import PROJECT
from marey_server.access.principal import SYSTEM
from marey_server.store.database.clock import DAY_US
from marey_server.store.database.connections import Database
from marey_server.store.events import LAST_NUMBER, newest_number, number_events
from marey_server.store.retention import DELETED_LOG, Retention
from marey_server.store.tables import project, server_state
from marey_server.store.transaction import Transaction
from marey_server.store.users import administrator_principal

AT_ONCE = 100_000
YEAR_US = 364 * DAY_US
"""Age of the oldest job: not yet old enough to be deleted."""
RARE_KIND = "import"
_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"

_NUMBERS = """
WITH RECURSIVE numbers(i) AS (SELECT CAST(:first AS BIGINT) UNION ALL SELECT i + 1 FROM numbers WHERE i < :last),
timed AS (SELECT i, CAST(:oldest_us AS BIGINT) + i * CAST(:step_us AS BIGINT) AS us FROM numbers),
jobs AS (
    SELECT i, us, {id} AS id,
        CASE WHEN i % 100 < 90 THEN 'succeeded' WHEN i % 100 < 96 THEN 'failed' ELSE 'cancelled' END AS state,
        CASE WHEN i % 100 < 90 THEN 1 WHEN i % 100 < 96 THEN 2 ELSE 0 END AS tries
    FROM timed
)
"""
_JOBS = """
INSERT INTO job (id, project_id, kind, state, params, inputs, unbound, into_path, priority, seed, labels_key,
    time_limit_s, memory_limit_mb, max_attempts, attempt, interruptions, unstarted, fence, counted_fence, run_at_us,
    result, outputs, failure, gathers, dependencies_left, on_failure, cache_mode, code_version, author_id, message,
    created_us, started_us, finished_us, rev)
SELECT id, :project, CASE WHEN i % 100 = 0 THEN :rare ELSE 'export' END, state, {params}, {inputs}, FALSE, '', 0, 0,
    '', 3600, 2048, 2, tries, 0, 0, tries, tries, us,
    CASE WHEN state = 'succeeded' THEN {result} END, CASE WHEN state = 'succeeded' THEN {outputs} END,
    CASE WHEN state = 'failed' THEN {failure} END, FALSE, 0, 'fail', 'off', '1', :author, '',
    us, CASE WHEN tries > 0 THEN us + 1000000 END, us + 60000000, 3
FROM jobs
"""
_ATTEMPTS = """
INSERT INTO attempt (job_id, fence, worker, claim_id, claimed_by, token_hash, started_us, ended_us, outcome, detail,
    write_id, answer, log_bytes)
SELECT id, try, 'worker-' || CAST(i % 20 AS TEXT), 'claim-' || CAST(i AS TEXT), :token,
    CAST(try AS TEXT) || id, us + 1000000 * try, us + 20000000 * try,
    CASE WHEN state = 'failed' THEN 'error' ELSE state END, CASE WHEN state = 'failed' THEN 'It went wrong.' END,
    'write-' || CAST(i AS TEXT), {answer}, CASE WHEN us > :logs_from_us THEN 2000 ELSE :short_log END
FROM jobs CROSS JOIN (SELECT 1 AS try UNION ALL SELECT 2) AS tried WHERE try <= tries
"""
_EVENTS = """
INSERT INTO event (seq, number, at_us, project_id, kind, subject, actor, body)
SELECT seq, {number}, at_us, :project, kind, id, 'admin', {body} FROM (
    SELECT :events_before + (i - 1) * 3 + k AS seq, us + 1000000 * k AS at_us, id,
        CASE k WHEN 0 THEN 'job.submitted' WHEN 1 THEN 'job.started' ELSE 'job.' || state END AS kind
    FROM jobs CROSS JOIN (SELECT 0 AS k UNION ALL SELECT 1 UNION ALL SELECT 2) AS step
    WHERE us > :events_from_us AND (tries > 0 OR k <> 1)
) AS happened
"""
_DOCUMENTS = {
    "params": '{"format": "bvh"}',
    "inputs": '{"clips": []}',
    "result": '{"clips": 1, "outputs": 0}',
    "outputs": "[]",
    "failure": '{"reason": "error", "code": "error", "detail": "It went wrong."}',
    "answer": '{"state": "succeeded", "outputs": []}',
    "body": '{"kind": "export"}',
}
_INDEXES = {
    "sqlite": "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND tbl_name = :table AND sql IS NOT NULL",
    "postgresql": """
        SELECT indexname, indexdef FROM pg_indexes WHERE tablename = :table
        AND NOT EXISTS (SELECT FROM pg_constraint WHERE conname = indexname)
    """,
}


def add_ended_jobs(database: Database, count: int, event_days: int = 365) -> None:
    """Add `count` ended jobs to the project of the benchmarks, evenly over the last year.

    Events are written for the last `event_days` only, as if older ones had been deleted.
    """
    database.write(SYSTEM, number_events)
    values = database.read(SYSTEM, _values, count, event_days)
    fragments = _fragments(postgres=not database.is_sqlite)
    with _loading(database) as connection:
        for table, statement in (("job", _JOBS), ("attempt", _ATTEMPTS), ("event", _EVENTS)):
            insertion = text((_NUMBERS + statement).format(**fragments))
            names = set(insertion.compile().params) - {"first", "last"}
            with _without_indexes(connection, table):
                for first in range(1, count + 1, AT_ONCE):
                    some = {"first": first, "last": min(first + AT_ONCE - 1, count)}
                    connection.execute(insertion, {name: values[name] for name in names} | some)
                    connection.commit()
        _settle(connection, values["events_before"] + 3 * count)


def _values(tx: Transaction, count: int, event_days: int) -> dict[str, Any]:
    return {
        "oldest_us": tx.now_us - YEAR_US,
        "step_us": (YEAR_US - 3600 * 1_000_000) // count,
        "logs_from_us": tx.now_us - Retention().logs_days * DAY_US,
        "events_from_us": tx.now_us - event_days * DAY_US,
        "short_log": len(DELETED_LOG),
        "events_before": newest_number(tx) + 1,
        "project": tx.execute(select(project.c.id).where(project.c.name == PROJECT)).scalar_one(),
        "author": administrator_principal(tx).user_id,
        "token": "token_of_a_year",
        "rare": RARE_KIND,
    }


@contextmanager
def _loading(database: Database) -> Iterator[Connection]:
    """Open a connection that neither waits for the disk nor checks references, because the rows are known to fit."""
    engine = create_engine(database.url, poolclass=NullPool)
    fast = ["PRAGMA synchronous = OFF", "PRAGMA foreign_keys = OFF", "PRAGMA cache_size = -200000"]
    if not database.is_sqlite:
        fast = ["SET synchronous_commit = off", "SET session_replication_role = replica"]
    with engine.connect() as connection:
        for statement in fast:
            connection.exec_driver_sql(statement)
        connection.commit()
        yield connection


@contextmanager
def _without_indexes(connection: Connection, table: str) -> Iterator[None]:
    """Drop the indexes of a table, and create them again at the end, which is faster than updates for each row."""
    indexes = connection.execute(text(_INDEXES[connection.dialect.name]), {"table": table}).all()
    for name, _ in indexes:
        connection.exec_driver_sql(f'DROP INDEX "{name}"')
    connection.commit()
    yield
    for _, definition in indexes:
        connection.exec_driver_sql(definition)
        connection.commit()


def _settle(connection: Connection, last_event: int) -> None:
    """Bring the counters of events, and on Postgres the statistics, to the state that a server leaves after a year."""
    if connection.dialect.name != "postgresql":
        return
    counter = server_state.c.key == LAST_NUMBER
    connection.execute(update(server_state).where(counter).values(value=last_event))
    connection.execute(text("SELECT setval(pg_get_serial_sequence('event', 'seq'), :last)"), {"last": last_event})
    connection.commit()
    connection.execution_options(isolation_level="AUTOCOMMIT")
    for table in ("job", "attempt", "event"):
        connection.exec_driver_sql(f"VACUUM ANALYZE {table}")  # as autovacuum does
    connection.exec_driver_sql("CHECKPOINT")


def _fragments(*, postgres: bool) -> dict[str, str]:
    """Return the parts of the statements that differ between databases, or contain braces or colons."""
    documents = {
        name: "'" + written.replace(":", r"\:") + "'" + (r"\:\:jsonb" if postgres else "")
        for name, written in _DOCUMENTS.items()
    }
    digits = (
        f"substr('{_ALPHABET}', CAST(((us / 1000) >> {shift}) & 31 AS INTEGER) + 1, 1)" for shift in range(45, -5, -5)
    )
    number = "CAST(i AS TEXT)"
    padded = f"substr('{'0' * 16}' || {number}, length({number}) + 1)"
    return {
        **documents,
        "id": f"'job_' || {' || '.join(digits)} || {padded}",
        "number": "seq" if postgres else "NULL",
    }
