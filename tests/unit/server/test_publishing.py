"""Publication of results of imports and jobs as items: together, once, and with references between them."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import Connection, event
from tests.support.predecessor_models import imported
from tests.support.store_fixtures import ALL_RIGHTS, Lab, motion_tree, skeleton_tree
from tests.support.tiers import examples

from marey_schemas.items import Staleness
from marey_schemas.kinds import Kind
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.store import blobs, documents, items, projects
from marey_server.store.database import prepared
from marey_server.store.items import Draft, StoredDocument, publishing, references
from marey_server.store.items.drafts import Published
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database


def publish(lab: Lab, *drafts: Any, **kwargs: Any) -> list[Published]:
    def run(tx: Transaction) -> list[Published]:
        project_row = projects.require(tx, "lab")
        return items.publish(tx, project_row, drafts, author_id=tx.principal.user_id, rights=ALL_RIGHTS, **kwargs)

    return lab.write(run)


def rig_draft(name: str = "rig", reuse: Literal["by_name", "by_content", "new"] = "by_content", **kwargs: Any) -> Draft:
    return Draft(name, Kind.SKELETON, name, {"hierarchy": skeleton_tree(**kwargs)}, reuse=reuse)


def clip_draft(name: str = "walk", rig: str = "rig", **kwargs: Any) -> Draft:
    motion = motion_tree({"output": rig}, **kwargs)
    return Draft(name, Kind.CLIP, name, {"motion": motion}, collection="raw", tags=("new",))


def listed(lab: Lab, kind: Kind) -> tuple[Any, ...]:
    return lab.read(items.list_items, "lab", kind, sort="name").items


def test_drafts_refer_to_each_other_whatever_their_order(lab: Lab) -> None:
    clip, rig = publish(lab, clip_draft(), rig_draft())
    part = lab.read(items.read_part, "lab", Kind.CLIP, clip.item, "motion")
    assert part.tree["skeleton"] == {"item": rig.item, "revision": 1}
    assert (clip.name, clip.created, rig.created) == ("walk", True, True)


def test_publishing_the_same_again_makes_nothing_new(lab: Lab) -> None:
    first = publish(lab, clip_draft(), rig_draft())
    again = publish(lab, clip_draft(), rig_draft())
    assert [(one.item, one.revision) for one in again] == [(one.item, one.revision) for one in first]
    assert not any(one.created for one in again)
    assert len(listed(lab, Kind.CLIP)) == len(listed(lab, Kind.SKELETON)) == 1


def test_other_content_under_a_name_is_its_next_revision(lab: Lab) -> None:
    publish(lab, clip_draft(), rig_draft())
    clip, _ = publish(lab, clip_draft(seed=1, frames=9), rig_draft())
    assert (clip.revision, clip.created) == (2, True)
    assert listed(lab, Kind.CLIP)[0].summary["frames"] == 9


def test_a_warning_in_other_words_makes_no_new_revision(lab: Lab) -> None:
    def take(message: str, angle_deg: float = 83.0, file: bytes = b"take") -> Draft:
        warning = {"code": "rotation-jump", "message": message, "frames": [0, 2], "values": {"angle_deg": angle_deg}}
        source = {"file": lab.write(blobs.put_blob, file), "format": "bvh"}
        info = {"schema": "marey/clip-info@1", "source": source, "checks": [warning]}
        draft = clip_draft()
        return replace(draft, parts={**draft.parts, "info": info})

    first, _ = publish(lab, take("one joint jumps"), rig_draft())
    again, _ = publish(lab, take("a rotation jumps"), rig_draft())
    assert (again.revision, again.created) == (first.revision, False)
    kept = lab.read(items.read_part, "lab", Kind.CLIP, first.item, "info").tree
    assert kept["checks"][0]["message"] == "one joint jumps"
    assert publish(lab, take("a rotation jumps", angle_deg=90.0), rig_draft())[0].revision == 2
    assert publish(lab, take("one joint jumps", angle_deg=90.0, file=b"retake"), rig_draft())[0].revision == 3
    kept = lab.read(items.read_part, "lab", Kind.CLIP, first.item, "info").tree
    assert kept["checks"][0]["message"] == "one joint jumps"


def test_equal_content_is_found_under_any_name_even_after_its_other_parts_were_edited(lab: Lab) -> None:
    (rig,) = publish(lab, rig_draft("rig"))
    mapping = {"joints": {"hips": "j0"}}
    lab.write(items.put_part, "lab", Kind.SKELETON, rig.item, "mapping", mapping, expected_rev=None)
    (found,) = publish(lab, rig_draft("other name"))
    assert (found.item, found.revision, found.created) == (rig.item, 2, False)


def test_other_content_under_a_taken_name_is_numbered(lab: Lab) -> None:
    publish(
        lab,
        rig_draft(bone_m=0.5),
    )
    publish(lab, rig_draft(bone_m=0.6))
    publish(lab, rig_draft(bone_m=0.7))
    assert [one.name for one in listed(lab, Kind.SKELETON)] == ["rig", "rig-2", "rig-3"]


def test_a_new_item_refuses_a_taken_name_and_nothing_is_published(lab: Lab) -> None:
    publish(lab, rig_draft())
    with pytest.raises(ConflictProblem):
        publish(lab, clip_draft(), rig_draft(reuse="new"))
    assert listed(lab, Kind.CLIP) == ()


def test_one_bad_draft_and_nothing_is_published(lab: Lab) -> None:
    with pytest.raises(InvalidProblem):
        publish(lab, rig_draft(), clip_draft("good"), clip_draft("bad", joints=2))
    assert listed(lab, Kind.SKELETON) == listed(lab, Kind.CLIP) == ()
    with lab.database.engine.connect() as connection:
        for table in ("document", "blob", "blob_chunk", "collection", "revision"):
            assert connection.exec_driver_sql(f"SELECT count(*) FROM {table}").scalar() == 0


def test_names_within_a_batch_are_unique(lab: Lab) -> None:
    with pytest.raises(InvalidProblem, match="have the name 'rig'"):
        publish(lab, rig_draft(), rig_draft())


def test_drafts_with_one_target_become_its_revisions_in_order(lab: Lab) -> None:
    drafts = [Draft(f"d{i}", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree(bone_m=i + 1)}) for i in range(3)]
    assert [(one.revision, one.created) for one in publish(lab, *drafts)] == [(1, True), (2, True), (3, True)]


def test_drafts_of_one_name_keep_their_order_where_they_refer_to_others(lab: Lab) -> None:
    later = Draft("later", Kind.CLIP, "walk", {"motion": motion_tree({"output": "rig"}, frames=9)}, collection="raw")
    clip, _, second = publish(lab, clip_draft(), rig_draft(), later)
    assert (clip.revision, second.revision, second.item) == (1, 2, clip.item)


def test_equal_content_within_a_batch_is_one_item(lab: Lab) -> None:
    rigs = publish(lab, rig_draft("a"), rig_draft("b", bone_m=0.7), rig_draft("c"))
    assert rigs[0].item == rigs[2].item != rigs[1].item
    assert [one.created for one in rigs] == [True, True, False]
    assert [one.name for one in listed(lab, Kind.SKELETON)] == ["a", "b"]


def test_other_content_under_one_name_within_a_batch_is_numbered_in_order(lab: Lab) -> None:
    rigs = [replace(rig_draft(f"file {i}", bone_m=0.5 + i % 3), item_name="rig") for i in range(5)]
    made = publish(lab, *rigs)
    assert [one.name for one in listed(lab, Kind.SKELETON)] == ["rig", "rig-2", "rig-3"]
    assert [one.id for one in listed(lab, Kind.SKELETON)] == [one.item for one in made[:3]]
    assert [one.item for one in made[3:]] == [one.item for one in made[:2]]


def test_ids_of_a_batch_are_in_the_order_of_its_drafts(lab: Lab) -> None:
    made = publish(lab, rig_draft(), *(clip_draft(f"walk {number}", seed=number) for number in range(20)))
    assert sorted(one.item for one in made[1:]) == [one.item for one in made[1:]]


@pytest.fixture
def statements(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Any:
    """List of the SQL statements that were run; one statement with many sets of values counts once."""
    run: list[str] = []
    event.listen(lab.database.engine, "before_cursor_execute", lambda *given: run.append(given[2]))
    straight = prepared._run

    def recorded(connection: Connection, text: str, *args: Any, **kwargs: Any) -> Any:
        run.append(text)
        return straight(connection, text, *args, **kwargs)

    monkeypatch.setattr(prepared, "_run", recorded)
    return run


def batch_of(count: int, *, start: int = 0, name: str = "walk") -> list[Draft]:
    """Return drafts of a skeleton and of `count` clips, each with one source."""
    drafts = [replace(rig_draft(), item_name=f"rig of {name}")]
    for number in range(start, start + count):
        drafts += [clip_draft(f"{name} {number}", seed=number)]
    return drafts


def count_statements(lab: Lab, statements: list[str], *drafts: Any, **kwargs: Any) -> Any:
    statements.clear()
    publish(lab, *drafts, **kwargs)
    return len([text for text in statements if "server_state" not in text])  # the clock is saved once a second


def test_a_large_batch_is_published_with_the_statements_of_a_small_one(lab: Lab, statements: list[str]) -> None:
    publish(lab, *batch_of(1))
    few = count_statements(lab, statements, *batch_of(2, start=10))
    many = count_statements(lab, statements, *batch_of(60, start=20))
    assert many == few
    assert len(listed(lab, Kind.CLIP)) == 50  # a page


def test_staged_documents_of_a_large_batch_are_published_with_the_statements_of_a_small_one(
    lab: Lab, statements: list[str]
) -> None:
    rig, *_ = publish(lab, rig_draft())

    def staged(start: int, count: int) -> Any:
        def store(tx: Transaction) -> Any:
            trees = [motion_tree({"output": "rig"}, seed=number) for number in range(start, start + count)]
            return [documents.store_document(tx, tree) for tree in trees]

        digests = lab.write(store)
        source = {"skeleton": [(rig.item, 1)]}
        return [
            Draft(digest, Kind.CLIP, f"walk {start} {place}", {"motion": StoredDocument(digest)}, sources=source)
            for place, digest in enumerate(digests)
        ]

    few = count_statements(lab, statements, rig_draft(), *staged(0, 2))
    many = count_statements(lab, statements, rig_draft(), *staged(100, 40))
    assert many == few


def test_a_failure_in_the_middle_of_a_batch_leaves_nothing(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_args: Any, **_kwargs: Any) -> None:
        raise RuntimeError("cut off")

    monkeypatch.setattr(publishing, "write_revisions", fail)
    with pytest.raises(RuntimeError, match="cut off"):
        publish(lab, *batch_of(5))
    with lab.database.engine.connect() as connection:
        for table in ("document", "blob", "blob_chunk", "collection", "item", "revision"):
            assert connection.exec_driver_sql(f"SELECT count(*) FROM {table}").scalar() == 0


def test_a_batch_larger_than_one_statement_takes_is_published_whole(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "DRAFTS_TOGETHER", 3)
    made = publish(lab, *batch_of(10))
    assert [one.created for one in made] == [True] * 11
    assert len({one.item for one in made}) == 11


def test_staged_documents_with_references_keep_their_arrays(lab: Lab) -> None:
    motion = motion_tree({"output": "rig"}, frames=6)
    staged = lab.write(documents.store_document, motion)
    draft = Draft("walk", Kind.CLIP, "walk", {"motion": StoredDocument(staged)})
    clip, rig = publish(lab, draft, rig_draft())
    part = lab.read(items.read_part, "lab", Kind.CLIP, clip.item, "motion", arrays="decoded")
    assert part.tree["poses"].tobytes() == motion["poses"].tobytes()
    assert part.tree["skeleton"] == {"item": rig.item, "revision": 1}


def test_sources_become_lineage_in_both_directions(lab: Lab) -> None:
    clip, rig = publish(lab, clip_draft(), rig_draft())
    sources = {"clip": [(clip.item, 1)], "skeleton": [(rig.item, 1)]}
    (made,) = publish(lab, Draft("out", Kind.CHARACTER, "out", {"character": {"n": 1}}, sources=sources))
    lineage = lab.read(items.read_lineage, "lab", Kind.CHARACTER, made.item)
    assert {(edge.role, edge.item, edge.revision, edge.kind) for edge in lineage.inputs} == {
        ("clip", clip.item, 1, Kind.CLIP), ("skeleton", rig.item, 1, Kind.SKELETON),
    }  # fmt: skip
    back = lab.read(items.read_lineage, "lab", Kind.CLIP, clip.item)
    assert [(edge.item, edge.revision, edge.role) for edge in back.outputs] == [(made.item, 1, "clip")]


def test_what_was_made_from_something_that_changed_is_stale_through_any_number_of_steps(lab: Lab) -> None:
    clip, _ = publish(lab, clip_draft(), rig_draft())
    steps = [clip]
    for step in range(3):
        draft = Draft(
            "o", Kind.CHARACTER, f"s{step}", {"character": {"step": step}}, sources={"in": [(steps[-1].item, 1)]}
        )
        steps += publish(lab, draft)

    def staleness() -> Staleness:
        return lab.read(items.read_staleness, "lab", Kind.CHARACTER, steps[-1].item)

    assert not staleness().stale
    lab.write(items.put_part, "lab", Kind.CLIP, clip.item, "info", {"subject": "x"}, expected_rev=None)
    assert staleness().stale
    assert [(edge.item, edge.revision) for edge in staleness().because] == [(clip.item, 1)]


def item_that_was_added_to(lab: Lab) -> tuple[Published, Published]:
    """Publish a clip, and a second clip made from it; then add a part to the second clip, made from that clip itself.

    Returns both clips.
    """
    clip, _ = publish(lab, clip_draft(), rig_draft())
    (step,) = publish(
        lab, Draft("s", Kind.CHARACTER, "step", {"character": {"n": 1}}, sources={"clips": [(clip.item, 1)]})
    )
    made, _ = publish(lab, replace(clip_draft("made", seed=1), sources={"step": [(step.item, 1)]}), rig_draft())
    part = {"info": {"subject": "x"}}
    (added,) = publish(lab, Draft("a", Kind.CLIP, "made", part, "raw", sources={"clip": [(made.item, 1)]}))
    assert (added.item, added.revision) == (made.item, 2)
    return clip, made


def test_what_was_added_to_an_item_because_of_itself_is_not_stale(lab: Lab) -> None:
    _, made = item_that_was_added_to(lab)
    staleness = lab.read(items.read_staleness, "lab", Kind.CLIP, made.item)
    assert (staleness.revision, staleness.stale, staleness.because) == (2, False, ())


def test_a_changed_input_is_told_through_what_was_added_to_an_item_later(lab: Lab) -> None:
    clip, made = item_that_was_added_to(lab)
    lab.write(items.put_part, "lab", Kind.CLIP, clip.item, "info", {"subject": "x"}, expected_rev=None)
    staleness = lab.read(items.read_staleness, "lab", Kind.CLIP, made.item)
    assert staleness.stale
    assert [(edge.item, edge.revision, edge.role) for edge in staleness.because] == [(clip.item, 1, "clips")]


def test_who_still_uses_an_earlier_revision_of_such_an_item_is_stale(lab: Lab) -> None:
    _, made = item_that_was_added_to(lab)
    users = [
        Draft(f"u{n}", Kind.CHARACTER, f"user{n}", {"character": {"n": n}}, sources={"clip": [(made.item, n)]})
        for n in (1, 2)
    ]
    old, new = publish(lab, *users)
    assert lab.read(items.read_staleness, "lab", Kind.CHARACTER, old.item).stale
    assert not lab.read(items.read_staleness, "lab", Kind.CHARACTER, new.item).stale


def test_the_event_of_a_revision_names_it_and_its_place(lab: Lab) -> None:
    (clip, _), _ = (publish(lab, clip_draft(seed=seed), rig_draft()) for seed in range(2))
    told = [(one.kind, one.body) for one in lab.events() if one.subject == clip.item]
    body = {"item_kind": "clip", "name": "walk", "collection": "raw", "job": None}
    assert told == [("item.created", {**body, "revision": 1}), ("item.revised", {**body, "revision": 2})]


def test_many_publishers_of_one_skeleton_make_one(lab: Lab) -> None:
    def run(tx: Transaction, number: int) -> list[Published]:
        project_row = projects.require(tx, "lab")
        drafts = [rig_draft(), clip_draft(f"walk {number}", seed=number)]
        return items.publish(tx, project_row, drafts, author_id=tx.principal.user_id, rights=ALL_RIGHTS)

    futures = [lab.database.submit_write(lab.owner, run, number) for number in range(8)]
    assert len({future.result(60)[0].item for future in futures}) == 1
    assert len(listed(lab, Kind.CLIP)) == 8
    assert len(listed(lab, Kind.SKELETON)) == 1


def test_a_publisher_whom_others_always_overtake_is_asked_to_try_again(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(lab, rig_draft(), clip_draft())
    monkeypatch.setattr(publishing, "write_head", lambda *_args, **_more: False)
    with pytest.raises(ConflictProblem, match="are changing the item 'walk'") as refused:
        publish(lab, rig_draft(), clip_draft(seed=1))
    assert refused.value.error_code == "contended"


def test_many_publishers_of_one_name_make_its_revisions(lab: Lab) -> None:
    publish(lab, rig_draft())

    def run(tx: Transaction, number: int) -> Published:
        project_row = projects.require(tx, "lab")
        return items.publish(
            tx, project_row, [rig_draft(), clip_draft(seed=number)], author_id=tx.principal.user_id, rights=ALL_RIGHTS
        )[1]

    futures = [lab.database.submit_write(lab.owner, run, number) for number in range(8)]
    assert sorted(future.result(60).revision for future in futures) == list(range(1, 9))
    assert listed(lab, Kind.CLIP)[0].revision == 8


names = st.sampled_from("abcdef")


@given(st.dictionaries(names, st.lists(names, max_size=3)))
@settings(max_examples=examples(100, soak=300))
def test_references_are_followed_before_what_refers(refers: dict[str, Any]) -> None:
    try:
        order = references.in_order(refers)
    except InvalidProblem:
        # There is a cycle: walking backwards over members of `refers` never ends.
        left = {name: {one for one in refers[name] if one in refers} for name in refers}
        while done := [name for name, others in left.items() if not others]:
            left = {name: others - set(done) for name, others in left.items() if name not in done}
        assert left
        return
    assert sorted(order) == sorted(refers)
    for name, others in refers.items():
        assert all(order.index(other) < order.index(name) for other in others if other in refers)


def model_drafts(**changes: Any) -> Iterator[Draft]:
    """Yield the drafts of a model with its tree, and of their skeleton."""
    parts, hierarchy = imported()
    model = {**parts["model"], "skeleton": {"output": "rig"}, "provenance": {}, **changes}
    yield Draft("walk", Kind.MODEL, "walk", {"tree": parts["tree"], "model": model})
    yield Draft("rig", Kind.SKELETON, "rig", {"hierarchy": hierarchy})


def test_a_tree_gets_the_digest_of_the_model_it_comes_with(lab: Lab) -> None:
    publish(lab, *model_drafts())
    (model,) = listed(lab, Kind.MODEL)
    tree = lab.read(items.read_part, "lab", Kind.MODEL, model.id, "tree").tree
    assert tree["model_digest"] == model.parts["model"].document


@pytest.mark.parametrize(
    "notes", [{"provenance": {"digest_of": ["x"]}}, {"headline": {"digest_of": "tree"}}, {"options": {"digest_of": 5}}]
)
def test_nothing_but_the_model_of_a_tree_is_replaced_by_a_digest(lab: Lab, notes: dict[str, Any]) -> None:
    publish(lab, *model_drafts(**notes))
    (found,) = listed(lab, Kind.MODEL)
    model = lab.read(items.read_part, "lab", Kind.MODEL, found.id, "model").tree
    assert {name: model[name] for name in notes} == notes


def test_a_tree_of_another_part_than_the_model_is_refused(lab: Lab) -> None:
    parts, _ = imported()
    with pytest.raises(InvalidProblem, match="model_digest"):
        publish(lab, Draft("walk", Kind.MODEL, "walk", {"tree": {**parts["tree"], "model_digest": {"digest_of": "x"}}}))


def test_what_a_batch_refers_to_within_itself_is_not_read_again(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def look_up(_self: object, *key: object) -> None:
        raise AssertionError(f"read {key}")

    monkeypatch.setattr(references.ReferenceCheck, "_look_up", look_up)
    publish(lab, *batch_of(3))
    again = publish(lab, rig_draft("other name"), clip_draft("found", "other name"))
    assert [one.created for one in again] == [False, True]


def test_a_joint_that_only_other_clips_move_keeps_its_offset(lab: Lab) -> None:
    """A skeleton whose clip translates a joint must not replace a skeleton whose clips need the joint's offset."""

    def drafts(number: int, offset_m: float, moved: tuple[tuple[str, ...], ...]) -> list[Draft]:
        hierarchy = skeleton_tree()
        hierarchy["joints"][2]["offset"] = [0.0, offset_m, 0.0]
        motions = [motion_tree({"output": f"rig{number}"}, seed=number) for _ in moved]
        for motion, joints in zip(motions, moved, strict=True):
            if joints:
                motion |= {"translated_joints": joints, "translations": np.zeros((5, len(joints), 3), np.float32)}
        return [
            Draft(f"rig{number}", Kind.SKELETON, "rig", {"hierarchy": hierarchy}, "skeletons", reuse="by_content"),
            *(
                Draft(f"take{number}-{place}", Kind.CLIP, f"take{number}-{place}", {"motion": motion}, "takes")
                for place, motion in enumerate(motions)
            ),
        ]

    made = publish(lab, *drafts(0, 0.0, (("j2",),)), *drafts(1, 0.3, ((),)), *drafts(2, 0.6, (("j2",), ())))
    assert len({one.item for one in made if one.name.startswith("rig")}) == 3


def test_takes_of_one_rig_use_one_skeleton_whatever_means_nothing_differs(lab: Lab) -> None:
    """The root's offset, rounding, and an offset that the motion replaces differ from take to take."""

    def take(number: int, change: Callable[[dict[str, Any]], None], moved: tuple[str, ...] = ()) -> list[Published]:
        hierarchy, motion = skeleton_tree(), motion_tree({"output": f"rig{number}"}, seed=number)
        change(hierarchy)
        if moved:
            motion |= {"translated_joints": moved, "translations": np.zeros((5, len(moved), 3), np.float32)}
        return publish(
            lab,
            Draft(f"rig{number}", Kind.SKELETON, "rig", {"hierarchy": hierarchy}, "skeletons", reuse="by_content"),
            Draft(f"take{number}", Kind.CLIP, f"take{number}", {"motion": motion}, "takes"),
        )

    def offset(joint: int, change: float) -> Callable[[dict[str, Any]], None]:
        def changed(hierarchy: dict[str, Any]) -> None:
            x, y, z = hierarchy["joints"][joint]["offset"]
            hierarchy["joints"][joint]["offset"] = [x, y + change, z]

        return changed

    first = take(0, offset(0, 0.0))[0].item
    assert take(1, offset(0, 0.97))[0].item == first
    assert take(2, offset(1, 1e-6))[0].item == first
    assert take(3, offset(2, 0.2), moved=("j2",))[0].item == first
    other = take(4, offset(2, 0.2))[0].item
    assert other != first
    assert take(5, offset(2, 0.2))[0].item == other
    together = publish(
        lab,
        *(
            Draft(
                f"new{n}", Kind.SKELETON, "new", {"hierarchy": skeleton_tree(bone_m=0.9 + n * 1e-6)}, reuse="by_content"
            )
            for n in range(2)
        ),
    )
    assert together[0].item == together[1].item
    assert len(listed(lab, Kind.SKELETON)) == 3
