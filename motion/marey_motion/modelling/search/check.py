"""Check of searches: the targets are positions of hands and feet in examples that were left out of the training."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.arrays import CM_PER_M, Flags, Floats
from marey_motion.modelling.example_groups import ExampleGroups
from marey_motion.modelling.sample_quality import joint_positions
from marey_motion.modelling.search.step_search import search_steps
from marey_motion.modelling.search.steps import Step
from marey_motion.modelling.search.tree import build_tree
from marey_motion.modelling.training import train_primitive
from marey_schemas.documents.standard_joints import LIMB_ENDS
from marey_schemas.options.modelling import ModelOptions, TreeOptions
from marey_schemas.search_constraints import JointPositionConstraint

HELD_OUT_EVERY = 5
LEAST_EXAMPLES = 10
LEAST_TAKES = 2
MOST_TARGETS = 60
SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class SearchCheck:
    """Errors of searches for motions in which a hand or foot reaches a position.

    The positions come from takes, and from performers, that were left out of the training of the model.

    Parameters
    ----------
    left_out : (n,) "take" if the example's take was left out of training, "subject" if its performer was
    examples, joints : (n,) uid of the example and standard name of the joint whose position is the target
    frames : (n,) canonical frame at which the positions of that joint differ most between the examples
    searched_cm, refined_cm : (n,) error of the best sample of the tree, before and after refinement
    """

    left_out: tuple[str, ...]
    examples: tuple[str, ...]
    joints: tuple[str, ...]
    frames: tuple[int, ...]
    searched_cm: Floats
    refined_cm: Floats


def check_search(
    aligned: AlignedSet, standard_joints: Mapping[str, int], options: ModelOptions, *, seed: int
) -> SearchCheck | None:
    """Train a model without every fifth take, and search for the positions of hands and feet in these takes.

    The take of the reference example is never one of these takes.

    If at least three performers are known, the same is done for each performer: a model is trained without the examples
    of this performer, and the positions of hands and feet in these examples are searched for.

    Parameters
    ----------
    aligned : AlignedSet    the examples
    standard_joints : mapping of str to int    joint index by standard name
    options : ModelOptions    options of the training
    seed : int    seed of training and samples

    Returns
    -------
    SearchCheck or None    None if there are fewer than ten examples or three takes, if hands and feet are not known, or
        if fewer than five examples remain without the left-out ones
    """
    joints = {name: standard_joints[name] for name in LIMB_ENDS if name in standard_joints}
    groups = ExampleGroups.of(aligned)
    known = {clip.uid: number for clip, number in zip(aligned.clips, groups.takes.tolist(), strict=True)}
    takes = [number for number in range(groups.take_count) if number != known.get(aligned.reference)]
    if len(aligned.clips) < LEAST_EXAMPLES or len(takes) < LEAST_TAKES or not joints:
        return None
    checking = _Checking(aligned, joints, standard_joints, options, seed)
    without = np.isin(groups.takes, takes[::HELD_OUT_EVERY])
    found = [("take", *one) for one in checking.search(without, MOST_TARGETS)]
    if groups.subjects is not None:
        each = max(1, MOST_TARGETS // groups.subject_count)
        for number in range(groups.subject_count):
            found += [("subject", *one) for one in checking.search(groups.subjects == number, each)]
    if not found:
        return None
    left_out, examples, names, frames, searched, refined = zip(*found, strict=True)
    return SearchCheck(left_out, examples, names, frames, CM_PER_M * np.array(searched), CM_PER_M * np.array(refined))


@dataclass(frozen=True, eq=False)
class _Checking:
    """Searches in models that were trained without some of the examples."""

    aligned: AlignedSet
    joints: Mapping[str, int]
    standard_joints: Mapping[str, int]
    options: ModelOptions
    seed: int

    def search(self, without: Flags, most: int) -> Iterator[tuple[str, str, int, float, float]]:
        """Train a model without some examples, and search it for at most `most` hand and foot positions of these.

        `without` (m,) is True for the examples that are left out of training.

        Yields uid of the example, name of the joint, canonical frame, and the errors in metres before and after
        refinement. Yields nothing if too few examples remain.
        """
        clips = np.array(self.aligned.clips, dtype=object)
        if (~without).sum() < LEAST_EXAMPLES // 2:
            return
        quick = self.options.replace(leave_one_out=False, folds=0, report_samples=0)
        primitive = train_primitive(
            replace(self.aligned, clips=tuple(clips[~without])), quick, seed=self.seed
        ).primitive
        tree = build_tree(primitive, self.seed, TreeOptions(samples=SAMPLES), end_effectors=tuple(self.joints.values()))
        frames = _most_varied(self.aligned, tuple(self.joints.values()))
        poses = np.stack([clip.motion.poses for clip in clips[without]])
        places = joint_positions(self.aligned.skeleton, poses, tuple(self.joints.values()))
        todo = [(example, place) for example in range(len(poses)) for place in range(len(self.joints))]
        for chosen in np.unique(np.linspace(0, len(todo) - 1, min(most, len(todo))).astype(np.int64)).tolist():
            example, place = todo[chosen]
            joint = list(self.joints)[place]
            x, y, z = places[example, frames[place], place].tolist()
            target = JointPositionConstraint(joint=joint, at=float(frames[place]), target_m=(x, y, z))
            found = search_steps([Step(primitive, (target,), self.standard_joints)], [tree])
            errors = (float(found.sampled.errors[0][0]), float(found.measured.errors[0][0]))
            yield (clips[without][example].uid, joint, int(frames[place]), *errors)


def _most_varied(aligned: AlignedSet, joints: tuple[int, ...]) -> NDArray[np.int64]:
    """Find, for each of k joints, the canonical frame (k,) in which the joint's positions in the examples vary most."""
    places = joint_positions(aligned.skeleton, aligned.poses, joints)
    return np.asarray(places.var(axis=0).sum(axis=-1).argmax(axis=0), dtype=np.int64)
