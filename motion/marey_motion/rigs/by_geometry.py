"""Finding the body in a skeleton whose names say nothing: two legs, two arms, a head.

Only lengths and branching are used where possible, because the rest pose of many files is no pose of a body at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from marey_motion.rigs.names import parse_name
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import Skeleton

# Two limbs belong together when their bones differ by less than this share of their length.
ASYMMETRY_LIMIT = 0.15
# Limbs of unequal ends are still a pair when they have this many bones in common: an arm to the wrist.
LEAST_COMMON_BONES = 3
# Limbs whose two long bones are shorter than this share of the longest pair's are fingers, ears or armour.
SHORTEST_ARM = 0.3
# Forearms have 0.7 to 1 of the longest bone of an arm, hands to the fingertips at most 0.62.
LONG_BONE = 0.65
# Joints nearer than this to their parent are rigging aids.
SHORTEST_BONE_M = 1e-3
# Branches that reach less far than this share of their largest sibling are rigging aids too.
SMALL_BRANCH = 0.3
# Limbs of one joint that are compared with each other; nothing that walks has more.
MOST_LIMBS = 12
# How much telling the sides apart by the rest pose takes from the confidence.
SIDES_UNNAMED = 0.8


@dataclass(frozen=True)
class Limb:
    """The chain from a branching joint to the farthest tip, three joints or more."""

    chain: tuple[int, ...]
    bones: tuple[float, ...]  # length from each joint of the chain to the next; the last to its end site, or 0

    @cached_property
    def upper(self) -> int:
        """Position in the chain of the joint that carries the two long bones: the last pair of nearly the longest.

        The last, because a clavicle can be as long as a forearm, while a hand or foot is shorter.
        """
        # End sites are no bones: exporters write all kinds of things there.
        bones = self.bones[:-1]
        least = LONG_BONE * max(bones)
        long = [place for place, pair in enumerate(pairwise(bones)) if min(pair) >= least]
        return long[-1] if long else int(np.argmax([a + b for a, b in pairwise(bones)]))

    @property
    def long_bones(self) -> float:
        """Length of the thigh and shank, or of the upper arm and forearm."""
        return sum(self.bones[self.upper : self.upper + 2])

    def cut(self, bones: int) -> Limb:
        """The limb up to the end of so many bones."""
        return Limb(self.chain[: bones + 1], (*self.bones[:bones], 0.0))

    def joint(self, position: int) -> int | None:
        """The joint so many places after the one that carries the long bones."""
        at = self.upper + position
        return self.chain[at] if 0 <= at < len(self.chain) else None


@dataclass(frozen=True)
class LimbPair:
    """Two limbs of equal build on one joint."""

    parent: int
    limbs: tuple[Limb, Limb]
    asymmetry: float


@dataclass(frozen=True)
class GeometryMatch:
    """Standard joints found by geometry (by index), how sure that is, and what was assumed."""

    joints: dict[str, int]
    confidence: float
    notes: tuple[str, ...]


def find_body(skeleton: Skeleton) -> GeometryMatch | None:
    """Legs, arms and head by symmetry, branching and lengths; None when there are no two pairs of limbs."""
    tree = _Tree(skeleton)
    pairs = sorted(tree.limb_pairs, key=lambda pair: -pair.limbs[0].long_bones)
    if not pairs:
        return None
    legs = pairs[0]
    arms = next((pair for pair in pairs[1:] if tree.are_apart(legs, pair)), None)
    if arms is None or arms.limbs[0].long_bones < SHORTEST_ARM * legs.limbs[0].long_bones:
        return None
    joints = {"pelvis": tree.common_ancestor(legs.parent, arms.parent)}
    neck, head = tree.neck_and_head(arms, legs)
    if head is not None:
        joints |= {"head": head} | ({"neck": neck} if neck is not None else {})
    confidence = (0.7 if head is not None else 0.5) * (1.0 - max(legs.asymmetry, arms.asymmetry))
    left = _left_direction(skeleton, legs, joints)
    notes = ["the names are not known: joints were found by symmetry, branching and bone lengths"]
    for pair, names in ((legs, ("hip", "knee", "ankle", "toe")), (arms, ("shoulder", "elbow", "wrist"))):
        limbs, by_name = _left_and_right(skeleton, pair, left)
        if not by_name:
            confidence *= SIDES_UNNAMED
            notes.append(f"left and right of {names[0]} to {names[-1]} were told apart by the rest pose alone")
        for side, limb in zip(SIDES, limbs, strict=True):
            named = {f"{side}_{joint}": limb.joint(place) for place, joint in enumerate(names)}
            if pair is arms:
                named[f"{side}_clavicle"] = limb.joint(-1)
            joints |= {name: index for name, index in named.items() if index is not None}
    return GeometryMatch(joints, confidence, tuple(notes))


def _left_direction(skeleton: Skeleton, legs: LimbPair, joints: dict[str, int]) -> NDArray[np.float64]:
    """Up crossed with where the toes point, in the rest pose; +x where that pose is too degenerate to tell."""
    positions = skeleton.rest_global_positions
    up = positions[joints.get("head", joints["pelvis"])] - positions[joints["pelvis"]]
    toes = [(limb.joint(2), limb.joint(3)) for limb in legs.limbs]
    forward = sum(
        (positions[toe] - positions[ankle] for ankle, toe in toes if ankle is not None and toe is not None),
        start=np.zeros(3),
    )
    left: NDArray[np.float64] = np.cross(up, forward)
    scale = float(np.linalg.norm(up) * np.linalg.norm(forward))
    return left if np.linalg.norm(left) > 0.2 * scale > 0.0 else np.array((1.0, 0.0, 0.0))


def _left_and_right(skeleton: Skeleton, pair: LimbPair, left: NDArray[np.float64]) -> tuple[tuple[Limb, Limb], bool]:
    """The limbs of a pair, left one first, and whether their names say so."""
    first, second = pair.limbs
    sides = [{parse_name(skeleton.display_names[joint]).side for joint in limb.chain} - {""} for limb in pair.limbs]
    if sides in ([{"left"}, {"right"}], [{"right"}, {"left"}]):
        return ((first, second) if sides[0] == {"left"} else (second, first)), True
    positions = skeleton.rest_global_positions
    across = positions[first.chain[first.upper]] - positions[second.chain[second.upper]]
    return ((first, second) if across @ left >= 0.0 else (second, first)), False


class _Tree:
    """A skeleton's branching and lengths."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.skeleton = skeleton
        self.lengths = np.linalg.norm(skeleton.offsets, axis=1)
        self.tips = np.zeros(skeleton.joint_count)
        for site in skeleton.end_sites:
            self.tips[site.joint] = max(self.tips[site.joint], float(np.linalg.norm(site.offset)))
        self.reach = self.tips.copy()  # from each joint to the farthest tip below it
        self.depth = np.ones(skeleton.joint_count, dtype=np.int32)  # joints from each one to the farthest leaf
        for joint in range(skeleton.joint_count - 1, 0, -1):
            parent = skeleton.parents[joint]
            self.reach[parent] = max(self.reach[parent], self.lengths[joint] + self.reach[joint])
            self.depth[parent] = max(self.depth[parent], 1 + self.depth[joint])

    def limb(self, start: int) -> Limb:
        """The farthest-reaching chain from a joint."""
        chain = [start]
        while children := self.skeleton.children[chain[-1]]:
            chain.append(max(children, key=lambda joint: self.lengths[joint] + self.reach[joint]))
        bones = [float(self.lengths[joint]) for joint in chain[1:]] + [float(self.tips[chain[-1]])]
        return Limb(tuple(chain), tuple(bones))

    @cached_property
    def limb_pairs(self) -> tuple[LimbPair, ...]:
        """All pairs of sibling chains of equal build and three joints or more."""
        pairs = []
        for parent, children in enumerate(self.skeleton.children):
            long = [child for child in children if self.depth[child] >= 3]
            if len(long) < 2:
                continue
            limbs = map(self.limb, sorted(long, key=lambda child: -self.reach[child])[:MOST_LIMBS])
            pairs += [pair for two in combinations(limbs, 2) if (pair := _paired(parent, *two)) is not None]
        return tuple(pairs)

    def are_apart(self, legs: LimbPair, arms: LimbPair) -> bool:
        """Whether two pairs sit on different joints, neither on the limbs of the other."""
        above_legs, above_arms = (self.skeleton.path_to_root(pair.parent) for pair in (legs, arms))
        nested = any(limb.chain[0] in above_arms for limb in legs.limbs) or any(
            limb.chain[0] in above_legs for limb in arms.limbs
        )
        return legs.parent != arms.parent and not nested

    def common_ancestor(self, a: int, b: int) -> int:
        """The lowest joint that both descend from, or are."""
        above = set(self.skeleton.path_to_root(a))
        return next(joint for joint in self.skeleton.path_to_root(b) if joint in above)

    def neck_and_head(self, arms: LimbPair, legs: LimbPair) -> tuple[int | None, int | None]:
        """First and last joint of the chain that goes on where the arms branch off, without a marker on top."""
        paired = {limb.chain[0] for pair in self.limb_pairs if pair.parent == arms.parent for limb in pair.limbs}
        towards_legs = self.skeleton.path_to_root(legs.parent)
        starts = [joint for joint in self.skeleton.children[arms.parent] if joint not in paired | set(towards_legs)]
        if not starts:
            return None, None
        chain = [max(starts, key=lambda joint: self.lengths[joint] + self.reach[joint])]
        while len(following := self._branches(chain[-1])) == 1 and self.lengths[following[0]] > SHORTEST_BONE_M:
            chain.append(following[0])
        # From the head's joint to its top is farther than from the neck's to the head's.
        if len(chain) > 2 and self.reach[chain[-1]] == 0.0 and self.lengths[chain[-1]] > 1.2 * self.lengths[chain[-2]]:
            chain.pop()
        return (chain[0], chain[-1]) if len(chain) > 1 else (None, chain[0])

    def _branches(self, joint: int) -> list[int]:
        """Children without those that are small beside the largest."""
        extents = {child: float(self.lengths[child] + self.reach[child]) for child in self.skeleton.children[joint]}
        return [child for child, extent in extents.items() if extent >= SMALL_BRANCH * max(extents.values())]


def _paired(parent: int, first: Limb, second: Limb) -> LimbPair | None:
    """Two limbs of equal build, or what they have in common before one of them goes on into what it holds."""
    shorter = min(len(first.chain), len(second.chain)) - 1
    for a, b in ((first, second), *((first.cut(k), second.cut(k)) for k in range(shorter, LEAST_COMMON_BONES - 1, -1))):
        asymmetry = _asymmetry(a, b)
        if asymmetry <= ASYMMETRY_LIMIT:
            return LimbPair(parent, (a, b), asymmetry)
    return None


def _asymmetry(first: Limb, second: Limb) -> float:
    """Difference of two chains' bones as a share of their length; infinite where they differ in build."""
    if len(first.bones) != len(second.bones):
        return float("inf")
    a, b = np.array(first.bones[:-1]), np.array(second.bones[:-1])
    total = float(np.sum(a + b)) / 2
    return float(np.sum(np.abs(a - b))) / total if total > 0.0 else float("inf")
