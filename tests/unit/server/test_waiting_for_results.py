"""Jobs that wait for the result of an identical job: the choice of this job, and the outcome if there is no result."""

from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from sqlalchemy import select, update
from tests.support.queue_desk import Desk

from marey_schemas.access import MemberChange, Role, UserCreate
from marey_schemas.queue.jobs import JobCreate
from marey_server.access.principal import SYSTEM
from marey_server.store import members, users
from marey_server.store.jobs import propagation, result_cache
from marey_server.store.jobs.reaper import share_waiting
from marey_server.store.retention import Retention, retire
from marey_server.store.tables import staged_output
from marey_server.store.transaction import Transaction

GPU = {"gpu": "a100"}
BIG_GPU = {"gpu": "a100", "memory": "large"}
AT_ONCE = 3
"""Greatest number of jobs that get a shared result in one transaction, with the fixture `few_at_once`."""


@pytest.fixture
def few_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the number of jobs that get a shared result in one transaction to `AT_ONCE`."""
    monkeypatch.setattr(result_cache, "SHARED_AT_ONCE", AT_ONCE)


def submit(desk: Desk, **fields: Any) -> str:
    """Submit a job of the kind `sum`; all of these jobs are identical."""
    return desk.submit("sum", **fields)


def source(desk: Desk, job: str) -> str | None:
    """Return the job for whose result a job waits, or None if the job is queued."""
    found = desk.job(job)
    assert found.state == ("queued" if found.cached_from is None else "waiting")
    return found.cached_from


# -- which job --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second", "waits"),
    [
        ({"labels": GPU}, {}, False),
        ({"labels": BIG_GPU}, {"labels": GPU}, False),
        ({"labels": {"gpu": "a10"}}, {"labels": GPU}, False),
        ({"labels": GPU}, {"labels": GPU}, True),
        ({"labels": GPU}, {"labels": BIG_GPU}, True),
        ({}, {"labels": GPU}, True),
        ({"priority": -1}, {}, False),
        ({"priority": 1}, {}, True),
        ({"concurrency_key": "press"}, {}, False),
        ({"concurrency_key": "press"}, {"concurrency_key": "press"}, True),
        ({}, {"concurrency_key": "press"}, True),
    ],
)
@pytest.mark.parametrize("together", [False, True], ids=["separately", "in-one-request"])
def test_a_job_waits_only_for_an_identical_one_that_runs_no_later_than_itself(
    desk: Desk, first: dict[str, Any], second: dict[str, Any], waits: bool, together: bool
) -> None:
    if together:
        one, two = desk.submit_many(JobCreate(kind="sum", **first), JobCreate(kind="sum", **second))
    else:
        one, two = submit(desk, **first), submit(desk, **second)
    assert source(desk, two) == (one if waits else None)


def test_a_job_without_labels_ends_although_no_worker_takes_the_identical_one_with_labels(desk: Desk) -> None:
    idle = submit(desk, labels=GPU)
    desk.complete(desk.claim(job=submit(desk)))
    assert desk.claim_many() == []
    assert desk.state(idle) == "queued"
    assert desk.state(submit(desk, labels=GPU)) == "succeeded"


def test_a_job_waits_for_one_of_lower_priority_that_a_worker_runs_already(desk: Desk) -> None:
    first = submit(desk, priority=-1)
    lease = desk.claim()
    urgent, labelled = submit(desk), submit(desk, labels=GPU)
    assert (source(desk, urgent), source(desk, labelled)) == (first, first)
    desk.complete(lease)
    assert (desk.state(urgent), desk.state(labelled)) == ("succeeded", "succeeded")


def test_a_job_waits_for_none_that_runs_on_a_worker_with_other_labels(desk: Desk) -> None:
    submit(desk, labels=GPU)
    desk.claim(labels=GPU)  # if this worker is lost, no other may come
    assert source(desk, submit(desk)) is None


def test_a_job_does_not_wait_while_an_identical_one_waits_for_its_next_attempt(desk: Desk) -> None:
    failed = submit(desk)
    desk.fail(desk.claim())
    assert source(desk, submit(desk, priority=-1)) is None
    desk.clock.advance(desk.policy.longest_backoff_s)
    assert source(desk, submit(desk)) == failed


def test_of_several_identical_jobs_the_next_waits_for_the_one_that_runs_first(desk: Desk) -> None:
    submit(desk, labels=GPU)
    submit(desk)
    urgent = submit(desk, priority=5)
    assert source(desk, submit(desk)) == urgent


def test_the_tasks_of_a_divided_job_are_no_longer_waited_for_than_single_jobs(desk: Desk) -> None:
    desk.things(2)
    fields: dict[str, Any] = {"params": {"number": 2}, "inputs": {"things": {"collection": "raw"}}}
    desk.submit("survey", labels=GPU, **fields)
    plain = desk.submit("survey", **fields)
    assert desk.job(plain).children == {"queued": 2}
    low = desk.submit("survey", priority=-1, **fields)
    assert source(desk, low) == plain


def test_a_divided_job_is_not_waited_for_if_its_tasks_wait_for_a_concurrency_key(desk: Desk) -> None:
    desk.things(2)
    fields: dict[str, Any] = {"params": {"number": 2}, "inputs": {"things": {"collection": "raw"}}}
    submit(desk, concurrency_key="press")
    desk.claim()
    keyed = desk.submit("survey", concurrency_key="press", **fields)
    plain = desk.submit("survey", **fields)
    assert desk.job(plain).children == {"queued": 2}
    assert source(desk, desk.submit("survey", concurrency_key="press", **fields)) in (keyed, plain)


def test_a_job_becomes_ready_and_does_not_wait_for_one_with_labels(desk: Desk) -> None:
    gate = desk.submit()
    behind = submit(desk, after=[gate])
    submit(desk, labels=GPU)
    desk.complete(desk.claim())
    assert source(desk, behind) is None


# -- results that a job cannot have -----------------------------------------------------------------------------------


LONG_PATH = "/".join(["long" * 50] * 5)
"""Path of a folder that is so long that a subfolder with a name of 20 letters would exceed the limit for paths."""


def states(desk: Desk, jobs: list[str]) -> dict[str, int]:
    """Return the number of the jobs in each state."""
    return Counter(map(desk.state, jobs))


def share_rest(desk: Desk) -> None:
    """Let the server give waiting jobs the results that exist."""
    while desk.database.write(SYSTEM, share_waiting):
        pass


def change_drafts(desk: Desk, **values: Any) -> None:
    """Overwrite members of the staged drafts that other jobs would share."""

    def act(tx: Transaction) -> None:
        for row in tx.execute(select(staged_output)).all():
            of_row = (staged_output.c.job_id == row.job_id, staged_output.c.name == row.name)
            tx.execute(update(staged_output).where(*of_row).values(draft=row.draft | values))

    desk.database.write(SYSTEM, act)


def test_of_jobs_that_cannot_have_a_shared_result_one_computes_and_the_others_wait_for_it(desk: Desk) -> None:
    submit(desk)
    misplaced = [submit(desk, into=LONG_PATH) for _ in range(3)]
    lease = desk.claim()
    desk.stage(lease, "total", collection="deep" * 5)
    desk.complete(lease)
    assert states(desk, misplaced) == {"queued": 1, "waiting": 2}
    (lease,) = desk.claim_many()
    desk.stage(lease, "total")
    desk.complete(lease)
    assert states(desk, misplaced) == {"succeeded": 3}
    assert [desk.job(job).cached_from for job in misplaced].count(lease.job) == 2


@pytest.mark.usefixtures("few_at_once")
def test_of_jobs_whose_shared_result_was_deleted_one_computes_and_the_others_wait_for_it(desk: Desk) -> None:
    submit(desk)
    waiting = [submit(desk, into=f"place{number}") for number in range(AT_ONCE + 3)]
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease)
    change_drafts(desk, parts={"character": f"sha256:{'0' * 64}"})
    share_rest(desk)
    assert states(desk, waiting) == {"succeeded": AT_ONCE, "queued": 1, "waiting": 2}
    assert states(desk, [submit(desk, into="new")]) == {"waiting": 1}
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease)
    assert states(desk, waiting) == {"succeeded": len(waiting)}


@pytest.mark.usefixtures("few_at_once")
@pytest.mark.parametrize("draft", [{"reuse": None, "kind": "no-kind"}, {"sources": {"things": [["item_1", 1]]}}])
def test_a_result_stored_in_a_form_that_cannot_be_read_is_computed_again(desk: Desk, draft: dict[str, Any]) -> None:
    submit(desk)
    waiting = [submit(desk, into=f"place{number}") for number in range(AT_ONCE + 2)]
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease)
    change_drafts(desk, **draft)
    share_rest(desk)
    assert states(desk, waiting[AT_ONCE:]) == {"queued": 1, "waiting": 1}


@pytest.mark.usefixtures("few_at_once")
def test_a_waiting_job_whose_source_was_deleted_because_it_was_old_computes_the_result(desk: Desk) -> None:
    submit(desk)
    desk.complete(desk.claim())
    waiting = desk.submit_many(*[JobCreate(kind="sum")] * (AT_ONCE + 2))[AT_ONCE:]
    assert states(desk, waiting) == {"waiting": 2}
    desk.clock.advance(3 * 86400)
    retire(desk.database, Retention(jobs_days=1))
    share_rest(desk)
    assert states(desk, waiting) == {"queued": 1, "waiting": 1}


# -- results that depend on more than the inputs ----------------------------------------------------------------------


def test_a_result_that_depends_on_more_than_the_inputs_is_not_shared_later(desk: Desk) -> None:
    submit(desk)
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease, shareable=False)
    assert [one.name for one in desk.outputs(lease.job)] == ["total"]
    again = submit(desk)
    assert desk.job(again).cached_from is None
    desk.complete(desk.claim())
    assert desk.job(submit(desk)).cached_from == again


def test_jobs_that_waited_for_a_result_that_is_not_shared_compute_it_side_by_side(desk: Desk) -> None:
    submit(desk)
    waiting = [submit(desk), submit(desk)]
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease, shareable=False)
    assert states(desk, waiting) == {"queued": 2}
    for lease in desk.claim_many():
        desk.stage(lease, "total")
        desk.complete(lease, shareable=False)
    assert states(desk, waiting) == {"succeeded": 2}
    assert {len(desk.outputs(job)) for job in waiting} == {1}


def test_a_result_that_is_not_shared_is_not_shared_later_either(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 2)
    submit(desk)
    waiting = [submit(desk) for _ in range(5)]
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease, shareable=False)
    assert states(desk, waiting) == {"queued": 2, "waiting": 3}
    while desk.database.write(SYSTEM, propagation.propagate_rest):
        pass
    assert states(desk, waiting) == {"queued": 5}


def test_the_result_of_a_worker_with_another_version_of_the_kind_is_not_shared(desk: Desk) -> None:
    submit(desk)
    waiting = submit(desk)
    desk.complete(desk.claim(), code_version="sum@0")
    lease = desk.claim()
    assert lease.job == waiting
    desk.complete(lease, code_version="sum@1")
    assert desk.job(submit(desk)).cached_from == waiting


@pytest.mark.parametrize("shareable", [False, True])
def test_a_result_gathered_from_tasks_is_shared_only_if_the_results_of_all_tasks_may_be(
    desk: Desk, shareable: bool
) -> None:
    desk.things(2)
    fields: dict[str, Any] = {"params": {"number": 2}, "inputs": {"things": {"collection": "raw"}}}
    first = desk.submit("survey", **fields)
    one, two = desk.claim_many()
    desk.complete(one)
    desk.complete(two, shareable=shareable)
    desk.complete(desk.claim())
    assert desk.state(first) == "succeeded"
    again = desk.job(desk.submit("survey", **fields))
    assert (again.state, again.cached_from) == (("succeeded", first) if shareable else ("running", None))


@pytest.mark.usefixtures("few_at_once")
def test_a_task_whose_source_was_released_before_its_turn_gets_no_empty_result(desk: Desk) -> None:
    desk.things(1)
    fields: dict[str, Any] = {"params": {"number": 2}, "inputs": {"things": {"collection": "raw"}}}
    gate = desk.submit()
    surveys = [desk.submit("survey", after=[gate], into=f"place{n}", **fields) for n in range(AT_ONCE + 2)]
    desk.complete(desk.claim(job=gate))
    for number, lease in enumerate(desk.claim_many()):
        desk.stage(lease, f"piece{number}")
        desk.complete(lease)
    (late,) = [job for job in surveys if desk.job(job).children == {"waiting": 2}]
    for lease in desk.claim_many():
        desk.complete(lease)
    share_rest(desk)
    assert desk.job(late).children == {"queued": 2}


def test_a_job_whose_author_lost_the_role_gets_no_shared_result(desk: Desk) -> None:
    ann = desk.user
    made = desk.database.write(SYSTEM, users.create_user, UserCreate(name="bob"))
    desk.database.write(ann, members.put_member, "lab", "bob", MemberChange(role=Role.OWNER))
    submit(desk)
    desk.user = replace(ann, user_id=made.id, user_name="bob", token_id="token_bob")
    waiting = submit(desk)
    desk.user = ann
    desk.database.write(ann, members.put_member, "lab", "bob", MemberChange(role=Role.READER))
    desk.complete(desk.claim(), result={"secret": 7})
    assert (desk.state(waiting), desk.job(waiting).result) == ("queued", None)
    desk.claim()
    desk.clock.advance(desk.policy.lease_ttl_s + 1)
    desk.reap()
    failure = desk.job(waiting).failure
    assert failure is not None
    assert failure.code == "author-lost-access"


def test_sharing_reads_no_jobs_but_those_that_share_results(desk: Desk) -> None:
    if not desk.database.is_sqlite:
        return  # Postgres chooses a plan by the sizes of tables, and small ones it reads whole
    submit(desk)
    waiting = [submit(desk) for _ in range(3)]
    assert None not in {source(desk, one) for one in waiting}
    run: list[str] = []

    def share(tx: Transaction) -> list[str]:
        driver: Any = tx.connection.connection.driver_connection
        driver.set_trace_callback(run.append)
        share_waiting(tx)
        result_cache._compute_again(tx, waiting)
        driver.set_trace_callback(None)
        read = [text for text in run if text.startswith(("SELECT", "UPDATE", "DELETE"))]
        return [str(step[3]) for text in read for step in driver.execute(f"EXPLAIN QUERY PLAN {text}")]

    plan = desk.database.write(SYSTEM, share)
    assert any("ix_job_cache" in step for step in plan)
    assert not [step for step in plan if step.startswith("SCAN job") or "ix_job_listing" in step]
