"""A clip is retargeted in the same way, whichever take of its skeleton was imported first."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.folded_rig import folded
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.documents import mapping_to_document, skeleton_to_document
from marey_motion.formats import read_motion
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.importing.files import mapping_part
from marey_motion.rigs import guess_axes, map_joints
from marey_schemas.documents.references import RevisionRef
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.queue.job_params import RetargetParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.job_io import skeleton_cache
from marey_worker.kinds import retarget

TAKES = {
    "bandai-namco": (
        "bandai-namco-2/dataset-2_walk-turn-left_normal_003.bvh",
        "bandai-namco-2/dataset-2_raise-up-right-hand_masculine_001.bvh",
    ),
    "reallusion": ("cmu-iclone-bvh/006_04.bvh", "cmu-iclone-bvh/007_02.bvh"),
    "mh-cmu": ("rigs/game-engine/vis_example.bvh", "rigs/game-engine/mh_cmu_skeleton_pose.bvh"),
}


def retargeted(
    folder: Path, clip: Clip, mapping: Any, *, onto: bool = False, after: Clip | None = None
) -> tuple[np.ndarray[Any, Any], list[str]]:
    """Retarget a clip whose skeleton has this `mapping`, and return the poses and the codes of the checks.

    With `onto`, another walk is retargeted to the skeleton of the clip instead. `after` is another clip of the same
    skeleton that the same job retargets before.
    """
    project = ProjectInMemory(folder)
    walk = generate_gait(1.4, 0.0, 1.0, 30.0)
    other = game_skeleton() if not onto else walk.skeleton
    moving, target = (walk, clip.skeleton) if onto else (clip, other)
    for name, one in (("before", after), ("take", moving)):
        if one is not None:
            add_clip(project, name, one)
    project.parts["skeleton_b", 1, "hierarchy"] = skeleton_to_document(target).model_dump(by_alias=True)
    project.parts["skeleton_b" if onto else "skeleton_a", 1, "mapping"] = mapping
    skeleton = {"item": "skeleton_b", "revision": 1, "kind": Kind.SKELETON, "name": "b", "collection": "rigs"}
    project.inputs["skeleton"] = (PinnedInput(**skeleton),)
    project.into = "out"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(skeleton_cache, "_skeletons", LruCache(max_entries=4))
        patched.setattr(skeleton_cache, "_plans", LruCache(max_entries=4))
        retarget.run(project, RetargetParams())
    *_, made = project.staged
    return np.asarray(made.parts["motion"]["poses"]), [check["code"] for check in made.parts["info"].get("checks", [])]


def documents_of(takes: Sequence[Clip]) -> list[Any]:
    """Return the documents `mapping` of a skeleton: as imports make it, and as they used to, from each of the takes."""
    skeleton = takes[0].skeleton
    mapping = map_joints(skeleton)
    old = [mapping_to_document(mapping, guess_axes_from_motion(skeleton, take)) for take in takes]
    made = mapping_part(skeleton_to_document(skeleton).model_dump(by_alias=True))
    return [made, *(one.model_dump(by_alias=True, exclude_none=True) for one in old)]


def guess_axes_from_motion(skeleton: Any, take: Clip) -> Any:
    """Read the axes of a skeleton from a motion, as imports did before the names of a rig told them."""
    mapping = replace(map_joints(skeleton), rig=None)
    return guess_axes(skeleton, mapping, replace(take, skeleton=skeleton))


@pytest.mark.parametrize("rig", TAKES)
def test_the_first_take_does_not_decide_how_clips_of_a_known_rig_are_turned(
    mocap: Path, tmp_path: Path, rig: str
) -> None:
    read = [read_motion((mocap / path).read_bytes(), path).clip for path in TAKES[rig]]
    takes = [one.sliced(0, min(one.frame_count, 60)) for one in read if one is not None]
    assert map_joints(takes[0].skeleton).rig == rig
    documents = documents_of(takes)
    assert documents[1]["axes"] != documents[2]["axes"], "the two takes show different axes"

    for onto in (False, True):
        (wanted, codes), *others = [retargeted(tmp_path, takes[0], one, onto=onto) for one in documents]
        assert not {"axes-from-clip", "axes-guessed"} & set(codes)
        for found, _ in others:
            np.testing.assert_array_equal(found, wanted)


def test_axes_that_neither_rest_pose_nor_names_tell_are_read_from_the_clip(tmp_path: Path) -> None:
    takes = [folded(generate_gait(1.4, 0.0, 2.0, 30.0), raised) for raised in (0.0, 0.9)]
    documents = documents_of(takes)
    assert "LeftForeArm" not in documents[0]["axes"]

    (wanted, codes), *others = [retargeted(tmp_path, takes[1], one) for one in documents]
    assert "axes-from-clip" in codes
    for found, _ in others:
        np.testing.assert_array_equal(found, wanted)

    _, codes = retargeted(tmp_path, takes[1], documents[0], onto=True)
    assert "axes-guessed" in codes


def test_axes_that_are_read_from_each_clip_undo_the_turned_frames_of_its_joints(tmp_path: Path) -> None:
    """The two takes are one motion, with other frames of the forearms."""
    takes = [folded(generate_gait(1.4, 0.0, 2.0, 30.0), raised) for raised in (0.0, 0.9)]
    mapping = documents_of(takes)[0]
    (first, _), (second, _) = [retargeted(tmp_path, take, mapping) for take in takes]
    assert np.degrees(_turned(first, second, "lowerarm_l").max()) < 1.0

    beside, _ = retargeted(tmp_path, takes[1], mapping, after=takes[0])
    np.testing.assert_array_equal(beside, second)


def test_axes_that_a_person_has_stated_are_used_as_they_are(tmp_path: Path) -> None:
    takes = [folded(generate_gait(1.4, 0.0, 2.0, 30.0), raised) for raised in (0.0, 0.9)]
    stated = [one | {"method": "manual", "confidence": 1.0} for one in documents_of(takes)[1:]]

    (first, codes), (second, _) = [retargeted(tmp_path, takes[1], one) for one in stated]
    assert "axes-from-clip" not in codes
    assert np.degrees(_turned(first, second, "lowerarm_l").max()) > 5.0


def test_a_joint_map_without_hips_and_shoulders_is_read_with_the_axes_that_it_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skeleton_cache, "_skeletons", LruCache(max_entries=4))
    project = ProjectInMemory(tmp_path)
    add_clip(project, "take", generate_gait(1.4, 0.0, 1.0, 30.0))
    axes = {"Head": {"twist": (0.0, 1.0, 0.0), "swing": (1.0, 0.0, 0.0)}}
    project.parts["skeleton_a", 1, "mapping"] = {"joints": {"head": "Head"}, "axes": axes}
    rig = skeleton_cache.Rig.as_stored(RevisionRef(item="skeleton_a", revision=1))
    assert skeleton_cache.read_mapped(project, rig).axes.keys() == {"Head"}


def _turned(first: np.ndarray[Any, Any], second: np.ndarray[Any, Any], joint: str) -> np.ndarray[Any, Any]:
    """Return the angles in radians between the rotations of a joint in two motions of the game skeleton."""
    place = 3 + 4 * game_skeleton().index_of(joint)
    return quaternions.angle_between(first[:, place : place + 4], second[:, place : place + 4])
