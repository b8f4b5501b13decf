"""Check of searches: the errors in reaching hand and foot positions of examples that were left out of training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.arrays import CM_PER_M, Floats
from marey_motion.modelling.sample_quality import toe_positions
from marey_motion.modelling.search.step_search import search_steps
from marey_motion.modelling.search.steps import Step
from marey_motion.modelling.search.tree import build_tree
from marey_motion.modelling.training import train_primitive
from marey_schemas.options.modelling import ModelOptions, TreeOptions
from marey_schemas.options.searching import RefineOptions
from marey_schemas.search_constraints import JointPositionConstraint

REACHING = ("left_wrist", "right_wrist", "left_ankle", "right_ankle")
"""Standard joints for which the check sets target positions."""

HELD_OUT_EVERY = 5
LEAST_EXAMPLES = 10
MOST_TARGETS = 60
SAMPLES = 2000
REFINING = RefineOptions(likelihood_weight=0.01)
"""Options with little weight on likelihood, because the check measures the smallest distance that the model allows."""


@dataclass(frozen=True, eq=False)
class SearchCheck:
    """Errors of searches for motions in which a hand or foot reaches a position.

    The positions come from examples that were left out of the training of the model.

    Parameters
    ----------
    examples, joints : (n,) uid of the example and standard name of the joint whose position is the target
    frames : (n,) canonical frame at which the positions of that joint differ most between the examples
    searched_cm, refined_cm : (n,) error of the best sample of the tree, before and after refinement
    """

    examples: tuple[str, ...]
    joints: tuple[str, ...]
    frames: tuple[int, ...]
    searched_cm: Floats
    refined_cm: Floats


def check_search(
    aligned: AlignedSet, standard_joints: Mapping[str, int], options: ModelOptions, *, seed: int
) -> SearchCheck | None:
    """Train a model without every fifth example, and search for the positions of hands and feet in these examples.

    Parameters
    ----------
    aligned : AlignedSet    the examples
    standard_joints : mapping of str to int    joint index by standard name
    options : ModelOptions    options of the training
    seed : int    seed of training and samples

    Returns
    -------
    SearchCheck or None    None if there are fewer than ten examples, or if hands and feet are not known
    """
    joints = {name: standard_joints[name] for name in REACHING if name in standard_joints}
    if len(aligned.clips) < LEAST_EXAMPLES or not joints:
        return None
    others = [clip for clip in aligned.clips if clip.uid != aligned.reference]
    held_out = others[::HELD_OUT_EVERY]
    kept = replace(aligned, clips=tuple(clip for clip in aligned.clips if clip not in held_out))
    quick = options.replace(leave_one_out=False, folds=0, report_samples=0)
    primitive = train_primitive(kept, quick, seed=seed).primitive
    tree = build_tree(primitive, seed, TreeOptions(samples=SAMPLES), end_effectors=tuple(joints.values()))
    frames = _most_varied(aligned, tuple(joints.values()))
    places = toe_positions(aligned.skeleton, np.stack([clip.motion.poses for clip in held_out]), tuple(joints.values()))
    wanted = [(example, place) for example in range(len(held_out)) for place in range(len(joints))][:MOST_TARGETS]
    names, searched, refined = tuple(joints), [], []
    for example, place in wanted:
        x, y, z = places[example, frames[place], place].tolist()
        step = Step(
            primitive,
            (JointPositionConstraint(joint=names[place], at=float(frames[place]), target_m=(x, y, z)),),
            standard_joints,
        )
        found = search_steps([step], [tree], refining=REFINING)
        searched.append(float(found.sampled.errors[0][0]))
        refined.append(float(found.measured.errors[0][0]))
    return SearchCheck(
        examples=tuple(held_out[example].uid for example, _ in wanted),
        joints=tuple(names[place] for _, place in wanted),
        frames=tuple(int(frames[place]) for _, place in wanted),
        searched_cm=CM_PER_M * np.array(searched),
        refined_cm=CM_PER_M * np.array(refined),
    )


def _most_varied(aligned: AlignedSet, joints: tuple[int, ...]) -> NDArray[np.int64]:
    """Find, for each of k joints, the canonical frame (k,) in which the joint's positions in the examples vary most."""
    places = toe_positions(aligned.skeleton, aligned.poses, joints)
    return np.asarray(places.var(axis=0).sum(axis=-1).argmax(axis=0), dtype=np.int64)
