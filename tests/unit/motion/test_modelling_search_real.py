"""Search in a model of real takes that raise a hand; targets are wrist positions from takes left out of training."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from tests.support.present import present
from tests.support.tiers import is_soak

from marey_motion.alignment.aligned import AlignedClip
from marey_motion.alignment.aligning import SourceExample, align_clips
from marey_motion.alignment.signs import consistent_poses
from marey_motion.arrays import Flags, Floats
from marey_motion.clip import Clip
from marey_motion.formats import read_motion
from marey_motion.kinematics import forward_kinematics
from marey_motion.matching.body import MatchingBody
from marey_motion.modelling.search.objective import build_objective
from marey_motion.modelling.search.step_search import search_steps
from marey_motion.modelling.search.steps import Step
from marey_motion.modelling.search.tree import END_EFFECTORS, build_tree
from marey_motion.modelling.training import TrainedPrimitive, train_primitive
from marey_motion.retargeting import plan_retarget, retarget
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.rigs.axes import JointAxes
from marey_motion.rigs.mapping import JointMapping
from marey_motion.skeleton import Skeleton, same_hierarchy
from marey_schemas.options.modelling import ModelOptions
from marey_schemas.search_constraints import JointPositionConstraint

TARGETS = 200 if is_soak() else 60
HELD_OUT_EVERY = 4


def test_places_that_unseen_takes_reached_are_found_and_met(mocap: Path) -> None:
    files = sorted(mocap.glob("bandai-namco-2/*raise-up*right-hand*.bvh"))
    assert len(files) >= 20
    clips = _on_one_skeleton([present(read_motion(file.read_bytes(), file.name).clip) for file in files])
    mapping = map_joints(clips[0].skeleton)
    body = MatchingBody.from_mapping(clips[0].skeleton, mapping)
    examples = [SourceExample(file.stem, file.stem, clip) for file, clip in zip(files, clips, strict=True)]
    aligned = align_clips(examples, body)
    unseen = [one for place, one in enumerate(aligned.clips) if place % HELD_OUT_EVERY == 0]
    known = tuple(one for one in aligned.clips if one not in unseen)
    reference = next((one.uid for one in known if one.uid == aligned.reference), known[0].uid)
    quick = ModelOptions(leave_one_out=False, folds=0, report_samples=0)
    trained = train_primitive(replace(aligned, clips=known, reference=reference), quick)
    searched_cm, refined_cm, likely = _search_all(trained, unseen, body)
    assert np.median(searched_cm) <= 0.3
    assert np.median(refined_cm) <= 0.05
    assert np.mean(likely) >= 0.85  # four narrow distributions; one wide distribution of less likely motions had 0.97
    assert (refined_cm <= searched_cm).all()


def _on_one_skeleton(clips: list[Clip]) -> list[Clip]:
    """Return all clips on the skeleton of the first one."""

    def rigged(skeleton: Skeleton) -> tuple[Skeleton, JointMapping, dict[str, JointAxes]]:
        mapping = map_joints(skeleton)
        return skeleton, mapping, guess_axes(skeleton, mapping)

    target = rigged(clips[0].skeleton)
    return [
        clip
        if same_hierarchy(clip.skeleton, clips[0].skeleton)
        else retarget(clip, plan_retarget(*rigged(clip.skeleton), *target))
        for clip in clips
    ]


def _search_all(
    trained: TrainedPrimitive, unseen: list[AlignedClip], body: MatchingBody
) -> tuple[Floats, Floats, Flags]:
    """Return the errors in cm after the search and after refinement, and whether results are as likely as examples."""
    primitive, joints = trained.primitive, dict(body.standard_joints)
    least = np.percentile([one.log_likelihood for one in trained.report.examples], 1)
    tree = build_tree(primitive, 1, end_effectors=[joints[name] for name in END_EFFECTORS])
    # Within reach of the model: where the wrist is in what the model makes of the unseen take.
    mean = primitive.spatial.basis.at_frames @ primitive.spatial.mean
    poses = consistent_poses(np.stack([one.motion.poses for one in unseen]), mean)
    latents = primitive.latents_of(poses, np.stack([one.time_function for one in unseen]))
    random = np.random.default_rng(0)
    searched, refined, likely = [], [], []
    for _ in range(TARGETS):
        frame = float(random.integers(primitive.frame_count))
        pose = primitive.poses(latents[[random.integers(len(latents))]], [frame])[:, 0]
        x, y, z = forward_kinematics(primitive.skeleton, pose)[0, joints["right_wrist"]].tolist()
        step = Step(primitive, (JointPositionConstraint(joint="right_wrist", at=frame, target_m=(x, y, z)),), joints)
        sequel = search_steps([step], [tree])
        searched.append(100.0 * sequel.sampled.errors[0][0])
        refined.append(100.0 * sequel.measured.errors[0][0])
        objective = build_objective(primitive, step.constraints, joints)
        np.testing.assert_allclose(objective.errors(sequel.latents[0][None])[0], sequel.measured.errors[0], atol=1e-12)
        likely.append(primitive.log_density(sequel.latents[0][None])[0] >= least)
    return np.array(searched), np.array(refined), np.array(likely)
