"""Recognition of the legs and arms of a person, and of the joints at which they bend, by proportions.

A skeleton can have other pairs of chains, such as a cape, wings or the bones of a skirt, and twist bones between the
joints that bend. Every interpretation of the chains has a score: the sum, over its proportions, of the logarithm of how
frequent the proportion is among people.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product
from math import log

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.rigs.limbs import BoneTree, LimbPair

# Shorter distances between a joint and its parent are not bones, but aids of the rig.
SHORTEST_BONE_M = 1e-3
# Greatest numbers of pairs of chains, and of interpretations of each pair, that are compared.
MOST_PAIRS, MOST_READINGS = 32, 4
# Number of joints at the start of a chain among which hip, knee and ankle are looked for.
LONGEST_CHAIN = 14
# Lowest score of a single proportion.
LEAST_SCORE = -8.0
# Least quotient of the direct distance and the length of a chain at which the chain counts as one straight bone.
STRAIGHT = 0.998
# Scores of each joint within a long bone, and of each additional bone before the limb.
TWIST_JOINT, STRAIGHT_JOINT, BENT_JOINT, EXTRA_JOINT = -0.2, -0.8, -2.0, -0.4
# Joints are twist joints if the parts of the bone differ by at most this share of its length.
EVENNESS = 0.04
# Lowest score of a hand or foot that is shorter than usual, because rigs may end at the wrist or ankle.
SHORT_END = -0.7
# Score of a wrist by its number of children: none, a hand, a hand and a thumb. More children have the score 1.
FINGERS = {0: 0.0, 1: 0.0, 2: 0.5}
# Factor of 1 + the cosine of the angle between legs and trunk: the score falls if the legs point up.
AGAINST_TRUNK = -1.5
# Factor of the logarithm of how much longer the longest pair of chains is than the legs: few people have longer limbs.
SHORTER = -1.5


@dataclass(frozen=True)
class Build:
    """Usual proportions of an arm or a leg of a person.

    `ratio` is the length of the upper long bone divided by that of the lower one. `end` is the length from wrist or
    ankle to the farthest tip, and `before` the length from the start of the chain to the upper long bone; both are
    divided by the length of the long bones together. `ratio` and `end` each consist of a usual value and the spread of
    its logarithm; `before` is an upper limit.
    """

    ratio: tuple[float, float]  # upper divided by lower long bone
    end: tuple[float, float]  # what follows, to the tip of toes or fingers, by both long bones
    before: float  # most that precedes the long bones, by their length


LEG = Build(ratio=(1.02, 0.15), end=(0.27, 0.5), before=0.35)
ARM = Build(ratio=(1.12, 0.25), end=(0.32, 0.4), before=0.6)
ARM_BY_LEG = (0.62, 0.2)
TRUNK_BY_LEG = (0.42, 0.45)
# Limits of the length of an arm divided by the length of a leg; other pairs are not arms and legs.
ARM_BY_LEG_LIMITS = (0.3, 1.2)


@dataclass(frozen=True)
class LimbReading:
    """Interpretation of a pair of chains as arms or legs, with a score.

    `places` are three indices into each chain: of hip, knee and ankle, or of shoulder, elbow and wrist.
    """

    pair: LimbPair
    places: tuple[int, int, int]
    length: float
    score: float

    @property
    def triple(self) -> tuple[int, int, int]:
        """Joint indices of hip, knee and ankle (or of shoulder, elbow and wrist) of the first of the two limbs."""
        a, b, c = (self.pair.limbs[0].chain[place] for place in self.places)
        return a, b, c

    def joint(self, side: int, place: int) -> int | None:
        """Find a joint of the limb.

        Parameters
        ----------
        side : int    0 for the first limb of the pair, 1 for the second
        place : int    0 to 3 for hip, knee, ankle and toe, or their counterparts in an arm; -1 for the joint before
            the hip or shoulder

        Returns
        -------
        int or None    index of the joint; None if the chain has no joint there
        """
        chain = self.pair.limbs[side].chain
        at = {-1: self.places[0] - 1, 3: self.places[2] + 1}.get(place)
        at = self.places[place] if at is None else at
        return chain[at] if 0 <= at < len(chain) else None


@dataclass(frozen=True)
class BodyPlan:
    """Legs and arms, and a score of how common their proportions are; for most people, the score is at least 0."""

    legs: LimbReading
    arms: LimbReading
    score: float


def body_plans(tree: BoneTree) -> list[BodyPlan]:
    """List the pairs of limbs that may be legs and arms.

    Parameters
    ----------
    tree : BoneTree    branching and lengths of the skeleton

    Returns
    -------
    list of BodyPlan    the likeliest first
    """
    pairs = sorted(tree.limb_pairs, key=lambda pair: -sum(pair.bones))[:MOST_PAIRS]
    legs = {pair: _readings(tree, pair, LEG) for pair in pairs}
    arms = {pair: _readings(tree, pair, ARM) for pair in pairs}
    longest = max((reading.length for readings in legs.values() for reading in readings), default=0.0)
    plans = []
    # The relation of two pairs is computed once for all their interpretations: a rig may be thousands of joints deep.
    for above, below in ((a, b) for a in pairs for b in pairs if tree.are_apart(b, a)):
        trunk = tree.distance(below.parent, above.parent)
        for leg, arm in product(legs[below], arms[above]):
            if ARM_BY_LEG_LIMITS[0] < arm.length / leg.length < ARM_BY_LEG_LIMITS[1]:
                together = _score_together(tree, leg, arm, trunk) + SHORTER * log(longest / leg.length)
                plans.append(BodyPlan(leg, arm, leg.score + arm.score + together))
    return sorted(plans, key=lambda plan: -plan.score)


def _readings(tree: BoneTree, pair: LimbPair, build: Build) -> list[LimbReading]:
    count = min(len(pair.limbs[0].chain), LONGEST_CHAIN)
    found = [
        LimbReading(pair, (a, b, c), sum(pair.bones[a:c]), _score(tree, pair, (a, b, c), build))
        for a, b, c in combinations(range(count), 3)
        if min(pair.bones[b - 1], pair.bones[c - 1]) > SHORTEST_BONE_M and sum(pair.bones[a:b]) > SHORTEST_BONE_M
    ]
    return sorted(found, key=_likeliest_first)[:MOST_READINGS]


def _likeliest_first(reading: LimbReading) -> tuple[float, int, int, int]:
    """Make a sort key: interpretations of limbs by falling score, and interpretations of equal score by their joints.

    Of several joints at the same position, the one farthest down the chain is preferred as hip, knee, shoulder or
    elbow, and the one nearest to the root as ankle or wrist.
    """
    a, b, c = reading.places
    return -round(reading.score, 6), -a, -b, c


def _score(tree: BoneTree, pair: LimbPair, places: tuple[int, int, int], build: Build) -> float:
    a, b, c = places
    upper, lower, end = (sum(pair.bones[start:stop]) for start, stop in ((a, b), (b, c), (c, len(pair.bones))))
    length = upper + lower
    score = commonness(upper / lower, build.ratio)
    score += max(commonness(end / length, build.end), SHORT_END if end < build.end[0] * length else LEAST_SCORE)
    before = [bone for bone in pair.bones[:a] if bone > SHORTEST_BONE_M]
    score -= 0.5 * (max(0.0, sum(before) / length - build.before) / 0.2) ** 2
    score += EXTRA_JOINT * max(0, len(before) - 1)
    score += sum(_score_of_joints_between(tree, pair, *span) for span in ((a, b), (b, c)))
    if build is ARM:
        score += FINGERS.get(min(len(tree.skeleton.children[limb.chain[c]]) for limb in pair.limbs), 1.0)
    return max(score, 3 * LEAST_SCORE)


def _score_of_joints_between(tree: BoneTree, pair: LimbPair, start: int, stop: int) -> float:
    """Score the extra joints between the ends of a long bone: 0 without such joints, otherwise negative.

    Each joint lowers the score: by the least amount if the joints divide a straight bone evenly, as twist joints do, by
    more if they divide a straight bone unevenly, and by the most if they bend the bone. Joints at the position of their
    parent are not counted.
    """
    count = sum(bone > SHORTEST_BONE_M for bone in pair.bones[start:stop]) - 1
    if count < 1:
        return 0.0
    chain = pair.limbs[0].chain
    positions = tree.skeleton.rest_global_positions
    direct = float(np.linalg.norm(positions[chain[stop]] - positions[chain[start]]))
    if direct < STRAIGHT * sum(pair.limbs[0].bones[start:stop]):
        return count * BENT_JOINT
    parts = [bone for bone in pair.bones[start:stop] if bone > SHORTEST_BONE_M]
    return count * (TWIST_JOINT if max(parts) - min(parts) < EVENNESS * sum(parts) else STRAIGHT_JOINT)


def _score_together(tree: BoneTree, legs: LimbReading, arms: LimbReading, trunk: float) -> float:
    score = commonness(arms.length / legs.length, ARM_BY_LEG) + commonness(trunk / legs.length, TRUNK_BY_LEG)
    positions = tree.skeleton.rest_global_positions
    up = unit(positions[arms.pair.parent] - positions[legs.pair.parent])
    down = [unit(end - start) for start, end in _ends(positions, legs)]
    return score + AGAINST_TRUNK * float(np.mean([1.0 + way @ up for way in down]))


def _ends(positions: Floats, legs: LimbReading) -> Iterator[tuple[Floats, Floats]]:
    for limb in legs.pair.limbs:
        yield positions[limb.chain[legs.places[0]]], positions[limb.chain[legs.places[2]]]


def unit(vector: Floats) -> Floats:
    """Scale a vector to length 1.

    Parameters
    ----------
    vector : (3,) float64    metres

    Returns
    -------
    (3,) float64    zero for vectors shorter than `SHORTEST_BONE_M`
    """
    length = float(np.linalg.norm(vector))
    return vector / length if length > SHORTEST_BONE_M else np.zeros(3)


def commonness(value: float, usual: tuple[float, float]) -> float:
    """Score a proportion by how common it is among people.

    Parameters
    ----------
    value : float    the proportion
    usual : (float, float)    usual value of the proportion, and the spread of the value's logarithm

    Returns
    -------
    float    0 for the usual value, negative for other values, at least `LEAST_SCORE`
    """
    expected, spread = usual
    if value <= 0.0:
        return LEAST_SCORE
    return max(LEAST_SCORE, -0.5 * (log(value / expected) / spread) ** 2)
