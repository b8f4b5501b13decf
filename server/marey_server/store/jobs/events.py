"""Events of jobs, many in one statement, and the wake-ups of waiting requests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from marey_schemas.event_kinds import OrdinaryEventKind
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import job_topic, wakeups, work_topic

EventOfJob = tuple[str, str, dict[str, Any]]
"""Project id, job id and body of an event."""


def emit_job_events(tx: Transaction, kind: OrdinaryEventKind, events: Sequence[EventOfJob]) -> None:
    """Record one event per job, visible when the transaction commits."""
    tx.emit_each((kind, *one) for one in events)


def wake_workers(tx: Transaction, kinds: Iterable[str]) -> None:
    """After the commit, wake the requests that wait for work of these kinds."""
    topics = {work_topic(kind) for kind in kinds}
    if topics:
        tx.after_commit(lambda: wakeups.announce(topics))


def wake_watchers(tx: Transaction, job_ids: Iterable[str]) -> None:
    """After the commit, wake the requests that wait for the end of these jobs."""
    topics = {job_topic(job_id) for job_id in job_ids}
    if topics:
        tx.after_commit(lambda: wakeups.announce(topics))
