"""Jobs that get the result of an earlier job, and jobs that are refused because of the place of their results."""

from typing import Any

import pytest
from tests.support.queue_desk import Desk
from tests.support.store_fixtures import motion_tree, skeleton_tree

from marey_schemas.kinds import Kind
from marey_schemas.queue.jobs import JobCreate
from marey_server.errors import InvalidProblem
from marey_server.store import blobs, items
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import submission
from marey_server.store.transaction import Transaction

TRIM: dict[str, Any] = {"commands": [{"command": "trim", "stop": 3}]}


def clips(desk: Desk, *names: str, collection: str = "walks") -> list[str]:
    """Create clips of one skeleton, and return their ids."""
    skeleton = Draft("rig", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}, collection="rigs")
    motion = motion_tree({"output": "rig"})
    drafts = [Draft(f"clip {name}", Kind.CLIP, name, {"motion": motion}, collection=collection) for name in names]
    return [one.item for one in desk.publish(skeleton, *drafts)[1:]]


def annotations(desk: Desk, clip: str) -> dict[str, str]:
    """Create a folder with one annotation of a clip; return a job input that refers to this folder."""
    said = {"schema": "marey/annotation@1", "clip": {"item": clip, "revision": 1}, "layer": "a", "segments": []}
    desk.publish(Draft("said", Kind.ANNOTATION, "said", {"annotation": said}, collection="said"))
    return {"collection": "said"}


def submit(desk: Desk, kind: str, inputs: dict[str, Any], params: dict[str, Any], **fields: Any) -> str:
    return desk.submit(kind, inputs=inputs, params=params, **fields)


def refused(desk: Desk, kind: str, inputs: dict[str, Any], params: dict[str, Any], **fields: Any) -> tuple[str, str]:
    with pytest.raises(InvalidProblem) as raised:
        submit(desk, kind, inputs, params, **fields)
    (error,) = raised.value.errors
    return error.pointer, error.code


def shares(desk: Desk, *job: Any, **fields: Any) -> bool:
    """Submit a job; return whether it gets the result of another job that was completed before."""
    return desk.job(submit(desk, *job, **fields)).cached_from is not None


def test_a_job_has_a_place_in_a_trace_until_its_end_and_still_shares_results(desk: Desk) -> None:
    def traced(span: str) -> str:
        def submit_traced(tx: Transaction) -> str:
            tx.trace_of_jobs = lambda _principal: f"00-{'a' * 32}-{span * 16}-01"
            return submission.submit(tx, "lab", [JobCreate(kind="sum")])[0].id

        return desk.database.write(desk.user, submit_traced)

    first = traced("b")
    desk.clock.advance(5)
    lease = desk.claim()
    assert lease.trace is not None
    assert lease.trace.traceparent == f"00-{'a' * 32}-{'b' * 16}-01"
    assert 5 <= lease.trace.waited_s < 60
    desk.complete(lease)
    assert desk.job(traced("c")).cached_from == first
    assert desk.job(desk.submit("sum")).cached_from == first
    assert desk.claim_many() == []
    desk.submit("errand")
    assert desk.claim().trace is None


def test_results_that_went_elsewhere_do_not_serve_where_they_would_replace_something(desk: Desk) -> None:
    clips(desk, "walk")
    edit = ("edit", {"clips": {"collection": "walks"}}, TRIM)
    submit(desk, *edit, into="edited")
    desk.complete(desk.claim())
    assert shares(desk, *edit, into="edited")
    assert not shares(desk, *edit, into="walks")
    assert refused(desk, *edit) == ("/into", "ambiguous-place")


def test_an_edit_in_place_is_computed_every_time(desk: Desk) -> None:
    (walk,) = clips(desk, "walk")
    edit = ("edit", {"clips": {"item": walk, "revision": 1}}, TRIM | {"in_place": True})
    submit(desk, *edit)
    assert not shares(desk, *edit)
    for _ in range(2):
        desk.complete(desk.claim())
    assert not shares(desk, *edit)
    assert refused(desk, *edit, into="elsewhere") == ("/into", "ambiguous-place")


def test_pieces_are_cut_again_unless_the_clips_that_name_them_are_among_the_inputs(desk: Desk) -> None:
    (walk,) = clips(desk, "walk")
    said = annotations(desk, walk)
    for inputs, serves in (({}, False), ({"clips": {"item": walk}}, True)):
        cut: tuple[str, dict[str, Any], dict[str, Any]] = ("cut", {"annotations": said} | inputs, {})
        submit(desk, *cut, into="pieces")
        desk.complete(desk.claim())
        assert shares(desk, *cut, into="pieces") is serves
        desk.claim_many()


def test_takes_are_imported_again_once_the_skeleton_they_use_was_revised(desk: Desk) -> None:
    clips(desk, "walk")
    (rig,) = desk.publish(Draft("r", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}, collection="rigs"))
    file = {"name": "walk.bvh", "blob": desk.database.write(desk.user, blobs.put_blob, b"a walk")}
    load: tuple[str, dict[str, Any], dict[str, Any]] = ("import", {}, {"files": [file], "skeleton": rig.item})
    submit(desk, *load, into="first")
    desk.complete(desk.claim())
    assert shares(desk, *load, into="second")
    desk.database.write(
        desk.user, items.put_part, "lab", Kind.SKELETON, rig.item, "hierarchy", skeleton_tree(bone_m=0.7),
        expected_rev=None,
    )  # fmt: skip
    assert not shares(desk, *load, into="third")


def test_a_tree_that_cannot_go_where_it_should_is_refused_before_the_job(desk: Desk) -> None:
    maker = {"model": {"job": submit(desk, "errand", {}, {})}}
    assert refused(desk, "tree", maker, {}, into="trees") == ("/into", "ambiguous-place")


@pytest.mark.parametrize("kind", ["edit", "retarget", "annotate", "align"])
def test_two_revisions_of_a_clip_whose_results_would_get_one_name_are_refused_before_the_job(
    desk: Desk, kind: str
) -> None:
    (walk,) = clips(desk, "walk")
    desk.database.write(
        desk.user, items.put_part, "lab", Kind.CLIP, walk, "info", {"schema": "marey/clip-info@1"}, expected_rev=None
    )
    inputs: dict[str, Any] = {"clips": [{"item": walk, "revision": number} for number in (1, 2)]}
    params = {"edit": TRIM, "annotate": {"proposal": {"method": "steps"}}}.get(kind, {})
    if kind == "retarget":
        inputs["skeleton"] = {"collection": "rigs"}
    assert refused(desk, kind, inputs, params, into="out") == ("/inputs/clips", "same-name")


def test_a_result_that_would_replace_another_input_is_refused_before_the_job_is_spread(desk: Desk) -> None:
    clips(desk, *(f"walk {number}" for number in range(20)), "walk 3-short")
    inputs = {"clips": {"collection": "walks"}}
    assert refused(desk, "edit", inputs, TRIM | {"suffix": "-short"}) == ("/inputs/clips", "own-input")
    assert desk.state(submit(desk, "edit", inputs, TRIM | {"suffix": "-brief"})) == "running"
    assert desk.state(submit(desk, "edit", inputs, TRIM | {"suffix": "-short"}, into="short")) == "running"
