"""A queue with many ended jobs: lists and sweeps find their rows by index, so that they stay as quick as in a new one.

Postgres chooses plans by the sizes of tables, and reads small ones whole. So the tests forbid it to do this, and to
sort: what remains shows whether an index could serve a statement.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from itertools import combinations, product
from typing import Any

import pytest
from sqlalchemy import Connection, event
from tests.support.queue_desk import Desk

from marey_schemas.queue.jobs import ItemInput, JobCreate, JobState
from marey_server.errors import NotFoundProblem
from marey_server.store import garbage, retention
from marey_server.store.database.clock import DAY_US
from marey_server.store.ids import first_id_at, new_id
from marey_server.store.jobs.reading import JobFilters, list_jobs
from marey_server.store.monitoring.demand import JobReach, read_demand
from marey_server.store.retention import DELETED_LOG, Retention, retire
from marey_server.store.tables import HAS_LONG_LOG
from marey_server.store.transaction import Transaction

_ONLY_BY_INDEX = "SET LOCAL enable_seqscan = off; SET LOCAL enable_sort = off; SET LOCAL enable_bitmapscan = off"
RUNNING, QUEUED, FAILED, SUCCEEDED = JobState.RUNNING, JobState.QUEUED, JobState.FAILED, JobState.SUCCEEDED


def plan_of(desk: Desk, act: Callable[[Transaction], object]) -> str:
    """Return the plans of the statements that `act` runs with `Transaction.execute`."""

    def explained(tx: Transaction) -> str:
        run: list[tuple[str, Any]] = []

        def note(connection: Connection, _cursor: Any, text: str, values: Any, *_: Any) -> None:
            run.append((text, values))

        event.listen(tx.connection, "after_cursor_execute", note)
        act(tx)
        event.remove(tx.connection, "after_cursor_execute", note)
        if tx.is_postgres:
            tx.connection.exec_driver_sql(_ONLY_BY_INDEX)
        explain = "EXPLAIN" if tx.is_postgres else "EXPLAIN QUERY PLAN"
        steps = (step for text, values in run for step in tx.connection.exec_driver_sql(f"{explain} {text}", values))
        return "\n".join(str(step[-1]) for step in steps)

    return desk.database.write(desk.user, explained)


LISTS = [
    (JobFilters(), "-created_at", "created"),
    (JobFilters(), "created_at", "created"),
    (JobFilters((SUCCEEDED,)), "-created_at", "created"),
    (JobFilters((FAILED,)), "-created_at", "state"),
    (JobFilters((RUNNING, QUEUED)), "-created_at", "state"),
    (JobFilters((RUNNING,), ("errand",)), "-created_at", "state"),
    (JobFilters(kinds=("errand", "sum")), "-created_at", "kind"),
    (JobFilters((FAILED,), ("errand",)), "-created_at", "kind"),
    (JobFilters(author="ann"), "-created_at", "author"),
    (JobFilters(), "-priority", "priority"),
]
"""Filters of lists, their orders, and the indexes in which the databases find their jobs."""


def test_a_page_of_jobs_is_read_in_the_order_of_an_index(desk: Desk) -> None:
    desk.submit_many(*(JobCreate(kind="errand") for _ in range(2)))
    for filters, sort, index in LISTS:
        first = desk.database.read(desk.user, list_jobs, desk.project, filters, sort=sort, limit=1)
        for cursor in {None, first.next_cursor}:
            plan = plan_of(
                desk, partial(list_jobs, project=desk.project, filters=filters, sort=sort, cursor=cursor, limit=1)
            )
            if desk.database.is_sqlite or index in ("created", "priority"):  # the others are equal in a small table
                assert f"ix_job_list_{index} " in plan, (filters, sort, plan)
            assert "SCAN job" not in plan
            assert "Seq Scan on job" not in plan


def test_the_pages_of_a_list_contain_the_jobs_that_its_filters_name_in_order(desk: Desk) -> None:
    made = [
        desk.submit(kind, priority=number % 3, params={"number": number})
        for number, kind in enumerate(["errand", "sum", "rig"] * 4)
    ]
    for lease in desk.claim_many(3):
        desk.complete(lease)
    for lease in desk.claim_many(3):
        desk.fail(lease)
    desk.cancel(made[-1])
    every = [desk.job(one) for one in made]
    by_state = [filters for size in (1, 2, 6) for filters in combinations(JobState, size)]
    for states, kinds in product([(), *by_state], [(), ("sum",), ("rig", "errand", "rig")]):
        wanted = [one for one in every if one.state in (states or JobState) and one.kind in (kinds or (one.kind,))]
        filters = JobFilters(states, kinds, author="ann" if len(states) == 2 else None)
        order = sorted(wanted, key=lambda one: (one.created_at, one.id), reverse=True)
        assert walked(desk, filters) == [one.id for one in order]
    assert walked(desk, JobFilters(author="bob")) == []


def walked(desk: Desk, filters: JobFilters) -> list[str]:
    """Return the ids of the jobs in all pages of a list, read two at a time; check the count of the first page."""
    found: list[str] = []
    page = desk.database.read(desk.user, list_jobs, desk.project, filters, limit=2, count=True)
    count = page.count
    while True:
        found += [one.id for one in page.items]
        if page.next_cursor is None:
            assert len(found) == count
            return found
        page = desk.database.read(desk.user, list_jobs, desk.project, filters, limit=2, cursor=page.next_cursor)


def test_sweeps_and_counts_look_up_what_is_old_or_runs(desk: Desk) -> None:
    def sweep(tx: Transaction) -> None:
        retention._old_jobs(tx, DAY_US, "")
        retention._old_logs(tx, DAY_US, ("", 0))
        garbage._staged_documents(tx)
        read_demand(tx, JobReach({}), ["w"], 10)

    plan = plan_of(desk, sweep)
    assert "ix_attempt_log" in plan
    if desk.database.is_sqlite:  # Postgres also reads small tables by the whole of an index
        scans = [step for step in plan.splitlines() if step.startswith(("SCAN job", "SCAN attempt"))]
        assert scans == ["SCAN job USING INDEX ix_job_expiry"], "which contains the running jobs only"
        assert "SEARCH job USING INDEX sqlite_autoindex_job_1 (id>? AND id<?)" in plan


def test_the_index_of_logs_contains_those_that_are_longer_than_the_text_that_replaces_them() -> None:
    assert HAS_LONG_LOG.text == f"log_bytes > {len(DELETED_LOG)}"


def test_an_id_of_a_time_sorts_before_the_ids_that_are_made_later() -> None:
    now_us = time.time_ns() // 1000
    assert first_id_at("job", now_us - 1000) < new_id("job") < first_id_at("job", now_us + DAY_US)


def test_old_jobs_are_deleted_although_a_job_waits_for_a_task_of_another_one(desk: Desk) -> None:
    things = tuple(ItemInput(item=thing) for thing in desk.things(3))
    whole = desk.submit("square", inputs={"things": things})
    leases = desk.claim_many()
    desk.submit("rig", after=(leases[0].job,))
    for lease in leases:
        desk.stage(lease, f"square of {lease.position}")
        desk.complete(lease)
    alone = desk.submit()
    desk.complete(desk.claim(kinds=("errand",)))
    desk.clock.advance(11 * DAY_US / 1_000_000)
    assert retire(desk.database, Retention(jobs_days=9)).jobs == 1
    with pytest.raises(NotFoundProblem):
        desk.job(alone)
    assert desk.job(whole).state == SUCCEEDED
