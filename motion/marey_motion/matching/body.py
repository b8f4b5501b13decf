"""The joints of a skeleton that motion matching uses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.rigs import JointMapping
from marey_motion.rigs.mapping import symmetric_joints
from marey_motion.skeleton import Skeleton

POSE_JOINTS = ("pelvis", "spine_2", "head", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
"""Standard joints over which the pose cost of a transition is summed: hips, spine, head, hands, feet."""


class JointChain(NamedTuple):
    """Some joints of a skeleton with all their ancestors.

    Parameters
    ----------
    joints : (K,) int64    indices of all these joints in the whole skeleton, increasing
    skeleton : Skeleton    a skeleton of only these K joints
    ends : (P,) int64    the requested joints without their ancestors, in the requested order, as indices into `joints`
    """

    joints: NDArray[np.int64]
    skeleton: Skeleton
    ends: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MatchingBody:
    """Joints of a skeleton that motion matching uses, by index.

    Parameters
    ----------
    hips : the joint whose velocity is matched
    carrier : the lowest joint from which all standard joints except `root` descend, usually the hips. Joints above the
        carrier, such as a static reference, only move the body as a whole.
    torso : the joint whose position on the ground is smoothed to make the simulation root: the upper spine, or else the
        hips
    feet, toes : (left, right) ankles, and (left, right) toes; without toe joints, the ankles again
    lefts, rights : hips and shoulders of each side, in the same order; the facing direction is computed from their
        differences
    pose_joints : joints of the pose cost: the joints of `POSE_JOINTS` that the skeleton has, in that order
    partners : (J,) each joint's partner on the other side; joints of the centre have their own index
    standard_joints : joint index by standard name, for all joints of the mapping
    """

    skeleton: Skeleton
    hips: int
    carrier: int
    torso: int
    feet: tuple[int, int]
    toes: tuple[int, int]
    lefts: tuple[int, ...]
    rights: tuple[int, ...]
    pose_joints: tuple[int, ...]
    partners: NDArray[np.int32]
    standard_joints: Mapping[str, int]

    @classmethod
    def from_mapping(cls, skeleton: Skeleton, mapping: JointMapping) -> MatchingBody:
        """Find the joints by their standard names.

        Parameters
        ----------
        skeleton : Skeleton    J joints
        mapping : JointMapping    its standard joints

        Returns
        -------
        MatchingBody    indices of the joints

        Raises
        ------
        MappingError    if required standard joints are not mapped; the error names them
        """
        hips, left_foot, right_foot = mapping.indices(skeleton, ("pelvis", "left_ankle", "right_ankle"))

        def optional(name: str, otherwise: int) -> int:
            return mapping.indices(skeleton, (name,))[0] if name in mapping.joints else otherwise

        standard_joints = {standard: skeleton.index_of(name) for standard, name in mapping.joints.items()}
        known = [joint for joint in POSE_JOINTS if joint in mapping.joints]
        return cls(
            skeleton=skeleton,
            hips=hips,
            carrier=_carrier(skeleton, standard_joints),
            torso=optional("spine_2", hips),
            feet=(left_foot, right_foot),
            toes=(optional("left_toe", left_foot), optional("right_toe", right_foot)),
            lefts=mapping.indices(skeleton, ("left_hip", "left_shoulder")),
            rights=mapping.indices(skeleton, ("right_hip", "right_shoulder")),
            pose_joints=tuple(dict.fromkeys(mapping.indices(skeleton, known))),
            partners=symmetric_joints(skeleton, mapping),
            standard_joints=standard_joints,
        )

    @cached_property
    def pose_chain(self) -> JointChain:
        """The pose joints and all their ancestors."""
        return joint_chain(self.skeleton, self.pose_joints)

    @cached_property
    def leg_chain(self) -> JointChain:
        """The toes and all their ancestors."""
        return joint_chain(self.skeleton, self.toes)


def joint_chain(skeleton: Skeleton, joints: Sequence[int]) -> JointChain:
    """Find some joints of a skeleton with all their ancestors.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    joints : sequence of int    indices of the joints

    Returns
    -------
    JointChain    K joints
    """
    needed = {0}
    for joint in joints:
        needed.update(skeleton.path_to_root(joint))
    chain = np.array(sorted(needed), dtype=np.int64)
    parents = np.concatenate(([-1], np.searchsorted(chain, skeleton.parents[chain[1:]])))
    names = tuple(skeleton.joint_names[joint] for joint in chain)
    part = Skeleton(names, parents.astype(np.int32), skeleton.offsets[chain], skeleton.rest_rotations[chain])
    return JointChain(chain, part, np.searchsorted(chain, np.array(joints, dtype=np.int64)))


def _carrier(skeleton: Skeleton, standard_joints: Mapping[str, int]) -> int:
    paths = [skeleton.path_to_root(joint)[::-1] for name, joint in standard_joints.items() if name != "root"]
    return max(int(joints[0]) for joints in zip(*paths, strict=False) if len(set(joints)) == 1)
