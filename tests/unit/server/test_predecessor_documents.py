"""Documents of the predecessor that were imported, changed and written, then read by an independent reader."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, get_args

import numpy as np
import pytest
from scipy.interpolate import BSpline
from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models

from marey_motion.clip import Clip
from marey_motion.documents import skeleton_from_document
from marey_motion.formats.predecessor import write_predecessor as write_clip
from marey_motion.importing.files import import_file
from marey_motion.importing.items import FileToImport, ImportedItem
from marey_motion.importing.plan import plan_imports
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.predecessor_exports import (
    LAYOUTS_OF,
    PARTS_OF,
    ExportLayout,
    ExportPart,
    PredecessorOptions,
    unchanged_original,
    write_predecessor,
)

DIGEST = f"sha256:{'1' * 64}"
BESIDE = f"sha256:{'2' * 64}"
FRAMES = np.arange(models.FRAMES)
TIMED = [name for name in old.primitives() if not name.startswith(("stand", "old"))]
"""Models that the independent reader reads: it does not know layout 1."""


@pytest.fixture(scope="module")
def imported() -> Mapping[str, ImportedItem]:
    """Items imported from the folder with one document of each kind, by kind and name."""
    return {f"{item.kind.value} {item.item_name}": item for item in _items()}


def _items() -> Iterator[ImportedItem]:
    files = old.folder()
    for planned in plan_imports(list(files)):
        if planned.role in ("motion", "skeleton"):
            companion, notes = (files.get(str(name)) for name in (planned.companion, planned.notes))
            found = import_file(
                FileToImport(
                    planned, files[planned.name], DIGEST,
                    companion=companion, companion_digest=BESIDE, notes=notes, notes_digest=BESIDE,
                )
            )  # fmt: skip
            assert found.refusal is None, found.refusal
            yield from (item for item in found.items if item.kind is not Kind.SKELETON or "mapping" in item.parts)


def written(
    imported: Mapping[str, ImportedItem], key: str, options: PredecessorOptions, **parts: Any
) -> tuple[str, dict[str, Any]]:
    """Write an item with some parts replaced; return the name of the file and its document."""
    item = imported[key]
    hierarchy = imported["skeleton hik (171 cm)"].parts["hierarchy"]
    given = {**item.parts, **parts}
    if item.kind is Kind.MODEL:
        given["model"] = {**given["model"], "skeleton": {"item": "s", "revision": 1}}
    name, data = write_predecessor(item.kind, item.item_name, given, hierarchy, options)
    return name, old.decode(data)


def test_every_item_knows_its_file_until_its_content_changes(imported: Mapping[str, ImportedItem]) -> None:
    changes: dict[str, tuple[str, dict[str, Any]]] = {
        "clip walk": ("motion", {"frame_rate_hz": 60.0}),
        "processed walk_aligned": ("motion", {"frame_rate_hz": 60.0}),
        "annotation walk imported": ("annotation", {"segments": []}),
        "model begin": ("model", {"keyframes": {}}),
        "skeleton hik (171 cm)": ("hierarchy", {"end_sites": []}),
    }
    for key, (part, change) in changes.items():
        item = imported[key]
        known = unchanged_original(item.kind, item.parts, PredecessorOptions())
        assert known is not None
        assert known.blob == (BESIDE if item.kind is Kind.ANNOTATION else DIGEST)
        changed = {**item.parts, part: {**item.parts[part], **change}}
        assert unchanged_original(item.kind, changed, PredecessorOptions()) is None
    for key, part, name in (
        ("skeleton hik (171 cm)", "skeleton_model", "body_skeleton_model.json"),
        ("processed walk_aligned", "alignment", "walk_aligned_alignment.json"),
    ):
        beside = unchanged_original(imported[key].kind, imported[key].parts, PredecessorOptions(part=part))
        assert beside is not None
        assert (beside.name, beside.blob) == (name, BESIDE)
    annotation = imported["annotation walk imported"]
    assert unchanged_original(annotation.kind, annotation.parts, PredecessorOptions(form="list")) is None


@pytest.mark.parametrize("layout", [None, "2", "3"])
@pytest.mark.parametrize("name", TIMED)
def test_changed_models_have_the_poses_and_the_time_that_they_had(
    imported: Mapping[str, ImportedItem], name: str, layout: ExportLayout | None
) -> None:
    key, document = f"model {name.split('_')[0]}", old.primitives()[name]
    changed = {**imported[key].parts["model"], "keyframes": {"contact0": 3}}
    _, again = written(imported, key, PredecessorOptions(layout=layout), model=changed)
    scores = np.random.default_rng(4).normal(size=models.SPATIAL)
    np.testing.assert_allclose(old.model_poses(again, scores), old.model_poses(document, scores), atol=1e-9)
    times = np.random.default_rng(5).normal(size=(20, models.TEMPORAL))
    error = max(np.abs(old.model_times(again, one) - old.model_times(document, one)).max() for one in times)
    assert error < (0.02 if layout == "3" and name.startswith("left") else 1e-9)  # frames; `left` steps by increments
    assert again["keyframes"] == {"contact0": 3}


@pytest.mark.parametrize("layout", ["2", "3"])
def test_a_motion_without_components_is_written_with_a_mixture(
    imported: Mapping[str, ImportedItem], layout: ExportLayout
) -> None:
    still = old.primitives()["stand_mm.json"]
    _, again = written(imported, "model stand", PredecessorOptions(layout=layout))
    means, covariances = (again["gmm"][one] if layout == "3" else again[f"gmm_{one}"] for one in ("means", "covars"))
    assert (np.shape(means), np.shape(covariances)) == ((1, 1), (1, 1, 1))
    expected = BSpline(np.array(still["knots"]), np.array(still["spatial_coeffs"]), 3)(FRAMES)
    np.testing.assert_allclose(old.model_poses(again, np.ones(1)), expected, atol=1e-9)
    np.testing.assert_allclose(old.model_times(again, np.zeros(0)), FRAMES, atol=1e-6)


def test_requests_can_name_each_part_and_each_layout_that_can_be_written() -> None:
    assert set(get_args(ExportPart)) == {part for parts in PARTS_OF.values() for part in parts}
    assert set(get_args(ExportLayout)) == {layout for layouts in LAYOUTS_OF.values() for layout in layouts}


@pytest.mark.parametrize("layout", ["database", "file"])
def test_skeletons_are_written_with_the_joints_that_they_had(
    imported: Mapping[str, ImportedItem], layout: ExportLayout
) -> None:
    name, document = written(imported, "skeleton hik (171 cm)", PredecessorOptions(layout=layout))
    assert name == ("hik (171 cm).skeleton" if layout == "file" else "hik (171 cm)_skeleton.json")
    found = {node.name: node for node in old.rig_of(document)}
    for joint in old.joints_of(old.RIG):
        expected = next(node for node in old.RIG if node.name == joint)
        assert found[joint].parent == expected.parent
        np.testing.assert_allclose(found[joint].offset, expected.offset, atol=1e-9)
        np.testing.assert_allclose(found[joint].rotation, expected.rotation, atol=1e-9)
    tips = [node for node in found.values() if node.name not in old.joints_of(old.RIG)]
    expected_tips = [node.offset for node in old.RIG if node.name not in old.joints_of(old.RIG)]
    np.testing.assert_allclose(sorted(tip.offset for tip in tips), sorted(expected_tips), atol=1e-9)


def test_a_mapping_that_was_edited_is_written_with_the_rest_of_the_skeleton_model(
    imported: Mapping[str, ImportedItem],
) -> None:
    mapping = imported["skeleton hik (171 cm)"].parts["mapping"]
    changed = {**mapping, "joints": {**mapping["joints"], "left_toe": "LeftFoot"}}
    only_model = PredecessorOptions(part="skeleton_model")
    name, document = written(imported, "skeleton hik (171 cm)", only_model, mapping=changed)
    assert (name, document["name"]) == ("hik (171 cm)_skeleton_model.json", "hik (171 cm)")
    model, before = document["model"], old.skeleton_model()
    assert model["joints"]["left_toe"] == "LeftFoot"
    for member in before.keys() - {"joints", "cos_map"}:
        assert model[member] == before[member]
    alone = {"hierarchy": imported["skeleton hik (171 cm)"].parts["hierarchy"]}
    with pytest.raises(NotFoundProblem, match="no joint mapping"):
        write_predecessor(Kind.SKELETON, "hik", alone, None, only_model)


def test_annotations_and_clips_that_were_changed_are_read_again(imported: Mapping[str, ImportedItem]) -> None:
    part = imported["annotation walk imported"].parts["annotation"]
    shorter = {**part, "clip": {"item": "c", "revision": 1}, "segments": part["segments"][:1]}
    _, document = written(imported, "annotation walk imported", PredecessorOptions(), annotation=shorter)
    assert document == {"sections": {"section 1": [{"start_idx": 0, "end_idx": 19}]}}

    skeleton = skeleton_from_document(
        SkeletonHierarchy.model_validate(imported["skeleton hik (171 cm)"].parts["hierarchy"])
    )
    poses = imported["clip run"].parts["motion"]["poses"][5:35]
    names, expected = old.read_clip(old.clips()["run.json"])
    for form in ("poses", "frames"):
        again = old.decode(write_clip(Clip(skeleton, 30.0, poses), form=form))
        assert old.read_clip(again)[0] == names
        np.testing.assert_allclose(old.read_clip(again)[1], expected[5:35], atol=2e-5)


@pytest.mark.parametrize(
    ("kind", "options", "told"),
    [
        (Kind.CLIP, PredecessorOptions(layout="3"), "kind clip has no layout '3'; it has none; leave it out"),
        (Kind.MODEL, PredecessorOptions(layout="file"), "kind model has no layout 'file'; it has 2 or 3"),
        (Kind.SKELETON, PredecessorOptions(part="tree"), "it has skeleton or skeleton_model"),
    ],
)
def test_what_an_item_does_not_have_is_refused_with_what_it_has(
    kind: Kind, options: PredecessorOptions, told: str
) -> None:
    with pytest.raises(InvalidProblem, match=told):
        options.require_fit(kind)
