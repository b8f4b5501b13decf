"""The queue of a server that has run for a year, compared with a new one: the same operations beside ended jobs.

Operations call the store of this process without HTTP. The ratio compares the processor time of this process and of
the database, with few and with many ended jobs: each round measures both, one after the other. A ratio of 1 means that
ended jobs cost nothing; below 1, that they make an operation slower.

`python -m benchmarks.bench_year_old_queue --jobs 10000000` measures another number of jobs, on one or both databases.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from sqlalchemy import select, text

from benchmarks.ended_jobs import RARE_KIND, add_ended_jobs
from benchmarks.local_postgres import local_postgres, new_database
from benchmarks.local_server import PROJECT
from benchmarks.seeding import fill_database
from benchmarks.timing import Row
from marey_schemas.queue.jobs import Job, JobCreate, JobState
from marey_schemas.queue.worker_protocol import ClaimRequest, CompleteRequest, Lease
from marey_server.access.principal import SYSTEM, Principal
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store import events
from marey_server.store.database.connections import Database
from marey_server.store.database.schema import upgrade_schema
from marey_server.store.garbage import collect_garbage
from marey_server.store.jobs import completion, queue, reading, submission
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.jobs.reading import JobFilters
from marey_server.store.jobs.reaper import correct_times, reap_page, share_waiting
from marey_server.store.monitoring.demand import JobReach, read_demand
from marey_server.store.monitoring.figures import read_figures
from marey_server.store.retention import Retention, retire
from marey_server.store.tables import item
from marey_server.store.users import administrator_principal

ENDED_JOBS, FEW_JOBS = 1_000_000, 10_000
ROUNDS = 9
CYCLES = 40
"""Number of jobs that are submitted, claimed and completed in each round."""
ROUND_S, MOST_CALLS = 0.05, 100
"""Duration in seconds for which each round repeats an operation, and greatest number of repetitions."""
GOAL = 0.8


@dataclass
class MeasuredQueue:
    """Queue with ended jobs, the caller of its operations, and the clock of the processor time that they take."""

    database: Database
    administrator: Principal
    job: JobCreate
    leases: list[Lease] = field(default_factory=list)
    cursors: dict[JobFilters, str] = field(default_factory=dict)
    newest: str = ""

    def processor_s(self) -> float:
        """Return the processor time of this process and of the connections to Postgres, in seconds."""
        return time.process_time() + sum(map(_processor_s_of, self._backends()))

    def _backends(self) -> list[int]:
        if self.database.is_sqlite:
            return []
        connected = text(
            "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND backend_type = 'client backend'"
        )
        with self.database.engine.connect() as connection:
            return list(connection.execute(connected).scalars())

    # -- operations ---------------------------------------------------------------------------------------------------

    def submit(self) -> None:
        """Submit one job."""
        self.newest = self.database.write(self.administrator, submission.submit, PROJECT, [self.job])[0].id

    def claim(self) -> None:
        """Claim one job."""
        wanted = ClaimRequest(worker="bench", kinds=(self.job.kind,))
        self.leases += self.database.write(self.administrator, queue.claim, wanted)

    def complete(self) -> None:
        """Complete the job that was claimed last."""
        lease = self.leases.pop()
        attempt = Principal("attempt", job_id=lease.job, fence=lease.fence)
        request = CompleteRequest(write_id="write-of-bench")
        self.database.write(attempt, completion.complete, lease.job, lease.fence, request)

    def list_jobs(self, filters: JobFilters, *, sort: str = "-created_at", later: bool = False) -> None:
        """Read the first page of a list, or the page that follows it."""
        cursor = self.cursors.get(filters) if later else None
        page = self.database.read(
            self.administrator, reading.list_jobs, PROJECT, filters, sort=sort, cursor=cursor, limit=50
        )
        if not later and page.next_cursor is not None:
            self.cursors[filters] = page.next_cursor

    def show_job(self) -> Job:
        """Read a job, its attempts and its events."""
        self.database.read(self.administrator, reading.list_attempts, self.newest)
        self.database.read(self.administrator, reading.list_job_events, self.newest)
        return self.database.read(self.administrator, reading.read_job, self.newest)

    def count_queue(self) -> None:
        """Read the numbers that `/metrics` and the pools of workers need."""
        self.database.read(SYSTEM, read_figures, (), "1")
        self.database.read(SYSTEM, read_demand, JobReach({}), ["bench"], 100)

    def follow_events(self) -> None:
        """Read the newest events of the project, and the topics of new events that wake waiting requests."""
        self.database.write(SYSTEM, events.number_events)
        after = self.database.read(SYSTEM, events.newest_number) - 50
        self.database.read(self.administrator, events.list_events, PROJECT, after=after)
        self.database.read(SYSTEM, events.read_news, after)

    def keep_house(self) -> None:
        """Do the frequent work of the leading server: expired leases, shared results, commits of many outputs."""
        self.database.write(SYSTEM, correct_times)
        self.database.write(SYSTEM, reap_page)
        self.database.write(SYSTEM, share_waiting)
        commit_deferred(self.database)

    def sweep(self) -> None:
        """Do the hourly work of the leading server: delete old rows and unused blobs."""
        retire(self.database, Retention())
        collect_garbage(self.database)

    def open_again(self) -> None:
        """Open the database as a server does at its start."""
        url = self.database.url.render_as_string(hide_password=False)
        upgrade_schema(url)
        other = Database(url)
        other.read(SYSTEM, events.newest_number)
        other.close()


def _processor_s_of(pid: int) -> float:
    """Return the processor time of a process of this machine, which Linux counts in nanoseconds; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9
    except (FileNotFoundError, ProcessLookupError):  # of a connection that an operation has closed
        return 0.0


FAILED = JobFilters(states=(JobState.FAILED,))
OPERATIONS: dict[str, Callable[[MeasuredQueue], object]] = {
    "submit": MeasuredQueue.submit,
    "claim": MeasuredQueue.claim,
    "complete": MeasuredQueue.complete,
    "list, first page": lambda one: one.list_jobs(JobFilters()),
    "list, next page": lambda one: one.list_jobs(JobFilters(), later=True),
    "list, failed": lambda one: one.list_jobs(FAILED),
    "list, failed, next page": lambda one: one.list_jobs(FAILED, later=True),
    "list, running": lambda one: one.list_jobs(JobFilters(states=(JobState.RUNNING,))),
    "list, unfinished": lambda one: one.list_jobs(JobFilters(states=tuple(s for s in JobState if not s.terminal))),
    "list, rare kind": lambda one: one.list_jobs(JobFilters(kinds=(RARE_KIND,))),
    "list, rare kind and state": lambda one: one.list_jobs(JobFilters((JobState.RUNNING,), (RARE_KIND,))),
    "list, author": lambda one: one.list_jobs(JobFilters(author="nobody")),
    "list, by priority": lambda one: one.list_jobs(JobFilters(), sort="-priority"),
    "show a job": MeasuredQueue.show_job,
    "metrics and demand": MeasuredQueue.count_queue,
    "events": MeasuredQueue.follow_events,
    "housekeeping": MeasuredQueue.keep_house,
    "hourly sweep": MeasuredQueue.sweep,
    "opening": MeasuredQueue.open_again,
}
_OF_A_CYCLE = ("submit", "claim", "complete")


def run(jobs: int = ENDED_JOBS, databases: Sequence[str] = ("SQLite", "Postgres"), event_days: int = 365) -> list[Row]:
    """Measure each operation in a queue with `jobs` ended jobs and the events of `event_days`, and in one with few."""
    rows = []
    if "SQLite" in databases:
        with tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
            data = Path(folder)
            settings = {count: Settings(data=data / str(count)) for count in (FEW_JOBS, jobs)}
            rows += _rows("SQLite", jobs, settings, event_days)
    if "Postgres" in databases:
        with local_postgres() as server, tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
            addresses = {count: new_database(server, f"bench_{count}") for count in (FEW_JOBS, jobs)}
            data = Path(folder)
            settings = {count: Settings(data=data / str(count), database_url=url) for count, url in addresses.items()}
            rows += _rows("Postgres", jobs, settings, event_days)
    return rows


def _rows(name: str, jobs: int, settings: dict[int, Settings], event_days: int) -> list[Row]:
    few = _opened(settings[FEW_JOBS], FEW_JOBS, event_days)
    with few as new, _opened(settings[jobs], jobs, event_days) as old:
        return [_row(name, jobs, operation, times) for operation, times in measure(new, old).items()]


@contextmanager
def _opened(settings: Settings, jobs: int, event_days: int) -> Iterator[MeasuredQueue]:
    database = open_database(settings)
    try:
        fill_database(database, 1)
        add_ended_jobs(database, jobs, event_days)
        administrator = database.read(SYSTEM, administrator_principal)
        clip = database.read(SYSTEM, lambda tx: tx.execute(select(item.c.id).where(item.c.kind == "clip")).scalar_one())
        job = JobCreate.model_validate({"kind": "export", "inputs": {"clips": [{"item": clip}]}, "cache": "off"})
        yield MeasuredQueue(database, administrator, job)
    finally:
        database.close()


def measure(new: MeasuredQueue, old: MeasuredQueue) -> dict[str, list[tuple[float, float]]]:
    """Return, for each operation and round, the processor time of one call on the new and on the old queue."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in OPERATIONS}
    calls = dict.fromkeys(_OF_A_CYCLE, CYCLES)
    for number in range(ROUNDS + 1):
        for name, operation in OPERATIONS.items():
            often = calls.get(name, 1)
            pair = [_seconds(one, operation, often) for one in ((new, old) if number % 2 else (old, new))]
            if number == 0:  # a warm-up, which also shows how often to repeat the call
                calls.setdefault(name, min(MOST_CALLS, max(1, round(ROUND_S / max(pair)))))
            else:
                found[name].append((pair[0], pair[1]) if number % 2 else (pair[1], pair[0]))
    return found


def _seconds(one: MeasuredQueue, operation: Callable[[MeasuredQueue], object], often: int) -> float:
    begun = one.processor_s()
    for _ in range(often):
        operation(one)
    return (one.processor_s() - begun) / often


def _row(database: str, jobs: int, operation: str, times: Sequence[tuple[float, float]]) -> Row:
    ratios = sorted(new / old for new, old in times)
    ratio = statistics.median(ratios)
    new_ms, old_ms = (statistics.median(column) * 1e3 for column in zip(*times, strict=True))
    return Row(
        f"queue after a year: {operation}",
        f"{database}, {jobs:,} ended jobs, {len(times)} pairs",
        f"{old_ms:.2f} ms of processor time",
        f"Marey with {FEW_JOBS:,} ended jobs: {new_ms:.2f} ms; pairs {ratios[1]:.2f} to {ratios[-2]:.2f}",
        ratio,
        f"≥ {GOAL}x",
        ratio >= GOAL,
    )


def main() -> int:
    """Print the rows; return the exit status 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_year_old_queue", description=__doc__)
    parser.add_argument("--jobs", type=int, default=ENDED_JOBS, help="number of ended jobs (default: %(default)s)")
    parser.add_argument(
        "--databases",
        nargs="*",
        default=("SQLite", "Postgres"),
        help="databases to measure: SQLite, Postgres (default: both)",
    )
    parser.add_argument("--event-days", type=int, default=365, help="days with events (default: 365); fewer save space")
    arguments = parser.parse_args()
    for row in run(arguments.jobs, arguments.databases, arguments.event_days):
        print(f"{row.job:45} {row.size:40} {row.ratio:6.2f}x  {row.ours}; {row.peer}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
