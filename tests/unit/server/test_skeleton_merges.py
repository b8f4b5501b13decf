"""Merges of duplicate skeletons: clips move to one skeleton, with the same motion, history and freshness."""

from typing import Any

import numpy as np
import pytest
from tests.support.store_fixtures import ALL_RIGHTS, Lab, motion_tree, skeleton_tree

from marey_schemas.documents.skeleton_merges import SKELETON_MERGE, SkeletonMergeRequest
from marey_schemas.items import ItemCreate, ItemRevert, PartPlace
from marey_schemas.kinds import Kind
from marey_server.errors import (
    ApiProblem,
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    TooLargeProblem,
)
from marey_server.store import items, projects
from marey_server.store.items import Draft, skeleton_merges
from marey_server.store.items.same_rigs import RigDocument, first_of_rig, is_same_rig


def rig(
    lab: Lab, name: str, *, root_m: float = 0.0, second_m: float = 0.5, mapping: dict[str, Any] | None = None
) -> Any:
    """Create a skeleton of three joints; its root and its second joint have these offsets."""
    tree = skeleton_tree()
    tree["joints"][0]["offset"] = [root_m, 0.0, 0.0]
    tree["joints"][2]["offset"] = [0.0, second_m, 0.0]
    parts = {"hierarchy": tree, **({"mapping": mapping} if mapping else {})}
    return lab.write(
        items.create_item, "lab", Kind.SKELETON, ItemCreate(name=name, collection="skeletons", parts=parts)
    )


def merge(lab: Lab, **fields: Any) -> Any:
    request = SkeletonMergeRequest(**fields)
    return (lab.read if request.dry_run else lab.write)(items.merge_skeletons, "lab", request, who=lab.maintainer)


def derived(lab: Lab, clip: Any, skeleton: Any) -> str:
    """Create a clip that was computed from `clip`; return its id."""

    def publish(tx: Any) -> Any:
        motion = motion_tree(skeleton, seed=9)
        draft = Draft("made", Kind.CLIP, "made", {"motion": motion}, "made", sources={"clips": [(clip.id, 1)]})
        row = projects.require(tx, "lab")
        return items.publish(tx, row, [draft], author_id=tx.principal.user_id, rights=ALL_RIGHTS)[0].item

    made: str = lab.write(publish)
    return made


def stale(lab: Lab, item: str) -> bool:
    found: bool = lab.read(items.read_staleness, "lab", Kind.CLIP, item).stale
    return found


def test_clips_move_to_one_skeleton_with_the_same_poses_and_nothing_becomes_stale(lab: Lab) -> None:
    first, second, other = rig(lab, "a"), rig(lab, "b", root_m=3.0), rig(lab, "c", second_m=0.7)
    for number in range(2):
        lab.add_clip(first, f"walk {number}", seed=number)
    moved = lab.add_clip(second, "run", collection="raw", seed=7, info={"subject": "ada"})
    body = {"clip": {"item": moved.id, "revision": 1}, "segments": [{"label": "a", "start": 0, "end": 2}]}
    said = lab.write(items.create_item, "lab", Kind.ANNOTATION, ItemCreate(name="said", parts={"annotation": body}))
    made = derived(lab, moved, other)

    preview = merge(lab, dry_run=True)
    assert [(one.kept.path, [gone.path for gone in one.merged]) for one in preview.rigs] == [
        ("skeletons/a", ["skeletons/b"])
    ]
    assert lab.read(items.read_item, "lab", Kind.CLIP, moved.id).revision == 1

    (done,) = merge(lab).rigs
    assert (done.kept.id, done.merged[0].id, done.merged[0].moved) == (first.id, second.id, {"clip": 1})
    now = lab.read(items.read_item, "lab", Kind.CLIP, moved.id)
    assert (now.revision, now.path, now.summary["skeleton"], now.summary["subject"]) == (2, "raw/run", first.id, "ada")
    before, after = (
        lab.read(items.read_part, "lab", Kind.CLIP, moved.id, "motion", revision=number).tree for number in (1, 2)
    )
    assert np.array_equal(before["poses"], after["poses"])
    assert {**before, "skeleton": None, "poses": None} == {**after, "skeleton": None, "poses": None}
    with pytest.raises(NotFoundProblem):
        lab.read(items.read_item, "lab", Kind.SKELETON, second.id)
    layer = lab.read(items.read_part, "lab", Kind.ANNOTATION, said.id, "annotation").tree
    assert layer["clip"] == {"item": moved.id, "revision": 2}
    (edge,) = lab.read(items.read_lineage, "lab", Kind.CLIP, moved.id).inputs
    assert (edge.role, edge.item, edge.revision) == (SKELETON_MERGE, moved.id, 1)

    assert not stale(lab, made)
    lab.write(items.put_part, "lab", Kind.CLIP, moved.id, "info", {"subject": "eve"}, expected_rev=None)
    assert stale(lab, made)
    assert merge(lab).rigs == ()


def test_revisions_before_a_merge_stay_readable_and_are_merged_again_if_they_come_back(lab: Lab) -> None:
    first, second = rig(lab, "a"), rig(lab, "b", root_m=3.0)
    lab.add_clip(first, "walk")
    moved = lab.add_clip(second, "run", seed=7)
    merge(lab)
    place = PartPlace(kind=Kind.SKELETON, item=second.id, revision=1, part="hierarchy")
    assert lab.read(items.load_parts, "lab", [place]).documents[0] is not None
    assert lab.read(items.read_part, "lab", Kind.SKELETON, second.id, "hierarchy", revision=1).tree["joints"]
    with pytest.raises(NotFoundProblem):
        lab.read(items.read_part, "lab", Kind.SKELETON, second.id, "hierarchy")

    lab.write(items.revert_item, "lab", Kind.CLIP, moved.id, ItemRevert(revision=1), expected_rev=None)
    back = lab.read(items.read_item, "lab", Kind.CLIP, moved.id)
    assert (back.revision, back.summary["skeleton"]) == (3, second.id)
    (again,) = merge(lab).rigs
    assert (again.kept.id, again.merged[0].id, again.merged[0].moved) == (first.id, second.id, {"clip": 1})
    assert merge(lab).rigs == ()


def test_annotations_of_a_thousand_clips_are_found_at_once(lab: Lab) -> None:
    clip = lab.add_clip(rig(lab, "a"))
    body = {"clip": {"item": clip.id, "revision": 1}, "segments": [{"label": "a", "start": 0, "end": 2}]}
    lab.write(items.create_item, "lab", Kind.ANNOTATION, ItemCreate(name="said", parts={"annotation": body}))
    clips = {f"clip_{number:026d}": 1 for number in range(999)} | {clip.id: 1}

    def find(tx: Any) -> list[Draft]:
        return list(skeleton_merges._moved_annotations(tx, projects.require(tx, "lab"), clips, "merged"))

    assert [one.item_name for one in lab.write(find)] == ["said"]


def test_only_documents_of_what_moves_are_read_and_not_before_the_limits_are_checked(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, duplicate = rig(lab, "a"), rig(lab, "b", root_m=1.0)
    for number in range(3):
        lab.add_clip(kept, f"stays {number}", seed=number)
    for number in range(2):
        lab.add_clip(duplicate, f"moves {number}", seed=number + 3)
    read: list[str] = []

    def note(load: Any) -> Any:
        def loading(tx: Any, project: Any, skeleton: str, **kwargs: Any) -> Any:
            read.append(skeleton)
            return load(tx, project, skeleton, **kwargs)

        return loading

    monkeypatch.setattr(skeleton_merges, "_items_using", note(skeleton_merges._items_using))
    monkeypatch.setattr(skeleton_merges, "MOST_MOVED", 1)
    with pytest.raises(TooLargeProblem, match="changes at most 1 clips"):
        merge(lab)
    assert read == []
    monkeypatch.setattr(skeleton_merges, "MOST_MOVED", 2)
    assert merge(lab).rigs[0].merged[0].moved == {"clip": 2}
    assert read == [duplicate.id]
    monkeypatch.setattr(skeleton_merges, "MOST_RIGS_COMPARED", 1)
    rig(lab, "c", root_m=2.0)
    with pytest.raises(TooLargeProblem, match="compares at most 1 skeletons"):
        merge(lab)


def test_comparing_many_rigs_reads_each_skeleton_a_fixed_number_of_times() -> None:
    class Body(dict[str, Any]):
        reads = 0

        def __getitem__(self, name: str) -> Any:
            self.reads += 1
            return super().__getitem__(name)

    rigs = [RigDocument(f"digest {n}", Body(skeleton_tree(60, bone_m=1 + n / 1000))) for n in range(20)]
    assert not any(is_same_rig(one, other, ()) for one in rigs for other in rigs if one is not other)
    assert is_same_rig(rigs[0], rigs[1], [f"j{n}" for n in range(60)])
    for place, one in enumerate(rigs):
        assert first_of_rig(rigs[:place], one, tuple) is None
        assert first_of_rig(rigs, one, tuple) == place
    assert first_of_rig(rigs[5:], rigs[0], lambda: rigs[0].names) == 0
    assert max(body.reads for one in rigs if isinstance(body := one.body, Body)) <= 4


def test_skeletons_whose_other_offsets_all_motions_replace_are_merged(lab: Lab) -> None:
    kept, replaced = rig(lab, "a"), rig(lab, "b", second_m=0.7)
    for skeleton in (kept, replaced):
        tree = motion_tree(skeleton, seed=1)
        tree |= {"translated_joints": ["j2"], "translations": np.ones((5, 1, 3), "<f4")}
        lab.write(items.create_item, "lab", Kind.CLIP, ItemCreate(name=skeleton.name, parts={"motion": tree}))
    assert len(merge(lab, kept=kept.id, dry_run=True).rigs) == 1
    lab.add_clip(replaced, "still")
    assert merge(lab, kept=kept.id, dry_run=True).rigs == ()
    with pytest.raises(InvalidProblem, match=r"differ by up to 0\.2") as refused:
        merge(lab, skeletons=(kept.id, replaced.id), kept=kept.id)
    assert refused.value.error_code == "other-rig"


def test_a_joint_map_made_by_hand_is_kept_and_two_of_them_are_a_question(lab: Lab) -> None:
    mapping = {"joints": {"hips": "j0"}, "method": "manual", "confidence": 1.0}
    plain, edited = rig(lab, "a"), rig(lab, "b", root_m=1.0, mapping=mapping)
    lab.add_clip(plain)
    assert merge(lab, dry_run=True).rigs[0].kept.id == edited.id
    rig(lab, "c", root_m=2.0, mapping={**mapping, "joints": {"hips": "j1"}})
    with pytest.raises(ConflictProblem, match="choose the skeleton that remains with --keep"):
        merge(lab)
    assert merge(lab, kept=edited.id).rigs[0].merged[1].path == "skeletons/a"


def test_only_maintainers_merge_and_unknown_skeletons_are_named(lab: Lab) -> None:
    rig(lab, "a")
    with pytest.raises(ForbiddenProblem):
        lab.write(items.merge_skeletons, "lab", SkeletonMergeRequest(), who=lab.contributor)
    with pytest.raises(ApiProblem, match="skeleton_gone"):
        merge(lab, skeletons=("skeleton_gone",))
