"""Items: creating, revising, moving, deleting and reading them."""

import threading
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest
from tests.support.store_fixtures import Lab, declared, motion_tree, skeleton_tree

from marey_motion.arrays import AnyFloats
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.items import CollectionChange, CollectionCreate, Item, ItemChange, ItemCreate, ItemRevert
from marey_schemas.kinds import Kind
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    PreconditionFailedProblem,
    UnauthenticatedProblem,
)
from marey_server.store import collections, items, projects
from marey_server.store.database.connections import Database
from marey_server.store.fsck import check_store
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.transaction import Transaction


@pytest.fixture
def rig(lab: Lab) -> Item:
    return lab.add_skeleton()


def read(lab: Lab, clip: Item, **kwargs: Any) -> Item:
    return lab.read(items.read_item, "lab", Kind.CLIP, clip.id, **kwargs)


def put_info(lab: Lab, clip: Item, expected_rev: int | None, **info: Any) -> Item:
    tree = {"schema": "marey/clip-info@1", **info}
    return lab.write(items.put_part, "lab", Kind.CLIP, clip.id, "info", tree, expected_rev=expected_rev)


def change(lab: Lab, clip: Item, expected_rev: int | None = None, **fields: Any) -> Item:
    return lab.write(items.change_item, "lab", Kind.CLIP, clip.id, ItemChange(**fields), expected_rev=expected_rev)


# -- what is written is read ------------------------------------------------------------------------------------------


def test_a_clip_comes_back_exactly(lab: Lab, rig: Item) -> None:
    motion = motion_tree(rig, frames=7)
    clip = lab.add_clip(rig, "walk", collection="raw/monday", tags=("b", "a"), frames=7)
    assert (clip.name, clip.collection, clip.tags, clip.revision, clip.rev) == ("walk", "raw/monday", ("a", "b"), 1, 1)
    assert read(lab, clip) == clip
    part = lab.read(items.read_part, "lab", Kind.CLIP, clip.id, "motion", arrays="decoded")
    assert part.tree["poses"].tobytes() == motion["poses"].tobytes()
    assert part.tree["joints"] == motion["joints"]
    assert part.tree["skeleton"] == {"item": rig.id, "revision": 1}
    encoded = lab.read(items.read_part, "lab", Kind.CLIP, clip.id, "motion")
    assert isinstance(encoded.tree["poses"], EncodedArray)
    assert encoded.tree["poses"].decode().tobytes() == motion["poses"].tobytes()


def test_contents_are_found_in_current_items_of_their_kind_only(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk", frames=7)
    hierarchy = lab.read(items.read_part, "lab", Kind.SKELETON, rig.id, "hierarchy").digest
    motion = lab.read(items.read_part, "lab", Kind.CLIP, clip.id, "motion").digest
    asked = [hierarchy, motion, "sha256:" + "0" * 64]
    assert lab.read(items.find_contents, "lab", Kind.SKELETON, "hierarchy", asked) == {hierarchy}
    assert lab.read(items.find_contents, "lab", Kind.CLIP, "motion", asked) == {motion}
    assert lab.read(items.find_contents, "lab", Kind.CLIP, "info", asked) == set()
    lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=None)
    assert lab.read(items.find_contents, "lab", Kind.CLIP, "motion", asked) == set()


def test_the_summary_tells_what_lists_show(lab: Lab, rig: Item) -> None:
    info = {"checks": [{"code": "foot-slide", "message": "m"}, {"code": "foot-slide", "message": "n"}]}
    clip = lab.add_clip(rig, frames=60, info=info)
    assert clip.summary == {
        "frames": 60, "frame_rate_hz": 120, "duration_s": 0.5, "joints": 3, "skeleton": rig.id,
        "warnings": ["foot-slide"],
    }  # fmt: skip
    assert rig.summary == {"joints": 3}


def cut_part(
    tx: Transaction,
    kind: Kind,
    item_id: str,
    part: str,
    *,
    frames: Any = None,
    joints: Any = None,
    arrays: str = "encoded",
) -> dict[str, Any]:
    """Return some frames and joints of a part."""
    tree = items.load_part(tx, items.find_part(tx, "lab", kind, item_id, part))
    return items.cut_part(tree, frames, joints, encoded=arrays == "encoded")


def plain(array: Any) -> AnyFloats:
    return array.decode() if isinstance(array, EncodedArray) else array


@pytest.mark.parametrize("arrays", ["encoded", "decoded"])
def test_slices_of_a_motion_equal_slices_of_the_array(lab: Lab, rig: Item, arrays: str) -> None:
    clip = lab.add_clip(rig, frames=40, seed=3)
    poses = motion_tree(rig, frames=40, seed=3)["poses"]
    for frames in (None, slice(0, 1), slice(5, 17), slice(30, 400), slice(-3, None)):
        for joints in (None, ["j0"], ["j2", "j0"], ["j0", "j1", "j2"]):
            tree = lab.read(cut_part, Kind.CLIP, clip.id, "motion", frames=frames, joints=joints, arrays=arrays)
            assert isinstance(tree["poses"], EncodedArray) == (arrays == "encoded")
            columns = [0, 1, 2]
            for name in joints or ["j0", "j1", "j2"]:
                columns += range(3 + 4 * int(name[1]), 7 + 4 * int(name[1]))
            np.testing.assert_array_equal(plain(tree["poses"]), poses[frames or slice(None)][:, columns])
            assert tree["joints"] == (joints or ["j0", "j1", "j2"])


@pytest.mark.parametrize("arrays", ["encoded", "decoded"])
def test_slices_cut_translations_along(lab: Lab, rig: Item, arrays: str) -> None:
    motion = motion_tree(rig, frames=6)
    motion["translations"] = np.arange(6 * 2 * 3, dtype="<f4").reshape(6, 2, 3)
    motion["translated_joints"] = ["j1", "j2"]
    clip = lab.write(items.create_item, "lab", Kind.CLIP, ItemCreate(name="w", parts={"motion": motion}))

    def cut(**kwargs: Any) -> dict[str, Any]:
        return lab.read(cut_part, Kind.CLIP, clip.id, "motion", arrays=arrays, **kwargs)

    np.testing.assert_array_equal(plain(cut(frames=slice(2, 4))["translations"]), motion["translations"][2:4])
    only = cut(joints=["j2", "j0"])
    np.testing.assert_array_equal(plain(only["translations"]), motion["translations"][:, 1:])
    assert only["translated_joints"] == ["j2"]
    none = cut(joints=["j0"])
    assert (none["translations"], none["translated_joints"]) == (None, [])


@pytest.mark.parametrize(
    "cut",
    [{"joints": ["nose"]}, {"joints": []}, {"joints": ["j0", "j0"]}, {"frames": slice(5, 9)}, {"frames": slice(3, 2)}],
)
def test_a_cut_that_makes_no_sense_is_refused(lab: Lab, rig: Item, cut: dict[str, Any]) -> None:
    clip = lab.add_clip(rig, frames=5)
    with pytest.raises(InvalidProblem):
        lab.read(cut_part, Kind.CLIP, clip.id, "motion", **cut)


def test_only_motions_are_cut(lab: Lab, rig: Item) -> None:
    with pytest.raises(InvalidProblem):
        lab.read(cut_part, Kind.SKELETON, rig.id, "hierarchy", frames=slice(0, 1))


# -- revisions --------------------------------------------------------------------------------------------------------


def test_a_new_part_makes_a_revision_and_shares_the_others(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig)
    revised = put_info(lab, clip, clip.rev, subject="Ann")
    assert (revised.revision, revised.rev) == (2, 2)
    assert revised.parts["motion"] == clip.parts["motion"]
    assert lab.read(items.read_revision, "lab", Kind.CLIP, clip.id, 1).parts == clip.parts
    assert [one.revision for one in lab.read(items.list_revisions, "lab", Kind.CLIP, clip.id).items] == [2, 1]


def test_a_revision_that_does_not_exist_yet_is_named_with_the_newest(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig)
    with pytest.raises(NotFoundProblem, match=r"has no revision 7; the newest one is 1\.$"):
        lab.read(items.find_part, "lab", Kind.CLIP, clip.id, "motion", revision=7)


@pytest.mark.parametrize("revision", [None, 1])
def test_a_part_of_an_item_that_does_not_exist_is_refused_as_the_item_is(lab: Lab, revision: int | None) -> None:
    with pytest.raises(NotFoundProblem, match=r"^There is no clip 'walk' in this project\.$"):
        lab.read(items.find_part, "lab", Kind.CLIP, "walk", "motion", revision=revision)


@pytest.mark.parametrize(
    ("change", "pointer", "reason"),
    [
        ({"frame_rate_hz": "30"}, "/motion/frame_rate_hz", "the value must be a number, not the text '30'"),
        ({"poses": np.zeros((2, 7))}, "/motion/poses", "expected dtype <f4, not <f8"),
        ({"joints": ["Hips", "Spine"]}, "/motion", "poses: the array has"),
    ],
)
def test_a_document_that_is_not_valid_is_refused_with_place_and_reason_once(
    lab: Lab, rig: Item, change: dict[str, Any], pointer: str, reason: str
) -> None:
    """The text of a number would be stored as it was sent, and fail whoever divides by it."""
    clip = lab.add_clip(rig)
    motion = {**motion_tree(rig), **change}
    with pytest.raises(InvalidProblem) as refused:
        lab.write(items.put_part, "lab", Kind.CLIP, clip.id, "motion", motion, expected_rev=None)
    assert f"marey/motion@1: {pointer}: {reason}" in str(refused.value.detail)
    assert refused.value.errors[0].pointer == pointer


def test_the_same_content_again_makes_no_revision(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, info={"subject": "Ann"})
    again = put_info(lab, clip, clip.rev, subject="Ann")
    assert (again.revision, again.rev) == (1, 1)
    motion = motion_tree(rig)
    same = lab.write(items.put_part, "lab", Kind.CLIP, clip.id, "motion", motion, expected_rev=None)
    assert same.revision == 1


def test_the_parts_of_any_number_of_revisions_are_read(lab: Lab, rig: Item) -> None:
    """A database limits the parameters of one statement: SQLite by default to 32,766, Postgres to 65,535."""
    wanted = {(f"item-{number}", 1) for number in range(66_000)} | {(rig.id, 1)}
    found = lab.read(read_part_digests, wanted)
    assert found.keys() == wanted
    assert {one: parts for one, parts in found.items() if parts} == {(rig.id, 1): {"hierarchy": ANY}}


def test_old_revisions_stay_readable(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, info={"subject": "Ann"})
    put_info(lab, clip, None, subject="Ben")

    def subject(**kwargs: Any) -> str:
        return lab.read(items.read_part, "lab", Kind.CLIP, clip.id, "info", **kwargs).tree["subject"]

    assert (subject(), subject(revision=1), subject(revision=2)) == ("Ben", "Ann", "Ben")
    for number in (0, 3, 10**12):
        with pytest.raises((NotFoundProblem, InvalidProblem)):
            subject(revision=number)


def test_summaries_follow_the_newest_revision(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, frames=5)
    longer = lab.write(
        items.put_part, "lab", Kind.CLIP, clip.id, "motion", motion_tree(rig, frames=9), expected_rev=None
    )
    assert (longer.summary["frames"], longer.summary["warnings"]) == (9, [])
    checked = put_info(lab, clip, None, checks=[{"code": "jump", "message": "m"}])
    assert (checked.summary["frames"], checked.summary["warnings"]) == (9, ["jump"])


def test_authors_and_messages_are_kept(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, who=lab.contributor)
    revision = lab.read(items.read_revision, "lab", Kind.CLIP, clip.id, 1)
    assert (revision.author, revision.job) == (lab.contributor.user_name, None)


# -- preconditions ----------------------------------------------------------------------------------------------------


def test_a_change_of_a_state_that_has_passed_is_refused_and_changes_nothing(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig)
    renamed = change(lab, clip, clip.rev, name="run")
    for attempt in (
        lambda: change(lab, clip, clip.rev, name="late"),
        lambda: change(lab, clip, clip.rev, tags=("late",)),
        lambda: put_info(lab, clip, clip.rev, subject="late"),
        lambda: put_info(lab, clip, 99),
        lambda: lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=clip.rev),
    ):
        with pytest.raises(PreconditionFailedProblem) as refused:
            attempt()
        assert refused.value.context == {"rev": renamed.rev}
    assert read(lab, clip) == renamed


@pytest.mark.parametrize("second", ["part", "name", "delete"])
def test_of_two_changes_at_once_one_wins(lab: Lab, rig: Item, open_database: Callable[..., Any], second: str) -> None:
    """The first change waits between its write and its commit. Meanwhile, the second one starts from the same state."""
    clip = lab.add_clip(rig)
    other = open_database()
    written, outcome = threading.Event(), []

    def first(tx: Transaction) -> None:
        items.change_item(tx, "lab", Kind.CLIP, clip.id, ItemChange(name="first"), expected_rev=clip.rev)
        written.set()
        thread.join(0.3)

    def run_second() -> None:
        written.wait(10)
        try:
            if second == "part":
                outcome.append(
                    other.write(
                        lab.owner, items.put_part, "lab", Kind.CLIP, clip.id, "info", {"subject": "x"}, expected_rev=1
                    )
                )
            elif second == "name":
                outcome.append(
                    other.write(
                        lab.owner,
                        items.change_item,
                        "lab",
                        Kind.CLIP,
                        clip.id,
                        ItemChange(name="second"),
                        expected_rev=1,
                    )
                )
            else:
                outcome.append(other.write(lab.owner, items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=1))
        except PreconditionFailedProblem as error:
            outcome.append(error.context)

    thread = threading.Thread(target=run_second)
    thread.start()
    lab.write(first)
    thread.join(30)
    assert outcome == [{"rev": 2}]
    after = read(lab, clip)
    assert (after.name, after.revision, after.rev) == ("first", 1, 2)


def test_many_changes_at_once_without_a_precondition_all_happen(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig)
    futures = [
        lab.database.submit_write(
            lab.owner, items.put_part, "lab", Kind.CLIP, clip.id, "info", {"subject": f"s{i}"}, expected_rev=None
        )
        for i in range(8)
    ]
    assert sorted(future.result(60).revision for future in futures)[-1] == 9
    assert read(lab, clip).revision == 9
    assert len(lab.read(items.list_revisions, "lab", Kind.CLIP, clip.id).items) == 9


# -- names and places -------------------------------------------------------------------------------------------------


def test_a_name_stands_once_per_kind_and_collection(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk", collection="a")
    with pytest.raises(ConflictProblem) as taken:
        lab.add_clip(rig, "walk", collection="a", seed=9)
    assert taken.value.error_code == "name-taken"
    lab.add_clip(rig, "walk", collection="b")
    lab.add_skeleton("walk")
    other = lab.add_clip(rig, "run", collection="a")
    changes: tuple[dict[str, Any], ...] = ({"name": "walk"}, {"name": "walk", "collection": "a"})
    for fields in changes:
        with pytest.raises(ConflictProblem):
            change(lab, other, **fields)
    with pytest.raises(ConflictProblem):
        change(lab, clip, collection="b")


def test_two_creators_of_one_name_make_one_item(lab: Lab, rig: Item) -> None:
    futures = [
        lab.database.submit_write(
            lab.owner, items.create_item, "lab", Kind.CLIP, ItemCreate(name="walk", parts={"motion": motion_tree(rig)})
        )
        for _ in range(6)
    ]
    errors = [future.exception(60) for future in futures]
    assert sum(error is None for error in errors) == 1
    assert {type(error) for error in errors} == {type(None), ConflictProblem}
    assert len(lab.read(items.list_items, "lab", Kind.CLIP).items) == 1


def test_renaming_moving_and_tagging(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk", tags=("a",))
    moved = change(lab, clip, name="run", collection="x/y", tags=("c", "b", "c"))
    assert (moved.name, moved.collection, moved.tags, moved.revision, moved.rev) == ("run", "x/y", ("b", "c"), 1, 2)
    assert change(lab, clip, tags=()).tags == ()
    assert [one.path for one in lab.read(collections.list_collections, "lab").items] == ["x", "x/y"]


def test_a_deleted_item_is_gone_until_it_is_restored(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk", collection="a")
    lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=clip.rev)
    with pytest.raises(NotFoundProblem):
        read(lab, clip)
    with pytest.raises(NotFoundProblem):
        lab.read(items.read_part, "lab", Kind.CLIP, clip.id, "motion")
    assert lab.read(items.list_items, "lab", Kind.CLIP).items == ()
    bin_ = lab.read(items.list_items, "lab", Kind.CLIP, items.ItemFilters(deleted=True)).items
    assert [one.id for one in bin_] == [clip.id]
    back = lab.write(items.restore_item, "lab", Kind.CLIP, clip.id)
    assert (back.id, back.name, back.revision, back.rev) == (clip.id, "walk", 1, 3)


def test_an_item_returns_to_an_earlier_revision_by_a_new_one(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk", info={"subject": "first"})
    second = put_info(lab, clip, clip.rev, subject="second")

    def revert(number: int, rev: int | None = None) -> Item:
        return lab.write(items.revert_item, "lab", Kind.CLIP, clip.id, ItemRevert(revision=number), expected_rev=rev)

    with pytest.raises(PreconditionFailedProblem):
        revert(1, clip.rev)
    with pytest.raises(NotFoundProblem, match="no revision 3"):
        revert(3)
    back = revert(1, second.rev)
    assert (back.revision, back.parts) == (3, clip.parts)
    assert lab.read(items.read_revision, "lab", Kind.CLIP, clip.id, 3).message == "Revert to revision 1"
    assert revert(3).revision == 3
    assert list(check_store(lab.database)) == []


def test_restoring_needs_the_name(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk")
    lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=None)
    lab.add_clip(rig, "walk", seed=5)
    with pytest.raises(ConflictProblem):
        lab.write(items.restore_item, "lab", Kind.CLIP, clip.id)


def test_collections_take_their_contents_along(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk", collection="raw/a")
    gone_before = lab.add_clip(rig, "old", collection="raw/a")
    lab.write(items.delete_item, "lab", Kind.CLIP, gone_before.id, expected_rev=None)
    raw = next(one for one in lab.read(collections.list_collections, "lab").items if one.path == "raw")
    moved = lab.write(
        collections.move_collection, "lab", raw.id, CollectionChange(path="new/raw"), expected_rev=raw.rev
    )
    assert read(lab, clip).collection == "new/raw/a"
    lab.write(collections.delete_collection, "lab", raw.id, expected_rev=moved.rev)
    with pytest.raises(NotFoundProblem):
        read(lab, clip)
    assert [one.path for one in lab.read(collections.list_collections, "lab").items] == ["new"]
    lab.write(collections.restore_collection, "lab", raw.id)
    assert read(lab, clip).collection == "new/raw/a"
    assert [one.name for one in lab.read(items.list_items, "lab", Kind.CLIP).items] == ["walk"]


def test_an_item_whose_collection_is_gone_comes_back_with_it(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, "walk", collection="raw")
    lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=None)
    raw = lab.read(collections.list_collections, "lab").items[0]
    lab.write(collections.delete_collection, "lab", raw.id, expected_rev=None)
    assert lab.write(items.restore_item, "lab", Kind.CLIP, clip.id).collection == "raw"


def test_a_folder_moved_by_two_at_once_without_a_precondition_ends_at_one_place(lab: Lab) -> None:
    folder = lab.write(collections.create_collection, "lab", CollectionCreate(path="a"))
    lab.write(collections.create_collection, "lab", CollectionCreate(path="a/b"))
    futures = [
        lab.database.submit_write(
            lab.owner, collections.move_collection, "lab", folder.id, CollectionChange(path=f"m{n}"), expected_rev=None
        )
        for n in range(6)
    ]
    for future in futures:
        future.result(60)
    last = lab.read(collections.read_collection, "lab", folder.id)
    assert last.rev == 7
    paths = [one.path for one in lab.read(collections.list_collections, "lab").items]
    assert paths == [last.path, f"{last.path}/b"]


def test_a_folder_moves_however_long_the_paths_of_others_are(lab: Lab) -> None:
    folder = lab.write(collections.create_collection, "lab", CollectionCreate(path="a"))
    lab.write(collections.create_collection, "lab", CollectionCreate(path="a/b"))
    deep = "/".join(["d" * 200] * 5)  # twenty characters remain
    other = Lab(lab.database, "other")
    for who in (lab, other):
        who.write(collections.create_collection, who.name, CollectionCreate(path=deep))
    change = CollectionChange(path="m" * 100)
    lab.write(collections.move_collection, "lab", folder.id, change, expected_rev=None)
    paths = [one.path for one in lab.read(collections.list_collections, "lab").items]
    assert {change.path, f"{change.path}/b", deep} < set(paths)


def test_collections_refuse_what_would_tangle_them(lab: Lab) -> None:
    a = lab.write(collections.create_collection, "lab", CollectionCreate(path="a"))
    lab.write(collections.create_collection, "lab", CollectionCreate(path="ab/c"))
    with pytest.raises(ConflictProblem):
        lab.write(collections.create_collection, "lab", CollectionCreate(path="a"))
    with pytest.raises(InvalidProblem):
        lab.write(collections.move_collection, "lab", a.id, CollectionChange(path="a/b"), expected_rev=None)
    with pytest.raises(ConflictProblem):
        lab.write(collections.move_collection, "lab", a.id, CollectionChange(path="ab"), expected_rev=None)
    with pytest.raises(PreconditionFailedProblem):
        lab.write(collections.move_collection, "lab", a.id, CollectionChange(path="z"), expected_rev=7)
    with pytest.raises(InvalidProblem):
        lab.write(collections.create_collection, "lab", CollectionCreate(path="/".join(["歩" * 200] * 5)))
    assert [one.path for one in lab.read(collections.list_collections, "lab").items] == ["a", "ab", "ab/c"]
    assert [one.path for one in lab.read(collections.list_collections, "lab", path="a").items] == ["a"]


# -- what a document may say ------------------------------------------------------------------------------------------


def refused(lab: Lab, kind: Kind, parts: dict[str, Any]) -> InvalidProblem:
    with pytest.raises(InvalidProblem) as error:
        lab.write(items.create_item, "lab", kind, ItemCreate(name="x", parts=parts))
    assert lab.read(items.list_items, "lab", kind, items.ItemFilters(name="x")).items == ()
    return error.value


def test_documents_are_checked_against_their_schema(lab: Lab, rig: Item) -> None:
    assert refused(lab, Kind.SKELETON, {"hierarchy": {"joints": []}}).errors[0].pointer.startswith("/joints")
    assert refused(lab, Kind.SKELETON, {"hierarchy": []})
    assert refused(lab, Kind.SKELETON, {"shape": skeleton_tree()}).error_code == "no-part"
    assert refused(lab, Kind.SKELETON, {"mapping": {"joints": {}}}).error_code == "part-required"
    assert refused(lab, Kind.SKELETON, {"hierarchy": {**skeleton_tree(), "schema": "marey/motion@1"}})
    assert (
        refused(lab, Kind.CHARACTER, {"character": {"schema": "marey/document@1", "text": "nul \x00"}}).error_code
        == "bad-text"
    )
    assert refused(lab, Kind.CHARACTER, {"character": {"schema": "marey/document@1", "text": "\ud800"}})
    assert refused(lab, Kind.CHARACTER, {"character": {"schema": "marey/document@1", "x": float("nan")}})


def test_a_motion_names_a_skeleton_of_the_project_with_its_joints(lab: Lab, rig: Item, database: Database) -> None:
    unknown = motion_tree({"item": "skeleton_x", "revision": 1})
    assert refused(lab, Kind.CLIP, {"motion": unknown}).error_code == "no-skeleton"
    assert refused(lab, Kind.CLIP, {"motion": motion_tree({"item": rig.id, "revision": 2})})
    assert refused(lab, Kind.CLIP, {"motion": motion_tree({"output": "other"})})
    assert refused(lab, Kind.CLIP, {"motion": motion_tree(rig, joints=2)}).error_code == "wrong-joints"
    moved_root = motion_tree(rig) | {"translations": np.zeros((5, 1, 3), "<f4"), "translated_joints": ["j0"]}
    assert refused(lab, Kind.CLIP, {"motion": moved_root}).error_code == "root-translated"
    elsewhere = Lab(database, "elsewhere").add_skeleton()
    assert refused(lab, Kind.CLIP, {"motion": motion_tree(elsewhere)}).error_code == "no-skeleton"


def test_an_annotation_stays_within_its_clip(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig, frames=10)
    ref = {"item": clip.id, "revision": 1}
    fits = {"clip": ref, "segments": [{"label": "a", "start": 0, "end": 10}], "keyframes": [{"label": "k", "frame": 9}]}
    lab.write(items.create_item, "lab", Kind.ANNOTATION, ItemCreate(name="ok", parts={"annotation": fits}))
    for beyond in ({"segments": [{"label": "a", "start": 0, "end": 11}]}, {"keyframes": [{"label": "k", "frame": 10}]}):
        assert refused(lab, Kind.ANNOTATION, {"annotation": {"clip": ref, **beyond}}).error_code == "beyond-end"


def test_nobody_refers_to_stored_arrays_by_their_digest(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig)
    body = lab.read(items.read_part, "lab", Kind.CLIP, clip.id, "motion", arrays="none").tree
    assert set(body["poses"]) == {"dtype", "shape", "content"}
    assert refused(lab, Kind.CLIP, {"motion": body}).errors[0].code == "array-reference"
    study = {"schema": "marey/document@1", "stolen": [body["poses"]]}
    assert refused(lab, Kind.CHARACTER, {"character": study}).errors[0].pointer == "/stolen/0"


def test_documents_of_other_kinds_hold_anything(lab: Lab) -> None:
    study: dict[str, Any] = {"schema": "marey/document@1", "n": [1, 2.5, None, True, "é"], "big": 2**62}
    study["a/b~c"] = {"x": np.arange(4, dtype="<i8")}
    made = lab.write(items.create_item, "lab", Kind.CHARACTER, ItemCreate(name="s", parts={"character": study}))
    back = lab.read(items.read_part, "lab", Kind.CHARACTER, made.id, "character", arrays="decoded").tree
    np.testing.assert_array_equal(back.pop("a/b~c")["x"], np.arange(4))
    study.pop("a/b~c")
    assert back == study


# -- who may ----------------------------------------------------------------------------------------------------------


def test_readers_read_contributors_change_maintainers_delete(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig)
    request = ItemChange(name="n")
    for who, can_read, can_change, can_delete in (
        (lab.anonymous, NotFoundProblem, NotFoundProblem, NotFoundProblem),
        (lab.stranger, NotFoundProblem, NotFoundProblem, NotFoundProblem),
        (lab.reader, None, ForbiddenProblem, ForbiddenProblem),
        (lab.contributor, None, None, ForbiddenProblem),
        (lab.maintainer, None, None, None),
    ):
        read_as, write_as = partial(lab.read, who=who), partial(lab.write, who=who)
        delete_as = partial(lab.write, who=who, required=declared("DELETE", "/projects/{project}/{kind}/{item}"))
        for refusal, run, function, *more in (
            (can_read, read_as, items.read_item),
            (can_read, read_as, items.read_part, "motion"),
            (can_read, read_as, items.read_lineage),
            (can_change, write_as, items.change_item, request),
            (can_change, write_as, items.put_part, "info", {}),
            (can_delete, delete_as, items.delete_item),
        ):
            expected: dict[str, Any] = {} if run is read_as else {"expected_rev": None}
            with pytest.raises(refusal) if refusal else nullcontext():
                run(function, "lab", Kind.CLIP, clip.id, *more, **expected)
    restoring = declared("POST", "/projects/{project}/{kind}/{item}/restore")
    with pytest.raises(ForbiddenProblem):
        lab.write(items.restore_item, "lab", Kind.CLIP, clip.id, who=lab.contributor, required=restoring)


def test_guests_of_a_public_project_read_and_change_nothing(lab: Lab, rig: Item) -> None:
    clip = lab.add_clip(rig)
    lab.make_public()
    assert read(lab, clip, who=lab.anonymous).id == clip.id
    with pytest.raises(UnauthenticatedProblem):
        lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=None, who=lab.anonymous)
    with pytest.raises(ForbiddenProblem):
        lab.write(items.put_part, "lab", Kind.CLIP, clip.id, "info", {}, expected_rev=None, who=lab.stranger)


def test_an_item_is_found_only_under_its_own_kind_and_project(lab: Lab, rig: Item, database: Database) -> None:
    elsewhere = Lab(database, "elsewhere")
    with pytest.raises(NotFoundProblem):
        lab.read(items.read_item, "lab", Kind.CLIP, rig.id)
    with pytest.raises(NotFoundProblem):
        elsewhere.read(items.read_item, "elsewhere", Kind.SKELETON, rig.id)
    with pytest.raises(NotFoundProblem):
        elsewhere.write(items.delete_item, "elsewhere", Kind.SKELETON, rig.id, expected_rev=None)
    assert lab.read(projects.read_project, "lab").name == "lab"
