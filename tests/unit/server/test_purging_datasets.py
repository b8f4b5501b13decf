"""Purges of deleted datasets: what they delete, what holds a dataset, and what stays."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import func, insert, select
from tests.support.committing_desk import CommittingDesk
from tests.support.queue_desk import Desk, document, output

from marey_schemas.datasets.commits import PutEntry
from marey_schemas.datasets.naming import DatasetCreate, RefCreate, RefKind
from marey_schemas.datasets.proposals import CommentCreate, ProposalCreate
from marey_schemas.kinds import Kind
from marey_schemas.purges import DatasetPurgeAnswer, DatasetPurgeRequest, ItemHolder, JobHolder, PurgeRequest
from marey_schemas.queue.jobs import JobState
from marey_server.access.principal import SYSTEM
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store import datasets, events, fsck, items, purging, transaction
from marey_server.store.datasets import proposals
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import retrying
from marey_server.store.tables import commit_parent, dataset, dataset_commit, dataset_ref, proposal, tree_chunk
from marey_server.store.tables import proposal_comment as comments
from marey_server.store.transaction import Transaction


def add(desk: Desk, name: str, content: object = 1) -> str:
    draft = Draft("d", Kind.CHARACTER, name, {"character": document(content=content, name=name)}, "raw")
    return desk.publish(draft)[0].item


def delete_gaits(gaits: CommittingDesk) -> str:
    """Delete the dataset, and return its id."""
    found = gaits.read(datasets.read_dataset, "lab", gaits.name)
    gaits.write(datasets.delete_dataset, "lab", gaits.name, expected_rev=found.rev)
    return str(found.id)


def preview(gaits: CommittingDesk, name: str = "gaits") -> DatasetPurgeAnswer:
    request = DatasetPurgeRequest(dataset=name, preview=True)
    answer: DatasetPurgeAnswer = gaits.read(purging.preview_dataset_purge, "lab", request)
    return answer


def purge(gaits: CommittingDesk, name: str = "gaits") -> DatasetPurgeAnswer:
    request = DatasetPurgeRequest(dataset=name)
    prepared = gaits.read(purging.prepare_dataset_purge, "lab", request)
    answer: DatasetPurgeAnswer = gaits.write(purging.record_dataset_purge, "lab", request, prepared)
    return answer


def count(gaits: CommittingDesk, *tables: Any) -> list[int]:
    def counts(tx: Transaction) -> list[int]:
        return [tx.execute(select(func.count()).select_from(table)).scalar_one() for table in tables]

    found: list[int] = gaits.read(counts)
    return found


def purge_item(gaits: CommittingDesk, item: str) -> Any:
    request = PurgeRequest(item=item)
    return gaits.write(purging.record_purge, "lab", request, gaits.read(purging.prepare_purge, "lab", request))


def sound(gaits: CommittingDesk) -> bool:
    return list(fsck.check_store(gaits.desk.database)) == []


def test_a_purged_dataset_leaves_no_version_branch_tag_or_proposal(gaits: CommittingDesk) -> None:
    walk, run = add(gaits.desk, "walk"), add(gaits.desk, "run", 2)
    gaits.change(PutEntry(path="walk", item=walk))
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="v1", kind=RefKind.TAG, at="main"))
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="more", kind=RefKind.BRANCH, at="main"))
    gaits.change(PutEntry(path="run", item=run), branch="more")
    gaits.write(proposals.open_proposal, "lab", "gaits", ProposalCreate(title="t", source="more", target="main"))
    gaits.write(proposals.add_comment, "lab", "gaits", 1, CommentCreate(text="hello"))
    dataset_id = delete_gaits(gaits)
    tables = (dataset, dataset_commit, commit_parent, dataset_ref, proposal, comments, tree_chunk)
    before = count(gaits, *tables)
    shown = preview(gaits)
    assert count(gaits, *tables) == before
    answer = purge(gaits)
    assert answer == shown.model_copy(update={"preview": False})
    assert (answer.dataset, answer.name, answer.commits, answer.proposals) == (dataset_id, "gaits", 2, 1)
    assert answer.freed_bytes > 0
    assert count(gaits, *tables) == [0] * len(tables)
    gaits.desk.database.write(SYSTEM, events.number_events)
    found = gaits.read(events.list_events, "lab", after=0, subject=dataset_id, limit=100).items
    assert (found[-1].kind, found[-1].actor) == ("dataset.purged", "ann")
    assert gaits.read(items.read_item, "lab", Kind.CHARACTER, walk).name == "walk"
    assert sound(gaits)


def test_items_that_only_its_versions_held_can_be_purged_afterwards(gaits: CommittingDesk) -> None:
    walk = add(gaits.desk, "walk")
    gaits.change(PutEntry(path="walk", item=walk))
    delete_gaits(gaits)
    gaits.write(items.delete_item, "lab", Kind.CHARACTER, walk, expected_rev=None)
    with pytest.raises(ConflictProblem, match="the deleted dataset gaits"):
        purge_item(gaits, walk)
    purge(gaits)
    assert [one.item for one in purge_item(gaits, walk).purged] == [walk]
    assert sound(gaits)


def test_an_item_is_purged_whose_dataset_was_purged_since_the_preparation(gaits: CommittingDesk) -> None:
    walk = add(gaits.desk, "walk")
    gaits.change(PutEntry(path="walk", item=walk))
    delete_gaits(gaits)
    gaits.write(items.delete_item, "lab", Kind.CHARACTER, walk, expected_rev=None)
    request = PurgeRequest(item=walk)
    prepared = gaits.read(purging.prepare_purge, "lab", request)
    purge(gaits)
    answer = gaits.write(purging.record_purge, "lab", request, prepared)
    assert [one.item for one in answer.purged] == [walk]
    assert sound(gaits)


def test_an_item_that_a_job_made_from_a_version_holds_the_dataset(gaits: CommittingDesk) -> None:
    gaits.change(PutEntry(path="walk", item=add(gaits.desk, "walk")))
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="v1", kind=RefKind.TAG, at="main"))
    job = gaits.desk.submit("square", inputs={"things": ({"dataset": "gaits", "version": "v1"},)}, into="made")
    delete_gaits(gaits)
    waiting = JobHolder(job=job, kind="square", state=JobState.QUEUED)
    assert preview(gaits).holders == (waiting,)
    gaits.work("square")
    (made,) = gaits.desk.outputs(job)
    holder = ItemHolder(item=made.item, kind=Kind.CHARACTER, path="made/square")
    with pytest.raises(ConflictProblem, match=r"cited by the character made/square") as raised:
        purge(gaits)
    assert raised.value.error_code == "still-held"
    assert DatasetPurgeAnswer.model_validate(raised.value.context).holders == (holder,)
    gaits.write(items.delete_item, "lab", Kind.CHARACTER, made.item, expected_rev=None)
    assert preview(gaits).holders == (holder.model_copy(update={"deleted": True}),)
    purge_item(gaits, made.item)
    assert purge(gaits).holders == ()
    assert gaits.desk.state(job) == "succeeded"
    assert sound(gaits)


def test_a_task_that_made_something_from_a_version_holds_the_dataset(gaits: CommittingDesk) -> None:
    things = [add(gaits.desk, f"t{number}", number) for number in range(4)]
    gaits.change(*(PutEntry(path=f"t{number}", item=one) for number, one in enumerate(things)))
    job = gaits.desk.submit("square", inputs={"things": ({"dataset": "gaits", "version": "main"},)}, into="made")
    gaits.work("one")
    gaits.work("two")
    assert gaits.desk.state(job) == "succeeded"
    delete_gaits(gaits)
    assert {one.path for one in preview(gaits).holders if isinstance(one, ItemHolder)} == {"made/one", "made/two"}


def test_an_item_that_several_jobs_made_from_a_version_counts_once(
    gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transaction, "_MOST_IN_LIST", 1)
    gaits.change(PutEntry(path="walk", item=add(gaits.desk, "walk")))
    for number in range(3):
        given = {"things": ({"dataset": "gaits", "version": "main"},)}
        job = gaits.desk.submit("square", inputs=given, into="made", cache="off")
        lease = gaits.desk.claim(job=job)
        gaits.desk.stage_outputs(lease, output("again", facts={"number": number}))
        gaits.desk.complete(lease)
    delete_gaits(gaits)
    answer = preview(gaits)
    assert [one.path for one in answer.holders if isinstance(one, ItemHolder)] == ["made/again"]
    assert answer.others == 0


def test_a_retry_after_the_preparation_holds_the_dataset(gaits: CommittingDesk) -> None:
    gaits.change(PutEntry(path="walk", item=add(gaits.desk, "walk")))
    job = gaits.desk.submit("square", inputs={"things": ({"dataset": "gaits", "version": "main"},)})
    gaits.desk.fail(gaits.desk.claim(), retryable=False)
    delete_gaits(gaits)
    request = DatasetPurgeRequest(dataset="gaits")
    prepared = gaits.read(purging.prepare_dataset_purge, "lab", request)
    again = gaits.desk.database.write(gaits.desk.user, retrying.retry_job, job)
    with pytest.raises(ConflictProblem, match=f"the queued job {again.id}"):
        gaits.write(purging.record_dataset_purge, "lab", request, prepared)
    assert sound(gaits)


def test_a_version_that_another_dataset_has_stays_and_is_not_held(gaits: CommittingDesk) -> None:
    gaits.change(PutEntry(path="walk", item=add(gaits.desk, "walk")))
    other = gaits.write(datasets.create_dataset, "lab", DatasetCreate(name="copy"))

    def copy(tx: Transaction) -> None:
        row = tx.execute(select(dataset_commit)).one()
        tx.execute(insert(dataset_commit).values(**(row._asdict() | {"dataset_id": other.id, "write_id": None})))

    gaits.write(copy)
    job = gaits.desk.submit("square", inputs={"things": ({"dataset": "gaits", "version": "main"},)})
    delete_gaits(gaits)
    answer = purge(gaits)
    assert answer.holders == ()
    assert count(gaits, dataset_commit, tree_chunk) == [1, 1]  # not the empty tree, which no version needs
    assert gaits.desk.state(job) == "queued"
    assert sound(gaits)


def test_a_tree_that_was_stored_again_after_the_preparation_stays(gaits: CommittingDesk) -> None:
    walk = add(gaits.desk, "walk")
    gaits.change(PutEntry(path="walk", item=walk))
    delete_gaits(gaits)
    request = DatasetPurgeRequest(dataset="gaits")
    prepared = gaits.read(purging.prepare_dataset_purge, "lab", request)
    assert len(prepared.chunks) == 2  # the empty tree, too
    gaits.desk.clock.advance(1)
    second = CommittingDesk(gaits.desk, "second")
    second.change(PutEntry(path="walk", item=walk))
    gaits.write(purging.record_dataset_purge, "lab", request, prepared)
    assert second.entries() == {"walk": walk}
    assert sound(gaits)


def test_only_deleted_datasets_are_purged_the_last_of_a_name_first(gaits: CommittingDesk) -> None:
    with pytest.raises(ConflictProblem, match="not deleted; delete it first"):
        purge(gaits)
    with pytest.raises(NotFoundProblem, match="no deleted dataset 'other'"):
        purge(gaits, "other")
    first = delete_gaits(gaits)
    gaits.desk.clock.advance(1)
    second = CommittingDesk(gaits.desk)
    later = delete_gaits(second)
    CommittingDesk(gaits.desk)
    assert (preview(gaits).dataset, preview(gaits).same_name) == (later, 1)
    assert preview(gaits, first).dataset == first
    assert [purge(gaits).dataset, purge(gaits).dataset] == [later, first]
    with pytest.raises(ConflictProblem, match="not deleted"):
        purge(gaits)
