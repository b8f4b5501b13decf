"""Purges: what they delete, what holds an item, what remains readable, and what garbage collection then frees."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select
from tests.support.committing_desk import CommittingDesk
from tests.support.database_fixtures import AdjustableClock
from tests.support.queue_desk import Desk, document
from tests.support.store_fixtures import ALL_RIGHTS, WRITE, motion_tree, requiring, skeleton_tree

from marey_schemas.datasets.commits import PutEntry, RemoveEntry
from marey_schemas.datasets.naming import RefCreate, RefKind
from marey_schemas.datasets.proposals import ProposalCreate
from marey_schemas.documents.motion_indexes import MotionIndexDocument
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import Event, ItemChange
from marey_schemas.kinds import Kind
from marey_schemas.lineage import LineageRequest, grouped, remarks_on, title_of
from marey_schemas.purges import DatasetHolder, HeldItem, ItemHolder, JobHolder, PurgeAnswer, PurgeRequest
from marey_schemas.queue.jobs import JobState
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem, ConflictProblem, GoneProblem, InvalidProblem, NotFoundProblem
from marey_server.store import blobs, collections, datasets, events, fsck, garbage, items, purging, transaction
from marey_server.store import projects as store_projects
from marey_server.store.blobs import GRACE_US
from marey_server.store.database.clock import DAY_US
from marey_server.store.database.prepared import Prepared
from marey_server.store.datasets import proposals
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import retrying
from marey_server.store.motion_indexes import IndexFiles
from marey_server.store.object_upkeep.checking import StoreDefect
from marey_server.store.purging import candidates, versions
from marey_server.store.quotas import holdings
from marey_server.store.tables import blob, collection, revision_part
from marey_server.store.tables import document as documents
from marey_server.store.tables import item as item_rows
from marey_server.store.transaction import Transaction
from marey_versions.tree.chunks import decode_trusted

LONG_S = GRACE_US / 1e6 + 1
NAME = "anna_walks"


@dataclass
class House:
    """Project whose owner deletes and purges items."""

    desk: Desk
    gaits: CommittingDesk

    def read(self, function: Any, *args: Any, **kwargs: Any) -> Any:
        return self.desk.database.read(self.desk.user, requiring(WRITE, function), *args, **kwargs)

    def write(self, function: Any, *args: Any, **kwargs: Any) -> Any:
        return self.desk.database.write(self.desk.user, requiring(WRITE, function), *args, **kwargs)

    def add(self, name: str, content: object = 1, collection: str = "raw", **parts: Any) -> str:
        """Create a study, and return its id."""
        draft = Draft(
            "d", Kind.CHARACTER, name, parts or {"character": document(content=content, name=name)}, collection
        )
        return self.desk.publish(draft)[0].item

    def add_many(self, count: int) -> list[str]:
        """Create studies in one transaction, and return their ids."""
        drafts = [
            Draft(f"d{n}", Kind.CHARACTER, f"s{n}", {"character": document(content=n, name=f"s{n}")}, "raw")
            for n in range(count)
        ]
        return [one.item for one in self.desk.publish(*drafts)]

    def add_clips(self, *names: str) -> tuple[str, list[str]]:
        """Create clips of one skeleton; return the ids of the skeleton and of the clips."""
        rig = Draft("rig", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}, collection="rigs")
        clips = [
            Draft(name, Kind.CLIP, name, {"motion": motion_tree({"output": "rig"}, seed=seed)}, collection="raw")
            for seed, name in enumerate(names)
        ]
        made = self.desk.publish(rig, *clips)
        return made[0].item, [one.item for one in made[1:]]

    def delete(self, *ids: str) -> None:
        for one in ids:
            self.write(items.delete_item, "lab", Kind(one.partition("_")[0]), one, expected_rev=None)

    def purge(self, **request: Any) -> PurgeAnswer:
        wanted = PurgeRequest.model_validate(request)
        if wanted.preview:
            shown: PurgeAnswer = self.read(purging.preview_purge, "lab", wanted)
            return shown
        prepared = self.read(purging.prepare_purge, "lab", wanted)
        answer: PurgeAnswer = self.write(purging.record_purge, "lab", wanted, prepared)
        return answer

    def holders(self, item_id: str) -> HeldItem:
        """Return what prevents the purge of a deleted item; fail unless the purge is refused and changes nothing."""
        with pytest.raises(ConflictProblem) as raised:
            self.purge(item=item_id)
        assert raised.value.error_code == "still-held"
        found = HeldItem.model_validate(raised.value.context)
        assert self.purge(item=item_id, preview=True).refused == (found,)
        assert all(
            self.read(lambda tx: tx.execute(select(revision_part).where(revision_part.c.item_id == item_id)).all())
        )
        return found

    def deleted(self, kind: Kind = Kind.CHARACTER) -> set[str]:
        page = self.read(items.list_items, "lab", kind, items.ItemFilters(deleted=True))
        return {one.id for one in page.items}

    def events(self, subject: str) -> list[Event]:
        self.desk.database.write(SYSTEM, events.number_events)
        found: list[Event] = self.read(events.list_events, "lab", after=0, subject=subject, limit=1000).items
        return found

    def collect(self) -> garbage.Collected:
        self.desk.clock.advance(LONG_S)
        return garbage.collect_garbage(self.desk.database)

    def stored_bytes(self) -> int:
        """Return the number of bytes of all documents and blobs."""

        def add_up(tx: Transaction) -> int:
            text = sum(len(json.dumps(row.body)) for row in tx.execute(select(documents.c.body)))
            return text + tx.execute(select(func.coalesce(func.sum(blob.c.size_bytes), 0))).scalar_one()

        return int(self.read(add_up))

    def faults(self) -> list[StoreDefect]:
        return list(fsck.check_store(self.desk.database))


@pytest.fixture
def house(desk: Desk, gaits: CommittingDesk) -> House:
    return House(desk, gaits)


# -- what goes --------------------------------------------------------------------------------------------------------


def test_a_purged_item_frees_the_bytes_that_nothing_else_needs(house: House) -> None:
    rig, (walk, run) = house.add_clips("walk", "run")
    house.collect()
    before = house.stored_bytes()
    house.delete(walk)
    preview = house.purge(item=walk, preview=True)
    assert [one.path for one in preview.purged] == ["raw/walk"]
    assert house.collect().documents == 0
    answer = house.purge(item=walk)
    unnamed = tuple(one.model_copy(update={"path": ""}) for one in preview.purged)
    assert answer == preview.model_copy(update={"preview": False, "purged": unnamed})
    assert house.stored_bytes() == before
    collected = house.collect()
    assert (collected.documents, collected.blobs) == (1, 1)
    assert before - house.stored_bytes() == pytest.approx(answer.freed_bytes, rel=0.2)
    assert answer.freed_bytes > 300
    assert house.read(items.read_item, "lab", Kind.CLIP, run).name == "run"
    assert house.read(items.read_item, "lab", Kind.SKELETON, rig).name == "rig"
    assert house.faults() == []


def test_content_that_another_item_has_is_not_freed(house: House) -> None:
    one, other = house.add("one", character=document(n=1)), house.add("other", character=document(n=1))
    house.delete(one)
    assert house.purge(item=one).freed_bytes == 0
    assert house.collect().documents == 0
    house.delete(other)
    assert house.purge(item=other).freed_bytes > 0
    assert house.collect().documents == 1
    assert house.faults() == []


def test_a_purged_item_is_neither_listed_nor_restored_nor_purged_again(house: House) -> None:
    one = house.add(NAME)
    house.delete(one)
    house.purge(item=one)
    assert house.deleted() == set()
    for act in (lambda: house.write(items.restore_item, "lab", Kind.CHARACTER, one), lambda: house.purge(item=one)):
        with pytest.raises(GoneProblem, match=f"{one}.*was purged on 20.*nothing can restore it"):
            act()
    with pytest.raises(NotFoundProblem):
        house.read(items.read_item, "lab", Kind.CHARACTER, one)
    with pytest.raises(NotFoundProblem):
        house.read(items.read_revision, "lab", Kind.CHARACTER, one, 1)
    with pytest.raises(NotFoundProblem):
        house.read(items.find_part, "lab", Kind.CHARACTER, one, "character", revision=1)
    assert house.purge(collection="").purged == ()
    assert house.add(NAME) != one


def test_only_deleted_items_of_the_project_are_purged(house: House) -> None:
    one = house.add("one")
    with pytest.raises(ConflictProblem, match="delete it first"):
        house.purge(item=one)
    with pytest.raises(NotFoundProblem, match="study_0"):
        house.purge(item="study_0")
    assert house.purge(collection="").purged == ()
    with pytest.raises(ValueError, match="give an item, a path, a collection or a query"):
        PurgeRequest()


def test_folder_path_kind_query_and_age_select_what_is_purged(house: House, clock: AdjustableClock) -> None:
    rig, (walk, run) = house.add_clips("walk", "run")
    inside, below, outside = (house.add("s", at, at) for at in ("raw", "raw/day", "rawer"))
    house.delete(walk, run, inside, below, outside, rig)

    def selected(**request: Any) -> set[str]:
        return {one.item for one in house.purge(preview=True, **request).purged}

    assert selected(collection="raw") == {walk, run, inside, below}
    assert selected(collection="raw", kind="clip") == {walk, run}
    assert selected(path="raw/s") == {inside}
    assert selected(collection="raw", kind="clip", query="name ~ wal") == {walk}
    assert selected(collection="", older_than_days=1) == set()
    clock.advance(DAY_US / 1e6 + 1)
    assert selected(collection="", older_than_days=1) == {walk, run, inside, below, outside, rig}
    with pytest.raises(ApiProblem, match="column 9"):
        house.purge(query="frames >")


def test_many_items_are_purged_in_steps_and_a_clip_before_its_skeleton(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(candidates, "MOST_PURGED", 2)
    rig, clips = house.add_clips("a", "b", "c")
    house.delete(rig, *clips)
    steps, after = [], None
    while True:
        answer = house.purge(collection="", after=after)
        steps.append([one.item for one in answer.purged])
        assert answer.refused == ()
        if (after := answer.next) is None:
            break
    assert sorted(steps[0] + steps[1][:1]) == sorted(clips)
    assert steps[1][1:] == [rig]
    house.collect()
    assert house.faults() == []
    with pytest.raises(ApiProblem, match="must be the value of `next`"):
        house.purge(collection="", after="nonsense")


def test_a_step_is_limited_by_the_number_of_revisions_too(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "MOST_REVISIONS", 3)
    one, other = house.add("one"), house.add("other")
    for number in (1, 2):
        house.write(items.put_part, "lab", Kind.CHARACTER, one, "character", document(n=number), expected_rev=None)
    house.delete(one, other)
    first = house.purge(collection="raw")
    assert [row.item for row in first.purged] == [other]
    assert [row.item for row in house.purge(collection="raw", after=first.next).purged] == [one]


def test_a_deleted_folder_goes_with_its_last_item(house: House) -> None:
    deep = house.add("deep", collection="anna/day-1")
    near = house.add("near", collection="anna")

    def paths() -> set[str]:
        return {row.path for row in house.read(lambda tx: tx.execute(select(collection)).all())}

    page = house.read(collections.list_collections, "lab")
    folder = next(one for one in page.items if one.path == "anna")
    house.write(collections.delete_collection, "lab", folder.id, expected_rev=None)
    house.purge(item=near)
    assert {"anna", "anna/day-1"} <= paths()
    house.purge(item=deep)
    assert not {"anna", "anna/day-1"} & paths()
    assert house.faults() == []


# -- what holds -------------------------------------------------------------------------------------------------------


def test_a_version_of_a_dataset_holds_the_items_of_its_entries(house: House) -> None:
    walk, run = house.add("walk"), house.add("run")
    house.gaits.change(PutEntry(path="walk", item=walk), PutEntry(path="run", item=run))
    house.write(datasets.create_ref, "lab", "gaits", RefCreate(name="v1", kind=RefKind.TAG, at="main"))
    house.gaits.change(RemoveEntry(path="run", kind=Kind.CHARACTER))
    house.delete(walk, run)
    held = DatasetHolder(dataset="gaits", branches=("main",), tags=("v1",), commits=2)
    assert house.holders(walk).holders == (held,)
    assert house.holders(run).holders == (held.model_copy(update={"branches": (), "commits": 1}),)
    assert house.gaits.entries() == {"walk": walk}
    dataset = house.read(datasets.read_dataset, "lab", "gaits")
    house.write(datasets.delete_dataset, "lab", "gaits", expected_rev=dataset.rev)
    (deleted,) = house.holders(run).holders
    assert isinstance(deleted, DatasetHolder)
    assert deleted.deleted


def test_a_version_that_has_an_earlier_revision_holds_the_item(house: House) -> None:
    walk = house.add("walk")
    house.gaits.change(PutEntry(path="walk", item=walk))
    house.write(items.put_part, "lab", Kind.CHARACTER, walk, "character", document(n=2), expected_rev=None)
    house.delete(walk)
    assert house.holders(walk).holders == (DatasetHolder(dataset="gaits", branches=("main",), commits=1),)


def test_a_large_version_is_searched_whole(house: House) -> None:
    many = house.add_many(300)
    house.gaits.change(*(PutEntry(path=f"folder-{n:03}/entry", item=one) for n, one in enumerate(many)))
    free = house.add("free", "other")
    house.delete(*many, free)
    answer = house.purge(collection="raw")
    assert [one.item for one in answer.purged] == [free]
    assert {one.item for one in answer.refused} == set(many)
    assert all(one.holders[0].commits == 1 for one in answer.refused if isinstance(one.holders[0], DatasetHolder))
    assert house.faults() == []


def test_an_open_proposal_is_named_among_the_holders(house: House) -> None:
    walk, run = house.add("walk"), house.add("run")
    house.gaits.change(PutEntry(path="walk", item=walk))
    house.write(datasets.create_ref, "lab", "gaits", RefCreate(name="more", kind=RefKind.BRANCH, at="main"))
    house.gaits.change(PutEntry(path="run", item=run), branch="more")
    house.write(proposals.open_proposal, "lab", "gaits", ProposalCreate(title="t", source="more", target="main"))
    house.delete(run)
    held = DatasetHolder(dataset="gaits", branches=("more",), proposals=(1,), commits=1)
    assert house.holders(run).holders == (held,)


def test_documents_of_other_items_hold_an_item_until_these_are_purged_too(house: House) -> None:
    rig, (walk, run) = house.add_clips("walk", "run")
    said = {"schema": "marey/annotation@1", "clip": {"item": walk, "revision": 1}, "layer": "a", "segments": []}
    (label,) = house.desk.publish(Draft("l", Kind.ANNOTATION, "steps", {"annotation": said}, collection="labels"))
    house.delete(rig, walk)
    holder = ItemHolder(item=label.item, kind=Kind.ANNOTATION, path="labels/steps")
    assert house.holders(walk).holders == (holder,)
    of_rig = house.holders(rig).holders
    assert of_rig == tuple(
        ItemHolder(item=clip, kind=Kind.CLIP, path=f"raw/{name}", deleted=clip == walk)
        for clip, name in sorted([(walk, "walk"), (run, "run")])
    )
    house.delete(run, label.item)
    answer = house.purge(collection="")
    assert [one.item for one in answer.purged][-1] == rig
    assert {one.item for one in answer.purged} == {rig, walk, run, label.item}
    assert house.faults() == []


def test_what_a_held_item_refers_to_is_held_by_it(house: House) -> None:
    rig, (walk, run) = house.add_clips("walk", "run")
    house.gaits.change(PutEntry(path="walk", item=walk))
    house.delete(rig, walk, run)
    answer = house.purge(collection="")
    assert [one.item for one in answer.purged] == [run]
    assert {one.item: one.holders for one in answer.refused} == {
        walk: (DatasetHolder(dataset="gaits", branches=("main",), commits=1),),
        rig: (ItemHolder(item=walk, kind=Kind.CLIP, path="raw/walk", deleted=True),),
    }
    assert house.faults() == []


def test_at_most_some_holders_are_listed_and_the_others_are_counted(house: House) -> None:
    target = house.add("target")
    for number in range(25):
        house.add(f"s{number:02}", character=document(n=number, of={"item": target, "revision": 1}))
    house.delete(target)
    held = house.holders(target)
    assert (len(held.holders), held.others) == (20, 5)


def test_items_of_another_project_hold_nothing(house: House, desk: Desk) -> None:
    from marey_schemas.access import ProjectCreate

    target = house.add("target")
    desk.database.write(desk.user, store_projects.create_project, ProjectCreate(name="other"))

    def refer(tx: Transaction) -> None:
        draft = Draft("d", Kind.CHARACTER, "s", {"character": document(of={"item": target, "revision": 1})})
        items.publish(
            tx, store_projects.require(tx, "other"), [draft], author_id=tx.principal.user_id, rights=ALL_RIGHTS
        )

    desk.database.write(desk.user, refer)
    house.delete(target)
    assert [one.item for one in house.purge(item=target).purged] == [target]


@pytest.mark.parametrize("state", ["queued", "running", "waiting"])
def test_a_job_that_has_not_ended_holds_its_inputs(house: House, state: str) -> None:
    thing = house.add("thing")
    before = (house.desk.submit("errand"),) if state == "waiting" else ()
    job = house.desk.submit("square", inputs={"things": ({"item": thing},)}, after=before)
    if state == "running":
        house.desk.claim()
    house.delete(thing)
    assert house.holders(thing).holders == (JobHolder(job=job, kind="square", state=state),)
    house.desk.cancel(job)
    if state == "running":
        house.desk.clock.advance(3600)
        house.desk.reap()
    assert [one.item for one in house.purge(item=thing).purged] == [thing]


def test_a_job_holds_what_its_parameters_name(house: House) -> None:
    rig, (walk,) = house.add_clips("walk")
    job = house.desk.submit("retarget", inputs={"clips": ({"item": walk},), "skeleton": {"item": rig}})
    house.delete(rig)
    assert JobHolder(job=job, kind="retarget", state="queued") in house.holders(rig).holders


def test_results_of_a_task_are_held_until_its_parent_job_has_ended(house: House) -> None:
    things = [house.add(f"t{n}", n) for n in range(4)]
    parent = house.gaits.submit("square", inputs={"things": tuple({"item": one} for one in things)}, into="out")
    first = house.desk.claim()
    house.desk.stage(first, "half")
    house.desk.complete(first)
    (made,) = house.desk.outputs(parent)
    house.delete(made.item)
    assert house.holders(made.item).holders == (JobHolder(job=parent, kind="square", state=JobState.RUNNING),)
    house.gaits.work("rest")
    assert house.desk.state(parent) == "succeeded"
    assert house.holders(made.item).holders == (DatasetHolder(dataset="gaits", branches=("main",), commits=1),)
    assert house.faults() == []


# -- what remains -----------------------------------------------------------------------------------------------------


def texts_of_database(house: House) -> str:
    """Return the text of all rows of the database, apart from those of trees."""
    from marey_server.store.tables import metadata

    def dump(tx: Transaction) -> Iterable[str]:
        return [repr(row) for table in metadata.sorted_tables for row in tx.execute(select(table)).all()]

    return "\n".join(house.read(dump))


def run(desk: Desk, source: str, name: str, **fields: Any) -> tuple[str, str]:
    """Run a job on an item; return the ids of the job and of its result."""
    job = desk.submit("square", inputs={"things": ({"item": source},)}, into="results", **fields)
    lease = desk.claim()
    desk.stage(lease, name, sources={"things": ({"item": source, "revision": 1},)})
    desk.complete(lease)
    return job, desk.outputs(job)[0].item


def test_lineage_and_jobs_stay_readable_and_say_that_an_item_was_purged(house: House) -> None:
    source = house.add(NAME)
    job, result = run(house.desk, source, "result")
    failed = house.desk.submit("square", inputs={"things": ({"item": source},)}, cache="off")
    house.desk.fail(house.desk.claim(), retryable=False)
    assert house.desk.state(failed) == "failed"
    house.delete(source)
    house.purge(item=source)

    lineage = house.read(items.read_lineage, "lab", Kind.CHARACTER, result)
    assert [(one.item, one.name, one.purged, one.revision) for one in lineage.inputs] == [(source, "", True, 1)]
    graph = house.read(items.read_lineage_graph, "lab", Kind.CHARACTER, result, LineageRequest())
    start, other = graph.revisions
    assert (start.purged, other.item, other.path, other.purged, other.deleted) == (False, source, "", True, True)
    groups, _links = grouped(graph)
    assert [(title_of(graph, one), remarks_on(graph, one)) for one in groups] == [
        ("results/result@1", []),
        (f"{source}@1", ["purged"]),
    ]
    assert not house.read(items.read_staleness, "lab", Kind.CHARACTER, result).stale
    for one in (job, failed):
        pin = {"item": source, "revision": 1, "kind": "character", "name": "", "collection": "", "purged": True}
        assert house.desk.job(one).inputs == {"things": [pin]}
    with pytest.raises(ConflictProblem, match=f"its input {source} was purged"):
        house.desk.database.write(house.desk.user, retrying.retry_job, failed)
    with pytest.raises(InvalidProblem, match="There is no character"):
        house.desk.submit("square", inputs={"things": ({"item": source},)})

    house.delete(result)
    house.purge(item=result)
    (output,) = house.desk.outputs(job)
    assert (output.item, output.name, output.purged) == (result, "", True)
    house.collect()
    assert house.faults() == []


def test_the_name_of_a_purged_item_is_nowhere_in_the_database(house: House) -> None:
    source = house.add("other")
    _job, result = run(house.desk, source, NAME, message="walks")
    house.write(
        items.change_item,
        "lab",
        Kind.CHARACTER,
        result,
        ItemChange(tags=("anna",), collection="of-anna"),
        expected_rev=None,
    )
    page = house.read(collections.list_collections, "lab")
    folder = next(one for one in page.items if one.path == "of-anna")
    house.write(collections.delete_collection, "lab", folder.id, expected_rev=None)
    assert "anna" in texts_of_database(house)
    house.purge(item=result)
    house.collect()
    assert [line for line in texts_of_database(house).splitlines() if "anna" in line] == []
    assert house.faults() == []


def test_the_purge_is_an_event_with_its_actor_and_earlier_events_lose_the_name(house: House) -> None:
    one = house.add(NAME)
    house.delete(one)
    house.purge(item=one)
    found = house.events(one)
    assert [event.kind for event in found] == ["item.created", "item.deleted", "item.purged"]
    assert found[-1].actor == "ann"
    assert found[-1].body == {"item_kind": "character"}
    assert all("name" not in event.body and "collection" not in event.body for event in found)
    assert found[0].body["item_kind"] == "character"


def test_the_record_of_an_export_without_consent_loses_the_path_too(house: House) -> None:
    from marey_schemas.consents import ConsentOverride
    from marey_server.store.items.consents import EndedConsent, record_override

    walk, other = house.add(NAME), house.add("other")
    job = house.desk.submit("square", inputs={"things": ({"item": walk}, {"item": other})})
    project_id = house.read(store_projects.require, "lab").id
    ended = [EndedConsent(walk, f"raw/{NAME}", "2026-01-01"), EndedConsent(other, "raw/other", "2026-01-01")]
    override = ConsentOverride(allow_expired_consent=True, consent_reason="by letter")
    elsewhere = "dataset_that_never_contained_the_clip"
    for subject in (job, elsewhere):
        house.write(record_override, project_id, subject, override, ended)
    house.desk.complete(house.desk.claim())
    house.delete(walk)
    house.purge(item=walk)
    for subject in (job, elsewhere):
        (record,) = [one for one in house.events(subject) if one.kind == "consent.overridden"]
        assert [(one["item"], one["path"]) for one in record.body["clips"]] == [(walk, ""), (other, "raw/other")]
    house.collect()
    assert NAME not in texts_of_database(house)


def test_a_purged_result_is_computed_again_and_not_taken_from_the_cache(house: House) -> None:
    source = house.add("source")
    job, result = run(house.desk, source, "result")
    again = house.desk.submit("square", inputs={"things": ({"item": source},)}, into="results")
    assert house.desk.job(again).cached_from == job
    house.delete(result)
    house.purge(item=result)
    third = house.desk.submit("square", inputs={"things": ({"item": source},)}, into="results")
    assert house.desk.job(third).cached_from is None
    assert house.desk.state(third) == "queued"
    lease = house.desk.claim()
    house.desk.stage(lease, "result", sources={"things": ({"item": source, "revision": 1},)})
    house.desk.complete(lease)
    (made,) = house.desk.outputs(third)
    assert made.item != result
    assert house.read(items.read_item, "lab", Kind.CHARACTER, made.item).name == "result"
    assert house.faults() == []


def test_a_job_that_waits_to_share_a_purged_result_is_queued(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    from marey_server.store.jobs import result_cache

    source = house.add("source")
    _job, result = run(house.desk, source, "result")
    monkeypatch.setattr(result_cache, "SHARED_AT_ONCE", 0)
    waiting = house.desk.submit("square", inputs={"things": ({"item": source},)}, into="results")
    assert house.desk.state(waiting) == "waiting"
    house.delete(result)
    house.purge(item=result)
    assert house.desk.state(waiting) == "queued"
    assert house.desk.claim().job == waiting


def test_quotas_count_a_purged_item_no_more_than_a_deleted_one(house: House) -> None:
    one = house.add("one")
    house.delete(one)

    def held(tx: Transaction) -> Any:
        return holdings.show_quotas(tx, "project", store_projects.require(tx, "lab").id)

    before = house.read(held)
    house.purge(item=one)
    assert house.read(held) == before
    assert house.faults() == []


def test_fsck_finds_a_purge_that_left_something(house: House) -> None:
    one = house.add("one")
    house.delete(one)
    house.purge(item=one)
    house.write(lambda tx: tx.execute(item_rows.update().where(item_rows.c.id == one).values(name=NAME)))
    (fault,) = house.faults()
    assert (fault.code, fault.subject) == ("purge-incomplete", one)


def test_fsck_finds_a_document_whose_references_are_not_recorded(house: House) -> None:
    from marey_server.store.tables import document_item

    house.add_clips("walk")
    house.write(lambda tx: tx.execute(document_item.delete()))
    assert {fault.code for fault in house.faults()} == {"document-reference"}


# -- together with other writes ---------------------------------------------------------------------------------------


def test_a_commit_that_was_computed_before_a_purge_is_not_recorded_after_it(house: House) -> None:
    from marey_schemas.datasets.commits import CommitCreate

    walk = house.add("walk")
    request = CommitCreate(message="m", changes=(PutEntry(path="walk", item=walk),))
    prepared = house.read(datasets.prepare_commit, "lab", "gaits", request)
    house.delete(walk)
    house.purge(item=walk)
    with pytest.raises(ConflictProblem, match="purged while the request was prepared"):
        house.write(datasets.record_commit, "lab", "gaits", prepared)
    assert house.gaits.head() is None
    assert house.faults() == []


def test_a_purge_that_was_prepared_before_a_commit_sees_the_commit(house: House) -> None:
    walk, run_ = house.add("walk"), house.add("run")
    house.gaits.change(PutEntry(path="first", item=run_))
    request = PurgeRequest(item=walk)
    house.delete(walk)
    prepared = house.read(purging.prepare_purge, "lab", request)
    house.write(items.restore_item, "lab", Kind.CHARACTER, walk)
    house.gaits.change(PutEntry(path="walk", item=walk))
    with pytest.raises(ConflictProblem, match="delete it first"):
        house.write(purging.record_purge, "lab", request, prepared)
    house.delete(walk)
    with pytest.raises(ConflictProblem, match=r"the dataset gaits \(branch main; 1 commit\)"):
        house.write(purging.record_purge, "lab", request, prepared)
    assert house.faults() == []


def test_a_job_that_was_submitted_after_the_preparation_holds_its_input(house: House) -> None:
    thing = house.add("thing")
    request = PurgeRequest(item=thing)
    house.delete(thing)
    prepared = house.read(purging.prepare_purge, "lab", request)
    house.write(items.restore_item, "lab", Kind.CHARACTER, thing)
    house.desk.submit("square", inputs={"things": ({"item": thing},)})
    house.delete(thing)
    with pytest.raises(ConflictProblem, match="the queued job"):
        house.write(purging.record_purge, "lab", request, prepared)


def test_a_job_that_named_an_item_after_the_preparation_loses_its_name_too(house: House) -> None:
    thing = house.add(NAME)
    request = PurgeRequest(item=thing)
    house.delete(thing)
    prepared = house.read(purging.prepare_purge, "lab", request)
    house.write(items.restore_item, "lab", Kind.CHARACTER, thing)
    job, result = run(house.desk, thing, "result")
    house.delete(thing)
    house.write(purging.record_purge, "lab", request, prepared)
    assert house.desk.job(job).inputs["things"][0]["purged"]
    house.collect()
    assert NAME not in texts_of_database(house)
    assert house.read(items.read_item, "lab", Kind.CHARACTER, result).name == "result"
    assert house.faults() == []


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_jobs_are_found_by_the_items_that_they_name(house: House) -> None:
    """The query plans of SQLite show that the preview of a purge reads neither all jobs nor all items."""
    thing = house.add("thing")
    job = house.desk.submit("square", inputs={"things": ({"item": thing},)})
    house.delete(thing)
    seen: list[tuple[str, Any]] = []

    def examine(tx: Transaction) -> PurgeAnswer:
        def note(_connection: object, _cursor: object, statement: str, parameters: Any, *_: object) -> None:
            seen.append((statement, parameters))

        event.listen(tx.connection, "before_cursor_execute", note)
        shown: PurgeAnswer = purging.preview_purge(tx, "lab", PurgeRequest(collection=""))
        event.remove(tx.connection, "before_cursor_execute", note)
        steps = [
            row[3]
            for statement, parameters in seen
            for row in tx.connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", parameters)
        ]
        assert [step for step in steps if re.match(r"SCAN (job|item|revision|document)\b", step)] == []
        assert [step for step in steps if "ix_job_listing" in step or "ix_item_listing" in step] == []
        assert any("ix_item_deleted" in step for step in steps)
        return shown

    assert [one.holders for one in house.read(examine).refused] == [
        (JobHolder(job=job, kind="square", state="queued"),)
    ]


def test_fsck_finds_a_job_whose_items_are_not_recorded(house: House) -> None:
    from marey_server.store.tables import job_item

    job = house.desk.submit("square", inputs={"things": ({"item": house.add("thing")},)})
    house.write(lambda tx: tx.execute(job_item.delete()))
    assert [(fault.code, fault.subject) for fault in house.faults()] == [("job-reference", job)]


def test_the_items_that_many_tasks_name_are_recorded_in_portions(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    portions: list[int] = []
    things = tuple({"item": house.add(f"s{n}", n)} for n in range(5))

    def note(tx: Transaction, statement: Prepared, many: Sequence[Mapping[str, Any]]) -> None:
        portions.extend([len(many)] if many[0].keys() == {"job_id", "item_id"} else [])
        statement.run_each(tx.connection, many)

    monkeypatch.setattr(transaction, "_MOST_IN_LIST", 4)
    monkeypatch.setattr(Transaction, "run_each", note)
    house.desk.submit("survey", inputs={"things": things}, params={"number": 3})
    assert (sum(portions), max(portions)) == (4 * len(things), 4)
    assert house.faults() == []


def test_chunks_are_read_once_however_many_versions_share_them(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    many = [house.add(f"s{n}", n) for n in range(200)]
    house.gaits.change(*(PutEntry(path=f"folder-{n:03}/entry", item=one) for n, one in enumerate(many)))
    for number in range(5):
        house.gaits.change(RemoveEntry(path=f"folder-{number:03}/entry", kind=Kind.CHARACTER))
    house.delete(many[0])
    read: list[str] = []

    def counting(digest: str, data: bytes) -> Any:
        read.append(digest)
        return decode_trusted(digest, data)

    monkeypatch.setattr(versions, "decode_trusted", counting)
    (holder, *_) = house.purge(item=many[0], preview=True).refused[0].holders
    assert isinstance(holder, DatasetHolder)
    assert holder.commits == 1
    assert len(read) == len(set(read))


def test_blobs_of_jobs_are_not_counted_as_freed(house: House) -> None:
    data = b"x" * 5000
    house.write(blobs.put_blob, data)
    one = house.add("one", character=document(blob=digest_of(data)))
    job = house.desk.submit("errand")
    house.write(blobs.keep_for_job, job, [digest_of(data)])
    house.delete(one)
    assert house.purge(item=one).freed_bytes < 1000


def test_files_that_jobs_imported_or_made_of_a_purged_item_are_released(house: House) -> None:
    """The job that imported the file, and the job that exported the item, keep no copy of the content."""
    source, archive = b"s" * 3000, b"a" * 4000
    made = house.desk.submit("sum")
    lease = house.desk.claim()
    house.desk.database.write(house.desk.attempt(lease), blobs.put_blob, source)
    house.desk.stage(lease, "take", facts={"blob": digest_of(source)})
    house.desk.complete(lease, result={"source": {"blob": digest_of(source)}})
    (take,) = house.desk.outputs(made)
    export = house.desk.submit("square", inputs={"things": ({"item": take.item},)})
    lease = house.desk.claim()
    house.desk.database.write(house.desk.attempt(lease), blobs.put_blob, archive)
    house.desk.complete(lease, result={"archive": {"blob": digest_of(archive)}})
    house.delete(take.item)
    assert house.purge(item=take.item, preview=True).freed_bytes > 3000
    assert house.purge(item=take.item).freed_bytes > 3000
    assert house.collect().blobs == 2
    assert (house.desk.job(export).result or {})["archive"] == {"blob": digest_of(archive)}
    assert house.read(blobs.readable, [digest_of(data) for data in (source, archive)]) == set()
    assert house.faults() == []


# -- poses in indexes of motions --------------------------------------------------------------------------------------


class IndexedHouse:
    """Indexes of motions that contain clips of a house."""

    def __init__(self, house: House) -> None:
        self.house = house
        self.files = 0

    def shard(self, *clips: str) -> dict[str, Any]:
        """Store the files of a shard with poses of clips."""
        count = len(clips)
        lists = {name: [1] * count for name in ("revisions", "rows", "joints", "frames", "rates_hz")}
        return self.shard_of(json.dumps({"items": clips, **lists}).encode(), count)

    def shard_of(self, listed: bytes, rows: int = 1) -> dict[str, Any]:
        self.files += 1
        files = {"clips": listed, "poses": b"poses %d" % self.files}
        for content in files.values():
            self.house.write(blobs.put_blob, content)
        sizes = {name: {"blob": digest_of(one), "size_bytes": len(one)} for name, one in files.items()}
        return {**sizes, "rows": rows}

    def add(self, *shards: dict[str, Any], name: str = "motion-index") -> str:
        (made,) = self.house.desk.publish(Draft("i", Kind.INDEX, name, {"index": self.document(*shards)}))
        return made.item

    def update(self, index: str, *shards: dict[str, Any]) -> None:
        self.house.write(
            items.put_part, "lab", Kind.INDEX, index, "index", self.document(*shards), expected_rev=None, message=""
        )

    def document(self, *shards: dict[str, Any]) -> dict[str, Any]:
        return {"schema": "marey/motion-index@1", "clips": 1, "rows": 1, "shards": list(shards)}


def test_a_purge_deletes_indexes_of_which_an_earlier_revision_contains_poses_of_the_clip(house: House) -> None:
    _, (walk, run) = house.add_clips("walk", "run")
    indexed = IndexedHouse(house)
    kept = indexed.shard(run)
    index, other = indexed.add(kept, indexed.shard(walk)), indexed.add(kept, name="other")
    indexed.update(index, kept)
    house.delete(walk)
    expected = house.purge(item=walk, preview=True)
    assert [(one.kind, one.path) for one in expected.purged] == [(Kind.CLIP, "raw/walk"), (Kind.INDEX, "motion-index")]
    assert {one.item for one in house.purge(item=walk).purged} == {walk, index}
    assert {one.kind for one in house.events(index)} >= {"item.deleted"}
    assert house.collect().blobs == 3, "the list of clips, the poses, and the motion of the purged clip"
    assert [one.id for one in house.read(items.list_items, "lab", Kind.INDEX, items.ItemFilters()).items] == [other]
    assert house.faults() == []


def test_clips_that_an_index_does_not_use_any_more_are_in_its_files(house: House) -> None:
    _, (walk, run) = house.add_clips("walk", "run")
    indexed = IndexedHouse(house)
    index = indexed.add({**indexed.shard(walk, run), "dropped": [0]})
    house.delete(walk, run)
    assert {one.item for one in house.purge(item=walk).purged} == {walk, index}
    assert [one.item for one in house.purge(item=run).purged] == [run]


def test_an_unfinished_job_that_reads_an_index_holds_the_clips_in_it(house: House) -> None:
    _, (walk, run) = house.add_clips("walk", "run")
    indexed = IndexedHouse(house)
    index = indexed.add(indexed.shard(walk))
    job = house.desk.submit("index", inputs={"clips": ({"item": run},), "index": ({"item": index},)})
    house.delete(walk)
    assert house.holders(walk).holders == (ItemHolder(item=index, kind=Kind.INDEX, path="motion-index"),)
    house.desk.cancel(job)
    assert {one.item for one in house.purge(item=walk).purged} == {walk, index}
    assert house.faults() == []


def test_an_index_that_is_written_during_the_preparation_is_found_by_the_purge(house: House) -> None:
    _, (walk,) = house.add_clips("walk")
    house.delete(walk)
    request = PurgeRequest(item=walk)
    prepared = house.read(purging.prepare_purge, "lab", request)
    indexed = IndexedHouse(house)
    index = indexed.add(indexed.shard(walk))
    assert {one.item for one in house.write(purging.record_purge, "lab", request, prepared).purged} == {walk, index}


@pytest.mark.parametrize("listed", [b"{", b"\xff", json.dumps({"items": ["clip_a"]}).encode()])
def test_an_index_with_an_unreadable_list_may_contain_any_clip(house: House, listed: bytes) -> None:
    _, (walk,) = house.add_clips("walk")
    indexed = IndexedHouse(house)
    index = indexed.add(indexed.shard_of(listed))
    thing = house.add("thing")
    house.delete(walk, thing)
    assert [one.item for one in house.purge(item=thing).purged] == [thing], "an index has poses of clips alone"
    assert {one.item for one in house.purge(item=walk).purged} == {walk, index}


def test_copies_of_index_files_are_removed_when_the_store_has_deleted_the_files(house: House, tmp_path: Path) -> None:
    _, (walk, run) = house.add_clips("walk", "run")
    indexed = IndexedHouse(house)
    indexes = {clip: indexed.add(indexed.shard(clip), name=clip) for clip in (walk, run)}
    copies = IndexFiles(tmp_path / "copies")
    assert house.read(copies.remove_unstored) == 0, "no index has been searched"
    for index in indexes.values():
        document = MotionIndexDocument.model_validate(
            house.read(items.read_part, "lab", Kind.INDEX, index, "index", revision=None).tree
        )
        for file in copies.missing(document):
            house.read(copies.copy, file)
    assert house.read(copies.remove_unstored) == 0
    house.delete(walk)
    house.purge(item=walk)
    house.collect()
    (tmp_path / "copies" / "unfinished").write_bytes(b"")
    assert house.read(copies.remove_unstored) == 2
    left = house.read(items.read_part, "lab", Kind.INDEX, indexes[run], "index", revision=None).tree
    assert copies.missing(MotionIndexDocument.model_validate(left)) == []
