"""Deferred commits: the server commits the outputs of a job with many outputs after its last task has ended."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update
from tests.support.committing_desk import CommittingDesk
from tests.support.queue_desk import Desk

from marey_schemas.datasets.commits import CommitCreate, PutEntry, RemoveEntry
from marey_schemas.datasets.naming import DatasetCreate, RefCreate, RefKind
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.kinds import Kind
from marey_schemas.purges import DatasetPurgeRequest, JobHolder, PurgeAnswer, PurgeRequest
from marey_schemas.queue.jobs import ItemInput, JobState
from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.app import create_app
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.process import housekeeping
from marey_server.process.settings import Settings
from marey_server.store import datasets, items, purging
from marey_server.store.datasets import output_plans
from marey_server.store.fsck import check_store
from marey_server.store.jobs import fan_out, finishing
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.tables import tree_chunk
from marey_server.store.wakeups import job_topic, wakeups


@pytest.fixture(autouse=True)
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the server defer commits of more than two entries, and store each chunk in a write of its own."""
    monkeypatch.setattr(fan_out, "MOST_AT_END", 2)
    monkeypatch.setattr(finishing, "CHUNKS_AT_ONCE", 1)


@pytest.fixture
def meanwhile(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], list[str]]:
    """Function that runs an action once, between the plan of a commit and its recording.

    It returns a list that collects the plans.
    """

    def arrange(action: Callable[[], object]) -> list[str]:
        plans: list[str] = []

        def passed(name: str) -> None:
            if name == "deferred_commit.after_chunks":
                plans.append(name)
                if len(plans) == 1:
                    action()

        monkeypatch.setattr(faults, "point", passed)
        return plans

    return arrange


def run_tasks(gaits: CommittingDesk, into: str = "made", **fields: Any) -> str:
    """Run a job of two tasks, each with two outputs; return its id."""
    things = tuple(ItemInput(item=one) for one in gaits.desk.things(4, "given"))
    made = gaits.submit("square", into=into, inputs={"things": things}, **fields)
    for number, lease in enumerate(gaits.desk.claim_many()):
        gaits.desk.stage(lease, f"a{number}", f"b{number}")
        gaits.desk.complete(lease)
    return made


MADE = {"made/a0", "made/b0", "made/a1", "made/b1"}


def test_many_outputs_are_committed_after_the_last_task(gaits: CommittingDesk) -> None:
    gaits.put("own", number=1)
    before = gaits.head()
    made = run_tasks(gaits)
    assert (gaits.job(made).state, gaits.head()) == ("running", before)
    assert commit_deferred(gaits.desk.database) == 1
    found = gaits.job(made)
    assert (found.state, found.publish_conflict) == ("succeeded", None)
    assert found.result is not None
    assert found.result["outputs"] == 4
    assert gaits.entries().keys() == {"own", *MADE}
    assert (gaits.commit().job, gaits.commit().parents) == (made, (before,))
    assert found.commit is not None
    assert found.commit.digest == gaits.head()
    assert list(check_store(gaits.desk.database)) == []
    assert commit_deferred(gaits.desk.database) == 0


def test_the_commit_has_the_tree_that_a_commit_at_once_has(
    gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_tasks(gaits, cache="off")
    commit_deferred(gaits.desk.database)
    monkeypatch.setattr(fan_out, "MOST_AT_END", 100)
    gaits.write(datasets.create_dataset, "lab", DatasetCreate(name="other"))
    run_tasks(gaits, to="other", cache="off")
    assert gaits.read(datasets.read_commit, "lab", "other", "main").tree == gaits.commit().tree


def test_what_others_commit_meanwhile_is_added_without_a_second_plan(
    gaits: CommittingDesk, meanwhile: Callable[[Callable[[], object]], list[str]]
) -> None:
    gaits.put("own", number=1)
    made = run_tasks(gaits)
    plans = meanwhile(lambda: gaits.put("later", number=2))
    assert commit_deferred(gaits.desk.database) == 1
    assert len(plans) == 1
    assert gaits.job(made).publish_conflict is None
    assert gaits.entries().keys() == {"own", "later", *MADE}
    later, own = gaits.log()[1:]
    assert (later.job, own.job, gaits.commit().parents) == (None, None, (later.digest,))
    assert list(check_store(gaits.desk.database)) == []


def test_a_first_commit_of_somebody_else_is_planned_upon(
    gaits: CommittingDesk, meanwhile: Callable[[Callable[[], object]], list[str]]
) -> None:
    run_tasks(gaits)
    meanwhile(lambda: gaits.put("later", number=2))
    assert commit_deferred(gaits.desk.database) == 1
    assert gaits.entries().keys() == {"later", *MADE}


def test_too_many_changes_of_others_are_planned_upon(
    gaits: CommittingDesk,
    monkeypatch: pytest.MonkeyPatch,
    meanwhile: Callable[[Callable[[], object]], list[str]],
) -> None:
    monkeypatch.setattr(output_plans, "MOST_FOLLOWED", 0)
    run_tasks(gaits)
    plans = meanwhile(lambda: gaits.put("later", number=2))
    assert commit_deferred(gaits.desk.database) == 1
    assert len(plans) == 2
    assert gaits.entries().keys() == {"later", *MADE}


def test_a_path_that_somebody_changes_meanwhile_is_not_overwritten(
    gaits: CommittingDesk, meanwhile: Callable[[Callable[[], object]], list[str]]
) -> None:
    made = run_tasks(gaits)
    plans = meanwhile(lambda: gaits.put("made/a0", number=2))
    assert commit_deferred(gaits.desk.database) == 1
    assert len(plans) == 2
    conflict = gaits.job(made).publish_conflict
    assert conflict is not None
    assert (conflict.code, conflict.branch, conflict.paths) == ("paths-changed", made, ("made/a0",))
    assert gaits.entries().keys() == {"made/a0"}
    assert gaits.entries(made).keys() == MADE


def test_a_branch_that_moves_during_each_plan_leaves_the_job_for_later(
    gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = run_tasks(gaits)
    numbers = iter(range(100))
    monkeypatch.setattr(output_plans, "MOST_FOLLOWED", 0)

    def move(name: str) -> None:
        if name == "deferred_commit.after_chunks":
            number = next(numbers)
            gaits.put(f"later{number}", number=number)

    monkeypatch.setattr(faults, "point", move)
    assert commit_deferred(gaits.desk.database) == 0
    assert gaits.job(made).state == "running"
    monkeypatch.undo()
    assert commit_deferred(gaits.desk.database) == 1
    assert gaits.entries().keys() >= MADE


# -- purges -----------------------------------------------------------------------------------------------------------


def delete_and_purge(gaits: CommittingDesk, *found: str) -> list[PurgeAnswer]:
    """Delete these items, and purge all deleted studies; return the answer."""
    for item in found:
        gaits.write(items.delete_item, "lab", Kind.CHARACTER, item, expected_rev=None)
    request = PurgeRequest(collection="", kind=Kind.CHARACTER)
    return [gaits.write(purging.record_purge, "lab", request, gaits.read(purging.prepare_purge, "lab", request))]


def purge_dataset(gaits: CommittingDesk, name: str) -> None:
    request = DatasetPurgeRequest(dataset=name)
    prepared = gaits.read(purging.prepare_dataset_purge, "lab", request)
    gaits.write(purging.record_dataset_purge, "lab", request, prepared)


def made_by(gaits: CommittingDesk) -> list[str]:
    """Return the items in the folder `made`."""
    filters = items.ItemFilters(collection="made")
    return [one.id for one in gaits.read(items.list_items, "lab", Kind.CHARACTER, filters).items]


@pytest.mark.parametrize("when", ["before the plan", "after the plan"])
def test_outputs_that_somebody_deletes_before_their_commit_are_not_purged(
    gaits: CommittingDesk, meanwhile: Callable[[Callable[[], object]], list[str]], when: str
) -> None:
    made = run_tasks(gaits, cache="off")
    outputs, answers = made_by(gaits), list[PurgeAnswer]()

    def purge() -> None:
        answers.extend(delete_and_purge(gaits, *outputs))

    if when == "before the plan":
        purge()
    else:
        meanwhile(purge)
    assert commit_deferred(gaits.desk.database) == 1
    (answer,) = answers
    assert (answer.purged, {one.item for one in answer.refused}) == ((), set(outputs))
    assert {holder for one in answer.refused for holder in one.holders} == {
        JobHolder(job=made, kind="square", state=JobState.RUNNING)
    }
    assert gaits.entries().keys() == MADE
    (later,) = delete_and_purge(gaits)
    assert len(later.refused) == len(outputs)  # now the version holds them
    assert list(check_store(gaits.desk.database)) == []


def test_a_commit_is_planned_again_after_a_purge(
    gaits: CommittingDesk, meanwhile: Callable[[Callable[[], object]], list[str]]
) -> None:
    (other,) = gaits.desk.things(1, "other")
    made = run_tasks(gaits)
    plans = meanwhile(lambda: delete_and_purge(gaits, other))
    assert commit_deferred(gaits.desk.database) == 1
    assert len(plans) == 2
    assert gaits.job(made).state == "succeeded"
    assert gaits.entries().keys() == MADE


def test_chunks_that_a_purged_dataset_had_too_are_stored_again(
    gaits: CommittingDesk, meanwhile: Callable[[Callable[[], object]], list[str]]
) -> None:
    """The branch also moves meanwhile, so the server builds a new tree from the chunks that it has planned."""
    (thing,) = gaits.desk.things(1, "far")
    for one in (CommittingDesk(gaits.desk, "other"), gaits):
        one.change(PutEntry(path="own", item=thing))
    run_tasks(gaits, to="other")
    assert commit_deferred(gaits.desk.database) == 1
    gaits.write(datasets.delete_dataset, "lab", "other", expected_rev=None)
    run_tasks(gaits, cache="off")

    def purge_and_move() -> None:
        purge_dataset(gaits, "other")
        gaits.change(PutEntry(path="later", item=thing))
        gaits.change(RemoveEntry(path="later", kind=Kind.CHARACTER))

    meanwhile(purge_and_move)
    assert commit_deferred(gaits.desk.database) == 1
    assert gaits.entries().keys() == {"own", *MADE}
    assert list(check_store(gaits.desk.database)) == []


# -- commits that are not possible any more ---------------------------------------------------------------------------


def drop_branch(gaits: CommittingDesk) -> None:
    gaits.write(datasets.delete_ref, "lab", "gaits", "work", expected_rev=None)


def drop_dataset(gaits: CommittingDesk) -> None:
    gaits.write(datasets.delete_dataset, "lab", "gaits", expected_rev=None)


def protect_work(gaits: CommittingDesk) -> None:
    rule = ProtectionRule(direct_commits=False)
    gaits.write(datasets.protect_branch, "lab", "gaits", "work", rule, expected_rev=None)


LATER = [(drop_branch, "no-version"), (drop_dataset, "no-dataset"), (protect_work, "branch-protected")]


@pytest.mark.parametrize(("change", "code"), LATER, ids=[code for _, code in LATER])
@pytest.mark.parametrize("when", ["before the plan", "after the plan"])
def test_a_job_fails_if_its_commit_is_not_possible_any_more(
    gaits: CommittingDesk,
    meanwhile: Callable[[Callable[[], object]], list[str]],
    when: str,
    change: Callable[[CommittingDesk], None],
    code: str,
) -> None:
    gaits.put("own", number=1)
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="work", kind=RefKind.BRANCH))
    made = run_tasks(gaits, to="gaits@work")
    if when == "before the plan":
        change(gaits)
    else:
        meanwhile(lambda: change(gaits))
    assert commit_deferred(gaits.desk.database) == 1
    found = gaits.job(made)
    assert (found.state, found.failure and found.failure.code) == ("failed", code)
    assert found.commit is None or found.commit.digest is None


def test_a_job_that_is_cancelled_before_its_commit_commits_nothing(gaits: CommittingDesk) -> None:
    made = run_tasks(gaits)
    gaits.desk.cancel(made)
    assert commit_deferred(gaits.desk.database) == 1
    assert (gaits.job(made).state, gaits.head()) == ("cancelled", None)


def test_no_commit_is_planned_for_a_cancelled_job(gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch) -> None:
    made = run_tasks(gaits)
    gaits.desk.cancel(made)
    monkeypatch.setattr(finishing, "plan_outputs", lambda *_: pytest.fail("a commit was planned"))
    assert commit_deferred(gaits.desk.database) == 1
    assert gaits.job(made).state == "cancelled"


def test_a_job_fails_if_its_commit_is_refused_while_it_is_planned(
    gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise ConflictProblem("There is no room.", code="no-room")

    made = run_tasks(gaits)
    monkeypatch.setattr(finishing, "plan_outputs", refuse)
    assert commit_deferred(gaits.desk.database) == 1
    found = gaits.job(made)
    assert (found.state, found.failure and found.failure.code) == ("failed", "no-room")


def test_a_job_fails_if_the_dataset_is_damaged(gaits: CommittingDesk) -> None:
    gaits.put("own", number=1)
    made = run_tasks(gaits)
    gaits.desk.database.write(SYSTEM, lambda tx: tx.execute(update(tree_chunk).values(data=b"damaged")))
    assert commit_deferred(gaits.desk.database) == 1
    found = gaits.job(made)
    assert (found.state, found.failure and found.failure.code) == ("failed", "dataset-damaged")


def test_a_job_that_depends_on_a_large_commit_starts_after_it(gaits: CommittingDesk) -> None:
    made = run_tasks(gaits)
    after = gaits.desk.submit("sum", after=(made,))
    assert gaits.desk.state(after) == "waiting"
    commit_deferred(gaits.desk.database)
    assert gaits.desk.state(after) == "queued"


def test_replacing_a_large_folder_is_deferred_even_for_few_outputs(gaits: CommittingDesk) -> None:
    for number in range(3):
        gaits.put(f"made/old{number}", number=number)
    things = tuple(ItemInput(item=one) for one in gaits.desk.things(3, "given"))
    gaits.submit("square", f"{gaits.name}/made", into="x", commit_replace=True, inputs={"things": things})
    gaits.work("a")
    gaits.work("b")
    assert len(gaits.entries()) == 3
    assert commit_deferred(gaits.desk.database) == 1
    assert gaits.entries().keys() == {"made/a", "made/b"}


def test_more_entries_than_a_commit_may_have_are_a_conflict(
    gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finishing, "MOST_COMMITTED", 3)
    made = run_tasks(gaits)
    assert commit_deferred(gaits.desk.database) == 1
    found = gaits.job(made)
    assert found.state == "succeeded"
    assert found.publish_conflict is not None
    assert (found.publish_conflict.code, gaits.head()) == ("too-many-changes", None)


def test_the_folder_of_a_dataset_goes_on_from_a_large_commit(desk: Desk) -> None:
    walks = CommittingDesk(desk, "walks", collection="walks")
    desk.things(1, "walks")
    request = CommitCreate(message="first")
    walks.write(datasets.record_commit, "lab", "walks", walks.read(datasets.prepare_commit, "lab", "walks", request))
    run_tasks(walks, into="walks/made")
    assert commit_deferred(desk.database) == 1
    with pytest.raises(InvalidProblem, match="Nothing has changed"):
        walks.read(datasets.prepare_commit, "lab", "walks", request)


def test_the_server_commits_the_outputs_when_the_last_task_ends(gaits: CommittingDesk, tmp_path: Path) -> None:
    app = create_app(Settings(data=tmp_path, port=0), gaits.desk.database)
    things = tuple(ItemInput(item=one) for one in gaits.desk.things(4, "given"))
    made = gaits.submit("square", into="made", inputs={"things": things})
    first, last = gaits.desk.claim_many()
    gaits.desk.stage(first, "a", "b")
    gaits.desk.complete(first)
    gaits.desk.stage(last, "c")

    async def end() -> bool:
        with wakeups.listen([job_topic(made)]) as listener:
            async with housekeeping.running_housekeeping(app.services):
                await asyncio.sleep(0)
                await asyncio.to_thread(gaits.desk.complete, last)
                return await listener.wait(30)

    assert asyncio.run(end())
    assert gaits.job(made).state == "succeeded"
    assert gaits.entries().keys() == {"made/a", "made/b", "made/c"}
