"""Files of an import are stored together; a file that cannot be stored does not affect the others."""

from dataclasses import replace
from typing import Any

import pytest
from tests.support.store_fixtures import Lab, motion_tree, skeleton_tree

from marey_schemas.imports import Refusal, refused_entry
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_server.errors import UnavailableProblem
from marey_server.motions import importing
from marey_server.motions.importing import PreparedImport
from marey_server.store import blobs, items
from marey_server.store.items import Draft


def read_file(name: str, *, joints: int = 3, seed: int = 0) -> Any:
    """Return the result of reading a file: a skeleton of three joints, and a clip that fits it if `joints` is 3."""
    rig = f"{name}#skeleton"
    motion = motion_tree({"output": rig}, joints=joints, seed=seed)
    drafts = (
        Draft(rig, Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}, "skeletons", reuse="by_content"),
        Draft(name, Kind.CLIP, name.partition(".")[0], {"motion": motion}, "takes"),
    )
    return PreparedImport(name, drafts=drafts, frames=5)


def store(lab: Lab, *files: Any) -> Any:
    return lab.write(importing.publish, "lab", files)


def test_files_become_items_in_their_order_with_one_skeleton(lab: Lab) -> None:
    entries = store(lab, *(read_file(f"walk{number}.bvh", seed=number) for number in range(6)))
    assert [entry.name for entry in entries] == [f"walk{number}.bvh" for number in range(6)]
    assert {entry.status for entry in entries} == {"created"}
    assert len({entry.skeleton for entry in entries}) == 1
    clips = lab.read(items.list_items, "lab", Kind.CLIP, sort="id").items
    assert [clip.id for clip in clips] == [entry.item for entry in entries]


def test_a_file_that_cannot_be_stored_harms_no_other(lab: Lab) -> None:
    refused = PreparedImport("c.bvh", entry=refused_entry("c.bvh", Refusal(code="empty", detail="no frames")))
    entries = store(lab, read_file("a.bvh"), read_file("b.bvh", joints=2), refused, read_file("d.bvh", seed=1))
    assert [(entry.name, entry.status) for entry in entries] == [
        ("a.bvh", "created"), ("b.bvh", "failed"), ("c.bvh", "failed"), ("d.bvh", "created"),
    ]  # fmt: skip
    assert [entry.error.code for entry in entries[1:3]] == ["wrong-joints", "empty"]
    assert [clip.name for clip in lab.read(items.list_items, "lab", Kind.CLIP, sort="name").items] == ["a", "d"]


def test_an_import_without_a_main_item_is_an_error_that_ends_the_request(lab: Lab) -> None:
    edit = Draft("clean-up", Kind.EDIT, "clean-up", {"edit": {"commands": [{"command": "trim", "start": 1}]}}, "takes")
    with pytest.raises(RuntimeError, match=r"none of clip, .* was created from .walk\.bvh."):
        store(lab, PreparedImport("walk.bvh", drafts=(edit,)))


def test_a_clip_gets_another_skeleton_only_on_request(lab: Lab) -> None:
    notes = {"schema": "marey/annotation@1", "clip": {"output": "walk.bvh"}, "layer": "notes"}

    def long_legs(*, asked: bool) -> Any:
        file = read_file("walk.bvh", seed=1)
        rig, clip = file.drafts
        return replace(
            file,
            drafts=(
                replace(rig, parts={"hierarchy": skeleton_tree(bone_m=9.0)}),
                replace(clip, same_skeleton=not asked),
                Draft("walk.bvh#notes", Kind.ANNOTATION, "notes", {"annotation": notes}, "takes"),
            ),
        )

    def skeletons() -> int:
        return len(lab.read(items.list_items, "lab", Kind.SKELETON).items)

    (first,) = store(lab, read_file("walk.bvh"))
    refused, other = store(lab, long_legs(asked=False), read_file("other.bvh"))
    assert (refused.status, refused.error.code, refused.item) == ("failed", "skeleton-differs", None)
    assert "--replace" in refused.error.detail
    assert (other.status, skeletons()) == ("created", 1)
    assert not lab.read(items.list_items, "lab", Kind.ANNOTATION).items
    (changed,) = store(lab, long_legs(asked=True))
    assert (changed.item, changed.revision, changed.skeleton_changed) == (first.item, 2, True)
    (back,) = store(lab, long_legs(asked=False))
    assert (back.status, back.revision, back.skeleton_changed, skeletons()) == ("unchanged", 2, False, 2)


def test_a_new_take_of_a_rig_keeps_the_skeleton_of_its_clip(lab: Lab) -> None:
    def rig(root_m: float) -> dict[str, Any]:
        tree = skeleton_tree()
        tree["joints"][0]["offset"] = [root_m, 0.0, 0.0]
        return tree

    for name, root_m in (("a", 0.0), ("b", 1.0)):
        request = ItemCreate(name=name, collection="skeletons", parts={"hierarchy": rig(root_m)})
        own = lab.write(items.create_item, "lab", Kind.SKELETON, request)
    lab.add_clip(own, "walk", collection="takes")

    def take(root_m: float, seed: int) -> Any:
        file = read_file("walk.bvh", seed=seed)
        skeleton, clip = file.drafts
        parts = {"hierarchy": rig(root_m)}
        return replace(file, drafts=(replace(skeleton, parts=parts), replace(clip, same_skeleton=True)))

    for revision, root_m in ((2, 7.0), (3, 0.0)):
        (entry,) = store(lab, take(root_m, revision))
        assert (entry.status, entry.revision, entry.error) == ("created", revision, None)
        assert (entry.skeleton, entry.skeleton_changed) == (own.id, False)
    clip = lab.read(items.read_item, "lab", Kind.CLIP, entry.item)
    assert clip.summary["skeleton"] == own.id
    assert len(lab.read(items.list_items, "lab", Kind.SKELETON).items) == 2


def test_the_same_take_twice_in_one_request_is_one_revision(lab: Lab) -> None:
    first, again = store(lab, read_file("walk.bvh"), read_file("walk.npz"))
    assert (first.status, again.status) == ("created", "unchanged")
    assert (first.item, first.revision) == (again.item, again.revision)


def test_a_failure_of_the_database_is_none_of_a_file(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_args: Any, **_kwargs: Any) -> None:
        raise UnavailableProblem("The database does not answer.")

    monkeypatch.setattr(blobs, "store_blobs", fail)
    with pytest.raises(UnavailableProblem):
        store(lab, read_file("a.bvh"), read_file("b.bvh", seed=1))
    assert lab.read(items.list_items, "lab", Kind.CLIP).items == ()
