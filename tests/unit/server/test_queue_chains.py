"""Connected jobs: dependencies, fan-outs, shared results, and retries."""

import asyncio
import re
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import pytest
from sqlalchemy import event, select, update
from tests.support.present import present
from tests.support.queue_desk import SUM, Desk, document
from tests.support.store_fixtures import declared, requiring

from marey_schemas.access import MemberChange, ProjectCreate, Role, UserCreate
from marey_schemas.kinds import Kind
from marey_schemas.queue import job_kinds
from marey_schemas.queue.jobs import ItemInput, JobCreate, JobState, Progress
from marey_schemas.queue.worker_protocol import Lease
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    LeaseLostProblem,
    NotFoundProblem,
    UnavailableProblem,
)
from marey_server.store import blobs, events, garbage, items, members, projects, users
from marey_server.store.database.connections import Database
from marey_server.store.database.prepared import padded
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import propagation, reading, result_cache, retrying
from marey_server.store.jobs.propagation import propagate_rest
from marey_server.store.jobs.reaper import share_waiting
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import staged_output
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import ENDS_TO_PROPAGATE, wakeups

AT_ONCE = 4
"""Greatest number of jobs that get a shared result in one transaction, with the fixture `few_at_once`."""


@pytest.fixture
def few_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the number of jobs that get a shared result in one transaction to `AT_ONCE`."""
    monkeypatch.setattr(result_cache, "SHARED_AT_ONCE", AT_ONCE)


def fail_for_good(desk: Desk, job: str | None = None) -> None:
    desk.fail(desk.claim(job=job), retryable=False, detail="no")


# -- dependencies ------------------------------------------------------------------------------------------------------


def test_a_job_waits_for_those_it_comes_after(desk: Desk) -> None:
    first, second = desk.submit(), desk.submit()
    third = desk.submit(after=[first, second])
    assert desk.state(third) == "waiting"
    one, two = desk.claim_many()
    desk.complete(one)
    assert desk.state(third) == "waiting"
    desk.complete(two)
    assert desk.state(third) == "queued"
    assert desk.claim().job == third


def test_a_job_after_one_that_has_succeeded_need_not_wait(desk: Desk) -> None:
    first = desk.submit()
    desk.complete(desk.claim())
    assert desk.state(desk.submit(after=[first, first])) == "queued"


def test_all_jobs_that_depend_on_one_end_in_few_statements(desk: Desk) -> None:
    """Other writes wait meanwhile, and thousands of jobs may depend on one."""
    first = desk.submit()
    failing = [desk.submit(after=[first]) for _ in range(30)]
    skipped = [desk.submit(after=[first], on_failure="skip") for _ in range(30)]
    after_both = desk.submit(after=[failing[0], skipped[0]])
    lease = desk.claim()
    statements: list[str] = []
    event.listen(desk.database.engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    desk.fail(lease, retryable=False, detail="no")
    assert len(statements) < 40, "\n".join(statements)
    assert {desk.state(one) for one in failing} == {"failed"}
    assert {(desk.state(one), desk.job(one).failure) for one in skipped} == {("cancelled", None)}
    assert present(desk.job(failing[-1]).failure).detail == f"This job needs {first} to succeed, but {first} is failed."
    assert present(desk.job(after_both).failure).reason == "dependency_failed"


def test_what_depends_on_a_failed_job_fails_down_the_chain(desk: Desk) -> None:
    first = desk.submit()
    second = desk.submit(after=[first])
    third = desk.submit(after=[second])
    skipped = desk.submit(after=[first], on_failure="skip")
    fail_for_good(desk)
    for job in (second, third):
        failure = desk.job(job).failure
        assert failure is not None
        assert failure.reason == "dependency_failed"
    assert desk.state(skipped) == "cancelled"
    late = desk.submit(after=[first])
    assert desk.state(late) == "failed"


def test_what_depends_on_a_cancelled_job_fails(desk: Desk) -> None:
    first = desk.submit()
    second = desk.submit(after=[first])
    desk.cancel(first)
    assert desk.state(second) == "failed"


def _graph(desk: Desk, collection: str) -> dict[str, str]:
    """Submit jobs that depend on the job `root` directly and indirectly; return their ids by name."""
    ids = {"root": desk.submit(), "other": desk.submit()}
    things = tuple(ItemInput(item=one) for one in desk.things(4, collection))
    for number in range(12):
        ids[f"chain-{number}"] = desk.submit(after=[ids[f"chain-{number - 1}" if number else "root"]])
    for number in range(12):
        ids[f"wide-{number}"] = desk.submit(after=[ids["root"], ids["other"]])
    ids["skipped"] = desk.submit(after=[ids["wide-3"], ids["chain-2"]], on_failure="skip")
    ids["after skipped"] = desk.submit(after=[ids["skipped"]])
    ids["whole"] = desk.submit("square", inputs={"things": things}, after=[ids["chain-5"]])
    ids["after whole"] = desk.submit(after=[ids["whole"]])
    ids["apart"] = desk.submit(after=[ids["other"]])
    return ids


def _told(desk: Desk, ids: dict[str, str]) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    """Return the states and failures of jobs, and the events of their ends, with names in place of ids."""
    desk.database.write(desk.user, events.number_events)
    feed = desk.database.read(desk.user, events.list_events, desk.project, limit=1000).items
    names = {job_id: name for name, job_id in ids.items()}

    def named(text: str) -> str:
        return re.sub(r"job_\w+", lambda found: names.get(found[0], "?"), text)

    jobs = {name: desk.job(job_id) for name, job_id in ids.items()}
    documents = {
        name: (job.state, job.failure and named(job.failure.model_dump_json()), job.finished_at is not None, job.rev)
        for name, job in jobs.items()
    }
    tasks = desk.database.read(desk.user, reading.list_jobs, desk.project, reading.JobFilters(parent=ids["whole"]))
    names |= {task.id: "task" for task in tasks.items}
    ends = [(one.kind, names[one.subject], one.actor) for one in feed if one.subject in names]
    return documents, [end for end in ends if end[0] in ("job.failed", "job.cancelled", "job.succeeded")]


def _levels(ends: list[tuple[Any, ...]]) -> list[str]:
    """Return the names of the jobs that failed, in order; those that depend on `root` itself have one name.

    The ids of jobs that are submitted within a millisecond have any order.
    """
    return [re.sub(r"^(wide-\d+|chain-0)$", "first level", name) for kind, name, _ in ends if kind == "job.failed"]


def test_the_end_of_a_job_with_many_dependants_is_propagated_in_short_transactions(
    desk: Desk, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = _graph(desk, "raw")
    desk.cancel(whole["root"])
    documents, ends = _told(desk, whole)
    assert len(ends) == len(whole) - 2 + 2  # without `other` and `apart`, but with two tasks
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 4)
    ids = _graph(desk, "more")
    desk.cancel(ids["root"])
    assert [desk.state(ids[name]) for name in ("root", "chain-11", "after whole")] == [
        "cancelled",
        "waiting",
        "waiting",
    ]
    late = desk.submit(after=[ids["root"]])
    assert desk.state(late) == "failed"
    steps = 0
    while open_database().write(SYSTEM, propagate_rest):  # as another process, after the end of this one
        steps += 1
    assert steps >= 8
    in_steps, ends_in_steps = _told(desk, ids)
    assert in_steps == documents
    assert sorted(ends_in_steps) == sorted(ends)
    assert _levels(ends_in_steps) == _levels(ends)
    assert not desk.database.write(SYSTEM, propagate_rest)


def test_dependants_of_a_job_that_succeeds_are_queued_in_short_transactions(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 4)
    first = desk.submit()
    others = [desk.submit(after=[first]) for _ in range(9)]
    desk.complete(desk.claim())
    assert Counter(desk.state(one) for one in others) == {"queued": 4, "waiting": 5}
    while desk.database.write(SYSTEM, propagate_rest):
        pass
    assert Counter(desk.state(one) for one in others) == {"queued": 9}


def _chain(desk: Desk) -> list[str]:
    """Submit 13 jobs of which each depends on the one before."""
    chain = [desk.submit()]
    for _ in range(12):
        chain.append(desk.submit(after=[chain[-1]]))
    return chain


def test_each_step_down_a_chain_counts_as_an_end(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 4)
    chain = _chain(desk)
    desk.cancel(chain[0])
    assert Counter(desk.state(one) for one in chain) == {"cancelled": 1, "failed": 2, "waiting": 10}


def test_ends_that_are_left_wake_housekeeping(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 4)
    chain = _chain(desk)

    async def cancel() -> bool:
        with wakeups.listen([ENDS_TO_PROPAGATE]) as listener:
            desk.cancel(chain[0])
            return await listener.wait(1.0)

    assert asyncio.run(cancel())


def test_jobs_that_end_in_a_later_transaction_come_after_those_that_others_have_left(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 4)
    chains = [_chain(desk) for _ in range(2)]
    for name, chain in zip(("ann", "bea"), chains, strict=True):
        actor = replace(desk.user, user_name=name)
        desk.database.write(actor, reading.cancel_job, chain[0], desk.policy)
    failed = []
    for _ in range(4):
        desk.database.write(SYSTEM, propagate_rest)
        failed.append([sum(desk.state(one) == "failed" for one in chain) for chain in chains])
    assert failed == [[3, 2], [3, 3], [4, 3], [4, 4]]


def test_a_parent_job_ends_with_its_last_task_however_few_ends_a_transaction_propagates(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 1)
    whole = desk.submit("square", inputs={"things": tuple(ItemInput(item=one) for one in desk.things(4))})
    for _ in range(2):
        desk.complete(desk.claim())
    assert desk.state(whole) == "succeeded"
    assert not desk.database.write(SYSTEM, propagate_rest)


def test_a_retry_waits_until_all_dependants_have_ended_and_includes_them(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 2)
    first = desk.submit()
    others = [desk.submit(after=[first]) for _ in range(3)]
    last = desk.submit(after=[others[0]])
    desk.cancel(first)
    for _ in range(3):
        with pytest.raises(UnavailableProblem) as refused:
            desk.database.write(desk.user, retrying.retry_job, first)
        assert (refused.value.error_code, refused.value.headers) == ("still-ending", {"Retry-After": "1"})
        assert desk.database.write(SYSTEM, propagate_rest)
    while desk.database.write(SYSTEM, propagate_rest):
        pass
    desk.database.write(desk.user, retrying.retry_job, first)
    everything = desk.database.read(desk.user, reading.list_jobs, desk.project).items
    assert {one.retry_of for one in everything} == {None, first, *others, last}


@pytest.mark.every_database
def test_more_jobs_than_one_transaction_retries_can_be_retried_one_by_one(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrying, "MOST_AT_ONCE", 3)
    first = desk.submit()
    others = [desk.submit(after=[first]) for _ in range(4)]
    desk.cancel(first)
    for job in (first, others[0]):
        with pytest.raises(ConflictProblem, match=r"More than 3 jobs .* --no-dependants \(") as refused:
            desk.database.write(desk.user, retrying.retry_job, job)
        assert refused.value.error_code == "too-many"
    again = desk.database.write(desk.user, retrying.retry_job, first, dependants=False)
    made = [desk.database.write(desk.user, retrying.retry_job, job) for job in others]
    assert [(job.retry_of, job.after) for job in made] == [(job, (again.id,)) for job in others]
    assert len(desk.database.read(desk.user, reading.list_jobs, desk.project).items) == 2 * 5


@pytest.mark.every_database
def test_dependants_that_are_not_retried_do_not_take_the_places_of_those_that_are(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrying, "MOST_AT_ONCE", 2)
    first = desk.submit()
    cancelled = [desk.submit(after=[first]) for _ in range(3)]
    time.sleep(0.002)  # ids sort by their milliseconds
    last = desk.submit(after=[first])
    for job in (*cancelled, first):
        desk.cancel(job)
    desk.database.write(desk.user, retrying.retry_job, first)
    everything = desk.database.read(desk.user, reading.list_jobs, desk.project).items
    assert {one.retry_of for one in everything} == {None, first, last}


def test_a_job_that_needs_more_jobs_than_one_transaction_retries_is_retried_after_them(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrying, "MOST_AT_ONCE", 2)
    chain = [desk.submit()]
    for _ in range(2):
        chain.append(desk.submit(after=[chain[-1]]))
    desk.cancel(chain[0])
    with pytest.raises(ConflictProblem, match="first retry the jobs on which it depends"):
        desk.database.write(desk.user, retrying.retry_job, chain[-1], dependants=False)
    made = [desk.database.write(desk.user, retrying.retry_job, job, dependants=False) for job in chain]
    assert [job.after for job in made] == [(), (made[0].id,), (made[1].id,)]


@pytest.mark.every_database
def test_a_dependant_that_was_retried_already_is_not_retried_again(desk: Desk) -> None:
    first = desk.submit()
    dependant = desk.submit(after=[first])
    desk.cancel(first)
    for _ in range(2):
        desk.database.write(desk.user, retrying.retry_job, first)
    everything = desk.database.read(desk.user, reading.list_jobs, desk.project).items
    assert Counter(one.retry_of for one in everything) == {None: 2, first: 2, dependant: 1}


@pytest.mark.every_database
def test_a_dependant_of_several_retried_jobs_takes_one_place(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retrying, "MOST_AT_ONCE", 6)
    first = desk.submit()
    second = desk.submit(after=[first])
    others = [desk.submit(after=[first, second]) for _ in range(4)]
    desk.cancel(first)
    desk.database.write(desk.user, retrying.retry_job, second)
    everything = desk.database.read(desk.user, reading.list_jobs, desk.project).items
    assert {one.retry_of for one in everything} == {None, first, second, *others}


@pytest.mark.every_database
def test_dependants_that_still_miss_another_job_do_not_hide_those_that_can_run(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrying, "MOST_AT_ONCE", 3)
    first, other = desk.submit(), desk.submit()
    waiting = [desk.submit(after=[first, other]) for _ in range(7)]
    time.sleep(0.002)  # ids sort by their milliseconds
    ready = [desk.submit(after=[first]) for _ in range(2)]
    for job in (first, other):
        desk.cancel(job)
    desk.database.write(desk.user, retrying.retry_job, first)
    everything = desk.database.read(desk.user, reading.list_jobs, desk.project).items
    assert {one.retry_of for one in everything} == {None, first, *ready}
    assert {desk.state(one) for one in waiting} <= {"failed", "cancelled"}


@pytest.mark.every_database
def test_later_transactions_leave_projects_alone_whose_purges_they_do_not_hold_off(
    desk: Desk, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On SQLite, where writes run one after another, no other write marks jobs meanwhile."""
    if desk.database.is_sqlite:
        return
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 2)
    elsewhere = open_database()
    desk.database.write(desk.user, projects.create_project, ProjectCreate(name="other"))
    chains: list[list[str]] = []
    for desk.project in ("lab", "other"):
        first = desk.submit()
        second = desk.submit(after=[first])
        chains.append([first, second, desk.submit(after=[second])])
    held: list[tuple[str, ...]] = []

    def hold_off_late(tx: Transaction, *ids: str) -> None:
        held.append(ids)
        if len(held) == 1:
            elsewhere.write(desk.user, reading.cancel_job, chains[1][0])
        hold_off_purges(tx, *ids)

    desk.cancel(chains[0][0])
    monkeypatch.setattr(propagation, "hold_off_purges", hold_off_late)
    assert desk.database.write(SYSTEM, propagate_rest)
    assert [desk.state(last) for *_, last in chains] == ["failed", "waiting"]
    while desk.database.write(SYSTEM, propagate_rest):
        pass
    assert [desk.state(last) for *_, last in chains] == ["failed", "failed"]


@pytest.mark.every_database
def test_jobs_that_share_a_result_no_more_are_left_alone_by_later_transactions(
    desk: Desk, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On SQLite, where writes run one after another, nothing happens between two statements of one."""
    if desk.database.is_sqlite:
        return
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 2)
    source = desk.submit("sum")
    others = [desk.submit(after=[source]) for _ in range(2)]
    lease = desk.claim(job=source)
    sharing = [desk.submit("sum") for _ in range(3)]
    desk.complete(lease, shareable=False)
    assert {desk.state(one) for one in others} == {"queued"}
    between, housekeeping = open_database(), open_database()
    shared: list[bool] = []

    def share_first(ids: Collection[str]) -> list[str]:
        if set(sharing) <= set(ids) and not shared:  # the dependants are known, and not locked
            shared.append(True)
            between.write(SYSTEM, share_waiting)
        return padded(ids)

    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 4)
    monkeypatch.setattr(propagation, "padded", share_first)
    while housekeeping.write(SYSTEM, propagate_rest):
        pass
    assert shared
    assert Counter(desk.state(one) for one in sharing) == {"queued": 1, "waiting": 2}
    assert {desk.job(one).cached_from for one in sharing if desk.state(one) == "waiting"} <= set(sharing)


def test_a_job_can_only_come_after_jobs_of_its_project(desk: Desk) -> None:
    with pytest.raises(InvalidProblem) as refused:
        desk.submit(after=["job_nowhere"])
    assert refused.value.errors[0].pointer == "/after/0"


# -- inputs ------------------------------------------------------------------------------------------------------------


def test_inputs_are_pinned_to_the_revisions_of_the_moment(desk: Desk) -> None:
    (thing,) = desk.things(1)
    job = desk.submit("square", inputs={"things": {"item": thing}})
    desk.publish(Draft("again", Kind.CHARACTER, "thing0", {"character": document(number=77)}, "raw"))
    newer = desk.submit("square", inputs={"things": {"item": thing}})
    older = desk.submit("square", inputs={"things": [{"item": thing, "revision": 1}]}, seed=5)
    revisions = {lease.job: lease.inputs["things"][0].revision for lease in desk.claim_many()}
    assert revisions == {job: 1, newer: 2, older: 1}


def test_a_collection_stands_for_all_items_of_the_kind_in_it_and_below(desk: Desk) -> None:
    desk.things(2, "raw")
    desk.things(1, "raw/deep")
    desk.things(1, "rawer")
    desk.things(1, "RAW")
    desk.submit("square", inputs={"things": {"collection": "raw"}})
    leases = desk.claim_many()
    places = sorted((pin.collection, pin.name) for lease in leases for pin in lease.inputs["things"])
    assert places == [("raw", "thing0"), ("raw", "thing1"), ("raw/deep", "thing0")]


@pytest.mark.parametrize(
    ("inputs", "pointer", "code"),
    [
        ({}, "/inputs", "missing-input"),
        ({"things": {"item": "study_none"}}, "/inputs/things/item", "unknown-item"),
        ({"things": [{"collection": "empty"}]}, "/inputs/things/0/collection", "empty-collection"),
        ({"things": []}, "/inputs/things", "empty-input"),
        ({"things": [], "ruler": []}, "/inputs/things", "empty-input"),
        ({"things": {"collection": "raw"}, "others": {"collection": "raw"}}, "/inputs/others", "unknown-input"),
        ({"things": {"collection": "raw"}, "ruler": {"collection": "raw"}}, "/inputs/ruler", "one-item"),
    ],
)
def test_inputs_that_make_no_sense_are_refused_with_their_place(
    desk: Desk, inputs: dict[str, Any], pointer: str, code: str
) -> None:
    desk.things(3)
    with pytest.raises(InvalidProblem) as refused:
        desk.submit("square", inputs=inputs)
    assert [(error.pointer, error.code) for error in refused.value.errors] == [(pointer, code)]


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("tree", {"inputs": {"model": {}}, "into": "elsewhere"}),
        ("edit", {"inputs": {"clips": {}}, "params": {"in_place": True}, "into": "elsewhere"}),
        ("edit", {"inputs": {"clips": {}}}),
    ],
)
def test_a_job_whose_results_have_no_clear_place_is_refused(desk: Desk, kind: str, fields: dict[str, Any]) -> None:
    maker = desk.submit()
    fields["inputs"] = {name: {"job": maker} for name in fields["inputs"]}
    with pytest.raises(InvalidProblem) as refused:
        desk.submit(kind, **fields)
    assert [(error.pointer, error.code) for error in refused.value.errors] == [("/into", "ambiguous-place")]


def test_results_that_would_lie_too_deep_are_refused_before_they_are_made(desk: Desk) -> None:
    desk.things(1, "raw/deep")
    inputs = {"things": {"collection": "raw"}}
    deepest = "/".join(["d" * 202] * 5)  # ten characters remain
    desk.submit("square", inputs=inputs, into=deepest)
    many_bytes = "/".join(["\U0001f9a6" * 255] * 3)
    for kind, given, into in (("square", inputs, f"{deepest}dd"), ("sum", {}, many_bytes)):
        with pytest.raises(InvalidProblem) as refused:
            desk.submit_many(JobCreate(kind="sum"), JobCreate(kind=kind, inputs=given, into=into))
        assert [(error.pointer, error.code) for error in refused.value.errors] == [("/jobs/1/into", "long-path")]
    desk.submit("sum", into=f"{deepest}dd")  # whose results keep no places below it


def test_a_revision_that_does_not_exist_is_refused(desk: Desk) -> None:
    (thing,) = desk.things(1)
    with pytest.raises(InvalidProblem) as refused:
        desk.submit("square", inputs={"things": [{"item": thing, "revision": 2}]})
    assert refused.value.errors[0].pointer == "/inputs/things/0/revision"


def test_one_bad_job_of_a_batch_lets_none_in(desk: Desk) -> None:
    with pytest.raises(InvalidProblem) as refused:
        desk.submit_many(JobCreate(kind="errand"), JobCreate(kind="errand", params={"numbre": 3}))
    assert refused.value.errors[0].pointer == "/jobs/1/params/numbre"
    assert desk.database.read(desk.user, reading.list_jobs, "lab").items == ()
    with pytest.raises(InvalidProblem) as refused:
        desk.submit("unheard-of")
    assert refused.value.errors[0].pointer == "/kind"


def test_parameters_that_name_bytes_nobody_sent_are_refused(desk: Desk) -> None:
    with pytest.raises(ConflictProblem) as refused:
        desk.submit("import", params={"files": [{"name": "walk.bvh", "blob": f"sha256:{'0' * 64}"}]})
    assert refused.value.error_code == "missing-blobs"


# -- fan-out -----------------------------------------------------------------------------------------------------------


def test_many_inputs_are_spread_over_tasks_and_gathered_into_one_result(desk: Desk) -> None:
    things = desk.things(5)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}}, into="made")
    head = desk.job(job)
    assert (head.size, head.state, head.children) == (3, "running", {"queued": 3})

    seen = []
    for lease in desk.claim_many():
        names = [pin.name for pin in lease.inputs["things"]]
        seen += [pin.item for pin in lease.inputs["things"]]
        desk.stage(lease, *(f"{name}-squared" for name in names))
        desk.complete(lease, result={"frames": 10, "seconds": 0.5, "refusals": [{"item": names[0]}]})
    assert sorted(seen) == sorted(things)
    head = desk.job(job)
    assert head.state == "succeeded"
    assert head.result is not None
    assert head.result["outputs"] == 5
    assert (head.result["tasks"], head.result["frames"], head.result["seconds"]) == (3, 30, 1.5)
    assert len(head.result["refusals"]) == 3
    assert len(desk.outputs(job)) == 5


def test_a_few_inputs_make_no_tasks(desk: Desk) -> None:
    desk.things(2)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}})
    assert desk.job(job).size is None
    assert desk.claim().job == job


def test_a_failed_task_fails_the_whole_after_the_others_have_ended(desk: Desk) -> None:
    desk.things(6)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}})
    dependant = desk.submit(after=[job])
    bad, *good = desk.claim_many()
    desk.fail(bad, "bad-thing", retryable=False, detail="thing0 is crooked")
    for lease in good:
        assert desk.state(job) == "running"
        desk.complete(lease)
    head = desk.job(job)
    assert head.failure is not None
    assert (head.state, head.failure.code) == ("failed", "bad-thing")
    assert "thing0 is crooked" in head.failure.detail
    assert desk.state(dependant) == "failed"


def test_cancelling_the_whole_cancels_its_tasks(desk: Desk) -> None:
    desk.things(6)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}})
    lease = desk.claim()
    assert desk.cancel(job).cancel_requested
    assert desk.job(job).children == {"cancelled": 2, "running": 1}
    assert desk.heartbeat(lease).cancel_requested
    desk.fail(lease, "cancelled")
    assert desk.state(job) == "cancelled"
    assert desk.claim_many() == []


def test_a_whole_of_which_a_task_has_failed_can_be_cancelled(desk: Desk) -> None:
    desk.things(6)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}})
    fail_for_good(desk)
    assert desk.cancel(job).state == "cancelled"
    assert desk.job(job).children == {"failed": 1, "cancelled": 2}


def test_a_cancelled_whole_waits_for_its_tasks_however_long_they_take_to_stop(desk: Desk) -> None:
    desk.things(4)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}})
    leases = desk.claim_many()
    desk.cancel(job)
    desk.complete(leases[0])
    desk.clock.advance(31)
    assert desk.reap() == 1
    assert desk.job(job).children == {"cancelled": 2}
    assert desk.state(job) == "cancelled"


def test_tasks_wait_with_the_job_they_belong_to(desk: Desk) -> None:
    desk.things(4)
    first = desk.submit()
    job = desk.submit("square", inputs={"things": {"collection": "raw"}}, after=[first])
    assert desk.state(job) == "waiting"
    claimed = desk.claim_many()
    assert [lease.job for lease in claimed] == [first]
    desk.complete(claimed[0])
    assert desk.state(job) == "running"
    for lease in desk.claim_many():
        desk.complete(lease)
    assert desk.state(job) == "succeeded"


def test_tasks_of_a_job_whose_dependency_failed_are_never_done(desk: Desk) -> None:
    desk.things(4)
    first = desk.submit()
    job = desk.submit("square", inputs={"things": {"collection": "raw"}}, after=[first])
    cancelled = desk.submit("square", inputs={"things": {"collection": "raw"}}, after=[first], seed=1)
    desk.cancel(cancelled)
    fail_for_good(desk)
    assert (desk.state(job), desk.job(job).children) == ("failed", {"cancelled": 2})
    assert (desk.state(cancelled), desk.job(cancelled).children) == ("cancelled", {"cancelled": 2})
    assert desk.claim_many() == []


def test_a_task_cancelled_before_its_job_begins_is_not_waited_for(desk: Desk) -> None:
    desk.things(4)
    first = desk.submit()
    job = desk.submit("square", inputs={"things": {"collection": "raw"}}, after=[first])
    listed = desk.database.read(desk.user, reading.list_jobs, "lab", reading.JobFilters(parent=job))
    for task in listed.items:
        desk.cancel(task.id)
    desk.complete(desk.claim())
    assert desk.state(job) == "cancelled"


# -- tasks that are counted, and gathered by a worker ------------------------------------------------------------------


def a_survey(desk: Desk, tasks: int = 3, **fields: Any) -> str:
    if not desk.database.read(desk.user, items.list_items, "lab", Kind.CHARACTER).items:
        desk.things(2)
    return desk.submit("survey", inputs={"things": {"collection": "raw"}}, params={"number": tasks}, **fields)


def kept_bytes(desk: Desk, lease: Lease, data: bytes) -> str:
    """Upload bytes as an attempt, and return their digest."""
    return desk.database.write(desk.attempt(lease), blobs.put_blob, data)


def test_the_parameters_say_how_many_tasks_there_are_and_each_has_all_inputs(desk: Desk) -> None:
    job = a_survey(desk)
    head = desk.job(job)
    assert (head.size, head.state, head.children) == (3, "running", {"queued": 3})
    leases = desk.claim_many()
    places = sorted((lease.position, lease.size, len(lease.inputs["things"])) for lease in leases)
    assert places == [(0, 3, 2), (1, 3, 2), (2, 3, 2)]


def test_when_all_tasks_have_succeeded_a_worker_gathers_what_they_brought(desk: Desk) -> None:
    job = a_survey(desk, into="made")
    for lease in reversed(desk.claim_many()):
        assert desk.state(job) == "running"
        desk.complete(lease, result={"seen": lease.position})
    assert desk.state(job) == "queued"
    gathering = desk.claim()
    assert (gathering.job, gathering.position, gathering.size) == (job, None, 3)
    assert len(gathering.inputs["things"]) == 2
    seen = desk.database.read(desk.user, reading.list_results, job).items
    assert [(one.position, one.state, one.result["seen"]) for one in seen] == [
        (0, "succeeded", 0),
        (1, "succeeded", 1),
        (2, "succeeded", 2),
    ]
    desk.stage(gathering, "overview")
    desk.complete(gathering, result={"verdict": "fine"})
    assert (desk.state(job), desk.job(job).result) == ("succeeded", {"verdict": "fine", "outputs": 1})
    (made,) = desk.outputs(job)
    lineage = desk.database.read(desk.user, items.read_lineage, "lab", Kind.CHARACTER, made.item)
    assert sorted(edge.name for edge in lineage.inputs) == ["thing0", "thing1"]


def test_one_task_alone_is_no_task(desk: Desk) -> None:
    job = a_survey(desk, tasks=1)
    lease = desk.claim()
    assert (lease.job, lease.position, lease.size) == (job, None, None)


def test_more_tasks_than_can_be_or_none_are_refused(desk: Desk) -> None:
    for number in (0, job_kinds.MOST_TASKS + 1):
        with pytest.raises(InvalidProblem) as refused:
            a_survey(desk, tasks=number)
        assert refused.value.errors[0].code == "too-many-tasks"


def test_dependants_wait_for_the_gathering(desk: Desk) -> None:
    job = a_survey(desk, tasks=2)
    dependant = desk.submit(after=[job])
    for lease in desk.claim_many():
        desk.complete(lease)
    assert desk.state(dependant) == "waiting"
    desk.complete(desk.claim())
    assert desk.state(dependant) == "queued"


def test_a_failed_task_leaves_nothing_to_gather_and_trying_again_repeats_only_what_did_not_succeed(desk: Desk) -> None:
    job = a_survey(desk)
    bad, *good = desk.claim_many()
    desk.fail(bad, "bad-thing", retryable=False, detail="thing0 is crooked")
    for lease in good:
        desk.complete(lease)
    failure = desk.job(job).failure
    assert failure is not None
    assert (desk.state(job), failure.code) == ("failed", "bad-thing")
    assert desk.claim_many() == []

    again = desk.database.write(desk.user, retrying.retry_job, job)
    assert again.children == {"succeeded": 2, "queued": 1}
    lease = desk.claim()
    assert lease.position == bad.position
    desk.complete(lease)
    desk.complete(desk.claim(job=again.id))
    assert desk.state(again.id) == "succeeded"


def test_when_a_task_has_failed_for_good_those_that_nobody_began_are_not_begun(desk: Desk) -> None:
    job = a_survey(desk, tasks=4)
    first, second = desk.claim_many(2)
    desk.complete(first)
    desk.fail(second, "refused", retryable=False, detail="things are crooked")
    head = desk.job(job)
    assert head.failure is not None
    assert (head.state, head.failure.code) == ("failed", "refused")
    assert head.children == {"succeeded": 1, "failed": 1, "cancelled": 2}
    again = desk.database.write(desk.user, retrying.retry_job, job)
    assert again.children == {"succeeded": 1, "queued": 3}


def test_a_gathering_that_is_lost_or_fails_is_done_again_without_the_tasks(desk: Desk) -> None:
    job = a_survey(desk, tasks=2)
    for lease in desk.claim_many():
        desk.complete(lease)
    lost = desk.claim()
    desk.clock.advance(61)
    assert desk.reap() == 1
    failing = desk.claim()
    with pytest.raises(LeaseLostProblem):
        desk.complete(lost)
    assert failing.job == job
    desk.fail(failing)
    desk.clock.advance(600)
    (last,) = desk.claim_many()
    assert last.job == job
    desk.complete(last)
    assert desk.state(job) == "succeeded"


def test_a_gathering_that_fails_for_good_fails_the_whole_and_its_tasks_serve_the_next_try(desk: Desk) -> None:
    job = a_survey(desk, tasks=2)
    for lease in desk.claim_many():
        desk.complete(lease)
    desk.fail(desk.claim(), retryable=False)
    assert desk.state(job) == "failed"
    again = desk.database.write(desk.user, retrying.retry_job, job)
    assert (again.state, again.children) == ("queued", {"succeeded": 2})
    (gathering,) = desk.claim_many()
    assert gathering.job == again.id


@pytest.mark.parametrize("when", ["tasks-run", "queued", "gathering"])
def test_a_job_is_cancelled_as_one_whenever_that_is(desk: Desk, when: str) -> None:
    job = a_survey(desk, tasks=2)
    leases = desk.claim_many()
    if when != "tasks-run":
        for lease in leases:
            desk.complete(lease)
        leases = desk.claim_many() if when == "gathering" else []
    desk.cancel(job)
    for lease in leases:
        assert desk.heartbeat(lease).cancel_requested
        desk.fail(lease, "cancelled")
    assert desk.state(job) == "cancelled"
    assert desk.claim_many() == []


def test_tasks_that_succeed_after_the_cancellation_are_not_gathered(desk: Desk) -> None:
    job = a_survey(desk, tasks=2)
    leases = desk.claim_many()
    desk.cancel(job)
    for lease in leases:
        desk.complete(lease)
    assert desk.state(job) == "cancelled"


def test_progress_is_that_of_the_tasks_and_then_of_the_gathering(desk: Desk) -> None:
    job = a_survey(desk)
    first, second, third = desk.claim_many()
    desk.complete(first)
    desk.heartbeat(second, Progress(done=3, total=4, note="trial 7"))
    assert desk.job(job).progress == Progress(done=1.75, total=3, note="trial 7")
    for lease in (second, third):
        desk.complete(lease)
    gathering = desk.claim()
    desk.heartbeat(gathering, Progress(done=1, total=2, note="drawing"))
    assert desk.job(job).progress == Progress(done=1, total=2, note="drawing")


def test_what_tasks_brought_is_kept_until_it_has_been_gathered(desk: Desk) -> None:
    job = a_survey(desk, tasks=2)
    digests = []
    for number, lease in enumerate(desk.claim_many()):
        digests.append(digest := kept_bytes(desk, lease, f"record {number}".encode()))
        desk.complete(lease, result={"record": {"blob": digest}})
    desk.clock.advance(3 * 86400)
    garbage.collect_garbage(desk.database)
    gathering = desk.claim()
    assert desk.database.read(desk.attempt(gathering), blobs.readable, digests) == set(digests)
    desk.complete(gathering)
    desk.clock.advance(3 * 86400)
    garbage.collect_garbage(desk.database)
    assert desk.state(job) == "succeeded"
    assert desk.database.read(SYSTEM, blobs.readable, digests) == set()


def test_the_same_job_again_shares_what_was_gathered_and_makes_no_tasks(desk: Desk) -> None:
    first = a_survey(desk, into="one")
    joined = a_survey(desk, into="two")
    assert (desk.job(joined).state, desk.job(joined).cached_from, desk.job(joined).size) == ("waiting", first, None)
    for lease in desk.claim_many():
        desk.complete(lease)
    gathering = desk.claim()
    desk.stage(gathering, "overview")
    desk.complete(gathering, result={"verdict": "fine"})
    later = a_survey(desk, into="three")
    for job in (joined, later):
        assert (desk.state(job), desk.job(job).cached_from) == ("succeeded", first)
        assert len(desk.outputs(job)) == 1


def test_who_waited_for_a_job_that_failed_does_the_whole_alone(desk: Desk) -> None:
    a_survey(desk, tasks=2)
    joined = a_survey(desk, tasks=2, into="two")
    for lease in desk.claim_many():
        desk.fail(lease, retryable=False)
    lease = desk.claim()
    assert (lease.job, lease.position, lease.size) == (joined, None, None)


@pytest.mark.usefixtures("few_at_once")
def test_a_task_whose_source_was_gathered_away_before_its_turn_is_done_again(desk: Desk) -> None:
    gate = desk.submit()
    surveys = [a_survey(desk, tasks=2, after=[gate], into=f"place{n}") for n in range(AT_ONCE + 2)]
    desk.complete(desk.claim(job=gate))
    leases = desk.claim_many()
    assert len(leases) == 2  # the tasks of all others wait for these
    for lease in leases:
        digest = kept_bytes(desk, lease, f"record {lease.position}".encode())
        desk.complete(lease, result={"record": {"blob": digest}})
    (late,) = [job for job in surveys if desk.job(job).children == {"waiting": 2}]
    for lease in desk.claim_many():
        desk.complete(lease)
    desk.clock.advance(3 * 86400)
    garbage.collect_garbage(desk.database)
    while desk.database.write(SYSTEM, share_waiting):
        pass
    assert desk.job(late).children == {"queued": 2}


# -- shared results ----------------------------------------------------------------------------------------------------


def test_the_same_job_again_has_its_result_at_once(desk: Desk) -> None:
    first = desk.submit("sum", params={"number": 3}, into="one")
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease, result={"seconds": 2.0}, code_version="sum@1")

    again = desk.submit("sum", params={"number": 3}, into="two")
    job = desk.job(again)
    assert (job.state, job.cached_from) == ("succeeded", first)
    assert job.result == {"seconds": 2.0, "outputs": 1}
    (there,), (here,) = desk.outputs(first), desk.outputs(again)
    assert here.created
    assert here.item != there.item
    same_place = desk.submit("sum", params={"number": 3}, into="one")
    (unchanged,) = desk.outputs(same_place)
    assert (unchanged.item, unchanged.revision, unchanged.created) == (there.item, 1, False)


def test_other_parameters_seeds_or_inputs_are_other_jobs(desk: Desk) -> None:
    desk.submit("sum", params={"number": 3})
    desk.complete(desk.claim())
    assert desk.state(desk.submit("sum", params={"number": 4})) == "queued"
    assert desk.state(desk.submit("sum", params={"number": 3}, seed=1)) == "queued"
    assert desk.state(desk.submit("sum", params={"number": 3}, cache="off")) == "queued"
    assert desk.state(desk.submit("sum", params={"number": 3}, cache="refresh")) == "queued"
    assert desk.state(desk.submit("sum", params={"number": 3})) == "succeeded"


def test_a_changed_input_or_a_new_version_of_the_kind_is_computed_again(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.things(1)
    inputs = {"things": {"collection": "raw"}}
    desk.submit("square", inputs=inputs)
    desk.complete(desk.claim())
    assert desk.state(desk.submit("square", inputs=inputs)) == "succeeded"
    desk.publish(Draft("again", Kind.CHARACTER, "thing0", {"character": document(number=77)}, "raw"))
    assert desk.state(desk.submit("square", inputs=inputs)) == "queued"

    desk.submit("sum")
    desk.complete(desk.claim(kinds=("sum",)))
    newer = {**job_kinds.job_kinds(), "sum": replace(SUM, version=2)}
    monkeypatch.setattr(job_kinds, "job_kinds", lambda: newer)
    assert desk.state(desk.submit("sum")) == "queued"


def test_results_know_exactly_which_revisions_they_were_made_from(desk: Desk) -> None:
    (thing,) = desk.things(1)
    desk.publish(Draft("again", Kind.CHARACTER, "thing0", {"character": document(number=77)}, "raw"))
    both: Any = {"things": [{"item": thing, "revision": 1}, {"item": thing, "revision": 2}]}
    desk.submit("square", inputs=both)
    lease = desk.claim()
    with pytest.raises(InvalidProblem, match="reads revision 1, revision 2"):
        desk.stage(lease, "vague", sources={"things": [{"item": thing}]})
    with pytest.raises(InvalidProblem, match="revision 3"):
        desk.stage(lease, "wrong", sources={"things": [{"item": thing, "revision": 3}]})
    desk.stage(lease, "first", sources={"things": [{"item": thing, "revision": 1}]})
    desk.stage(lease, "second", sources={"things": [{"item": thing, "revision": 2}]})
    desk.complete(lease)

    def made_from(job: str) -> dict[str, list[int]]:
        return {
            one.name: [
                edge.revision
                for edge in desk.database.read(
                    desk.user, items.read_lineage, "lab", Kind.CHARACTER, one.item, revision_number=one.revision
                ).inputs
            ]
            for one in desk.outputs(job)
        }

    assert made_from(lease.job) == {"first": [1], "second": [2]}
    again = desk.submit("square", inputs=both, into="again")
    assert made_from(again) == {"first": [1], "second": [2]}


def test_jobs_identical_to_one_under_way_wait_for_it_and_share_its_result(desk: Desk) -> None:
    first = desk.submit("sum")
    joined = [desk.submit("sum", into=f"place{n}") for n in range(2)]
    assert [desk.state(job) for job in joined] == ["waiting", "waiting"]
    (lease,) = desk.claim_many()
    joined.append(desk.submit("sum", into="place2"))
    desk.stage(lease, "total")
    desk.complete(lease)
    for job in joined:
        assert (desk.state(job), desk.job(job).cached_from) == ("succeeded", first)
        assert len(desk.outputs(job)) == 1


def test_identical_jobs_of_one_batch_are_computed_once(desk: Desk) -> None:
    ids = desk.submit_many(*(JobCreate(kind="sum") for _ in range(5)))
    desk.complete(desk.claim())
    assert desk.claim_many() == []
    assert {desk.state(job) for job in ids} == {"succeeded"}


@pytest.mark.parametrize("end", ["fail", "cancel"])
def test_if_the_one_under_way_brings_nothing_the_next_computes_for_the_rest(desk: Desk, end: str) -> None:
    first = desk.submit("sum")
    lease = desk.claim()
    second, third = desk.submit("sum"), desk.submit("sum")
    if end == "fail":
        desk.fail(lease, retryable=False)
    else:
        desk.cancel(first)
        desk.fail(lease)
    assert sorted([desk.state(second), desk.state(third)]) == ["queued", "waiting"]
    (again,) = desk.claim_many()
    desk.complete(again)
    assert (desk.state(second), desk.state(third)) == ("succeeded", "succeeded")


def test_a_result_whose_documents_are_gone_is_computed_again(desk: Desk) -> None:
    desk.submit("sum")
    lease = desk.claim()
    desk.stage(lease, "total")
    desk.complete(lease)

    def forget(tx: Transaction) -> None:
        draft = tx.execute(select(staged_output.c.draft)).scalar_one()
        tx.execute(update(staged_output).values(draft=draft | {"parts": {"character": f"sha256:{'0' * 64}"}}))

    desk.database.write(SYSTEM, forget)
    assert desk.state(desk.submit("sum")) == "queued"


@pytest.mark.usefixtures("few_at_once")
def test_more_shared_results_than_fit_one_transaction_are_served_bit_by_bit(desk: Desk) -> None:
    desk.submit("sum")
    joined = desk.submit_many(*(JobCreate(kind="sum", into=f"place{n}") for n in range(2 * AT_ONCE + 1)))
    desk.complete(desk.claim())
    states = [desk.state(job) for job in joined]
    assert states.count("succeeded") == AT_ONCE
    while desk.database.write(SYSTEM, share_waiting):
        pass
    assert {desk.state(job) for job in joined} == {"succeeded"}


LONG_PATH = "/".join(["long" * 50] * 5)
"""Path of a folder that is so long that a subfolder with a name of 20 letters would exceed the limit for paths."""


def test_a_job_that_cannot_have_a_shared_result_stops_neither_its_source_nor_others(desk: Desk) -> None:
    first = desk.submit("sum")
    misplaced, other = desk.submit("sum", into=LONG_PATH), desk.submit("sum", into="other")
    assert (desk.state(misplaced), desk.state(other)) == ("waiting", "waiting")
    lease = desk.claim()
    desk.stage(lease, "total", collection="deep" * 5)
    desk.complete(lease)
    assert (desk.state(first), desk.state(other)) == ("succeeded", "succeeded")
    assert [one.name for one in desk.outputs(other)] == ["total"]
    assert desk.job(misplaced).model_dump(include={"state", "cached_from", "after"}) == {
        "state": "queued",
        "cached_from": None,
        "after": (),
    }
    lease = desk.claim()
    assert lease.job == misplaced
    desk.stage(lease, "total")  # by itself it may do better, or fail
    desk.complete(lease)
    assert desk.state(misplaced) == "succeeded"


@pytest.mark.usefixtures("few_at_once")
def test_a_job_that_cannot_have_a_result_that_is_there_is_computed_and_those_behind_it_get_theirs(desk: Desk) -> None:
    desk.submit("sum")
    lease = desk.claim()
    desk.stage(lease, "total", collection="deep" * 5)
    desk.complete(lease)
    places = [*(f"place{n}" for n in range(AT_ONCE)), LONG_PATH, "last"]
    reading = desk.submit_many(*(JobCreate(kind="sum", into=place) for place in places))
    assert [desk.state(job) for job in reading[-3:]] == ["succeeded", "waiting", "waiting"]
    assert desk.database.write(SYSTEM, share_waiting) == 1
    assert [desk.state(job) for job in reading[-3:]] == ["succeeded", "queued", "succeeded"]


def test_tasks_find_the_results_of_earlier_tasks(desk: Desk) -> None:
    desk.things(5)
    inputs = {"things": {"collection": "raw"}}
    first = desk.submit("square", inputs=inputs, into="one")
    leases = desk.claim_many()
    for lease in leases[:2]:
        desk.stage(lease, *(f"{pin.name}-squared" for pin in lease.inputs["things"]))
        desk.complete(lease)
    desk.fail(leases[2], retryable=False)
    assert desk.state(first) == "failed"

    again = desk.database.write(desk.user, retrying.retry_job, first)
    assert (again.retry_of, again.size, again.children) == (first, 3, {"succeeded": 2, "queued": 1})
    lease = desk.claim()
    desk.stage(lease, *(f"{pin.name}-squared" for pin in lease.inputs["things"]))
    desk.complete(lease)
    assert desk.state(again.id) == "succeeded"
    assert len(desk.outputs(again.id)) == 5


# -- trying again, and who may -----------------------------------------------------------------------------------------


def test_only_what_failed_or_was_cancelled_can_be_tried_again(desk: Desk) -> None:
    job = desk.submit(params={"number": 7}, priority=3, concurrency_key="k", labels={"gpu": "x"}, max_attempts=1)
    with pytest.raises(ConflictProblem):
        desk.database.write(desk.user, retrying.retry_job, job)
    desk.cancel(job)
    again = desk.database.write(desk.user, retrying.retry_job, job)
    assert (again.params, again.priority, again.max_attempts, again.retry_of) == ({"number": 7}, 3, 1, job)
    assert desk.claim_many() == []
    assert desk.claim(labels={"gpu": "x"}).job == again.id


def test_others_jobs_are_cancelled_by_maintainers_only_and_hidden_from_strangers(desk: Desk) -> None:
    read = requiring(declared("GET", "/jobs/{job}"), reading.read_job)
    cancel = requiring(declared("POST", "/jobs/{job}/cancel"), reading.cancel_job)
    job = desk.submit()
    made = desk.database.write(SYSTEM, users.create_user, UserCreate(name="bob"))
    bob = Principal("user", made.id, "bob", scopes=("read", "write", "jobs"))
    with pytest.raises(NotFoundProblem):
        desk.database.read(bob, read, job)
    desk.database.write(SYSTEM, members.put_member, "lab", "bob", MemberChange(role=Role.CONTRIBUTOR))
    assert desk.database.read(bob, read, job).id == job
    with pytest.raises(ForbiddenProblem):
        desk.database.write(bob, cancel, job)
    desk.database.write(SYSTEM, members.put_member, "lab", "bob", MemberChange(role=Role.MAINTAINER))
    assert desk.database.write(bob, cancel, job).state == "cancelled"


def test_lists_show_jobs_newest_first_by_state_kind_and_author(desk: Desk) -> None:
    first, second = desk.submit(), desk.submit("sum")
    desk.complete(desk.claim(kinds=("errand",)))

    def listed(filters: reading.JobFilters, **more: Any) -> list[str]:
        page = desk.database.read(desk.user, reading.list_jobs, "lab", filters, **more)
        return [one.id for one in page.items]

    assert listed(reading.JobFilters()) == [second, first]
    assert listed(reading.JobFilters(states=(JobState.SUCCEEDED,))) == [first]
    assert listed(reading.JobFilters(kinds=("sum",))) == [second]
    assert listed(reading.JobFilters(author="ann")) == [second, first]
    assert listed(reading.JobFilters(author="bob")) == []
    page = desk.database.read(desk.user, reading.list_jobs, "lab", limit=1, count=True)
    assert (page.count, [one.id for one in page.items]) == (2, [second])
    rest = desk.database.read(desk.user, reading.list_jobs, "lab", limit=1, cursor=page.next_cursor)
    assert [one.id for one in rest.items] == [first]


def test_what_happened_to_a_job_can_be_told(desk: Desk) -> None:
    job = desk.submit()
    desk.fail(desk.claim())
    desk.clock.advance(11)
    desk.complete(desk.claim())
    desk.database.write(desk.user, events.number_events)
    told = desk.database.read(desk.user, reading.list_job_events, job).items
    assert [one.kind for one in told] == [
        "job.submitted",
        "job.started",
        "job.requeued",
        "job.started",
        "job.succeeded",
    ]
    attempts = desk.database.read(desk.user, reading.list_attempts, job).items
    assert [(one.fence, one.outcome) for one in attempts] == [(1, "failed"), (2, "succeeded")]


def test_the_latest_tries_of_more_jobs_than_a_statement_takes_are_found(desk: Desk) -> None:
    failed = desk.submit()
    fail_for_good(desk, failed)
    again = desk.database.write(desk.user, retrying.retry_job, failed).id
    many = {failed, *(f"job_{n}" for n in range(70_000))}
    latest = desk.database.read(desk.user, retrying._latest_tries, many)
    assert len(latest) == len(many)
    assert {one: last for one, last in latest.items() if one != last} == {failed: again}
