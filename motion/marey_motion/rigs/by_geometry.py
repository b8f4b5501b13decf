"""Recognition of legs, arms and head in a skeleton whose joint names contain no information.

Only lengths and branching are used where possible, because the rest pose of many files is not the pose of a body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.rigs.body_plans import SHORTEST_BONE_M, BodyPlan, LimbReading, body_plans, commonness, unit
from marey_motion.rigs.limbs import BoneTree
from marey_motion.rigs.names import parse_name
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import Skeleton

# Branches that reach less far than this share of the reach of their largest sibling are aids of the rig.
SMALL_BRANCH = 0.3
# Distance from the branch of the arms to the head's joint, divided by the length of a leg: usual value and spread.
NECK_BY_LEG = (0.25, 0.6)
# Score if there is no neck, and lowest score of a neck.
NO_NECK = -2.5
# Branches whose lengths differ by less than this share are the left and right of a pair.
TWIN = 0.02
# Greatest number of interpretations of the body for which a neck is looked for.
MOST_PLANS = 30
# Cosine of the sharpest bend within a neck.
HAIR_TURN = 0.75
# Factors of the confidence where the sides are distinguished by the rest pose, or guessed.
SIDES_UNNAMED, SIDES_GUESSED = 0.8, 0.7
KNOWN_BY_REST_POSE = "were distinguished by the rest pose alone"
GUESSED = "are a guess: no foot shows the direction the body faces, so left was taken for +x; check before use"
# Interpretations whose score is lower by less than `CLOSE` are as likely; `DOUBTED` is then a factor of the confidence.
CLOSE, DOUBTED = 0.3, 0.6


@dataclass(frozen=True)
class GeometryMatch:
    """Standard joints found by geometry.

    Parameters
    ----------
    joints : dict of str to int    index by standard name
    confidence : float    0 to 1
    notes : tuple of str    assumptions, as sentences for people
    """

    joints: dict[str, int]
    confidence: float
    notes: tuple[str, ...]


def find_body(skeleton: Skeleton) -> GeometryMatch | None:
    """Find legs, arms and head by symmetry, branching and lengths.

    Parameters
    ----------
    skeleton : Skeleton    joints with any names

    Returns
    -------
    GeometryMatch or None    None if there are not two pairs of limbs
    """
    tree = BoneTree(skeleton)
    plans = body_plans(tree)
    if not plans:
        return None
    # A neck costs more to look for than limbs do.
    necks = [_neck(tree, plan) for plan in plans[:MOST_PLANS]]
    scores = [plan.score + score for plan, (score, _) in zip(plans, necks, strict=False)]
    best = int(np.argmax(scores))
    plan, (_, neck_and_head) = plans[best], necks[best]
    legs, arms = plan.legs, plan.arms
    joints = {"pelvis": tree.common_ancestor(legs.pair.parent, arms.pair.parent)}
    if neck_and_head:
        joints |= {"head": neck_and_head[-1]} | ({"neck": neck_and_head[0]} if len(neck_and_head) > 1 else {})
    confidence = (0.7 if neck_and_head else 0.5) * (1.0 - max(legs.pair.asymmetry, arms.pair.asymmetry))
    left = _left_direction(skeleton, legs, joints)
    notes = ["the names are not known: joints were found by symmetry, branching and bone lengths"]
    for reading, names in ((legs, ("hip", "knee", "ankle", "toe")), (arms, ("shoulder", "elbow", "wrist", "clavicle"))):
        sides, by_name = _left_and_right(skeleton, reading, np.array((1.0, 0.0, 0.0)) if left is None else left)
        if not by_name:
            confidence *= SIDES_GUESSED if left is None else SIDES_UNNAMED
            origin = GUESSED if left is None else KNOWN_BY_REST_POSE
            notes.append(f"left and right of {names[0]} to {names[2]} {origin}")
        for side, limb in zip(SIDES, sides, strict=True):
            places = (*range(3), -1 if reading is arms else 3)
            named = {f"{side}_{name}": reading.joint(limb, place) for name, place in zip(names, places, strict=True)}
            joints |= {name: index for name, index in named.items() if index is not None}
    rivals = [one for one, score in zip(plans, scores, strict=False) if score > scores[best] - CLOSE]
    doubts = _doubts(skeleton, plan, rivals)
    return GeometryMatch(joints, confidence * (DOUBTED if doubts else 1.0), (*notes, *doubts))


def _doubts(skeleton: Skeleton, plan: BodyPlan, rivals: list[BodyPlan]) -> tuple[str, ...]:
    """Describe other chains that may be the legs or arms, one sentence each.

    `rivals` are interpretations of the body whose proportions are nearly as common as those of `plan`.
    """
    doubts = []
    for limb, joints, reading, others in (
        ("legs", "hip, knee and ankle", plan.legs, [one.legs for one in rivals]),
        ("arms", "shoulder, elbow and wrist", plan.arms, [one.arms for one in rivals]),
    ):
        other = next((one for one in others if one.triple != reading.triple), None)
        if other is not None:
            names = [", ".join(skeleton.display_names[joint] for joint in one.triple) for one in (reading, other)]
            doubts.append(f"{limb} are doubtful: {names[1]} may be {joints} as well as {names[0]}; check before use")
    return tuple(doubts)


def _neck(tree: BoneTree, plan: BodyPlan) -> tuple[float, list[int]]:
    """Find the chain of joints from neck to head, which starts where the arms branch off.

    Returns a score of how common the proportions of the chain are, then the chain, which is empty if none is found.
    """
    skeleton, arms, legs = tree.skeleton, plan.arms.pair, plan.legs.pair
    limbs = {limb.chain[0] for limb in arms.limbs} | set(skeleton.path_to_root(legs.parent))
    chains = [_neck_chain(tree, joint) for joint in skeleton.children[arms.parent] if joint not in limbs]
    found = [(_looks_like_neck(tree, plan, chain), chain) for chain in chains]
    score, chain = max(found, key=lambda one: one[0], default=(NO_NECK, []))
    return max(score, NO_NECK), chain


def _neck_chain(tree: BoneTree, start: int) -> list[int]:
    """List joints from `start` up to where the chain branches, ends, or bends sharply, as hair behind a head does."""
    skeleton = tree.skeleton
    chain = [start]
    while len(following := _branches(tree, chain[-1])) == 1 and tree.lengths[following[0]] > SHORTEST_BONE_M:
        if len(chain) > 1 and _turn(skeleton, chain[-2], chain[-1], following[0]) < HAIR_TURN:
            break
        chain.append(following[0])
    # From the head's joint to its top is farther than from the neck's to the head's.
    if len(chain) > 2 and tree.reach[chain[-1]] == 0.0 and tree.lengths[chain[-1]] > 1.2 * tree.lengths[chain[-2]]:
        chain.pop()
    return chain


def _looks_like_neck(tree: BoneTree, plan: BodyPlan, chain: list[int]) -> float:
    """Score a chain as a neck by its length and direction; a sibling chain of equal length lowers the score."""
    positions = tree.skeleton.rest_global_positions
    parent = plan.arms.pair.parent
    length = float(np.sum(tree.lengths[chain]))
    up = unit(positions[parent] - positions[plan.legs.pair.parent])
    score = commonness(length / plan.legs.length, NECK_BY_LEG) + float(
        up @ unit(positions[chain[-1]] - positions[parent])
    )
    extents = [tree.extent(joint) for joint in tree.skeleton.children[parent] if joint != chain[0]]
    has_twin = any(abs(extent - tree.extent(chain[0])) < TWIN * extent for extent in extents)
    return score + (NO_NECK if has_twin else 0.0)


def _turn(skeleton: Skeleton, a: int, b: int, c: int) -> float:
    """Compute the cosine of the angle, in the rest pose, between the bones from `a` to `b` and from `b` to `c`."""
    positions = skeleton.rest_global_positions
    return float(unit(positions[b] - positions[a]) @ unit(positions[c] - positions[b]))


def _branches(tree: BoneTree, joint: int) -> list[int]:
    """Return the children of a joint, without those whose chains are short compared with the longest one."""
    extents = {child: tree.extent(child) for child in tree.skeleton.children[joint]}
    return [child for child, extent in extents.items() if extent >= SMALL_BRANCH * max(extents.values())]


def _left_direction(skeleton: Skeleton, legs: LimbReading, joints: dict[str, int]) -> Floats | None:
    """Compute the direction (3,) to the body's left in the rest pose: the cross product of up and forward.

    Up points from the pelvis to the head, and forward from the ankles to the toes or the tips of the feet. Returns None
    if up or forward is zero, or if they are nearly parallel.
    """
    positions = skeleton.rest_global_positions
    up = positions[joints.get("head", joints["pelvis"])] - positions[joints["pelvis"]]
    forward = sum((_foot(skeleton, legs.joint(side, 2), legs.joint(side, 3)) for side in range(2)), start=np.zeros(3))
    left: Floats = np.cross(up, forward)
    scale = float(np.linalg.norm(up) * np.linalg.norm(forward))
    return left if np.linalg.norm(left) > 0.2 * scale > 0.0 else None


def _foot(skeleton: Skeleton, ankle: int | None, toe: int | None) -> Floats:
    """Compute the vector (3,), in the rest pose, from an ankle to the toe joint or, without one, to the foot's tip.

    The vector is zero if the skeleton has neither a toe joint nor a tip.
    """
    if ankle is not None and toe is not None:
        way: Floats = skeleton.rest_global_positions[toe] - skeleton.rest_global_positions[ankle]
        return way
    tips = [site.offset for site in skeleton.end_sites if site.joint == ankle]
    if ankle is None or not tips:
        return np.zeros(3)
    return np.asarray(quaternions.rotate_vectors(skeleton.rest_global_rotations[ankle], tips[0]), dtype=np.float64)


def _left_and_right(skeleton: Skeleton, reading: LimbReading, left: Floats) -> tuple[tuple[int, int], bool]:
    """Return the indices of the left and of the right limb in a pair, and whether the joint names show the sides.

    `left` is the direction to the left of the body.
    """
    first, second = reading.pair.limbs
    sides = [
        {parse_name(skeleton.display_names[joint]).side for joint in limb.chain} - {""} for limb in (first, second)
    ]
    if sides in ([{"left"}, {"right"}], [{"right"}, {"left"}]):
        return ((0, 1) if sides[0] == {"left"} else (1, 0)), True
    positions = skeleton.rest_global_positions
    across = positions[first.chain[reading.places[0]]] - positions[second.chain[reading.places[0]]]
    return ((0, 1) if across @ left >= 0.0 else (1, 0)), False
