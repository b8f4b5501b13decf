"""Purges at the same time as other writes: in any order of commits, nothing refers to a purged item afterwards.

Either the purge is refused and names what holds the item, or the other write is refused with a reason.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillRunning
from dataclasses import dataclass
from typing import Any

import pytest
from sqlalchemy import select
from tests.support.committing_desk import CommittingDesk
from tests.support.interleaving import HEAD_START_S, Step, interleave
from tests.support.patience import PATIENCE_S
from tests.support.queue_desk import Desk, document, output
from tests.support.store_fixtures import ALL_RIGHTS, WRITE, motion_tree, requiring, skeleton_tree

from marey_schemas.access import EVERY_MEMBER, FolderRoleChange
from marey_schemas.datasets.commits import CommitCreate, PutEntry
from marey_schemas.datasets.naming import RefCreate, RefKind
from marey_schemas.datasets.proposals import CommentCreate, ProposalCreate, ProposalMerge
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.purges import DatasetPurgeRequest, PurgeAnswer, PurgeRequest
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.worker_protocol import CompleteRequest, FailRequest, Lease
from marey_server import faults
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ApiProblem, ConflictProblem, GoneProblem, NotFoundProblem
from marey_server.store import collections, datasets, events, fsck, items, projects, purging
from marey_server.store.database.connections import Database
from marey_server.store.datasets import proposals
from marey_server.store.folder_roles import managing
from marey_server.store.items.drafts import Draft
from marey_server.store.items.facets import publish_facets
from marey_server.store.items.publishing import publish
from marey_server.store.jobs import completion, fan_out, reading, reaper, result_cache, submission
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.jobs.policy import QueuePolicy
from marey_server.store.jobs.retrying import retry_job
from marey_server.store.purge_lock import begin_purge
from marey_server.store.purging import erasing
from marey_server.store.quotas import holdings
from marey_server.store.tables import item_facet, job
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

Act = Callable[[Transaction], Any]
ORDERS = pytest.mark.parametrize("order", ["purge first", "purge second"])


@dataclass
class Scene:
    """Project in which one item is purged while another request runs."""

    desk: Desk
    gaits: CommittingDesk
    other: Database

    def add(self, name: str, **facts: Any) -> str:
        """Create a study, and return its id."""
        draft = Draft("d", Kind.CHARACTER, name, {"character": document(name=name, **facts)}, "raw")
        return self.desk.publish(draft)[0].item

    def write(self, function: Any, *args: Any, **kwargs: Any) -> Any:
        return self.desk.database.write(self.desk.user, requiring(WRITE, function), *args, **kwargs)

    def folders(self, path: str) -> list[str]:
        """Return the ids of the folders with this path that are not deleted."""
        page = self.desk.database.read(self.desk.user, collections.list_collections, "lab", path=path)
        return [one.id for one in page.items if one.path == path]

    def delete(self, item: str) -> None:
        kind = Kind(item.partition("_")[0])
        self.write(items.delete_item, "lab", kind, item, expected_rev=None)

    def of_user(self, function: Any, *args: Any, **kwargs: Any) -> Act:
        """Return a function that calls `function` with these arguments, as a user who may write."""
        return lambda tx: requiring(WRITE, function)(tx, *args, **kwargs)

    def purge_of(self, item: str) -> Act:
        """Prepare the purge of a deleted item; return a function that records the purge in a transaction."""
        request = PurgeRequest(item=item)
        prepared = self.desk.database.read(self.desk.user, requiring(WRITE, purging.prepare_purge), "lab", request)
        return self.of_user(purging.record_purge, "lab", request, prepared)

    def race(self, order: str, act: Act, purge: Act, who: Principal | None = None) -> tuple[Any, Any]:
        """Interleave the write `act` and a purge; return the result or error of `act`, then that of the purge.

        Fails if a transaction runs twice, which happens after a deadlock.
        """
        runs: list[str] = []

        def counted(name: str, action: Act) -> Act:
            def run(tx: Transaction) -> Any:
                runs.append(name)
                return action(tx)

            return run

        step = Step(self.desk.database, who or self.desk.user, counted("act", act))
        purging_ = Step(self.other, self.desk.user, counted("purge", purge))
        if order == "purge first":
            purged, done = interleave(purging_, step)
        else:
            done, purged = interleave(step, purging_)
        assert sorted(runs) == ["act", "purge"], "two transactions waited for each other"
        return done, purged

    def race_half_way(
        self, act: Act, purge: Act, *, before: tuple[Any, str] = (events, "forget_names")
    ) -> tuple[Any, Any]:
        """Pause a purge before it calls a function, and let `act` begin meanwhile; return both results.

        `before` is the module and the name of the function. By default, the purge has locked the items at this point,
        and has deleted nothing yet.
        """
        paused, may_go_on = threading.Event(), threading.Event()
        runs: list[str] = []

        def go_on_later(*args: Any) -> Any:
            paused.set()
            may_go_on.wait(PATIENCE_S)
            return function(*args)

        def run_purge(tx: Transaction) -> Any:
            runs.append("purge")
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(*before, go_on_later)
                return purge(tx)

        def run_act(tx: Transaction) -> Any:
            runs.append("act")
            return act(tx)

        function = getattr(*before)
        with ThreadPoolExecutor(2) as pool:
            purging_ = pool.submit(self.other.write, self.desk.user, run_purge)
            assert paused.wait(PATIENCE_S)
            acting = pool.submit(self.desk.database.write, self.desk.user, run_act)
            with contextlib.suppress(StillRunning):
                acting.exception(HEAD_START_S)
            may_go_on.set()
            outcomes = [future.exception(PATIENCE_S) or future.result() for future in (acting, purging_)]
        assert sorted(runs) == ["act", "purge"], "two transactions waited for each other"
        return outcomes[0], outcomes[1]

    def race_after_deletion(
        self, item: str, act: Act, who: Principal | None = None, *, while_publishing: bool = False
    ) -> tuple[Any, Any]:
        """Delete `item` and begin its purge after `act` has read it, but before `act` commits; return both results.

        On SQLite, transactions do not overlap, so the item is deleted and purged after `act`. With `while_publishing`,
        the item is deleted just before `act` counts what it has added to the project. After this count, a deletion
        would wait for `act`.
        """

        def delete_and_count(*args: Any) -> None:
            self.delete(item)
            count_added(*args)

        def act_beside_deletion(tx: Transaction) -> Any:
            with pytest.MonkeyPatch.context() as patch:
                if while_publishing:
                    patch.setattr(holdings, "count_added", delete_and_count)
                done = act(tx)
            if not while_publishing:
                self.delete(item)
            return done

        def purge(tx: Transaction) -> Any:
            request = PurgeRequest(item=item)
            return recording(tx, "lab", request, preparation(tx, "lab", request))

        count_added = holdings.count_added
        preparation, recording = requiring(WRITE, purging.prepare_purge), requiring(WRITE, purging.record_purge)
        principal, database = who or self.desk.user, self.desk.database
        if not database.is_sqlite:
            step = Step(database, principal, act_beside_deletion)
            return interleave(step, Step(self.other, self.desk.user, purge))
        done = database.write(principal, act)
        self.delete(item)
        try:
            return done, self.other.write(self.desk.user, purge)
        except ApiProblem as error:
            return done, error

    def complete(self, lease: Lease) -> Act:
        request = CompleteRequest(write_id=self.desk.write_id())
        return lambda tx: completion.complete(tx, lease.job, lease.fence, request)

    def assert_sound(self) -> None:
        assert list(fsck.check_store(self.desk.database)) == []


@pytest.fixture
def scene(desk: Desk, gaits: CommittingDesk, open_database: Callable[[], Database]) -> Scene:
    return Scene(desk, gaits, open_database())


def require_held_by(purged: Any, what: str) -> None:
    """Check that a purge was refused, and that the refusal names what holds the item."""
    assert isinstance(purged, ConflictProblem), purged
    assert purged.error_code == "still-held"
    assert what in purged.detail


def require_purged(purged: Any, item: str) -> None:
    assert isinstance(purged, PurgeAnswer), purged
    assert [one.item for one in purged.purged] == [item]


# -- restored items ---------------------------------------------------------------------------------------------------


@ORDERS
def test_an_item_is_restored_or_purged(scene: Scene, order: str) -> None:
    thing = scene.add("thing")
    scene.delete(thing)
    restore = scene.of_user(items.restore_item, "lab", Kind.CHARACTER, thing)
    done, purged = scene.race(order, restore, scene.purge_of(thing))
    if order == "purge first":
        assert isinstance(done, GoneProblem)
        require_purged(purged, thing)
    else:
        assert done.id == thing
        assert isinstance(purged, ConflictProblem)
        assert purged.error_code == "not-deleted"
    scene.assert_sound()


def test_a_folder_is_not_restored_while_half_of_a_purge_is_done(scene: Scene) -> None:
    """A purge locks the item before the folder; the restoration of a folder locks the folder before the item."""
    thing = scene.add("thing")
    (raw,) = scene.folders("raw")
    scene.write(collections.delete_collection, "lab", raw, expected_rev=None)
    restore = scene.of_user(collections.restore_collection, "lab", raw)
    done, purged = scene.race_half_way(restore, scene.purge_of(thing))
    assert isinstance(done, NotFoundProblem)
    require_purged(purged, thing)
    scene.assert_sound()


def test_a_folder_that_is_deleted_during_a_purge_keeps_its_items_and_roles(scene: Scene) -> None:
    """Deletions do not wait for purges. The folder that is kept is new, and has the path of the purged folder."""
    thing = scene.add("thing")
    (raw,) = scene.folders("raw")
    scene.write(collections.delete_collection, "lab", raw, expected_rev=None)
    purge = scene.purge_of(thing)
    kept = scene.add("kept")
    (again,) = scene.folders("raw")
    change = FolderRoleChange.model_validate({"role": "reader"})
    scene.write(managing.put_folder_role, "lab", again, EVERY_MEMBER, change)
    delete = scene.of_user(collections.delete_collection, "lab", again, expected_rev=None)
    done, purged = scene.race_half_way(delete, purge, before=(erasing, "_is_within"))
    assert done is None
    require_purged(purged, thing)
    scene.write(collections.restore_collection, "lab", again)
    found = scene.desk.database.read(scene.desk.user, items.read_item, "lab", Kind.CHARACTER, kept)
    assert found.collection == "raw"
    roles = scene.desk.database.read(scene.desk.user, managing.list_folder_roles, "lab").items
    assert [(one.folder, one.role) for one in roles] == [("raw", "reader")]
    scene.assert_sound()


@ORDERS
def test_a_folder_is_restored_with_its_items_or_these_are_purged(scene: Scene, order: str) -> None:
    thing = scene.add("thing")
    (raw,) = scene.folders("raw")
    scene.write(collections.delete_collection, "lab", raw, expected_rev=None)
    restore = scene.of_user(collections.restore_collection, "lab", raw)
    done, purged = scene.race(order, restore, scene.purge_of(thing))
    if order == "purge first":
        assert isinstance(done, NotFoundProblem)
        require_purged(purged, thing)
    else:
        assert done.path == "raw"
        assert isinstance(purged, ConflictProblem)
    scene.assert_sound()


# -- imported items ---------------------------------------------------------------------------------------------------


def clip_of(rig: str, name: str = "walk") -> ItemCreate:
    return ItemCreate(name=name, parts={"motion": motion_tree({"item": rig, "revision": 1})})


def test_a_clip_that_is_imported_holds_its_skeleton(scene: Scene) -> None:
    (rig,) = scene.desk.publish(Draft("r", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}))
    create = scene.of_user(items.create_item, "lab", Kind.CLIP, clip_of(rig.item))
    _done, purged = scene.race_after_deletion(rig.item, create, while_publishing=True)
    require_held_by(purged, "the clip walk")
    scene.assert_sound()


@ORDERS
def test_an_import_does_not_share_a_skeleton_that_is_being_purged(scene: Scene, order: str) -> None:
    """The import finds a skeleton with equal content, which is deleted and purged before the import commits."""
    tree = skeleton_tree()
    (rig,) = scene.desk.publish(Draft("r", Kind.SKELETON, "rig", {"hierarchy": tree}))

    def share(tx: Transaction) -> Any:
        skeleton = Draft("r", Kind.SKELETON, "rig", {"hierarchy": tree}, reuse="by_content")
        clip = Draft("c", Kind.CLIP, "walk", {"motion": motion_tree({"output": "r"})}, "raw")
        row = projects.require(tx, "lab")
        return publish(tx, row, [skeleton, clip], author_id=tx.principal.user_id, rights=ALL_RIGHTS)

    if order == "purge second":
        done, purged = scene.race_after_deletion(rig.item, share, while_publishing=True)
        assert done[0].item == rig.item
        require_held_by(purged, "the clip raw/walk")
    else:
        scene.delete(rig.item)
        done, purged = scene.race(order, share, scene.purge_of(rig.item))
        assert done[0].item != rig.item
        require_purged(purged, rig.item)
    scene.assert_sound()


def test_a_new_revision_of_an_item_that_is_deleted_meanwhile_goes_with_it(scene: Scene) -> None:
    thing = scene.add("thing")
    revise = scene.of_user(items.put_part, "lab", Kind.CHARACTER, thing, "character", document(n=2), expected_rev=None)
    scene.write(revise)
    scene.delete(thing)
    revised, purged = scene.race("purge first", revise, scene.purge_of(thing))
    assert isinstance(revised, NotFoundProblem)
    require_purged(purged, thing)
    scene.assert_sound()


# -- jobs -------------------------------------------------------------------------------------------------------------


def square_of(*things: str, **fields: Any) -> JobCreate:
    return JobCreate.model_validate(
        {"kind": "square", "inputs": {"things": [{"item": one} for one in things]}} | fields
    )


def test_a_job_that_is_submitted_while_its_input_is_deleted_holds_it(scene: Scene) -> None:
    thing = scene.add("thing")
    submit = scene.of_user(submission.submit, "lab", [square_of(thing)])
    (made,), purged = scene.race_after_deletion(thing, submit)
    require_held_by(purged, f"the queued job {made.id}")
    scene.desk.complete(scene.desk.claim(job=made.id))
    scene.assert_sound()


@ORDERS
def test_a_job_that_is_retried_holds_its_input_or_is_refused(scene: Scene, order: str) -> None:
    thing = scene.add("thing")
    (failed,) = scene.desk.submit_many(square_of(thing))
    scene.desk.fail(scene.desk.claim(), retryable=False)
    scene.delete(thing)
    done, purged = scene.race(order, lambda tx: retry_job(tx, failed), scene.purge_of(thing))
    if order == "purge first":
        assert isinstance(done, ConflictProblem)
        assert done.error_code == "input-purged"
        require_purged(purged, thing)
    else:
        require_held_by(purged, f"the queued job {done.id}")
    scene.assert_sound()


@ORDERS
def test_a_job_that_ends_while_its_input_is_purged_ends_once(scene: Scene, order: str) -> None:
    thing = scene.add("thing")
    (job,) = scene.desk.submit_many(square_of(thing))
    lease = scene.desk.claim()
    scene.desk.stage(lease, "square", sources={"things": ({"item": thing, "revision": 1},)})
    scene.delete(thing)
    done, purged = scene.race(order, scene.complete(lease), scene.purge_of(thing), scene.desk.attempt(lease))
    assert done.state == "succeeded"
    if order == "purge first":
        require_held_by(purged, f"the running job {job}")
    else:
        require_purged(purged, thing)
        assert scene.desk.job(job).inputs["things"][0]["purged"]
    scene.assert_sound()


def test_a_late_input_that_is_deleted_while_it_is_pinned_is_held(scene: Scene) -> None:
    """A completed job gives an existing item to another job as its input, while a user deletes and purges the item."""
    thing = scene.add("thing")
    (maker,) = scene.desk.submit_many(JobCreate(kind="sum", into="raw"))
    (reader,) = scene.desk.submit_many(
        JobCreate.model_validate({"kind": "square", "inputs": {"things": [{"job": maker}]}})
    )
    lease = scene.desk.claim(job=maker)
    same = output("thing", facts={}, reuse="by_content")
    scene.desk.stage_outputs(lease, same)
    _done, purged = scene.race_after_deletion(thing, scene.complete(lease), scene.desk.attempt(lease))
    assert [one.item for one in scene.desk.outputs(maker)] == [thing]
    require_held_by(purged, f"the queued job {reader}")
    scene.assert_sound()


@ORDERS
def test_a_cached_result_is_shared_or_its_item_is_purged(scene: Scene, order: str) -> None:
    source = scene.add("source")
    (first,) = scene.desk.submit_many(square_of(source, into="made"))
    lease = scene.desk.claim()
    scene.desk.stage(lease, "square", sources={"things": ({"item": source, "revision": 1},)})
    scene.desk.complete(lease)
    (made,) = scene.desk.outputs(first)
    scene.delete(made.item)
    submit = scene.of_user(submission.submit, "lab", [square_of(source, into="again")])
    done, purged = scene.race(order, submit, scene.purge_of(made.item))
    require_purged(purged, made.item)
    (job,) = done
    assert scene.desk.job(job.id).cached_from == (None if order == "purge first" else first)
    if order == "purge second":
        (copy,) = scene.desk.outputs(job.id)
        assert (
            scene.desk.database.read(scene.desk.user, items.read_item, "lab", Kind.CHARACTER, copy.item).name
            == "square"
        )
    scene.assert_sound()


def test_a_job_that_awaits_a_purged_result_is_queued_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server looks for a result to share with the job, while a purge that is half done deletes this result."""
    source = scene.add("source")
    (first,) = scene.desk.submit_many(square_of(source, into="made"))
    lease = scene.desk.claim()
    scene.desk.stage(lease, "square", sources={"things": ({"item": source, "revision": 1},)})
    scene.desk.complete(lease)
    (made,) = scene.desk.outputs(first)
    with monkeypatch.context() as patch:
        patch.setattr(result_cache, "SHARED_AT_ONCE", 0)
        (waiting,) = scene.desk.submit_many(square_of(source, into="again"))
    scene.delete(made.item)
    shared, purged = scene.race_half_way(reaper.share_waiting, scene.purge_of(made.item))
    assert shared == 0
    require_purged(purged, made.item)
    assert scene.desk.state(waiting) == "queued"
    scene.assert_sound()


@ORDERS
@pytest.mark.parametrize("ends", ["cancel", "fail", "reap", "share"])
def test_a_job_whose_result_others_await_ends_beside_a_purge(scene: Scene, order: str, ends: str) -> None:
    """The end of a job may publish items or fix the inputs of other jobs; it must form no deadlock with a purge."""
    thing, kept = scene.add("thing"), scene.add("kept", n=2)
    (job,) = scene.desk.submit_many(square_of(kept, max_attempts=1))
    lease = scene.desk.claim()
    (behind,) = scene.desk.submit_many(JobCreate(kind="errand", after=(job,)))
    scene.delete(thing)
    scene.desk.clock.advance(3600)
    fail = FailRequest(write_id="write-last", code="x", retryable=False)
    acts: dict[str, tuple[Act, Any]] = {
        "cancel": (lambda tx: reading.cancel_job(tx, behind), scene.desk.user),
        "fail": (lambda tx: completion.fail(tx, lease.job, lease.fence, fail), scene.desk.attempt(lease)),
        "reap": (lambda tx: reaper.reap_page(tx, QueuePolicy(max_unstarted=0)), SYSTEM),
        "share": (reaper.share_waiting, SYSTEM),
    }
    done, purged = scene.race(order, acts[ends][0], scene.purge_of(thing), acts[ends][1])
    assert not isinstance(done, ApiProblem), done
    require_purged(purged, thing)
    assert scene.desk.state(behind) == {"cancel": "cancelled", "share": "waiting"}.get(ends, "failed")
    scene.assert_sound()


def test_a_commit_of_many_outputs_waits_for_a_purge_before_it_locks_its_job(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fan_out, "MOST_AT_END", 1)
    things = [{"item": scene.add(f"thing{number}", n=number)} for number in range(4)]
    made = scene.gaits.submit("square", into="made", inputs={"things": things})
    for number in range(2):
        scene.gaits.work(f"a{number}")
    project_id = scene.desk.database.read(scene.desk.user, requiring(WRITE, projects.require), "lab").id
    begun, planned = threading.Event(), threading.Event()

    def passed(name: str) -> None:
        if name == "deferred_commit.after_chunks":
            planned.set()

    def purge(tx: Transaction) -> list[str]:
        begin_purge(tx, project_id)
        begun.set()
        if tx.is_postgres:
            assert planned.wait(PATIENCE_S)
        threading.Event().wait(HEAD_START_S)
        free = select(job.c.id).where(job.c.id == made).with_for_update(skip_locked=True)
        return list(tx.execute(free).scalars())

    monkeypatch.setattr(faults, "point", passed)
    with ThreadPoolExecutor(2) as pool:
        purging_ = pool.submit(scene.other.write, scene.desk.user, purge)
        assert begun.wait(PATIENCE_S)
        committing = pool.submit(commit_deferred, scene.desk.database)
        assert purging_.result(PATIENCE_S) == [made]
        assert committing.result(PATIENCE_S) == 1
    assert scene.desk.state(made) == "succeeded"


@ORDERS
def test_no_facet_of_a_purged_item_is_published(scene: Scene, order: str) -> None:
    thing, kept = scene.add("thing"), scene.add("kept", n=2)
    scene.delete(thing)
    project_id = scene.desk.database.read(scene.desk.user, requiring(WRITE, projects.require), "lab").id
    facets = [[thing, 1, {"usage": 0.5}], [kept, 1, {"usage": 0.5}]]
    done, purged = scene.race(order, lambda tx: publish_facets(tx, project_id, facets), scene.purge_of(thing))
    assert not isinstance(done, ApiProblem), done
    require_purged(purged, thing)
    named = scene.desk.database.read(SYSTEM, lambda tx: tx.execute(select(item_facet.c.item_id)).scalars().all())
    assert named == [kept]
    scene.assert_sound()


# -- versions ---------------------------------------------------------------------------------------------------------


@ORDERS
def test_a_commit_holds_its_items_or_is_refused(scene: Scene, order: str) -> None:
    thing = scene.add("thing")
    request = CommitCreate(message="m", changes=(PutEntry(path="thing", item=thing),))
    prepared = scene.gaits.read(datasets.prepare_commit, "lab", "gaits", request)
    scene.delete(thing)
    commit = scene.of_user(datasets.record_commit, "lab", "gaits", prepared)
    done, purged = scene.race(order, commit, scene.purge_of(thing))
    if order == "purge first":
        assert isinstance(done, ConflictProblem)
        assert done.error_code == "purged-meanwhile"
        require_purged(purged, thing)
    else:
        require_held_by(purged, "the dataset gaits (branch main; 1 commit)")
    scene.assert_sound()


def test_a_job_that_commits_an_item_which_others_delete_holds_it(scene: Scene) -> None:
    thing = scene.add("thing")
    job = scene.gaits.submit("sum", into="raw")
    lease = scene.desk.claim(job=job)
    scene.desk.stage_outputs(lease, output("thing", reuse="by_content"))
    done, purged = scene.race_after_deletion(thing, scene.complete(lease), scene.desk.attempt(lease))
    assert done.commit is not None
    require_held_by(purged, "the dataset gaits (branch main; 1 commit)")
    scene.assert_sound()


@ORDERS
def test_a_merge_of_a_proposal_and_a_purge_do_not_hinder_each_other(scene: Scene, order: str) -> None:
    kept, thing = scene.add("kept"), scene.add("thing")
    scene.gaits.change(PutEntry(path="kept", item=kept))
    scene.write(datasets.create_ref, "lab", "gaits", RefCreate(name="more", kind=RefKind.BRANCH, at="main"))
    scene.gaits.change(PutEntry(path="thing", item=thing), branch="more")
    scene.write(proposals.open_proposal, "lab", "gaits", ProposalCreate(title="t", source="more", target="main"))
    scene.delete(thing)
    head = scene.gaits.head("more")
    request = ProposalMerge(commit=head)
    prepared = scene.gaits.read(proposals.prepare_acceptance, "lab", "gaits", 1, request)
    merge = scene.of_user(proposals.merge_proposal, "lab", "gaits", 1, request, prepared)
    done, purged = scene.race(order, merge, scene.purge_of(thing))
    assert done.state == "merged"
    require_held_by(purged, "the dataset gaits")
    scene.assert_sound()


@pytest.mark.parametrize("does", ["tag", "comment", "commit"])
def test_what_is_added_to_a_dataset_while_it_is_deleted_is_purged_with_it(scene: Scene, does: str) -> None:
    """The dataset is deleted and purged after a request has found it, and before the request commits."""
    thing = scene.add("thing")
    scene.gaits.change(PutEntry(path="kept", item=scene.add("kept", n=2)))
    scene.write(datasets.create_ref, "lab", "gaits", RefCreate(name="more", kind=RefKind.BRANCH, at="main"))
    scene.gaits.change(PutEntry(path="thing", item=thing), branch="more")
    scene.write(proposals.open_proposal, "lab", "gaits", ProposalCreate(title="t", source="more", target="main"))
    again = CommitCreate(message="m", changes=(PutEntry(path="again", item=thing),))
    prepared_commit = scene.gaits.read(datasets.prepare_commit, "lab", "gaits", again)
    acts = {
        "tag": scene.of_user(datasets.create_ref, "lab", "gaits", RefCreate(name="v", kind=RefKind.TAG, at="main")),
        "comment": scene.of_user(proposals.add_comment, "lab", "gaits", 1, CommentCreate(text="hello")),
        "commit": scene.of_user(datasets.record_commit, "lab", "gaits", prepared_commit),
    }
    request = DatasetPurgeRequest(dataset="gaits")

    def delete() -> None:
        scene.write(datasets.delete_dataset, "lab", "gaits", expected_rev=None)

    def act(tx: Transaction) -> Any:
        done = acts[does](tx)
        if tx.is_postgres:
            delete()
        return done

    def purge(tx: Transaction) -> Any:
        if not tx.is_postgres:
            requiring(WRITE, datasets.delete_dataset)(tx, "lab", "gaits", expected_rev=None)
        return purge_again(tx)

    def purge_again(tx: Transaction) -> Any:
        prepared = requiring(WRITE, purging.prepare_dataset_purge)(tx, "lab", request)
        return requiring(WRITE, purging.record_dataset_purge)(tx, "lab", request, prepared)

    done, purged = interleave(
        Step(scene.desk.database, scene.desk.user, act), Step(scene.other, scene.desk.user, purge)
    )
    assert not isinstance(done, ApiProblem), done
    if does == "commit" and not scene.desk.database.is_sqlite:  # the purge was prepared without this commit
        assert isinstance(purged, ConflictProblem)
        assert purged.error_code == "purged-meanwhile"
        purged = scene.desk.database.write(scene.desk.user, purge_again)
    assert (purged.name, purged.commits) == ("gaits", 3 if does == "commit" else 2)
    scene.assert_sound()
