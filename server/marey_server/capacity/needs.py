"""Needs of an amount of clips: seconds of workers, servers and database, and the part that saturates first."""

from __future__ import annotations

from dataclasses import dataclass

from marey_server.capacity.costs import MeasuredCosts
from marey_server.store.jobs.policy import DEFAULT_POLICY

HEARTBEAT_SHARE = 0.5
"""Server time of a heartbeat, as a share of the server time of a job: a heartbeat is one write, a job needs two."""


@dataclass(frozen=True)
class PlannedWork:
    """Planned work and available machines: clips to import and process within a number of days.

    Each worker runs one job at a time. All servers use the same Postgres database.
    """

    clips: int = 10_000_000
    jobs_per_clip: float = 1.0
    clip_bytes: float = 500_000.0
    days: float = 30.0
    workers: int = 1000
    servers: int = 100
    database_processors: int = 8

    def __post_init__(self) -> None:
        amounts = (self.clips, self.clip_bytes, self.days, self.workers, self.servers, self.database_processors)
        if min(amounts) <= 0 or self.jobs_per_clip < 0:
            raise ValueError("all amounts must be greater than 0; only the jobs per clip may be 0")


@dataclass(frozen=True)
class InstalledPart:
    """Part of an installation: the seconds of its processors or workers that the work needs, and those available."""

    name: str
    needed_s: float
    available_s: float

    @property
    def share(self) -> float:
        """The share of the available time that is needed; above 1, the part is saturated."""
        return self.needed_s / self.available_s


@dataclass(frozen=True)
class Needs:
    """Computed needs: the parts, the busiest one first, and the bytes to store."""

    parts: tuple[InstalledPart, ...]
    blob_bytes: float
    database_bytes: float
    clips_per_day: float

    @property
    def first(self) -> InstalledPart:
        """The part that saturates first."""
        return self.parts[0]


def compute_needs(costs: MeasuredCosts, demand: PlannedWork) -> Needs:
    """Compute the needs of the work in `demand`, which is assumed to be spread evenly over its days.

    `clips_per_day` of the result is the number of clips per day at which the first part is saturated. Heartbeats are
    counted only while workers run jobs.
    """
    period_s = demand.days * 24 * 3600
    jobs = demand.clips * demand.jobs_per_clip
    work_s = jobs * costs.clip.worker_s
    heartbeats = work_s / DEFAULT_POLICY.heartbeat_s
    busy_s = jobs * costs.job.busy_s + heartbeats * HEARTBEAT_SHARE * costs.job.busy_s
    upload_s = demand.clips * (costs.clip.import_s + demand.clip_bytes * costs.byte.upload_s)
    waits_s = jobs * (costs.job.claim_s + costs.job.complete_s)
    database_s = (jobs + heartbeats * HEARTBEAT_SHARE + demand.clips) * costs.job.database_s
    parts = (
        InstalledPart("workers", work_s + waits_s, demand.workers * period_s),
        InstalledPart("servers", busy_s + upload_s, demand.servers * period_s),
        InstalledPart("database", database_s, demand.database_processors * period_s),
    )
    ordered = tuple(sorted(parts, key=lambda part: part.share, reverse=True))
    return Needs(
        ordered,
        blob_bytes=demand.clips * (costs.clip.stored_bytes * (1 + demand.jobs_per_clip) + demand.clip_bytes),
        database_bytes=jobs * costs.job.database_bytes,
        clips_per_day=demand.clips / demand.days / ordered[0].share,
    )
