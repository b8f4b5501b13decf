"""Checks of a retargeted clip whose source has joint translations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.documents import skeleton_to_document
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.moved_bones import FollowedBones, follow_moved_bones
from marey_motion.retargeting import clips
from marey_motion.skeleton import Skeleton
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.queue.job_params import RetargetParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import JobRefused
from marey_worker.job_io import skeleton_cache
from marey_worker.kinds import retarget


def counted_follows(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list that grows with each call of `follow_moved_bones`, by the clip of this call."""
    calls = []

    def follow(clip: Clip, joints: dict[str, int]) -> FollowedBones:
        calls.append(clip)
        return follow_moved_bones(clip, joints)

    monkeypatch.setattr(clips, "follow_moved_bones", follow)
    return calls


def test_the_checks_of_a_result_name_the_bones_that_translations_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skeleton_cache, "_skeletons", LruCache(max_entries=4))
    monkeypatch.setattr(skeleton_cache, "_plans", LruCache(max_entries=4))
    project = ProjectInMemory(tmp_path)
    plain = generate_gait(1.4, 0.0, 2.0)
    knee = plain.skeleton.index_of("LeftLeg")
    moved = np.tile(plain.skeleton.offsets[knee] + (0.1, 0.0, 0.0), (plain.frame_count, 1, 1))
    add_clip(project, "plain", plain)
    add_clip(project, "moved", replace(plain, translations=moved, translated_joints=(knee,)))
    project.parts["skeleton_b", 1, "hierarchy"] = skeleton_to_document(game_skeleton()).model_dump(by_alias=True)
    skeleton = {"item": "skeleton_b", "revision": 1, "kind": Kind.SKELETON, "name": "b", "collection": "rigs"}
    project.inputs["skeleton"] = (PinnedInput(**skeleton),)

    follows = counted_follows(monkeypatch)
    project.into = "out"
    result = retarget.run(project, RetargetParams())
    assert (result["clips"], result["refused"]) == (2, [])
    assert result["warnings"] == {"bones-moved-by-translations": 1}
    checks = {output.item_name: output.parts["info"].get("checks", []) for output in project.staged}
    assert checks["plain"] == []
    (check,) = checks["moved"]
    assert check["code"] == "bones-moved-by-translations"
    assert check["joints"] == ["LeftUpLeg"]
    assert len(follows) == 2, "the bones of a clip are followed once, for its check and its poses"
    assert 10.0 < check["values"]["largest_turn_deg"] < 20.0

    project.staged.clear()
    kept = retarget.run(project, RetargetParams(keep_feet=True, keep_hands=True, suffix="-kept"))
    assert kept["warnings"] == {"bones-moved-by-translations": 1, "feet-kept": 2, "hands-kept": 2}
    for output in project.staged:
        checks = {check["code"]: check["values"] for check in output.parts["info"]["checks"]}
        assert checks["feet-kept"]["slide_after_m"] < checks["feet-kept"]["slide_before_m"]
        assert checks["hands-kept"]["missed_m"] < 0.02 < checks["hands-kept"]["moved_m"]


def test_a_job_that_can_retarget_no_clip_fails(tmp_path: Path) -> None:
    project = ProjectInMemory(tmp_path)
    chain = Skeleton(("a", "b"), np.array([-1, 0], np.int32), np.eye(3)[:2], quaternions.identity(2))
    add_clip(
        project, "rope", Clip(chain, 30.0, np.tile(np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], np.float32), (9, 1)))
    )
    project.parts["skeleton_b", 1, "hierarchy"] = skeleton_to_document(game_skeleton()).model_dump(by_alias=True)
    skeleton = {"item": "skeleton_b", "revision": 1, "kind": Kind.SKELETON, "name": "b", "collection": "rigs"}
    project.inputs["skeleton"] = (PinnedInput(**skeleton),)
    project.into = "out"
    with pytest.raises(JobRefused, match="none of 1 clip can be retargeted"):
        retarget.run(project, RetargetParams(keep_hands=True))
    assert not project.staged
