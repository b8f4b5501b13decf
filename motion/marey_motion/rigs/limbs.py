"""Chains of bones that may be limbs: pairs that branch from one joint and have nearly equal bone lengths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from marey_motion.skeleton import Skeleton

# Two limbs belong together when their bones differ by less than this share of their length.
ASYMMETRY_LIMIT = 0.15
# Limbs with different ends are still a pair if at least this many bones are equal: an arm to the wrist.
LEAST_COMMON_BONES = 2
# Greatest number of limbs of one joint that are compared with each other.
MOST_LIMBS = 12


@dataclass(frozen=True)
class Limb:
    """A chain of three joints or more: from a child of a branching joint towards the farthest tip."""

    chain: tuple[int, ...]
    bones: tuple[float, ...]  # length from each joint of the chain to the next

    def cut(self, bones: int) -> Limb:
        """Shorten the limb.

        Parameters
        ----------
        bones : int    number of bones to keep

        Returns
        -------
        Limb    the first bones of the chain
        """
        return Limb(self.chain[: bones + 1], self.bones[:bones])


@dataclass(frozen=True, eq=False)
class LimbPair:
    """Two limbs that branch from the same joint and have the same number of bones of nearly equal lengths."""

    parent: int
    limbs: tuple[Limb, Limb]
    asymmetry: float

    @cached_property
    def bones(self) -> tuple[float, ...]:
        """Length of each bone, averaged over the two limbs, in the skeleton's unit."""
        return tuple((a + b) / 2 for a, b in zip(self.limbs[0].bones, self.limbs[1].bones, strict=True))


class BoneTree:
    """Branching and bone lengths of a skeleton."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.skeleton = skeleton
        self._paths: dict[int, tuple[int, ...]] = {}
        self.lengths = np.linalg.norm(skeleton.offsets, axis=1)
        self.reach = np.zeros(skeleton.joint_count)  # from each joint to the farthest tip below it
        for site in skeleton.end_sites:
            self.reach[site.joint] = max(self.reach[site.joint], float(np.linalg.norm(site.offset)))
        self.depth = np.ones(skeleton.joint_count, dtype=np.int32)  # joints from each one to the farthest leaf
        for joint in range(skeleton.joint_count - 1, 0, -1):
            parent = skeleton.parents[joint]
            self.reach[parent] = max(self.reach[parent], self.lengths[joint] + self.reach[joint])
            self.depth[parent] = max(self.depth[parent], 1 + self.depth[joint])

    def path_to_root(self, joint: int) -> tuple[int, ...]:
        """List the joints from one joint up to the root; the list is computed once for each joint.

        Parameters
        ----------
        joint : int    index of the first joint

        Returns
        -------
        tuple of int    indices from `joint` to the root, both included
        """
        if joint not in self._paths:
            self._paths[joint] = self.skeleton.path_to_root(joint)
        return self._paths[joint]

    def extent(self, joint: int) -> float:
        """Measure the length from a joint's parent to the farthest tip below the joint.

        Parameters
        ----------
        joint : int    index of the joint

        Returns
        -------
        float    length along the bones, in the skeleton's unit
        """
        return float(self.lengths[joint] + self.reach[joint])

    def limb(self, start: int) -> Limb:
        """Follow the chain that leads from a joint to the farthest tip.

        End sites are not bones: exporters write arbitrary lengths there.

        Parameters
        ----------
        start : int    index of the first joint

        Returns
        -------
        Limb    the chain to its last joint
        """
        chain = [start]
        while children := self.skeleton.children[chain[-1]]:
            chain.append(max(children, key=self.extent))
        return Limb(tuple(chain), tuple(float(self.lengths[joint]) for joint in chain[1:]))

    @cached_property
    def limb_pairs(self) -> tuple[LimbPair, ...]:
        """All pairs of chains that branch from one joint, have matching bone lengths and at least three joints each."""
        pairs = []
        for parent, children in enumerate(self.skeleton.children):
            long = [child for child in children if self.depth[child] >= 3]
            if len(long) < 2:
                continue
            limbs = map(self.limb, sorted(long, key=lambda child: -self.reach[child])[:MOST_LIMBS])
            pairs += [pair for two in combinations(limbs, 2) if (pair := _paired(parent, *two)) is not None]
        return tuple(pairs)

    def are_apart(self, legs: LimbPair, arms: LimbPair) -> bool:
        """Check whether two pairs of limbs start at different joints, neither of which is on a limb of the other pair.

        Parameters
        ----------
        legs, arms : LimbPair    the pairs

        Returns
        -------
        bool    True if they can belong to one body
        """
        above_legs, above_arms = (self.path_to_root(pair.parent) for pair in (legs, arms))
        nested = any(limb.chain[0] in above_arms for limb in legs.limbs) or any(
            limb.chain[0] in above_legs for limb in arms.limbs
        )
        return legs.parent != arms.parent and not nested

    def common_ancestor(self, a: int, b: int) -> int:
        """Find the lowest joint from which two joints descend.

        Parameters
        ----------
        a, b : int    indices of the joints

        Returns
        -------
        int    index of the ancestor, which may be one of the two joints
        """
        above = set(self.path_to_root(a))
        return next(joint for joint in self.path_to_root(b) if joint in above)

    def distance(self, a: int, b: int) -> float:
        """Measure the length of the bones between two joints.

        Parameters
        ----------
        a, b : int    indices of the joints

        Returns
        -------
        float    length along the bones, in the skeleton's unit
        """
        between = set(self.path_to_root(a)) ^ set(self.path_to_root(b))
        return float(sum(self.lengths[joint] for joint in between))


def _paired(parent: int, first: Limb, second: Limb) -> LimbPair | None:
    """Make a pair of two limbs if their bones match; None otherwise.

    If only the first bones match, as when one hand holds an object, both limbs are shortened to these bones.
    """
    shorter = min(len(first.chain), len(second.chain)) - 1
    for a, b in ((first, second), *((first.cut(k), second.cut(k)) for k in range(shorter, LEAST_COMMON_BONES - 1, -1))):
        asymmetry = _asymmetry(a, b)
        if asymmetry <= ASYMMETRY_LIMIT:
            return LimbPair(parent, (a, b), asymmetry)
    return None


def _asymmetry(first: Limb, second: Limb) -> float:
    """Sum the differences of two chains' bone lengths, as a share of their length; infinite if bone counts differ."""
    if len(first.bones) != len(second.bones):
        return float("inf")
    a, b = np.array(first.bones), np.array(second.bones)
    total = float(np.sum(a + b)) / 2
    return float(np.sum(np.abs(a - b))) / total if total > 0.0 else float("inf")
