"""Jobs that commit their outputs: one transaction both publishes the outputs and moves the branch."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from sqlalchemy import update
from tests.support.committing_desk import CommittingDesk
from tests.support.present import present
from tests.support.queue_desk import Desk, document
from tests.support.store_fixtures import motion_tree, skeleton_tree

from marey_schemas.access import MemberChange, Role, UserCreate
from marey_schemas.datasets.commits import CommitCreate, PutEntry, RemoveEntry
from marey_schemas.datasets.naming import RefCreate, RefKind
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.encoding.digests import digest_of
from marey_schemas.imports import skeleton_output
from marey_schemas.items import ItemChange
from marey_schemas.kinds import Kind
from marey_schemas.lineage import LineageRequest
from marey_schemas.queue.jobs import ItemInput, JobOutputsInput
from marey_schemas.queue.worker_protocol import BatchCompletion, StagedOutput
from marey_server.access.principal import SYSTEM
from marey_server.errors import ConflictProblem, ForbiddenProblem, InvalidProblem, LeaseLostProblem
from marey_server.store import blobs, datasets, events, fsck, items, members, users
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import commits, completion, reading, retrying, staging
from marey_server.store.retention import Retention, retire
from marey_server.store.tables import tree_chunk

pytestmark = pytest.mark.every_database


def test_a_job_commits_its_outputs_when_it_completes(gaits: CommittingDesk) -> None:
    made = gaits.submit(into="made")
    assert gaits.head() is None
    assert gaits.job(made).commit is not None
    gaits.work("a", "b")
    found = gaits.job(made)
    (first, second) = gaits.desk.outputs(made)
    assert gaits.entries() == {"made/a": first.item, "made/b": second.item}
    commit = gaits.commit()
    assert found.commit is not None
    assert (found.state, found.commit.digest, found.publish_conflict) == ("succeeded", commit.digest, None)
    assert (commit.job, commit.author, commit.message, commit.parents) == (made, "ann", f"Results of sum {made}", ())
    assert [first.entry, second.entry] == ["made/a", "made/b"]


def test_others_commits_to_other_paths_stay(gaits: CommittingDesk) -> None:
    gaits.put("mine", number=1)
    made = gaits.submit(into="made")
    theirs = gaits.put("later", number=2)
    before = gaits.head()
    gaits.work("a")
    (output,) = gaits.desk.outputs(made)
    assert gaits.commit().parents == (before,)
    assert gaits.entries().keys() == {"mine", "later", "made/a"}
    assert gaits.entries()["later"] == theirs
    assert gaits.entries()["made/a"] == output.item


def test_a_path_that_somebody_changed_meanwhile_is_not_overwritten(gaits: CommittingDesk) -> None:
    gaits.put("made/a", number=1)
    base = gaits.head()
    made = gaits.submit(into="made")
    theirs = gaits.put("made/a", number=2)
    head = gaits.head()
    gaits.work("a", "b")
    found = gaits.job(made)
    conflict = found.publish_conflict
    assert found.state == "succeeded"
    assert conflict is not None
    assert (conflict.code, conflict.branch, conflict.paths, conflict.count) == ("paths-changed", made, ("made/a",), 1)
    assert gaits.head() == head
    assert gaits.entries()["made/a"] == theirs
    assert gaits.commit(made).parents == (base,)
    assert gaits.entries(made) == {f"made/{one.name}": one.item for one in gaits.desk.outputs(made)}
    assert found.commit is not None
    assert found.commit.digest == gaits.head(made)


def test_a_job_fails_if_the_dataset_to_which_it_commits_is_damaged(gaits: CommittingDesk) -> None:
    gaits.put("own", number=1)
    made = gaits.submit(into="made")
    gaits.desk.database.write(SYSTEM, lambda tx: tx.execute(update(tree_chunk).values(data=b"damaged")))
    gaits.work("a")
    found = gaits.job(made)
    assert (found.state, found.failure and found.failure.code) == ("failed", "dataset-damaged")


def test_an_entry_that_was_removed_meanwhile_is_a_conflict(gaits: CommittingDesk) -> None:
    gaits.put("made/a", number=1)
    made = gaits.submit(into="made")
    gaits.change(RemoveEntry(path="made/a", kind=Kind.CHARACTER))
    gaits.work("a")
    conflict = gaits.job(made).publish_conflict
    assert conflict is not None
    assert gaits.entries() == {}
    assert gaits.entries(made).keys() == {"made/a"}


def test_commits_of_others_to_the_same_branch_are_all_kept(gaits: CommittingDesk) -> None:
    """Several jobs start from the same commit, and end one after another."""
    jobs = [gaits.submit(into=f"made{number}", cache="off", params={"number": number}) for number in range(5)]
    for number in range(5):
        gaits.work(f"a{number}", facts={"number": number})
    assert len(gaits.entries()) == 5
    assert {one.job for one in gaits.log()} == set(jobs)
    assert all(gaits.job(one).publish_conflict is None for one in jobs)


def test_two_jobs_that_make_one_path_differently_end_on_two_branches(gaits: CommittingDesk) -> None:
    first, second = (gaits.submit(into="made", cache="off", params={"number": number}) for number in range(2))
    gaits.work("a", facts={"of": 1})
    gaits.work("a", facts={"of": 2})
    assert gaits.commit().job == first
    conflict = gaits.job(second).publish_conflict
    assert conflict is not None
    assert conflict.branch == second
    assert gaits.commit(second).job == second
    assert gaits.entries() == gaits.entries(second)  # the second revision of the same item
    assert gaits.commit().tree != gaits.commit(second).tree


def test_the_same_result_is_committed_once(gaits: CommittingDesk) -> None:
    first, second = (gaits.submit(into="made", cache="off") for _ in range(2))
    gaits.work("a")
    gaits.work("a")
    assert [one.job for one in gaits.log()] == [first]
    found = gaits.job(second)
    assert (found.state, found.publish_conflict, found.commit and found.commit.digest) == ("succeeded", None, None)


def test_changes_of_other_parts_of_an_entry_are_combined(gaits: CommittingDesk) -> None:
    """A user tags the entry while a job computes its content again."""
    first = gaits.submit(into="made")
    gaits.work("a")
    (made,) = gaits.desk.outputs(first)
    second = gaits.submit(into="made", cache="off")
    gaits.write(items.change_item, "lab", Kind.CHARACTER, made.item, ItemChange(tags=("seen",)), expected_rev=None)
    gaits.change(PutEntry(path="made/a", item=made.item))
    gaits.work("a", facts={"again": 1})
    assert gaits.job(second).publish_conflict is None
    (entry,) = gaits.read(datasets.list_entries, "lab", "gaits", "main", path="", cursor=None, limit=10).items
    assert (entry.tags, entry.revision) == (("seen",), 2)


def test_an_entry_with_parts_of_the_job_and_of_somebody_else_has_a_revision(gaits: CommittingDesk) -> None:
    """The job adds a mapping while a user changes the bones; no item has both parts before the commit stores them."""
    hierarchies = [skeleton_tree(2, bone_m=bone_m) for bone_m in (0.5, 0.6)]
    (rig,) = gaits.desk.publish(Draft("d", Kind.SKELETON, "rig", {"hierarchy": hierarchies[0]}, "own"))
    gaits.change(PutEntry(path="made/rig", item=rig.item))
    made = gaits.submit("rig", into="made")
    gaits.desk.publish(Draft("d", Kind.SKELETON, "rig", {"hierarchy": hierarchies[1]}, "own"))
    gaits.change(PutEntry(path="made/rig", item=rig.item))
    (theirs,) = gaits.listed()
    parts = {"hierarchy": hierarchies[0], "mapping": {"schema": "marey/skeleton-mapping@1", "joints": {"j0": "hips"}}}
    lease = gaits.desk.claim()
    gaits.desk.stage_outputs(lease, StagedOutput(name="rig", kind=Kind.SKELETON, item_name="rig", parts=parts))
    gaits.desk.complete(lease)
    assert gaits.job(made).publish_conflict is None
    (entry,) = gaits.listed()
    (output,) = gaits.desk.outputs(made)
    assert entry.item not in (None, rig.item, output.item)
    digests = {
        part: gaits.read(items.find_part, "lab", Kind.SKELETON, item, part, revision=revision).digest
        for part, item, revision in [("hierarchy", rig.item, 2), ("mapping", output.item, output.revision)]
    }
    assert entry.parts == digests
    assert entry.parts["hierarchy"] == theirs.parts["hierarchy"]
    assert list(fsck.check_store(gaits.desk.database)) == []


# -- once, or not at all ----------------------------------------------------------------------------------------------


def test_a_completion_that_is_repeated_commits_once(gaits: CommittingDesk) -> None:
    made = gaits.submit(into="made")
    lease = gaits.desk.claim()
    gaits.desk.stage(lease, "a")
    first = gaits.desk.complete(lease, write_id="the-write-id")
    assert gaits.desk.complete(lease, write_id="the-write-id") == first
    assert first.commit == gaits.head() == present(gaits.job(made).commit).digest
    assert len(gaits.log()) == 1
    with pytest.raises(LeaseLostProblem):
        gaits.desk.complete(lease, write_id="another-write-id")


def test_an_attempt_that_lost_its_lease_commits_nothing(gaits: CommittingDesk) -> None:
    made = gaits.submit(into="made")
    late = gaits.desk.claim()
    gaits.desk.stage(late, "late")
    gaits.desk.clock.advance(3600)
    gaits.desk.reap()
    prompt = gaits.desk.claim()
    with pytest.raises(LeaseLostProblem):
        gaits.desk.complete(late)
    assert gaits.head() is None
    gaits.desk.stage(prompt, "a")
    gaits.desk.complete(prompt)
    assert gaits.entries().keys() == {"made/a"}
    assert gaits.commit().job == made


def test_a_cancelled_job_commits_nothing(gaits: CommittingDesk) -> None:
    made = gaits.submit(into="made")
    lease = gaits.desk.claim()
    gaits.desk.stage(lease, "a")
    gaits.desk.cancel(made)
    assert gaits.desk.complete(lease).state == "cancelled"
    assert gaits.head() is None
    assert present(gaits.job(made).commit).digest is None


def test_jobs_that_end_in_one_batch_commit_one_after_another(gaits: CommittingDesk) -> None:
    jobs = [gaits.submit(into=f"made{number}", cache="off") for number in range(4)]
    leases = gaits.desk.claim_many()
    for lease in leases:
        gaits.desk.stage(lease, "a")
    batch = [BatchCompletion(job=one.job, fence=one.fence, write_id=gaits.desk.write_id()) for one in leases]
    results = gaits.desk.database.write(gaits.desk.user, completion.complete_many, batch)
    assert {one.answer.commit for one in results if one.answer} == {one.digest for one in gaits.log()}
    assert {one.job for one in gaits.log()} == set(jobs)


# -- fan-outs, cached results, pipelines ------------------------------------------------------------------------------


def test_a_fan_out_commits_once_at_its_end(gaits: CommittingDesk) -> None:
    things = gaits.desk.things(5)
    made = gaits.submit("square", into="made", inputs={"things": tuple(ItemInput(item=one) for one in things)})
    leases = gaits.desk.claim_many()
    assert len(leases) == 3
    for number, lease in enumerate(leases):
        assert gaits.head() is None
        gaits.desk.stage(lease, f"a{number}", f"b{number}")
        gaits.desk.complete(lease)
    assert [one.job for one in gaits.log()] == [made]
    outputs = gaits.desk.outputs(made)
    assert gaits.entries() == {one.entry: one.item for one in outputs}
    assert len(outputs) == 6
    assert gaits.job(leases[0].job).commit is None
    assert present(gaits.job(made).commit).digest == gaits.head()


def test_a_fan_out_of_which_a_task_fails_commits_nothing_and_its_retry_everything(gaits: CommittingDesk) -> None:
    things = gaits.desk.things(4)
    made = gaits.submit("square", into="made", inputs={"things": tuple(ItemInput(item=one) for one in things)})
    first, second = gaits.desk.claim_many()
    gaits.desk.stage(first, "a")
    gaits.desk.complete(first)
    gaits.desk.fail(second, retryable=False)
    assert gaits.job(made).state == "failed"
    assert gaits.head() is None
    again = gaits.write(retrying.retry_job, made).id
    gaits.work("b")
    assert gaits.job(again).state == "succeeded"
    assert gaits.entries().keys() == {"made/a", "made/b"}
    assert [one.job for one in gaits.log()] == [again]


@pytest.mark.parametrize(("made", "empty"), [((), []), (("a",), []), ((), ["thing 3"])])
def test_a_fan_out_that_refused_all_inputs_has_failed(
    gaits: CommittingDesk, made: tuple[str, ...], empty: list[str]
) -> None:
    things = gaits.desk.things(4)
    job = gaits.submit("square", into="made", inputs={"things": tuple(ItemInput(item=one) for one in things)})
    for number, lease in enumerate(gaits.desk.claim_many()):
        if number == 1 and made:
            gaits.desk.stage(lease, *made)
        refused = [{"name": f"thing {number}", "detail": "it has no feet"}]
        gaits.desk.complete(lease, result={"refused": refused, "empty": empty})
    ended = gaits.job(job)
    if made or empty:
        assert ended.state == "succeeded"
    else:
        assert ended.failure is not None
        assert (ended.state, ended.failure.code) == ("failed", "nothing-done")
        assert "all inputs were refused; the first, thing " in ended.failure.detail
        assert gaits.head() is None


def test_an_import_job_says_which_takes_are_revisions_and_refuses_other_skeletons(desk: Desk) -> None:
    data = b"HIERARCHY"
    desk.database.write(desk.user, blobs.put_blob, data)
    names, digest = ("walk.bvh", "run.bvh"), digest_of(data)
    files = [{"name": name, "blob": digest} for name in names]
    entries = [{"name": name, "status": "created", "frames": 5} for name in names]

    def run(bone_m: float, seed: int, **params: Any) -> Any:
        job = desk.submit("import", params={"files": files, **params}, cache="refresh")
        lease = desk.claim()
        for name in names:
            hierarchy = skeleton_tree(bone_m=bone_m if name == "walk.bvh" else 1.0)
            rig = skeleton_output(name)
            motion = motion_tree({"output": rig}, joints=3, seed=seed)
            common = {"collection": "raw", "sources": {}}
            desk.stage_outputs(
                lease,
                StagedOutput(
                    name=rig, kind=Kind.SKELETON, item_name="rig", parts={"hierarchy": hierarchy},
                    reuse="by_content", **common,
                ),
                StagedOutput(
                    name=name, kind=Kind.CLIP, item_name=name, parts={"motion": motion},
                    same_skeleton=not params.get("replace_skeleton"), **common,
                ),
            )  # fmt: skip
        desk.complete(lease, result={"entries": entries, "clips": 2, "frames": 10})
        result = desk.job(job).result
        assert result is not None
        return result, {one["name"]: one for one in result["entries"]}

    run(1.0, 0)
    result, told = run(9.0, 1)
    assert told["walk.bvh"]["error"]["code"] == "skeleton-differs"
    assert (told["run.bvh"]["status"], told["run.bvh"]["revision"], result["clips"]) == ("created", 2, 1)
    _, told = run(9.0, 1, replace_skeleton=True)
    assert (told["walk.bvh"]["revision"], told["walk.bvh"]["skeleton_changed"]) == (2, True)
    assert told["run.bvh"]["status"] == "unchanged"


def test_a_job_whose_tasks_are_gathered_commits_what_it_gathered(gaits: CommittingDesk) -> None:
    things = gaits.desk.things(1)
    made = gaits.submit("survey", into="made", params={"number": 2}, inputs={"things": (ItemInput(item=things[0]),)})
    for lease in gaits.desk.claim_many():
        gaits.desk.complete(lease)
    assert gaits.head() is None
    gaits.work("whole")
    assert gaits.entries().keys() == {"made/whole"}
    assert gaits.commit().job == made


def test_a_cached_result_is_committed_too(gaits: CommittingDesk) -> None:
    gaits.desk.submit("sum", into="first")
    gaits.work("a")
    made = gaits.submit(into="second")
    found = gaits.job(made)
    assert (found.state, found.cached_from is not None) == ("succeeded", True)
    assert gaits.entries().keys() == {"second/a"}
    assert gaits.commit().job == made


def test_jobs_that_wait_for_one_result_all_commit_it(gaits: CommittingDesk) -> None:
    jobs = [gaits.submit(into=f"made{number}") for number in range(3)]
    gaits.work("a")
    assert gaits.entries().keys() == {"made0/a", "made1/a", "made2/a"}
    assert {one.job for one in gaits.log()} == set(jobs)


def test_identical_jobs_that_all_meet_a_conflict_share_the_commit(gaits: CommittingDesk) -> None:
    jobs = [gaits.submit(into="made", commit_message="same") for _ in range(3)]
    gaits.put("made/a", number=7)
    gaits.work("a")
    assert gaits.branches() == {"main", *jobs}
    assert len({gaits.head(one) for one in jobs}) == 1


def test_a_step_that_reads_an_earlier_one_starts_from_the_commit_of_that(gaits: CommittingDesk) -> None:
    """Two steps write to one path; the second starts from the commit of the first, so there is no conflict."""
    first = gaits.submit(into="made")
    second = gaits.submit("square", into="made", inputs={"things": (JobOutputsInput(job=first),)})
    gaits.work("a")
    gaits.work("a", facts={"step": 2})
    assert gaits.job(second).publish_conflict is None
    assert [one.job for one in gaits.log()] == [second, first]


# -- who may ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("to", "pointer", "code"),
    [
        ("nothing", "/commit/dataset", "no-dataset"),
        ("gaits@nothing", "/commit/branch", "no-version"),
        ("gaits@v1", "/commit/branch", "is-tag"),
    ],
)
def test_an_unknown_place_is_refused_with_its_field(gaits: CommittingDesk, to: str, pointer: str, code: str) -> None:
    gaits.put("a", number=1)
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="v1", kind=RefKind.TAG))
    with pytest.raises(InvalidProblem) as caught:
        gaits.submit(to=to)
    assert [(one.pointer, one.code) for one in caught.value.errors] == [(pointer, code)]


def test_a_job_without_items_or_a_folder_to_replace_has_nothing_to_commit(gaits: CommittingDesk) -> None:
    with pytest.raises(InvalidProblem, match="create no items"):
        gaits.submit("errand")
    with pytest.raises(InvalidProblem, match="whole dataset"):
        gaits.submit(commit_replace=True)


def test_a_token_that_may_only_submit_jobs_may_not_commit(gaits: CommittingDesk) -> None:
    gaits.desk.user = replace(gaits.desk.user, scopes=("read", "jobs"))
    with pytest.raises(ForbiddenProblem, match="'write'"):
        gaits.submit()


def protect(gaits: CommittingDesk, **rule: Any) -> None:
    gaits.write(datasets.protect_branch, "lab", "gaits", "main", ProtectionRule(**rule), expected_rev=None)


def test_a_branch_that_only_proposals_move_refuses_the_submission(gaits: CommittingDesk) -> None:
    gaits.put("a", number=1)
    protect(gaits, direct_commits=False)
    with pytest.raises(ConflictProblem) as caught:
        gaits.submit()
    assert caught.value.error_code == "branch-protected"
    assert [one.pointer for one in caught.value.errors] == ["/commit/branch"]


def drop_branch(gaits: CommittingDesk) -> None:
    gaits.write(datasets.delete_ref, "lab", "gaits", "work", expected_rev=None)


def drop_dataset(gaits: CommittingDesk) -> None:
    gaits.write(datasets.delete_dataset, "lab", "gaits", expected_rev=None)


def protect_work(gaits: CommittingDesk) -> None:
    rule = ProtectionRule(direct_commits=False)
    gaits.write(datasets.protect_branch, "lab", "gaits", "work", rule, expected_rev=None)


LATER = [(drop_branch, "no-version"), (drop_dataset, "no-dataset"), (protect_work, "branch-protected")]


@pytest.mark.parametrize(("change", "code"), LATER, ids=[code for _, code in LATER])
@pytest.mark.parametrize("way", ["single", "fan-out", "cached"])
def test_a_job_fails_if_its_commit_is_not_possible_any_more(
    gaits: CommittingDesk, way: str, change: Callable[[CommittingDesk], None], code: str
) -> None:
    gaits.put("own", number=1)
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="work", kind=RefKind.BRANCH))
    things = tuple(ItemInput(item=one) for one in gaits.desk.things(4))
    if way == "fan-out":
        made = gaits.submit("square", "gaits@work", into="made", inputs={"things": things})
    else:
        if way == "cached":
            gaits.desk.submit("sum", into="first")
        made = gaits.submit(to="gaits@work", into="made")
    leases = gaits.desk.claim_many()
    change(gaits)
    for number, lease in enumerate(leases):
        gaits.desk.stage(lease, f"a{number}")
    answers = [gaits.desk.complete(lease, write_id=f"the-write-id-{lease.job}") for lease in leases]
    found = gaits.job(made)
    assert (found.state, found.failure and found.failure.code) == ("failed", code)
    assert (found.commit and found.commit.digest, found.result if way == "single" else None) == (None, None)
    if way == "single":
        assert answers[0].state == "failed"
        assert gaits.desk.complete(leases[0], write_id=f"the-write-id-{made}") == answers[0]
        assert gaits.desk.outputs(made) == []
        (attempt,) = gaits.read(reading.list_attempts, made).items
        assert attempt.outcome == "failed"
        assert "gaits@work" in attempt.detail
    if way != "fan-out":
        assert not gaits.desk.outputs(made)


def test_an_author_who_lost_the_role_that_the_rule_asks_for_commits_nothing(gaits: CommittingDesk) -> None:
    gaits.put("own", number=1)
    other = gaits.write(users.create_user, UserCreate(name="bob"), who=SYSTEM)
    bob = replace(gaits.desk.user, user_id=other.id, user_name="bob")
    owner = gaits.desk.user

    def become(role: Role) -> None:
        gaits.desk.database.write(owner, members.put_member, "lab", "bob", MemberChange(role=role))

    become(Role.MAINTAINER)
    protect(gaits, role=Role.MAINTAINER, direct_commits=True)
    gaits.desk.user = bob
    made = gaits.submit(into="made")
    gaits.desk.user = owner
    lease = gaits.desk.claim()
    gaits.desk.stage(lease, "a")
    become(Role.CONTRIBUTOR)
    assert gaits.desk.complete(lease).state == "failed"
    assert present(gaits.job(made).failure).code == "branch-protected"
    with pytest.raises(ForbiddenProblem, match="maintainer"):
        gaits.write(retrying.retry_job, made, who=bob)
    become(Role.MAINTAINER)
    again = gaits.write(retrying.retry_job, made, who=bob).id
    gaits.work("a")
    assert gaits.commit().job == again
    assert gaits.commit().author == "bob"


# -- folders ----------------------------------------------------------------------------------------------------------


def test_replacing_removes_what_the_job_does_not_make_again(gaits: CommittingDesk) -> None:
    gaits.submit(into="made")
    gaits.work("a", "b")
    own = gaits.put("other/c", number=1)
    gaits.submit(into="made", cache="off", commit_replace=True)
    gaits.put("made/later", number=2)
    gaits.work("b", "c")
    assert gaits.entries().keys() == {"made/b", "made/c", "made/later", "other/c"}
    assert gaits.entries()["other/c"] == own


def test_a_job_without_outputs_replaces_nothing(gaits: CommittingDesk) -> None:
    gaits.submit(into="made")
    gaits.work("a")
    head = gaits.head()
    made = gaits.submit(into="made", cache="off", commit_replace=True)
    gaits.work()
    assert (gaits.job(made).state, gaits.head()) == ("succeeded", head)


def test_an_entry_that_somebody_changed_is_not_replaced(gaits: CommittingDesk) -> None:
    gaits.submit(into="made")
    gaits.work("a")
    made = gaits.submit(into="made", cache="off", commit_replace=True)
    theirs = gaits.put("made/a", number=3)
    gaits.work("b")
    assert gaits.job(made).publish_conflict is not None
    assert gaits.entries() == {"made/a": theirs}
    assert gaits.entries(made).keys() == {"made/b"}


@pytest.mark.parametrize(
    ("to", "into", "path"),
    [
        ("walks", "walks/made", "made/sub/a"),
        ("walks", "elsewhere", "elsewhere/sub/a"),
        ("walks@main/there", "walks/made", "there/sub/a"),
        ("walks@main/", "elsewhere", "sub/a"),
        ("walks", "walks", "sub/a"),
    ],
)
def test_outputs_have_their_paths_in_the_folder_of_the_dataset(desk: Desk, to: str, into: str, path: str) -> None:
    walks = CommittingDesk(desk, "walks", collection="walks")
    made = walks.submit(to=to, into=into)
    walks.work("a", collection="sub")
    assert walks.entries().keys() == {path}
    assert desk.outputs(made)[0].entry == path


def test_the_folder_of_a_dataset_goes_on_from_the_commit_of_a_job(desk: Desk) -> None:
    walks = CommittingDesk(desk, "walks", collection="walks")
    desk.things(1, "walks")
    request = CommitCreate(message="first")
    walks.write(datasets.record_commit, "lab", "walks", walks.read(datasets.prepare_commit, "lab", "walks", request))
    walks.submit(into="walks/made")
    walks.work("a")
    with pytest.raises(InvalidProblem, match="Nothing has changed"):
        walks.read(datasets.prepare_commit, "lab", "walks", request)
    walks.submit(into="elsewhere", cache="off")
    walks.work("a")
    with pytest.raises(ConflictProblem, match="not the newest version of this branch"):
        walks.read(datasets.prepare_commit, "lab", "walks", request)


def test_outputs_of_one_name_are_numbered(gaits: CommittingDesk) -> None:
    """An import may give several skeletons the same name: equal skeletons become one item, others get numbers."""
    gaits.submit(into="made")
    lease = gaits.desk.claim()
    drafts = [
        StagedOutput(
            name=f"n{number}", kind=Kind.CHARACTER, item_name="rig", parts={"character": document(number=number // 2)},
            reuse="by_content",
        )
        for number in range(4)
    ]  # fmt: skip
    principal = gaits.desk._attempt_of(lease)
    prepared = [staging.prepare_output(one) for one in drafts]
    gaits.desk.database.write(principal, staging.stage, lease.job, lease.fence, prepared)
    gaits.desk.complete(lease)
    assert gaits.entries().keys() == {"made/rig", "made/rig-2"}


def test_a_commit_of_too_many_outputs_is_recorded_as_a_conflict(
    gaits: CommittingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commits, "MOST_COMMITTED_AT_ONCE", 2)
    made = gaits.submit(into="made")
    gaits.work("a", "b", "c")
    found = gaits.job(made)
    assert found.state == "succeeded"
    assert found.publish_conflict is not None
    assert (found.publish_conflict.code, found.publish_conflict.branch) == ("too-many-changes", None)
    assert gaits.head() is None
    assert len(gaits.desk.outputs(made)) == 3


# -- records ----------------------------------------------------------------------------------------------------------


def test_events_and_lineage_name_the_commit(gaits: CommittingDesk) -> None:
    made = gaits.submit(into="made")
    gaits.work("a")
    gaits.desk.database.write(SYSTEM, events.number_events)
    told = {one.kind: one for one in gaits.read(events.list_events, "lab", after=0, limit=1000).items}
    assert told["branch.moved"].body["job"] == made
    assert told["branch.moved"].body["commit"] == told["job.succeeded"].body["commit"] == gaits.head()
    (output,) = gaits.desk.outputs(made)
    graph = gaits.read(items.read_lineage_graph, "lab", Kind.CHARACTER, output.item, LineageRequest())
    assert [(one.id, one.commit) for one in graph.jobs] == [(made, gaits.head())]


def test_a_job_that_a_commit_names_is_kept(gaits: CommittingDesk) -> None:
    gaits.desk.submit("sum", into="made")
    gaits.work("a")
    made = gaits.submit(into="made", cache="off")
    gaits.work("a")
    assert [one.created for one in gaits.desk.outputs(made)] == [False]
    gaits.desk.clock.advance(1000 * 86400.0)
    retire(gaits.desk.database, Retention(events_days=0, logs_days=0, jobs_days=10))
    assert present(gaits.job(made).commit).digest == gaits.head()
    assert list(fsck.check_store(gaits.desk.database)) == []
