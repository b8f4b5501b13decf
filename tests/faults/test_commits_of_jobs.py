"""Jobs that commit their outputs while processes are killed: all outputs of a job are visible, or none is."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import pytest
from sqlalchemy import update
from tests.support.committing_desk import CommittingDesk
from tests.support.interleaving import Step, interleave
from tests.support.present import present
from tests.support.queue_desk import Desk
from tests.support.store_fixtures import WRITE, requiring
from tests.support.store_writer import StoreWriter

from marey_schemas.datasets.commits import CommitCreate, PutEntry
from marey_schemas.datasets.naming import RefCreate, RefKind
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.lineage import LineageRequest
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.worker_protocol import CompleteRequest, Lease
from marey_server.errors import ApiProblem
from marey_server.store import datasets, items
from marey_server.store.database.connections import Database
from marey_server.store.datasets import outputs
from marey_server.store.datasets.naming import find_ref
from marey_server.store.fsck import check_store
from marey_server.store.jobs import completion, fan_out
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.tables import dataset_ref
from marey_server.store.transaction import Transaction

BEFORE = (
    "publish.before_commit",
    "job_commit.after_chunks",
    "job_commit.after_commit",
    "job_commit.after_move",
    "complete.before_commit",
)
"""Fault points inside the transaction that completes a job, before its commit."""
AFTER = ("publish.after_commit", "complete.after_commit")
"""Fault points after the commit of this transaction."""


class Seen(NamedTuple):
    """State of a job that commits, as other clients see it."""

    state: str
    outputs: int
    sources: int
    commits: int
    entries: int
    in_lineage: bool


def seen(gaits: CommittingDesk, job_id: str, branch: str = "main") -> Seen:
    """Return what readers see of a job: its state, its outputs with their lineage, and its commit on a branch."""
    made = gaits.desk.outputs(job_id)
    graphs = [gaits.read(items.read_lineage_graph, "lab", one.kind, one.item, LineageRequest()) for one in made]
    head = gaits.head(branch) if branch in gaits.branches() else None
    log = [] if head is None else gaits.log(branch)
    found = gaits.job(job_id)
    own = [one for one in log if one.job == job_id]
    assert (found.commit is not None and found.commit.digest is not None) == bool(own)
    entries = {} if head is None else gaits.entries(branch)
    return Seen(
        found.state, len(made), sum(len(one.links) for one in graphs), len(own),
        sum(one.entry in entries for one in made), any(one.commit for graph in graphs for one in graph.jobs),
    )  # fmt: skip


def dies(desk: Desk, url: str, work: str, fault: str) -> bool:
    """Do some work in a process that is killed at a fault point; return whether the process was killed there."""
    return StoreWriter(url, present(desk.user.user_id), "ann").run(work, f"{fault}:kill") != 0


@pytest.mark.every_nth(8)
@pytest.mark.parametrize("place", [*BEFORE, *AFTER])
@pytest.mark.parametrize("way", ["main", "own-branch", "fan-out"])
def test_a_server_that_dies_at_a_completion_leaves_all_or_nothing(
    gaits: CommittingDesk, database_url: str, place: str, way: str
) -> None:
    things = tuple(ItemInput(item=one) for one in gaits.desk.things(4))
    gaits.put("own", number=1)
    made = gaits.submit("square", into="made", inputs={"things": things if way == "fan-out" else things[:1]})
    leases = gaits.desk.claim_many()
    for number, lease in enumerate(leases):
        gaits.desk.stage(lease, f"a{number}", f"b{number}")
    if way == "own-branch":
        gaits.put("made/a0", number=2)
    for lease in leases[:-1]:
        gaits.desk.complete(lease)
    branch = made if way == "own-branch" else "main"
    tasks, both = len(leases) - 1, 2 * len(leases)
    before = seen(gaits, made, branch)
    assert before == Seen("running", 2 * tasks, 4 * tasks, 0, 0, False)

    passed = not (way == "own-branch" and place == "job_commit.after_move")
    work = f"complete {leases[-1].job} {leases[-1].fence}"
    assert dies(gaits.desk, database_url, work, place) == passed
    after = Seen("succeeded", both, 2 * both if way == "fan-out" else both, 1, both, True)
    visible = place in AFTER or not passed
    assert seen(gaits, made, branch) == (after if visible else before)

    write_id = f"write-{leases[-1].job}-{leases[-1].fence}"
    answers = [gaits.desk.complete(leases[-1], write_id=write_id) for _ in range(2)]
    assert seen(gaits, made, branch) == after
    assert [one.commit for one in answers] == [None if way == "fan-out" else gaits.head(branch)] * 2
    assert list(check_store(gaits.desk.database)) == []


PLACES = [
    "deferred_commit.after_chunks",
    "job_commit.after_commit",
    "job_commit.after_move",
    "deferred_commit.before_commit",
]


@pytest.mark.parametrize("place", PLACES)
def test_a_server_that_dies_during_a_large_commit_repeats_it(
    gaits: CommittingDesk, database_url: str, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.setattr(fan_out, "MOST_AT_END", 3)
    things = tuple(ItemInput(item=one) for one in gaits.desk.things(4))
    made = gaits.submit("square", into="made", inputs={"things": things})
    for number, lease in enumerate(gaits.desk.claim_many()):
        gaits.desk.stage(lease, f"a{number}", f"b{number}")
        gaits.desk.complete(lease)
    before = Seen("running", 4, 8, 0, 0, False)
    assert seen(gaits, made) == before
    assert dies(gaits.desk, database_url, "commit-deferred", place)
    assert seen(gaits, made) == before
    assert commit_deferred(gaits.desk.database) == 1
    assert seen(gaits, made) == Seen("succeeded", 4, 8, 1, 4, True)
    assert list(check_store(gaits.desk.database)) == []


def complete_each(gaits: CommittingDesk, leases: list[Lease], database: Database) -> None:
    """Complete attempts from several threads at the same time."""

    def complete(lease: Lease) -> Any:
        request = CompleteRequest(write_id=f"write-{lease.job}")
        return database.write(gaits.desk._attempt_of(lease), completion.complete, lease.job, lease.fence, request)

    with ThreadPoolExecutor(8) as pool:
        assert {answer.state for answer in pool.map(complete, leases)} == {"succeeded"}


def submitted(gaits: CommittingDesk, count: int) -> tuple[list[str], list[Lease]]:
    """Submit jobs that all start from the present commit, and upload outputs of each; return job ids and leases."""
    jobs = [gaits.submit(into=f"made{number}", cache="off", params={"number": number}) for number in range(count)]
    leases = gaits.desk.claim_many()
    for number, lease in enumerate(leases):
        gaits.desk.stage(lease, "a", "b", facts={"number": number})
    return jobs, leases


@pytest.mark.every_database
def test_jobs_that_complete_at_once_all_reach_the_branch(gaits: CommittingDesk) -> None:
    count = 24
    jobs, leases = submitted(gaits, count)
    complete_each(gaits, leases, gaits.desk.database)
    log = gaits.log()
    assert sorted(one.job or "" for one in log) == sorted(jobs)
    assert [len(one.parents) for one in log] == [1] * (count - 1) + [0]
    assert gaits.entries().keys() == {f"made{number}/{name}" for number in range(count) for name in "ab"}
    assert list(check_store(gaits.desk.database)) == []


def do_not_lock(patch: pytest.MonkeyPatch) -> None:
    def find(tx: Transaction, dataset_id: str, name: str, *, lock: bool) -> Any:
        return find_ref(tx, dataset_id, name)

    def move(tx: Transaction, prepared: Any, digest: str, _mover: Any) -> None:
        which = (dataset_ref.c.dataset_id == prepared.dataset_id, dataset_ref.c.name == prepared.branch)
        tx.execute(update(dataset_ref).where(*which).values(digest=digest))

    patch.setattr(outputs, "find_ref", find)
    patch.setattr(outputs, "move_branch_to", move)


@pytest.mark.every_database
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
def test_without_the_lock_and_the_check_of_the_branch_commits_would_be_lost(
    gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check that the test of simultaneous commits would fail without the lock and the check of the branch."""
    do_not_lock(monkeypatch)
    for _ in range(20):
        before = len(gaits.log()) if gaits.head() else 0
        jobs, leases = submitted(gaits, 8)
        complete_each(gaits, leases, gaits.desk.database)
        if len(gaits.log()) < before + len(jobs):
            return
    raise AssertionError("no commit was lost")


@pytest.mark.every_database
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
@pytest.mark.parametrize("first", ["person", "job"])
def test_a_person_and_a_job_that_commit_at_once_lose_nothing(
    gaits: CommittingDesk, open_database: Callable[[], Database], first: str
) -> None:
    gaits.put("own", number=1)
    (thing,) = gaits.desk.things(1)
    made = gaits.submit(into="made")
    lease = gaits.desk.claim()
    gaits.desk.stage(lease, "a")
    request = CommitCreate(message="mine", changes=(PutEntry(path="mine", item=thing),))
    prepared = gaits.read(datasets.prepare_commit, "lab", "gaits", request)
    complete = CompleteRequest(write_id="write-of-job")

    def job(tx: Transaction) -> Any:
        return completion.complete(tx, lease.job, lease.fence, complete)

    def person(tx: Transaction) -> Any:
        return datasets.record_commit(tx, "lab", "gaits", prepared)

    of_job = (gaits.desk._attempt_of(lease), job)
    of_person = (gaits.desk.user, requiring(WRITE, person))
    order = (of_person, of_job) if first == "person" else (of_job, of_person)
    done = interleave(Step(gaits.desk.database, *order[0]), Step(open_database(), *order[1]))
    assert gaits.job(made).state == "succeeded"
    assert gaits.job(made).publish_conflict is None
    refused = [one.error_code for one in done if isinstance(one, ApiProblem)]
    assert refused == ([] if first == "person" else ["branch-moved"])
    assert gaits.entries().keys() == {"own", "made/a"} | ({"mine"} if first == "person" else set())


@pytest.mark.every_database
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
@pytest.mark.parametrize("first", ["rule", "job"])
def test_a_rule_that_is_set_while_a_job_completes_holds_for_it_or_waits(
    gaits: CommittingDesk, open_database: Callable[[], Database], first: str
) -> None:
    gaits.put("own", number=1)
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="work", kind=RefKind.BRANCH))
    made = gaits.submit(to="gaits@work", into="made")
    lease = gaits.desk.claim()
    gaits.desk.stage(lease, "a")
    complete = CompleteRequest(write_id="write-of-job")

    def job(tx: Transaction) -> Any:
        return completion.complete(tx, lease.job, lease.fence, complete)

    def rule(tx: Transaction) -> Any:
        wanted = ProtectionRule(direct_commits=False)
        return datasets.protect_branch(tx, "lab", "gaits", "work", wanted, expected_rev=None)

    of_job = (gaits.desk._attempt_of(lease), job)
    of_person = (gaits.desk.user, requiring(WRITE, rule))
    order = (of_person, of_job) if first == "rule" else (of_job, of_person)
    interleave(Step(gaits.desk.database, *order[0]), Step(open_database(), *order[1]))
    found = gaits.job(made)
    assert found.state == ("failed" if first == "rule" else "succeeded")
    assert gaits.desk.outputs(made) == [] if first == "rule" else gaits.commit("work").job == made
