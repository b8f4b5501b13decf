"""The function of the job kind `model`, with a project in memory instead of a server."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.support.alignment_examples import warped_walks
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.clip import Clip
from marey_motion.documents import mapping_to_document
from marey_motion.rigs import guess_axes, map_joints
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.queue.job_params import AlignParams, ModelParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.job_io import skeleton_cache
from marey_worker.kinds import align, model


def unknown_names(clip: Clip) -> Clip:
    """Return the clip on a skeleton whose joint names tell nothing."""
    names = tuple(f"j{number}" for number in range(clip.skeleton.joint_count))
    return replace(clip, skeleton=replace(clip.skeleton, joint_names=names))


def mapping_of(clip: Clip) -> dict[str, Any]:
    """Return the document `mapping` that a person would make for the renamed skeleton of a clip."""
    skeleton, renamed = clip.skeleton, unknown_names(clip).skeleton
    found = map_joints(skeleton)
    joints = {standard: renamed.joint_names[skeleton.index_of(name)] for standard, name in found.joints.items()}
    mapping = replace(found, joints=joints, method="manual", rig=None, confidence=1.0)
    return mapping_to_document(mapping, guess_axes(renamed, mapping)).model_dump(by_alias=True, exclude_none=True)


def test_searches_are_checked_with_the_joint_mapping_of_the_project(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skeleton_cache, "_skeletons", LruCache(max_entries=4))
    project = ProjectInMemory(tmp_path)
    examples, _ = warped_walks(4)
    for name, one in zip("abcd", examples, strict=True):
        add_clip(project, name, unknown_names(one.clip))
    project.parts["skeleton_a", 1, "mapping"] = mapping_of(examples[0].clip)
    align.run(project, AlignParams())
    for output in project.staged:
        project.parts |= {(output.name, 1, part): tree for part, tree in output.parts.items()}
    project.inputs = {
        "aligned": tuple(
            PinnedInput(item=output.name, revision=1, kind=Kind.PROCESSED, name=output.name, collection="aligned")
            for output in project.staged
        )
    }
    seen: list[dict[str, int]] = []

    def see(_aligned: AlignedSet, standard_joints: Mapping[str, int], *_options: object, seed: int) -> None:
        seen.append(dict(standard_joints))

    monkeypatch.setattr(model, "check_search", see)
    monkeypatch.setattr(model, "write_model_report", lambda *_arguments: {})
    model.run(project, ModelParams(starts=1))
    skeleton = examples[0].clip.skeleton
    assert seen == [{standard: skeleton.index_of(name) for standard, name in map_joints(skeleton).joints.items()}]
