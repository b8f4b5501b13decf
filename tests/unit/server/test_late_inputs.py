"""Late inputs (outputs of other jobs): a job gets them as if it had been submitted after the other jobs."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pytest
from tests.support.queue_desk import KINDS, SUM, Desk, document
from tests.support.store_fixtures import skeleton_tree

from marey_schemas.access import ProjectCreate
from marey_schemas.kinds import Kind
from marey_schemas.queue import job_kinds
from marey_schemas.queue.jobs import InputSpec, JobCreate
from marey_schemas.queue.scripts import ScriptDeclaration
from marey_server.access.principal import SYSTEM
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.store import items, projects
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import inputs as job_inputs
from marey_server.store.jobs import late_inputs, reading, result_cache, submission
from marey_server.store.jobs.reaper import share_waiting
from marey_server.store.jobs.retrying import retry_job


def make(desk: Desk, job: str, *names: str, **facts: Any) -> None:
    """Claim a job, and complete it with small documents of these names."""
    lease = desk.claim(job=job)
    if names:
        desk.stage(lease, *names, facts=facts)
    desk.complete(lease)


def square(desk: Desk) -> list[list[str]]:
    """Complete all jobs of the kind `square`; return the names of the inputs of each attempt."""
    seen = []
    while leases := desk.claim_many(kinds=("square",)):
        for lease in sorted(leases, key=lambda lease: lease.position or 0):
            names = [pin.name for pin in lease.inputs["things"]]
            desk.stage(lease, *(f"{name}-squared" for name in names))
            desk.complete(lease)
            seen.append(names)
    return seen


def squares_of(job: str, **fields: Any) -> JobCreate:
    return JobCreate.model_validate({"kind": "square", "inputs": {"things": {"job": job}}, "into": "squared"} | fields)


def failure_of(desk: Desk, job: str) -> tuple[str, str, str]:
    failure = desk.job(job).failure
    assert failure is not None
    return failure.reason.value, failure.code, failure.detail


def again(desk: Desk, job: str) -> str:
    return desk.database.write(desk.user, retry_job, job).id


def names(outputs: Iterable[Any]) -> list[str]:
    return [output.name for output in outputs]


# -- getting inputs ----------------------------------------------------------------------------------------------------


def test_a_job_gets_what_another_made_once_that_has_succeeded(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (job,) = desk.submit_many(squares_of(maker))
    waiting = desk.job(job)
    assert (waiting.state, waiting.inputs, waiting.after) == ("waiting", {"things": [{"job": maker}]}, (maker,))
    assert desk.claim_many(kinds=("square",)) == []
    make(desk, maker, "a")
    ready = desk.job(job)
    assert ready.state == "queued"
    (made,) = desk.outputs(maker)
    assert ready.inputs == {
        "things": [
            {"item": made.item, "revision": 1, "kind": "character", "name": "a", "collection": "made", "below": ""}
        ]
    }
    assert square(desk) == [["a"]]
    (squared,) = desk.outputs(job)
    lineage = desk.database.read(desk.user, items.read_lineage, "lab", Kind.CHARACTER, squared.item)
    assert [(edge.item, edge.revision) for edge in lineage.inputs] == [(made.item, 1)]


def test_many_outputs_are_spread_over_tasks_and_those_of_all_tasks_are_inputs_in_order(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (first,) = desk.submit_many(squares_of(maker))
    (second,) = desk.submit_many(squares_of(first, into="twice"))
    make(desk, maker, "a", "b", "c", "d", "e")
    head = desk.job(first)
    assert (head.state, head.size, head.children, head.inputs) == (
        "running",
        3,
        {"queued": 3},
        {"things": {"count": 5}},
    )
    leases = desk.claim_many(kinds=("square",))
    for lease in reversed(leases):  # in whatever order they end
        desk.stage(lease, *(f"{pin.name}2" for pin in lease.inputs["things"]))
        desk.complete(lease)
    assert (desk.state(first), desk.job(second).size) == ("succeeded", 3)
    assert square(desk) == [["a2", "b2"], ["c2", "d2"], ["e2"]]
    assert desk.state(second) == "succeeded"


def test_a_job_whose_tasks_are_counted_gets_its_inputs_and_is_gathered(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    survey = desk.submit("survey", inputs={"things": {"job": maker}}, params={"number": 2})
    (after,) = desk.submit_many(squares_of(survey))
    make(desk, maker, "a", "b")
    assert (desk.job(survey).size, desk.job(survey).children) == (2, {"queued": 2})
    for lease in desk.claim_many():
        assert [pin.name for pin in lease.inputs["things"]] == ["a", "b"]
        desk.complete(lease)
    make(desk, survey, "overview")
    assert square(desk) == [["overview"]]
    assert desk.state(after) == "succeeded"


def test_outputs_stand_beside_items_and_collections_and_those_of_several_jobs(desk: Desk) -> None:
    (thing, *_) = desk.things(2)
    makers = [desk.submit("sum", params={"number": n}, into=f"made{n}") for n in range(2)]
    wanted: Any = [{"job": makers[1]}, {"collection": "raw"}, {"job": makers[0]}, {"item": thing}]
    job = desk.submit("square", inputs={"things": wanted})
    make(desk, makers[0], "a")
    assert desk.state(job) == "waiting"
    make(desk, makers[1], "b")
    assert desk.job(job).size == 2
    assert sorted(name for names in square(desk) for name in names) == ["a", "b", "thing0", "thing1"]


def test_what_a_job_that_has_succeeded_made_is_given_at_once(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    make(desk, maker, "a", "b", "c")
    (job,) = desk.submit_many(squares_of(maker))
    assert (desk.state(job), desk.job(job).size) == ("running", 2)


def test_inputs_are_the_revisions_the_job_made_not_newer_ones(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (job,) = desk.submit_many(squares_of(maker, after=[desk.submit()]))
    make(desk, maker, "a")
    desk.publish(Draft("again", Kind.CHARACTER, "a", {"character": document(number=77)}, "made"))
    desk.complete(desk.claim(kinds=("errand",)))
    (lease,) = desk.claim_many()
    assert (lease.job, lease.inputs["things"][0].revision) == (job, 1)


def test_of_an_item_that_a_job_made_twice_the_last_revision_is_the_input(desk: Desk) -> None:
    desk.things(4)
    maker = desk.submit("square", inputs={"things": {"collection": "raw"}}, into="made")
    (job,) = desk.submit_many(squares_of(maker))
    for number, lease in enumerate(desk.claim_many()):
        desk.stage(lease, "same", facts={"number": number})
        desk.complete(lease)
    (lease,) = desk.claim_many()
    assert (lease.job, [pin.revision for pin in lease.inputs["things"]]) == (job, [2])


def test_an_output_that_was_deleted_meanwhile_is_no_input(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (job,) = desk.submit_many(squares_of(maker, after=[desk.submit()]))
    make(desk, maker, "a", "b")
    kept, deleted = desk.outputs(maker)
    desk.database.write(desk.user, items.delete_item, "lab", Kind.CHARACTER, deleted.item, expected_rev=None)
    desk.complete(desk.claim(kinds=("errand",)))
    assert [pin["item"] for pin in desk.job(job).inputs["things"]] == [kept.item]


def test_what_one_job_made_is_known_by_its_place_below_where_that_put_it(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    other = desk.submit("sum", params={"number": 1}, into="other")
    (job,) = desk.submit_many(squares_of(maker))
    both = desk.submit("square", inputs={"things": [{"job": maker}, {"job": other}]})
    for one in (maker, other):
        lease = desk.claim(job=one)
        desk.stage(lease, "a", collection="deep/down")
        desk.complete(lease)
    leases = {lease.job: lease for lease in desk.claim_many()}
    (pin,) = leases[job].inputs["things"]
    assert (pin.collection, pin.folder) == ("made/deep/down", "deep/down")
    assert [pin.folder for pin in leases[both].inputs["things"]] == ["made/deep/down", "other/deep/down"]


# -- shared results ----------------------------------------------------------------------------------------------------


def test_a_chain_that_was_computed_before_is_done_when_it_is_submitted(desk: Desk) -> None:
    def submit_chain() -> tuple[str, str, str]:
        maker = desk.submit("sum", into="made")
        (first,) = desk.submit_many(squares_of(maker))
        (second,) = desk.submit_many(squares_of(first, into="twice"))
        return maker, first, second

    made = submit_chain()
    make(desk, made[0], "a", "b", "c")
    assert len(square(desk)) == 4
    later = submit_chain()
    assert [desk.state(job) for job in later] == ["succeeded"] * 3
    assert [desk.outputs(one) for one in made] == [
        [output.model_copy(update={"created": True}) for output in desk.outputs(one)] for one in later
    ]
    assert {output.created for output in desk.outputs(later[2])} == {False}


def test_a_long_chain_that_was_computed_before_is_served_in_portions(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A transaction that published the results of a whole pipeline would occupy the database for too long."""
    monkeypatch.setattr(result_cache, "MOST_SHARED_OUTPUTS", 3)

    def submit_chain() -> list[str]:
        chain = [desk.submit("sum", into="made")]
        for step in range(3):
            chain += desk.submit_many(squares_of(chain[-1], into=f"step{step}"))
        return chain

    first = submit_chain()
    make(desk, first[0], *"abcde")
    square(desk)
    again = submit_chain()
    assert [desk.state(job) for job in again][::3] == ["succeeded", "waiting"]
    portions = 0
    while desk.database.write(SYSTEM, share_waiting):
        portions += 1
    assert portions > 1
    assert {desk.state(job) for job in again} == {"succeeded"}
    assert [len(desk.outputs(job)) for job in again] == [5, 5, 5, 5]
    assert desk.claim_many() == []


def test_only_what_depends_on_a_change_is_computed_again(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    desk.submit_many(squares_of(maker))
    lease = desk.claim()
    for name in "abcdef":
        desk.stage(lease, name, facts={"number": 1})
    desk.complete(lease)
    assert len(square(desk)) == 3

    changed = desk.submit("sum", params={"number": 1}, into="made")
    (job,) = desk.submit_many(squares_of(changed))
    lease = desk.claim()
    for name in "abcdef":
        desk.stage(lease, name, facts={"number": 2 if name == "c" else 1})
    desk.complete(lease)
    assert desk.job(job).children == {"succeeded": 2, "queued": 1}
    assert square(desk) == [["c", "d"]]
    assert desk.state(job) == "succeeded"


@pytest.mark.parametrize(("read", "state"), [(("hierarchy",), "succeeded"), ((), "queued")])
def test_parts_that_a_job_does_not_read_make_it_no_other_job(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, read: tuple[str, ...], state: str
) -> None:
    """For example, a tree that was added to a model does not change a job that computes trees of models."""
    reads = {"rig": InputSpec(kind=Kind.SKELETON, parts=read)}
    monkeypatch.setattr(job_kinds, "job_kinds", lambda: {**KINDS, "sum": replace(SUM, inputs=reads)})
    (rig,) = desk.publish(Draft("r", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}))
    desk.submit("sum", inputs={"rig": {"item": rig.item}})
    desk.complete(desk.claim())
    desk.publish(Draft("r", Kind.SKELETON, "rig", {"mapping": {"joints": {"hips": "j0"}}}))
    assert desk.state(desk.submit("sum", inputs={"rig": {"item": rig.item}})) == state


def test_identical_jobs_that_get_their_inputs_at_one_time_are_computed_once(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    jobs_ = desk.submit_many(*(squares_of(maker, into=f"place{n}") for n in range(3)))
    make(desk, maker, "a")
    assert sorted(desk.state(job) for job in jobs_) == ["queued", "waiting", "waiting"]
    assert square(desk) == [["a"]]
    assert {desk.state(job) for job in jobs_} == {"succeeded"}
    assert [len(desk.outputs(job)) for job in jobs_] == [1, 1, 1]


def test_a_maker_that_waits_for_another_ones_result_hands_it_on(desk: Desk) -> None:
    first = desk.submit("sum", into="one")
    joined = desk.submit("sum", into="two")
    (job,) = desk.submit_many(squares_of(joined))
    make(desk, first, "a")
    assert (desk.state(joined), desk.job(joined).cached_from) == ("succeeded", first)
    assert [pin["collection"] for pin in desk.job(job).inputs["things"]] == ["two"]


# -- when there is nothing to get --------------------------------------------------------------------------------------


def test_a_job_for_which_nothing_was_made_fails_and_says_who_made_nothing(desk: Desk) -> None:
    maker = desk.submit("sum")
    (job,) = desk.submit_many(squares_of(maker))
    (after,) = desk.submit_many(squares_of(job))
    make(desk, maker)
    reason, code, detail = failure_of(desk, job)
    assert (desk.state(job), reason, code) == ("failed", "error", "no-input")
    assert maker in detail
    assert "character" in detail
    assert failure_of(desk, after)[0] == "dependency_failed"
    assert desk.job(job).inputs == {"things": [{"job": maker}]}


def test_an_input_that_takes_one_thing_refuses_more(desk: Desk) -> None:
    maker = desk.submit("sum")
    desk.things(1)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}, "ruler": {"job": maker}})
    make(desk, maker, "a", "b")
    reason, code, detail = failure_of(desk, job)
    assert (reason, code) == ("error", "one-item")
    assert f"2 were created by the job {maker}" in detail


def test_an_input_that_a_job_can_do_without_is_left_out_where_nothing_was_made(desk: Desk) -> None:
    maker = desk.submit("sum")
    desk.things(1)
    job = desk.submit("square", inputs={"things": {"collection": "raw"}, "ruler": {"job": maker}})
    make(desk, maker)
    assert desk.job(job).inputs.keys() == {"things"}
    assert square(desk) == [["thing0"]]


def test_more_inputs_than_can_be_fail_the_job(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(late_inputs, "MOST_INPUTS", 2)
    maker = desk.submit("sum")
    (job,) = desk.submit_many(squares_of(maker))
    make(desk, maker, "a", "b", "c")
    assert failure_of(desk, job)[1] == "too-many"
    assert job_inputs.MOST_INPUTS == 100_000


@pytest.mark.parametrize("end", ["fail", "cancel"])
def test_what_waits_for_a_job_that_brings_nothing_fails_down_the_chain(desk: Desk, end: str) -> None:
    maker = desk.submit("sum")
    (first,) = desk.submit_many(squares_of(maker))
    (second,) = desk.submit_many(squares_of(first))
    (skipped,) = desk.submit_many(squares_of(first, on_failure="skip"))
    if end == "fail":
        desk.fail(desk.claim(), retryable=False)
    else:
        desk.cancel(maker)
    assert {failure_of(desk, job)[0] for job in (first, second)} == {"dependency_failed"}
    assert desk.state(skipped) == "cancelled"
    (late,) = desk.submit_many(squares_of(maker))
    assert failure_of(desk, late)[0] == "dependency_failed"


def test_a_kind_that_the_server_has_forgotten_fails_its_job_and_not_the_maker(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    maker = desk.submit("sum")
    (job,) = desk.submit_many(squares_of(maker))
    monkeypatch.setattr(job_kinds, "job_kinds", lambda: {name: k for name, k in KINDS.items() if name != "square"})
    make(desk, maker, "a")
    assert desk.state(maker) == "succeeded"
    assert failure_of(desk, job)[1] == "unknown-kind"


def test_a_script_whose_declaration_is_not_valid_any_more_fails_its_job_and_not_the_maker(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    maker = desk.submit("sum")
    (job,) = desk.submit_many(squares_of(maker))
    monkeypatch.setattr(late_inputs, "kind_of_job", lambda name, params: ScriptDeclaration.model_validate({}))
    make(desk, maker, "a")
    assert desk.state(maker) == "succeeded"
    assert failure_of(desk, job)[1] == "invalid-params"


@pytest.mark.parametrize(
    ("inputs", "pointer"),
    [
        ({"things": {"job": "job_nowhere"}}, "/inputs/things/job"),
        ({"things": [{"collection": "raw"}, {"job": "job_nowhere"}]}, "/inputs/things/1/job"),
    ],
)
def test_makers_that_are_not_there_are_refused_with_their_place(
    desk: Desk, inputs: dict[str, Any], pointer: str
) -> None:
    desk.things(1)
    with pytest.raises(InvalidProblem) as refused:
        desk.submit("square", inputs=inputs)
    assert [(error.pointer, error.code) for error in refused.value.errors] == [(pointer, "unknown-job")]


def test_a_maker_that_makes_no_such_thing_is_refused(desk: Desk) -> None:
    errand = desk.submit()
    with pytest.raises(InvalidProblem) as refused:
        desk.submit_many(squares_of(errand))
    assert (refused.value.errors[0].pointer, refused.value.errors[0].code) == ("/inputs/things/job", "wrong-kind")


def test_a_job_of_another_project_is_as_unknown_as_none(desk: Desk) -> None:
    desk.database.write(desk.user, projects.create_project, ProjectCreate(name="other"))
    (elsewhere,) = desk.database.write(desk.user, submission.submit, "other", [JobCreate(kind="sum")])
    told = []
    for job in (elsewhere.id, "job_nowhere"):
        with pytest.raises(InvalidProblem) as refused:
            desk.submit_many(squares_of(job))
        told.append(refused.value.detail.replace(job, "X"))
    assert told[0] == told[1]


# -- cancelling --------------------------------------------------------------------------------------------------------


def test_a_job_is_cancelled_while_it_waits_for_its_inputs(desk: Desk) -> None:
    maker = desk.submit("sum")
    (job,) = desk.submit_many(squares_of(maker))
    (after,) = desk.submit_many(squares_of(job))
    assert desk.cancel(job).state == "cancelled"
    assert failure_of(desk, after)[0] == "dependency_failed"
    make(desk, maker, "a")
    assert desk.state(job) == "cancelled"
    assert desk.claim_many() == []


def test_a_job_is_cancelled_with_its_tasks_once_it_has_its_inputs(desk: Desk) -> None:
    maker = desk.submit("sum")
    (job,) = desk.submit_many(squares_of(maker))
    make(desk, maker, "a", "b", "c")
    desk.cancel(job)
    assert (desk.state(job), desk.job(job).children) == ("cancelled", {"cancelled": 2})


# -- trying again ------------------------------------------------------------------------------------------------------


def test_a_job_that_failed_is_tried_again_with_the_inputs_it_had(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (job,) = desk.submit_many(squares_of(maker))
    make(desk, maker, "a", "b", "c")
    good, bad = sorted(desk.claim_many(), key=lambda lease: lease.position or 0)
    desk.stage(good, "done")
    desk.complete(good)
    desk.fail(bad, retryable=False)
    desk.publish(Draft("again", Kind.CHARACTER, "a", {"character": document(number=77)}, "made"))
    second = again(desk, job)
    assert (desk.job(second).children, desk.job(second).retry_of) == ({"succeeded": 1, "queued": 1}, job)
    assert square(desk) == [["c"]]


def test_what_failed_with_a_job_goes_on_when_that_is_tried_again(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (first,) = desk.submit_many(squares_of(maker))
    (second,) = desk.submit_many(squares_of(first, into="twice"))
    desk.fail(desk.claim(), retryable=False)
    assert desk.state(second) == "failed"
    make(desk, again(desk, maker), "a")
    assert square(desk) == [["a"], ["a-squared"]]
    jobs = desk.database.read(desk.user, reading.list_jobs, "lab").items
    by_try = {job.retry_of: job for job in jobs if job.retry_of}
    assert {job: by_try[job].state for job in (maker, first, second)} == dict.fromkeys(
        (maker, first, second), "succeeded"
    )


def test_trying_the_last_of_a_chain_again_begins_where_the_chain_broke(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (first,) = desk.submit_many(squares_of(maker))
    (second,) = desk.submit_many(squares_of(first, into="twice"))
    make(desk, maker, "a", "b")
    desk.fail(desk.claim(), retryable=False)
    last = again(desk, second)
    assert (desk.state(last), desk.job(last).retry_of) == ("waiting", second)
    assert square(desk) == [["a", "b"], ["a-squared", "b-squared"]]
    assert desk.state(last) == "succeeded"


def test_a_job_tried_again_waits_for_the_latest_try_of_what_it_needs(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (job,) = desk.submit_many(squares_of(maker))
    desk.cancel(job)
    desk.fail(desk.claim(), retryable=False)
    second_try = again(desk, maker)
    desk.fail(desk.claim(), retryable=False)
    third_try = again(desk, second_try)
    waiting = desk.job(again(desk, job))
    assert (waiting.inputs, waiting.after) == ({"things": [{"job": third_try}]}, (third_try,))


def test_a_job_that_was_cancelled_by_itself_is_not_taken_up_with_what_it_needs(desk: Desk) -> None:
    maker = desk.submit("sum", into="made")
    (job,) = desk.submit_many(squares_of(maker))
    desk.cancel(job)
    desk.fail(desk.claim(), retryable=False)
    again(desk, maker)
    assert [one.retry_of for one in desk.database.read(desk.user, reading.list_jobs, "lab").items if one.retry_of] == [
        maker
    ]


def test_a_job_that_misses_something_else_is_not_taken_up(desk: Desk) -> None:
    makers = [desk.submit("sum", params={"number": n}, into=f"made{n}") for n in range(2)]
    job = desk.submit("square", inputs={"things": [{"job": maker} for maker in makers]})
    for lease in desk.claim_many():
        desk.fail(lease, retryable=False)
    tries = [again(desk, maker) for maker in makers]
    waiting = [one for one in desk.database.read(desk.user, reading.list_jobs, "lab").items if one.retry_of == job]
    assert [one.after for one in waiting] == [tuple(sorted(tries))]


def test_a_job_that_only_shared_the_result_of_a_failed_one_does_not_need_that(desk: Desk) -> None:
    first = desk.submit("sum")
    joined = desk.submit("sum", into="two")
    desk.fail(desk.claim(job=first), retryable=False)
    desk.fail(desk.claim(job=joined), retryable=False)
    again(desk, joined)
    assert [one.retry_of for one in desk.database.read(desk.user, reading.list_jobs, "lab").items if one.retry_of] == [
        joined
    ]


def test_a_job_that_ran_cannot_be_tried_again_before_it_ends(desk: Desk) -> None:
    maker = desk.submit("sum")
    (job,) = desk.submit_many(squares_of(maker))
    with pytest.raises(ConflictProblem):
        again(desk, job)
