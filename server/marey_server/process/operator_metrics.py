"""Metrics about the queue, workers and stored data, for operators.

Counters count events in this process. Numbers from the database are the same in all processes that share the database.
A request to /metrics starts a new read of these numbers if at least `REFRESH_S` seconds, and 20 times the duration of
the last read, have passed since that read. The request does not wait: it shows the last numbers, with their age.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from marey_server.store.monitoring.figures import Figures
from marey_server.store.transaction import Observer

REFRESH_S = 10.0
REST = 20
"""Least time between two reads of the database: `REST` times the duration of the last read, at least `REFRESH_S`."""
_CLAIM_DELAYS_S = (0.01, 0.05, 0.1, 0.5, 1, 5, 30, 120, 600, 3600, 6 * 3600, 86400)


class OperatorMetrics(Observer):
    """Metrics about the queue, workers and stored data.

    The database calls an object of this class to count claims, ends of jobs, and lost leases in this process.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        self._add_jobs(registry)
        self._add_stored(registry)
        self.feed_age = Gauge(
            "marey_events_lag_seconds", "Time since this process last read the feed of events to its end; normally "
            "less than 3 seconds.", registry=registry,
        )  # fmt: skip
        self.figures_age = Gauge(
            "marey_figures_age_seconds", "Age of the numbers of jobs, workers, uploads, stored bytes and the database. "
            "A request for metrics shows the numbers that were read for an earlier request.", registry=registry,
        )  # fmt: skip
        self.has_figures = False
        """True if numbers were read from the database since the start."""
        self._feed_read_s = self._figures_read_s = time.monotonic()
        self._next_read_s = 0.0
        self.feed_age.set_function(lambda: time.monotonic() - self._feed_read_s)
        self.figures_age.set_function(lambda: time.monotonic() - self._figures_read_s)

    def _add_jobs(self, registry: CollectorRegistry) -> None:
        self.jobs_queued = Gauge(
            "marey_jobs_queued", "Jobs in the queue by kind, including those that wait for a retry. `labels` is `some` "
            "if the jobs require labels of their worker, otherwise `none`.", ("kind", "labels"), registry=registry,
        )  # fmt: skip
        self.oldest_age = Gauge(
            "marey_oldest_queued_job_age_seconds", "Longest time for which a queued job could have run, by kind and "
            "`labels` as for `marey_jobs_queued`.", ("kind", "labels"), registry=registry,
        )  # fmt: skip
        self.jobs_running = Gauge("marey_jobs_running", "Jobs that workers run, by kind.", ("kind",), registry=registry)
        self.workers = Gauge(
            "marey_workers", "Workers that run jobs, or that claimed jobs from this server in the last minute. "
            "`version` is the version of the server, `other`, or `unknown` (the worker claims jobs from another "
            "server).", ("version",), registry=registry,
        )  # fmt: skip
        self.jobs_ended = Counter(
            "marey_jobs_ended", "Jobs that ended, by state (succeeded, failed or cancelled) and by the reason of a "
            "failure; `none` if the job did not fail.", ("state", "reason"), registry=registry,
        )  # fmt: skip
        self.attempts_lost = Counter(
            "marey_leases_lost", "Attempts that ended because their lease expired.", registry=registry
        )
        self.jobs_requeued = Counter(
            "marey_jobs_requeued", "Retries of jobs, by outcome of the attempt before: failed, interrupted or lost.",
            ("outcome",), registry=registry,
        )  # fmt: skip
        self.claim_delay = Histogram(
            "marey_claim_delay_seconds", "Time from when a job could run to its claim by a worker.",
            buckets=_CLAIM_DELAYS_S, registry=registry,
        )  # fmt: skip

    def _add_stored(self, registry: CollectorRegistry) -> None:
        self.uploads = Gauge("marey_upload_sessions", "Unfinished uploads.", registry=registry)
        self.stored_bytes = Gauge(
            "marey_stored_bytes", "Bytes that the quotas of all projects count, by storage of new blobs (database, "
            "directory or s3): a part of an item counts in each revision that changed it. Bytes that several items or "
            "projects share are stored once, but count for each of them. Deleted items take space until they are "
            "purged, but do not count. `marey_database_bytes` shows the space that is taken.", ("backing",),
            registry=registry,
        )  # fmt: skip
        self.database_bytes = Gauge(
            "marey_database_bytes", "Space that the database takes on its disk, including free space inside it. Blobs "
            "in the folder `blobs` are not part of it.", registry=registry,
        )  # fmt: skip
        self.disk_free = Gauge("marey_disk_free_bytes", "Free bytes on the disk of the data folder.", registry=registry)
        self.disk_floor = Gauge(
            "marey_disk_min_free_bytes", "Free bytes below which nothing is stored: the setting min_free_bytes.",
            registry=registry,
        )  # fmt: skip

    def watch_disk(self, folder: Path, floor_bytes: int) -> None:
        """Show the free space of the disk that holds `folder`, and the free space below which nothing is stored."""
        self.disk_floor.set(floor_bytes)
        self.disk_free.set_function(lambda: shutil.disk_usage(folder).free if folder.exists() else 0)

    def note_feed(self) -> None:
        """Record that this process has just read the feed of events to its end."""
        self._feed_read_s = time.monotonic()

    @property
    def is_due(self) -> bool:
        """True if the numbers are so old that they may be read again."""
        return time.monotonic() >= self._next_read_s

    def rest(self, duration_s: float) -> None:
        """Set the time before which the numbers are not read again, after a read that took `duration_s` seconds."""
        self._next_read_s = time.monotonic() + max(REFRESH_S, REST * duration_s)

    def show(self, figures: Figures, backing: str) -> None:
        """Set the metrics to numbers read from the database; `backing` is the kind of storage for blobs."""
        self.has_figures, self._figures_read_s = True, time.monotonic()
        _replace(self.jobs_queued, {key: one.count for key, one in figures.queued.items()})
        _replace(self.oldest_age, {key: one.oldest_age_s for key, one in figures.queued.items()})
        _replace(self.jobs_running, {(kind,): count for kind, count in figures.running.items()})
        _replace(self.workers, {(version,): count for version, count in figures.workers.items()})
        self.uploads.set(figures.uploads)
        self.stored_bytes.labels(backing).set(figures.stored_bytes)
        self.database_bytes.set(figures.database_bytes)

    def count_ended(self, state: str, reason: str | None) -> None:
        """Count a job that has ended in the state `state`; `reason` is the reason of its failure, if it has failed."""
        self.jobs_ended.labels(state, reason or "none").inc()

    def count_requeued(self, outcome: str) -> None:
        """Count a job that is queued again after an attempt with this outcome."""
        self.jobs_requeued.labels(outcome).inc()

    def count_lost_lease(self) -> None:
        """Count an attempt whose lease has expired."""
        self.attempts_lost.inc()

    def observe_claims(self, delays_s: Sequence[float]) -> None:
        """Record for each claimed job how many seconds it had waited since the time from which it could run."""
        for delay_s in delays_s:
            self.claim_delay.observe(delay_s)


def _replace(gauge: Gauge, values: Mapping[tuple[str, ...], float]) -> None:
    """Set the values of a gauge by their labels; combinations of labels that are not in `values` become 0."""
    for shown in gauge.collect():
        for sample in shown.samples:
            gauge.labels(**sample.labels).set(0)
    for labels, value in values.items():
        gauge.labels(*labels).set(value)
