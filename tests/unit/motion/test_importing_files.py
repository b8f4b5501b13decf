"""Import of one file, which computes nothing twice."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models
from tests.support.motion_files import ARM, POSITIONS, ZXY, bvh

from marey_motion import formats
from marey_motion.documents import clip_from_document, clip_to_document, clip_to_tree, skeleton_to_document
from marey_motion.exporting import write_clip_file
from marey_motion.formats import predecessor, read_motion, write_bvh, write_predecessor_skeleton
from marey_motion.formats.predecessor import clips
from marey_motion.gait import generate_gait
from marey_motion.importing import anatomy, source
from marey_motion.importing.files import import_file, mapping_part
from marey_motion.importing.items import FileToImport, GivenSkeleton, ImportedFile
from marey_motion.importing.plan import PlannedFile, plan_imports
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import OutputRef
from marey_schemas.documents.skeletons import MAX_JOINTS
from marey_schemas.lru import LruCache
from marey_schemas.options.imports import ImportOptions

DIGEST = f"sha256:{'1' * 64}"
Count = Callable[[Any, str], Counter[str]]


@pytest.fixture
def count(monkeypatch: pytest.MonkeyPatch) -> Count:
    """Function that counts the calls of a function of a module, by name."""
    calls: Counter[str] = Counter()

    def watch(module: ModuleType, name: str) -> Counter[str]:
        real = getattr(module, name)

        def counting(*args: Any, **kwargs: Any) -> Any:
            calls[name] += 1
            return real(*args, **kwargs)

        monkeypatch.setattr(module, name, counting)
        return calls

    return watch


def read(name: str, data: bytes, **given: Any) -> ImportedFile:
    (planned,) = plan_imports([name])
    found = import_file(FileToImport(planned, data, DIGEST, **given))
    assert found.refusal is None, found.refusal
    return found


def test_a_compressed_clip_of_the_predecessor_is_detected_and_decoded_once(count: Count) -> None:
    clip = generate_gait(1.2, 0.0, 1.0, 30.0)
    written = write_clip_file(clip, "predecessor")
    count(formats, "detect_format")
    count(predecessor, "decode_content")
    calls = count(clips, "decode_document")  # the skeleton document is the second file
    planned = PlannedFile("take.bson.bz2", "motion", "", "take", companion="take.skeleton")
    companion = write_predecessor_skeleton(clip.skeleton)
    found = import_file(FileToImport(planned, written.data, DIGEST, companion=companion, companion_digest=DIGEST))
    assert found.frames == clip.frame_count
    assert calls == {"detect_format": 1, "decode_content": 1, "decode_document": 1}


def test_a_model_of_the_predecessor_is_decoded_once(count: Count) -> None:
    calls = count(predecessor, "decode_content")
    read("walk_mm.json", json.dumps(models.layout_3()).encode())
    assert calls == {"decode_content": 1}


def test_the_anatomy_of_equal_skeletons_is_found_once(count: Count, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(anatomy, "_KNOWN", LruCache(max_entries=8))
    takes = [generate_gait(speed, 0.0, 1.0, 30.0) for speed in (1.0, 1.4)]
    count(anatomy, "map_joints")
    calls = count(anatomy, "find_landmarks")
    first, second = (read(f"take{number}.bvh", write_bvh(take)) for number, take in enumerate(takes))
    assert first.items[0].parts["hierarchy"] == second.items[0].parts["hierarchy"]
    # Of the skeleton in the file's centimetres, and in metres.
    assert calls["find_landmarks"] == 1
    assert calls["map_joints"] <= 2


def test_a_skeleton_is_made_for_the_first_of_equal_files_only(count: Count, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(anatomy, "_KNOWN", LruCache(max_entries=8))
    calls = count(source, "Skeleton")
    for speed in (1.0, 1.4):
        read("take.bvh", write_bvh(generate_gait(speed, 0.0, 1.0, 30.0)))
    assert calls == {"Skeleton": 1}


def test_what_is_kept_of_one_file_changes_nothing_about_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """The cache by skeleton changes no result: documents equal those from a process with an empty cache."""
    takes = [write_bvh(generate_gait(speed, 0.0, 1.0, 30.0)) for speed in (1.0, 1.4)]

    def documents_of(data: bytes) -> Any:
        found = read("take.bvh", data)
        hierarchy = found.items[0].parts["hierarchy"]
        return mapping_part(hierarchy), hierarchy, found.checks

    monkeypatch.setattr(anatomy, "_KNOWN", LruCache(max_entries=8))
    alone = documents_of(takes[1])
    monkeypatch.setattr(anatomy, "_KNOWN", LruCache(max_entries=8))
    documents_of(takes[0])
    assert documents_of(takes[1]) == alone


def test_skeletons_are_converted_once_for_equal_joints_tips_units_and_axes() -> None:
    bent = ARM.replace("OFFSET 0 10 0", "OFFSET 3 10 0")

    def skeleton_of(hierarchy: str = bent, **options: Any) -> Skeleton:
        given = ImportOptions(**dict[str, Any](unit="cm", up_axis="y") | options)
        return read_motion(bvh(hierarchy=hierarchy), "arm.bvh", options=given).skeleton

    first = skeleton_of()
    assert skeleton_of() is first
    assert first.offsets[1].tolist() == pytest.approx([0.03, 0.1, 0.0])
    assert skeleton_of(handedness="left").offsets[1].tolist() == pytest.approx([-0.03, 0.1, 0.0])
    assert skeleton_of(up_axis="z").offsets[1].tolist() == pytest.approx([0.03, 0.0, -0.1])
    assert skeleton_of(unit="m").offsets[1].tolist() == pytest.approx([3.0, 10.0, 0.0])
    longer = skeleton_of(bent.replace("OFFSET 0 5 0", "OFFSET 0 7 0"))
    assert [one.end_sites[0].offset[1] for one in (first, longer)] == pytest.approx([0.05, 0.07])


def test_a_clip_becomes_the_same_document_without_the_schemas_objects() -> None:
    clip = generate_gait(1.2, 0.0, 1.0, 30.0)
    reference = OutputRef(output="rig")
    tree = clip_to_tree(clip, reference.model_dump())
    wanted = clip_to_document(clip, reference).model_dump(by_alias=True, exclude_none=True)
    np.testing.assert_array_equal(tree.pop("poses"), wanted.pop("poses"))
    assert tree == wanted


def test_a_file_that_cannot_be_read_is_a_refusal_with_its_line() -> None:
    (planned,) = plan_imports(["take.bvh"])
    found = import_file(FileToImport(planned, bvh(["0 0 x 0 0 0 0 0 0"], hierarchy=ARM), DIGEST))
    assert found.refusal is not None
    assert (found.refusal.code, found.refusal.line, found.items) == ("bad-number", 19, ())


def test_a_file_with_a_value_that_no_document_may_contain_is_a_refusal() -> None:
    (planned,) = plan_imports(["take.bvh"])
    end_sites = "End Site\n{\nOFFSET 0 0 0\n}\n" * (4 * MAX_JOINTS + 1)
    hierarchy = f"HIERARCHY\nROOT a\n{{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n{end_sites}}}\n"
    data = f"{hierarchy}MOTION\nFrames: 1\nFrame Time: 0.01\n0 1 0\n".encode()
    options = ImportOptions(unit_scale_m=1.0, up_axis="y")
    found = import_file(FileToImport(planned, data, DIGEST, options=options))
    assert found.refusal is not None
    assert (found.refusal.code, found.items) == ("value-range", ())


def test_a_collection_that_is_too_long_is_a_refusal() -> None:
    (planned,) = plan_imports([f"{'a' * 250}/take.bvh"])
    options = ImportOptions(collection="/".join(["b" * 200] * 5))
    found = import_file(FileToImport(planned, bvh(), DIGEST, options=options))
    assert found.refusal is not None
    assert found.refusal.code == "name-invalid"


def test_joints_keep_their_rotation_orders_on_a_skeleton_with_another_order_of_joints() -> None:
    def joint(name: str, x: int, order: str) -> str:
        channels = " ".join(f"{axis}rotation" for axis in order)
        return f"JOINT {name}\n{{\nOFFSET {x} 10 0\nCHANNELS 3 {channels}\nEnd Site\n{{\nOFFSET 0 5 0\n}}\n}}\n"

    root = f"HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\nCHANNELS 6 {POSITIONS} {ZXY}\n"
    left, right = joint("Left", 3, "YZX"), joint("Right", -3, "XYZ")
    options = ImportOptions(unit_scale_m=0.01, up_axis="y")
    chosen = read_motion(bvh([], hierarchy=root + right + left + "}\n"), "body.bvh", options=options).skeleton
    given = GivenSkeleton("skeleton", 1, skeleton_to_document(chosen).model_dump(by_alias=True, exclude_none=True))
    rows = ["0 90 0 10 20 30 11 21 31 12 22 32"]
    found = read("take.bvh", bvh(rows, hierarchy=root + left + right + "}\n"), skeleton=given, options=options)
    parts = found.items[0].parts
    assert parts["info"]["source"]["details"]["channels"][1:] == [
        ["Xrotation", "Yrotation", "Zrotation"],
        ["Yrotation", "Zrotation", "Xrotation"],
    ]
    clip = clip_from_document(MotionDocument.model_validate(parts["motion"]), chosen)
    written = write_clip_file(clip, "bvh", info=parts["info"]).data.decode().splitlines()[-1]
    assert [round(float(word)) for word in written.split()] == [0, 90, 0, 10, 20, 30, 12, 22, 32, 11, 21, 31]


def import_all(files: dict[str, bytes]) -> dict[str, ImportedFile]:
    """Import files as a server does, each with the companion that the plan names."""
    return {
        one.name: import_file(
            FileToImport(
                one,
                files[one.name],
                DIGEST,
                companion=None if one.companion is None else files[one.companion],
                companion_digest=None if one.companion is None else DIGEST,
            )
        )
        for one in plan_imports(list(files))
        if one.role in ("motion", "skeleton")
    }


def test_a_clip_of_the_predecessor_is_imported_with_the_skeleton_of_its_folder() -> None:
    clip = generate_gait(1.2, 0.0, 1.0, 30.0)
    files = {
        "old/skeleton.json": write_predecessor_skeleton(clip.skeleton),
        "old/walk.bson.bz2": write_clip_file(clip, "predecessor").data,
    }
    found = import_all(files)
    assert {name: one.refusal for name, one in found.items()} == dict.fromkeys(files)
    skeleton, walk = found["old/walk.bson.bz2"].items
    assert (walk.item_name, walk.collection, found["old/walk.bson.bz2"].frames) == ("walk", "old", 30)
    assert walk.parts["info"]["source"]["companion_name"] == "skeleton.json"
    (beside,) = found["old/skeleton.json"].items
    assert beside.parts["hierarchy"] == skeleton.parts["hierarchy"]


def test_a_model_beside_a_skeleton_is_imported_without_a_tree() -> None:
    skeleton = write_predecessor_skeleton(generate_gait(1.2, 0.0, 1.0, 30.0).skeleton)
    found = import_all({"skeleton.json": skeleton, "walk.json": json.dumps(models.layout_3()).encode()})
    assert found["walk.json"].refusal is None
    assert "tree" not in found["walk.json"].items[-1].parts


def test_a_chosen_skeleton_may_differ_in_what_the_motion_replaces() -> None:
    """The root's offset differs from take to take; a bone of another length is another skeleton."""
    clip = generate_gait(1.2, 0.0, 1.0, 30.0)

    def chosen(joint: int) -> GivenSkeleton:
        offsets = clip.skeleton.offsets.copy()
        offsets[joint] += 0.25
        other = replace(clip.skeleton, offsets=offsets)
        return GivenSkeleton("s1", 1, skeleton_to_document(other).model_dump(by_alias=True))

    (planned,) = plan_imports(["walk.bvh"])
    found = import_file(FileToImport(planned, write_bvh(clip), DIGEST, skeleton=chosen(0)))
    assert found.refusal is None
    assert found.items[0].parts["motion"]["skeleton"] == {"item": "s1", "revision": 1}
    refused = import_file(FileToImport(planned, write_bvh(clip), DIGEST, skeleton=chosen(3))).refusal
    assert refused is not None
    assert refused.code == "skeleton-mismatch"
    assert "offsets by up to 0.2500 m" in refused.detail


def test_a_chosen_skeleton_with_another_hierarchy_is_refused_with_the_joint() -> None:
    clip = generate_gait(1.2, 0.0, 1.0, 30.0)
    document = skeleton_to_document(clip.skeleton).model_dump(by_alias=True)
    names = clip.skeleton.joint_names
    head = next(joint for joint in document["joints"] if joint["name"] == "Head")
    head["parent"] = names.index("Spine2") if isinstance(head["parent"], int) else "Spine2"
    (planned,) = plan_imports(["walk.bvh"])
    given = GivenSkeleton("s1", 1, document)
    refused = import_file(FileToImport(planned, write_bvh(clip), DIGEST, skeleton=given)).refusal
    assert refused is not None
    assert (refused.code, refused.joint) == ("skeleton-mismatch", "Head")
    assert "the joint Head is below Neck, but in the chosen skeleton, it is below Spine2" in refused.detail


def test_a_skeleton_with_a_tail_is_called_an_animal() -> None:
    clip = generate_gait(1.2, 0.0, 1.0, 30.0)
    assert read("walk.bvh", write_bvh(clip)).items[0].item_name == "hik (176 cm)"
    tailed = write_bvh(clip).replace(b"LeftShoulder", b"Tail01")
    options = ImportOptions(unit="cm", up_axis="y")
    assert read("dog.bvh", tailed, options=options).items[0].item_name == "animal"


def test_refusals_can_be_stored_and_are_short() -> None:
    lost = json.dumps({"nodes": {"walk": {"1": {"name": "begin", "type": "start", "transitions": {}}}},
                       "start_node": ["walk", "x" * 100_000]})  # fmt: skip
    model = json.dumps(models.layout_3(11, old.joints_of(old.RIG)) | {"skeleton": old.file_skeleton(old.RIG)})
    for document in (lost, model.replace('"LeftFoot"', '"\\ud800"', 1)):
        refused = import_file(FileToImport(plan_imports(["one.json"])[0], document.encode(), DIGEST)).refusal
        assert refused is not None
        assert len(refused.model_dump_json()) < 5000


def test_graphs_with_names_that_cannot_be_stored_are_refused() -> None:
    graph = {"nodes": {"walk": {"1": {"name": "\ud800", "type": "start", "transitions": {}}}},
             "start_node": ["walk", "1"]}  # fmt: skip
    refused = import_file(FileToImport(plan_imports(["one.json"])[0], json.dumps(graph).encode(), DIGEST)).refusal
    assert refused is not None
    assert refused.code == "value-range"
