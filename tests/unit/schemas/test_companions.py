"""Pairing of files with their companions, by their names."""

from __future__ import annotations

import pytest

from marey_schemas.formats.companions import is_skeleton_name, model_name, pair_companions, stem_of


def pairs(*names: str) -> dict[str, str | None]:
    return {pairing.file: pairing.companion for pairing in pair_companions(names)}


@pytest.mark.parametrize(
    ("skeleton", "clip"),
    [
        ("skeleton.json", "walk.bson.bz2"),
        ("walk_skeleton.json", "walk_01.bson"),
        ("walk.skeleton", "walk.json"),
        ("walk.skeleton.json", "walk.bson.bz2"),
        ("Lab.SKELETON", "walk.BSON"),
    ],
)
def test_a_clip_of_the_predecessor_has_the_skeleton_of_its_folder(skeleton: str, clip: str) -> None:
    (pairing,) = pair_companions([f"a/{skeleton}", f"a/{clip}", "b/other_skeleton.json"])
    assert (pairing.file, pairing.companion) == (f"a/{clip}", f"a/{skeleton}")
    assert pairing.beside == (f"a/{skeleton}",)
    assert pairing.shared


def test_of_several_skeletons_the_one_with_the_longest_equal_beginning_is_chosen() -> None:
    skeletons = ("walk_skeleton.json", "walk_fast_skeleton.json", "skeleton.json")
    found = pairs("walk_slow.bson", "walk_fast_2.bson", "run.bson", *skeletons)
    assert found == {
        "run.bson": "skeleton.json",
        "walk_fast_2.bson": "walk_fast_skeleton.json",
        "walk_slow.bson": "walk_skeleton.json",
    }
    (unclear,) = pair_companions(["run.bson", "walk_skeleton.json", "jump_skeleton.json"])
    assert (unclear.companion, unclear.code) == (None, "")
    assert unclear.beside == ("jump_skeleton.json", "walk_skeleton.json")


def test_files_without_a_match_need_two_others_that_show_it() -> None:
    others = tuple(f"{number:04d}.asf" for number in range(5000))
    takes = [f"take{number}.amc" for number in range(5000)]
    pairings = pair_companions([*others, *takes])
    assert {(pairing.companion, pairing.code) for pairing in pairings} == {(None, "asf-missing")}
    assert {pairing.beside for pairing in pairings} == {others[:2]}
    for pairing in pairings[:3]:
        assert pair_companions([pairing.file, *pairing.beside]) == (pairing,)


def test_a_model_has_its_tree_and_no_skeleton() -> None:
    names = ["skeleton.json", "walk_1.5_mm.json", "walk_1.5_cluster_tree.json", "run_quaternion_mm.bson.bz2"]
    assert pairs(*names) == {"walk_1.5_mm.json": "walk_1.5_cluster_tree.json"}


def test_a_clip_that_is_called_like_a_model_takes_no_tree_from_it() -> None:
    assert pairs("skeleton.json", "walk.json", "walk_mm.json", "walk_cluster_tree.json") == {
        "walk.json": "skeleton.json",
        "walk_mm.json": "walk_cluster_tree.json",
    }


def test_clips_that_differ_only_in_the_ending_all_have_a_skeleton() -> None:
    clips = ("walk.bson", "walk.bson.bz2", "walk.json")
    assert pairs("skeleton.json", *clips) == dict.fromkeys(clips, "skeleton.json")


def test_a_clip_that_is_only_called_like_a_tree_has_a_skeleton() -> None:
    assert pairs("skeleton.json", "climb_tree.bson") == {"climb_tree.bson": "skeleton.json"}


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("a/walk.bson.bz2", "walk"),
        ("walk.1.json", "walk.1"),
        ("walk.BSON", "walk"),
        ("walk.1.bvh", "walk.1"),
        ("a\\b.asf", "b"),
        (".json", ".json"),
    ],
)
def test_the_stem_of_a_name_has_no_ending(name: str, stem: str) -> None:
    assert stem_of(name) == stem


def test_a_model_is_called_like_its_file_without_what_marks_it_as_a_model() -> None:
    names = ("walk_left_quaternion_mm", "walk_mm", "walk_mm.bson.bz2", "walk", "_mm", "walk.1_mm")
    assert [model_name(name) for name in names] == ["walk_left", "walk", "walk", "walk", "_mm", "walk.1"]


def test_only_documents_of_the_predecessor_are_skeletons() -> None:
    assert is_skeleton_name("x/My_Skeleton.json")
    assert not is_skeleton_name("skeleton.bvh")
    assert not is_skeleton_name("skeleton/walk.json")


def test_motions_have_notes_and_skeletons_have_models_with_their_names() -> None:
    names = "walk.bson walk_sections.json take.bvh take_alignment.json 07_1.amc 07.asf 07_1_sections.json body.skeleton"
    found = {
        one.file: one for one in pair_companions([*names.split(), "body_skeleton_model.json", "lost_sections.json"])
    }
    assert {file: one.notes for file, one in found.items() if one.notes} == {
        "walk.bson": "walk_sections.json",
        "take.bvh": "take_alignment.json",
        "07_1.amc": "07_1_sections.json",
    }
    assert found["body.skeleton"].companion == "body_skeleton_model.json"
    assert found["walk.bson"].beside == ("body.skeleton", "body_skeleton_model.json", "walk_sections.json")
    assert found["take.bvh"].companion is None
    assert found["lost_sections.json"].companion == "body.skeleton"  # as any document whose content is not known yet
