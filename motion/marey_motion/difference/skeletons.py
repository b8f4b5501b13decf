"""Differences between skeletons and between joint mappings.

Joints can be added, removed, renamed, or changed in the rest pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import CM_PER_M
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.differences import MappedJoint, MappingDifference, RestChange, SkeletonDifference
from marey_schemas.documents.skeletons import SkeletonMapping

RENAMED_WITHIN_CM = 0.1
"""Greatest distance, in centimetres, between the offsets of two joints that are paired as one renamed joint."""
NOISE_CM = 1e-3
NOISE_DEG = 1e-3


class JointPairs(NamedTuple):
    """Joints that two skeletons have in common.

    Parameters
    ----------
    before, after : tuple of int    indices of the same joints in both skeletons
    renamed : tuple of pairs of str    names of each renamed joint, before and after
    """

    before: tuple[int, ...]
    after: tuple[int, ...]
    renamed: tuple[tuple[str, str], ...]


def pair_joints(before: Skeleton, after: Skeleton) -> JointPairs:
    """Pair the joints that two skeletons have in common.

    Joints of the same name are paired. Two of the remaining joints are paired as renamed if they have the same parent
    and nearly the same offset, and if neither of the two has another possible partner.

    Parameters
    ----------
    before, after : Skeleton    skeletons of any number of joints

    Returns
    -------
    JointPairs    pairs in the order of the skeleton `after`
    """
    places = {name: joint for joint, name in enumerate(before.joint_names)}
    kept = set(before.joint_names) & set(after.joint_names)
    found: dict[int, int] = {}  # joint before, by joint after
    for joint, name in enumerate(after.joint_names):
        if name in kept:
            found[joint] = places[name]
        elif (other := _renamed_from(before, after, joint, found, kept)) is not None:
            found[joint] = other
    pairs = sorted(found.items())
    names = ((before.joint_names[old], after.joint_names[new]) for new, old in pairs)
    renamed = tuple((old, new) for old, new in names if old != new)
    return JointPairs(tuple(old for _, old in pairs), tuple(new for new, _ in pairs), renamed)


def _renamed_from(
    before: Skeleton, after: Skeleton, joint: int, found: Mapping[int, int], kept: set[str]
) -> int | None:
    """Return the only joint of `before` that may have been renamed to joint `joint` of `after`, or None.

    `found` maps joints of `after` to the joints of `before` that are paired already; `kept` are the names that both
    skeletons have.
    """
    parent = int(after.parents[joint])
    if parent >= 0 and parent not in found:
        return None
    parent_before = -1 if parent < 0 else found[parent]
    taken = set(found.values())

    def fits(skeleton: Skeleton, own_parent: int, other: int) -> bool:
        near = CM_PER_M * np.linalg.norm(skeleton.offsets[other] - after.offsets[joint]) <= RENAMED_WITHIN_CM
        return int(skeleton.parents[other]) == own_parent and skeleton.joint_names[other] not in kept and bool(near)

    candidates = [
        other for other in range(before.joint_count) if other not in taken and fits(before, parent_before, other)
    ]
    rivals = [other for other in range(after.joint_count) if fits(after, parent, other)]
    return candidates[0] if len(candidates) == 1 and len(rivals) == 1 else None


def compare_skeletons(before: Skeleton, after: Skeleton) -> SkeletonDifference | None:
    """Describe the differences between two skeletons.

    Parameters
    ----------
    before, after : Skeleton    the skeletons

    Returns
    -------
    SkeletonDifference or None    None if names, order, parents, rest poses and end sites are equal
    """
    pairs = pair_joints(before, after)
    changes = tuple(_rest_changes(before, after, pairs))
    sites = [[(one.joint, *one.offset.tolist()) for one in skeleton.end_sites] for skeleton in (before, after)]
    found = SkeletonDifference(
        joint_count=(before.joint_count, after.joint_count),
        added=_names_without(after, pairs.after),
        removed=_names_without(before, pairs.before),
        renamed=pairs.renamed,
        joints=changes,
        reordered=list(pairs.before) != sorted(pairs.before),
        end_sites_changed=sites[0] != sites[1],
    )
    nothing = SkeletonDifference(joint_count=(before.joint_count, after.joint_count))
    return None if found == nothing else found


def _names_without(skeleton: Skeleton, paired: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(name for joint, name in enumerate(skeleton.joint_names) if joint not in paired)


def _rest_changes(before: Skeleton, after: Skeleton, pairs: JointPairs) -> list[RestChange]:
    old, new = list(pairs.before), list(pairs.after)
    offsets = CM_PER_M * np.linalg.norm(after.offsets[new] - before.offsets[old], axis=1)
    angles = np.degrees(quaternions.angle_between(before.rest_rotations[old], after.rest_rotations[new]))
    counterpart = dict(zip(old, new, strict=True))
    changes = []
    for place, (first, second) in enumerate(zip(old, new, strict=True)):
        parent = int(before.parents[first])
        moved = (-1 if parent < 0 else counterpart.get(parent)) != int(after.parents[second])
        offset, angle = float(offsets[place]), float(angles[place])
        if moved or offset > NOISE_CM or angle > NOISE_DEG:
            changes.append(
                RestChange(
                    joint=after.joint_names[second],
                    parent=(_parent_name(before, first), _parent_name(after, second)) if moved else None,
                    offset_cm=offset if offset > NOISE_CM else 0.0,
                    rotation_deg=angle if angle > NOISE_DEG else 0.0,
                )
            )
    return changes


def _parent_name(skeleton: Skeleton, joint: int) -> str | None:
    parent = int(skeleton.parents[joint])
    return None if parent < 0 else skeleton.joint_names[parent]


def compare_mappings(before: SkeletonMapping, after: SkeletonMapping) -> MappingDifference:
    """Describe the differences between two joint mappings.

    Parameters
    ----------
    before, after : SkeletonMapping    the two documents

    Returns
    -------
    MappingDifference    standard joints that are mapped to different joints, and joints whose axes differ
    """
    standards = dict.fromkeys((*before.joints, *after.joints))
    joints = ((name, before.joints.get(name), after.joints.get(name)) for name in standards)
    axes = dict.fromkeys((*before.axes, *after.axes))
    return MappingDifference(
        joints=tuple(MappedJoint(standard=name, before=old, after=new) for name, old, new in joints if old != new),
        axes=tuple(name for name in axes if before.axes.get(name) != after.axes.get(name)),
    )
