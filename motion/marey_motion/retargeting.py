"""Retargeting: transfer of the motion of one skeleton to another, with any rest poses, proportions and local axes.

Both skeletons give each joint two axes in its own frame: twist along the bone and swing across it (`rigs.guess_axes`).
A target joint gets the global orientation in which its two axes coincide with the two axes of the source joint with the
same standard name (Herrmann et al. 2019, Algorithm 1, after Monzani et al. 2000).

The paper rotates twist onto twist, then swing onto swing, for every pose. As both axes are fixed in their joints, this
is the same as one constant rotation per joint: with the axes of source and target as the columns of orthonormal
matrices S and T, the target's global orientation is G·S·Tᵀ if the source's global orientation is G. This module differs
from the printed algorithm in two ways. Here, the second rotation turns only about the twist axis, so it does not undo
the first rotation. And the second rotation is applied after the first one, whereas line 12 of the printed algorithm has
the opposite order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.errors import ClipError, MappingError
from marey_motion.moved_bones import FollowedBones, follow_moved_bones
from marey_motion.rigs import ESSENTIAL_JOINTS, STANDARD_JOINTS, JointAxes, JointMapping
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import SAME_SKELETON_M, Skeleton, same_hierarchy

FEWEST_ESSENTIAL = 8  # of the essential joints: a pelvis, and more than the legs or the arms alone
SAME_RAD = 1e-6  # by which axes may differ that went through a document
SAME_DIRECTION = 0.94  # cosine of about 20 degrees: bones of one rig on two people differ by less
STANDING = 0.7  # cosine between legs and trunk from which a rest pose is taken for one that stands
FOOT_DROP = 0.45  # of the ankle-to-toe length: the height of the ankle above the toe of a foot that stands


@dataclass(frozen=True)
class JointPair:
    """A standard joint that both skeletons have.

    Parameters
    ----------
    standard : str    its standard name
    source, target : str    its names in the two skeletons
    """

    standard: str
    source: str
    target: str


@dataclass(frozen=True, eq=False)
class RetargetPlan:
    """Everything that retargeting needs besides the clip; made by `plan_retarget`.

    Parameters
    ----------
    source, target : Skeleton    the skeletons
    scale : float    metres that the target's pelvis moves per metre that the source's pelvis moves
    pairs : tuple of JointPair    joints that follow the source
    carried : tuple of str    target joints outside the mapping that copy the local rotation of the source joint with
        the same name, because both skeletons are copies of one rig
    at_rest : tuple of str    target joints that are neither paired nor carried; they keep their rest rotation
    missing : tuple of str    standard joints that only one of the skeletons has
    sources : (K,) int32    source joint that each of the K target joints follows, -1 for none
    corrections : (K, 4) float64    constant rotation of each mapped joint as (w, x, y, z), identity for the other
        joints; the target's global orientation is the source's global orientation times this rotation

    Examples
    --------
    >>> from marey_motion import game_skeleton, guess_axes, map_joints, plan_retarget, studio_skeleton
    >>> source, target = studio_skeleton(), game_skeleton()
    >>> joints = map_joints(source), map_joints(target)
    >>> axes = guess_axes(source, joints[0]), guess_axes(target, joints[1])
    >>> plan = plan_retarget(source, joints[0], axes[0], target, joints[1], axes[1])
    >>> len(plan.pairs), plan.pairs[0]
    (26, JointPair(standard='pelvis', source='Hips', target='pelvis'))
    >>> plan.changes_no_pose
    False
    """

    source: Skeleton
    target: Skeleton
    scale: float
    pairs: tuple[JointPair, ...]
    carried: tuple[str, ...]
    at_rest: tuple[str, ...]
    missing: tuple[str, ...]
    sources: NDArray[np.int32]
    corrections: NDArray[np.float64]

    @cached_property
    def changes_no_pose(self) -> bool:
        """True if both skeletons are the same and no correction turns a joint."""
        turned = quaternions.angle_between(self.corrections, quaternions.identity(len(self.corrections)))
        return same_hierarchy(self.source, self.target, tolerance_m=SAME_SKELETON_M) and bool(np.all(turned < SAME_RAD))


def plan_retarget(
    source: Skeleton,
    source_mapping: JointMapping,
    source_axes: Mapping[str, JointAxes],
    target: Skeleton,
    target_mapping: JointMapping,
    target_axes: Mapping[str, JointAxes],
    *,
    scale: float | None = None,
) -> RetargetPlan:
    """Pair the joints of two skeletons and compute their corrections and the scale of travel.

    Parameters
    ----------
    source : Skeleton    the skeleton that clips come from
    source_mapping : JointMapping    its standard joints
    source_axes : mapping of str to JointAxes    twist and swing axes of the source by joint name, at least of the
        mapped joints
    target : Skeleton    the skeleton to which clips are transferred
    target_mapping : JointMapping    its standard joints
    target_axes : mapping of str to JointAxes    twist and swing axes of the target, like `source_axes`
    scale : float, optional    metres that the target's pelvis moves per metre that the source's pelvis moves; the ratio
        of the hip heights if None

    Returns
    -------
    RetargetPlan    input of `retarget`

    Raises
    ------
    MappingError    if too few joints are mapped, if the axes of a mapped joint are missing or parallel, or if the scale
        is invalid or cannot be computed
    UnknownJoint    if a mapping names a joint that its skeleton does not have

    Examples
    --------
    >>> from marey_motion import game_skeleton, guess_axes, map_joints, plan_retarget, studio_skeleton
    >>> source, target = studio_skeleton(), game_skeleton()
    >>> joints = map_joints(source), map_joints(target)
    >>> axes = guess_axes(source, joints[0]), guess_axes(target, joints[1])
    >>> round(plan_retarget(source, joints[0], axes[0], target, joints[1], axes[1]).scale, 2)
    1.11
    """
    pairs = _paired(source, source_mapping, target, target_mapping)
    _check_enough(pairs, source_mapping, target_mapping)
    sources = np.full(target.joint_count, -1, dtype=np.int32)
    corrections = quaternions.identity(target.joint_count).astype(np.float64)
    for pair in pairs:
        joint = target.index_of(pair.target)
        sources[joint] = source.index_of(pair.source)
        axes = _axes_of(source_axes, pair.source, "source"), _axes_of(target_axes, pair.target, "target")
        corrections[joint] = quaternions.from_matrix(axes[0] @ axes[1].T)
    if scale is None:
        scale = _hip_height_ratio(pairs, source, source_axes, target, target_axes)
    if not (np.isfinite(scale) and scale > 0):
        raise MappingError(f"the scale must be a positive number, not {scale}", code="scale-invalid", where="scale")
    followed = {pair.target for pair in pairs}
    others = tuple(name for name in target.joint_names if name not in followed)
    same_rig = _are_same_rig(source, target)
    unshared = source_mapping.joints.keys() ^ target_mapping.joints.keys()
    return RetargetPlan(
        source,
        target,
        float(scale),
        pairs,
        carried=others if same_rig else (),
        at_rest=() if same_rig else others,
        missing=tuple(name for name in STANDARD_JOINTS if name in unshared),
        sources=sources,
        corrections=corrections,
    )


def retarget(clip: Clip, plan: RetargetPlan, bones: FollowedBones | None = None) -> Clip:
    """Retarget a clip to the plan's target skeleton.

    A mapped joint takes the orientation of its source joint. Any other joint keeps its rest rotation or, if both
    skeletons are copies of one rig, copies the local rotation of the source joint with the same name. Bones keep the
    lengths of the target. If the clip translates joints, the target's bones point in the directions of the clip's
    translated bones; if the target is the source skeleton itself, the clip keeps its translations. The path of the
    pelvis is the source's path times the plan's scale; a root above the pelvis moves with the pelvis without turning.

    Parameters
    ----------
    clip : Clip    motion of the plan's source skeleton
    plan : RetargetPlan    result of `plan_retarget`
    bones : FollowedBones, optional    result of `moved_bones`, if already computed

    Returns
    -------
    Clip    the motion of the target skeleton, at the same frame rate

    Raises
    ------
    ClipError    if the clip's skeleton differs from the plan's source skeleton

    Examples
    --------
    >>> from marey_motion import game_skeleton, generate_gait, guess_axes, map_joints, plan_retarget, retarget
    >>> clip, target = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0), game_skeleton()
    >>> joints = map_joints(clip.skeleton), map_joints(target)
    >>> axes = guess_axes(clip.skeleton, joints[0]), guess_axes(target, joints[1])
    >>> result = retarget(clip, plan_retarget(clip.skeleton, joints[0], axes[0], target, joints[1], axes[1]))
    >>> result.skeleton is target, result.poses.shape
    (True, (120, 159))
    """
    from marey_motion import retargeting_kernels as kernels

    if not same_hierarchy(clip.skeleton, plan.source, tolerance_m=SAME_SKELETON_M):
        raise ClipError(
            "the clip has a different skeleton from the source skeleton of the retargeting plan", where="skeleton"
        )
    target = plan.target
    ways = np.where(plan.sources >= 0, kernels.MAPPED, kernels.AT_REST).astype(np.int8)
    sources = plan.sources.copy()
    for name in plan.carried:
        joint = target.index_of(name)
        ways[joint], sources[joint] = kernels.CARRIED, joint
    poses = np.empty((clip.frame_count, 3 + 4 * target.joint_count), dtype=np.float32)
    kernels.rotations(
        (bones or moved_bones(clip, plan)).rotations,
        plan.source.parents,
        ways,
        sources,
        plan.corrections,
        target.rest_rotations,
        target.parents,
        poses[:, 3:],
    )
    rotations = poses[:, 3:].reshape(clip.frame_count, -1, 4)
    translations, joints = (clip.translations, clip.translated_joints) if plan.changes_no_pose else (None, ())
    pelvis = next(pair for pair in plan.pairs if pair.standard == "pelvis")
    travel = plan.scale * _position_in_world(clip, clip.skeleton.index_of(pelvis.source))
    poses[:, :3] = travel - _position_from_root(
        target, rotations, target.index_of(pelvis.target), _offsets_by_joint(translations, joints)
    )
    return Clip(target, clip.frame_rate_hz, poses, translations, joints)


def moved_bones(clip: Clip, plan: RetargetPlan) -> FollowedBones:
    """Correct the rotations of a clip so that bones keep their directions when the clip's translations are removed.

    Parameters
    ----------
    clip : Clip    motion of the plan's source skeleton
    plan : RetargetPlan    result of `plan_retarget`

    Returns
    -------
    FollowedBones    rotations (F, 4·J) float32, and the largest turn of each joint in degrees
    """
    if plan.changes_no_pose:
        return FollowedBones(clip.poses[:, 3:], {})
    return follow_moved_bones(clip, {pair.standard: clip.skeleton.index_of(pair.source) for pair in plan.pairs})


def _paired(
    source: Skeleton, source_mapping: JointMapping, target: Skeleton, target_mapping: JointMapping
) -> tuple[JointPair, ...]:
    """Pair joints of the two skeletons that have the same standard name; each target joint is in at most one pair.

    The standard joint `root` is not paired: a root that is not also the pelvis is a point on the floor, and no bone
    defines its axes.
    """
    for skeleton, mapping in ((source, source_mapping), (target, target_mapping)):
        for name in mapping.joints.values():
            skeleton.index_of(name)
    pairs: dict[str, JointPair] = {}
    for standard in STANDARD_JOINTS:
        if standard != "root" and standard in source_mapping.joints and standard in target_mapping.joints:
            pair = JointPair(standard, source_mapping.joints[standard], target_mapping.joints[standard])
            pairs.setdefault(pair.target, pair)
    return tuple(pairs.values())


def _check_enough(pairs: tuple[JointPair, ...], source_mapping: JointMapping, target_mapping: JointMapping) -> None:
    found = {pair.standard for pair in pairs} & set(ESSENTIAL_JOINTS)
    if "pelvis" in found and len(found) >= FEWEST_ESSENTIAL:
        return
    lacks = []
    for which, mapping in (("source", source_mapping), ("target", target_mapping)):
        missing = [name for name in ESSENTIAL_JOINTS if name not in mapping.joints]
        if missing:
            lacks.append(f"the {which} skeleton's mapping has no {', '.join(missing)}")
    raise MappingError(
        f"too few joints are mapped to retarget: {'; '.join(lacks)}. Add them to the joint mappings; both "
        f"skeletons must map the pelvis and at least {FEWEST_ESSENTIAL - 1} of the other essential joints",
        code="mapping-too-small",
        where="mapping",
    )


def _axes_of(axes: Mapping[str, JointAxes], joint: str, which: str) -> NDArray[np.float64]:
    """Make the orthonormal matrix (3, 3) of twist, swing and their cross product as columns, in the joint's frame."""
    if joint not in axes:
        raise MappingError(
            f"the {which} skeleton has no twist and swing axes for this joint; define both axes", where=joint
        )
    twist, swing = np.array(axes[joint].twist), np.array(axes[joint].swing)
    cross = np.cross(twist, swing)
    if not np.linalg.norm(cross) > 1e-6 * np.linalg.norm(twist) * np.linalg.norm(swing):
        raise MappingError(
            f"the twist axis {axes[joint].twist} and the swing axis {axes[joint].swing} of this joint of the {which} "
            "skeleton must not be zero and must not be parallel",
            where=joint,
        )
    columns = (twist, np.cross(cross, twist), cross)
    return np.stack([column / np.linalg.norm(column) for column in columns], axis=-1)


def _hip_height_ratio(
    pairs: tuple[JointPair, ...],
    source: Skeleton,
    source_axes: Mapping[str, JointAxes],
    target: Skeleton,
    target_axes: Mapping[str, JointAxes],
) -> float:
    """Compute the height of the target's pelvis above its toes, divided by the same height of the source.

    The heights are those of upright bodies, computed as sums of bone lengths, because the rest pose of many files is
    not upright. If a part of the height is known for only one of the skeletons, both sums omit this part.
    """
    parts = []
    for skeleton, axes, which in ((source, source_axes, "source"), (target, target_axes, "target")):
        joints = {pair.standard: skeleton.index_of(getattr(pair, which)) for pair in pairs}
        up = np.array(axes[skeleton.joint_names[joints["pelvis"]]].twist)
        parts.append(np.mean([_heights(skeleton, joints, up, side) for side in SIDES], axis=0))
    known = np.isfinite(parts[0]) & np.isfinite(parts[1])
    heights = [float(np.sum(part[known])) for part in parts]
    if min(heights) <= 0.0:
        raise MappingError(
            "the scale cannot be computed from legs of length zero; set it with --scale or the parameter scale",
            where="left_hip",
        )
    return heights[1] / heights[0]


def _heights(
    skeleton: Skeleton, joints: Mapping[str, int], up: NDArray[np.float64], side: str
) -> tuple[float, float, float]:
    """Measure three heights of a side in metres: pelvis above hip, hip above ankle in a straight leg, ankle above toe.

    `up` is the direction of the trunk in the pelvis' frame. The first and last heights are NaN if they are unknown.
    """
    missing = [f"{side}_{joint}" for joint in ("hip", "knee", "ankle") if f"{side}_{joint}" not in joints]
    if missing:
        raise MappingError(
            "the scale is computed from both legs, but these joints are not mapped in both skeletons: "
            f"{', '.join(missing)}; map them, or set the scale with --scale or the parameter scale",
            where=missing[0],
        )
    positions, pelvis = skeleton.rest_global_positions, joints["pelvis"]
    hip, knee, ankle = (positions[joints[f"{side}_{joint}"]] for joint in ("hip", "knee", "ankle"))
    leg = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
    trunk = quaternions.rotate_vectors(skeleton.rest_global_rotations[pelvis], up / np.linalg.norm(up))
    # Joints between pelvis and hip may be bent in any way at rest, unless that pose stands.
    told = skeleton.parents[joints[f"{side}_hip"]] == pelvis or float((hip - ankle) @ trunk) > STANDING * leg
    drop = float((positions[pelvis] - hip) @ trunk) if told else np.nan
    toe = joints.get(f"{side}_toe")
    foot = np.nan if toe is None else FOOT_DROP * float(np.linalg.norm(positions[toe] - ankle))
    return drop, leg, foot


def _are_same_rig(source: Skeleton, target: Skeleton) -> bool:
    """Return whether both skeletons have equal joint names, hierarchy and rest rotations, and similar bone directions.

    Bone lengths may differ.
    """
    if source.joint_names != target.joint_names or not np.array_equal(source.parents, target.parents):
        return False
    turned = quaternions.angle_between(source.rest_rotations, target.rest_rotations)
    along = np.sum(source.offsets * target.offsets, axis=1)
    lengths = np.linalg.norm(source.offsets, axis=1) * np.linalg.norm(target.offsets, axis=1)
    return bool(np.all(turned < 1e-4) and np.all(along[1:] >= SAME_DIRECTION * lengths[1:]))


def _position_in_world(clip: Clip, joint: int) -> AnyFloats:
    """Compute positions (F, 3) of one joint of a clip, metres."""
    moved = _offsets_by_joint(clip.translations, clip.translated_joints)
    return clip.root_translations + _position_from_root(clip.skeleton, clip.rotations, joint, moved)


def _offsets_by_joint(translations: NDArray[np.float32] | None, joints: tuple[int, ...]) -> dict[int, AnyFloats]:
    """Return the translations (F, 3) of each of `joints`, by joint index; empty if `translations` is None."""
    return {} if translations is None else {joint: translations[:, slot] for slot, joint in enumerate(joints)}


def _position_from_root(
    skeleton: Skeleton, rotations: AnyFloats, joint: int, moved: Mapping[int, AnyFloats] = MappingProxyType({})
) -> AnyFloats:
    """Compute vectors (F, 3) from root to joint in the world; `moved` has the offsets (F, 3) of translated joints."""
    position: AnyFloats = np.zeros((len(rotations), 3))
    for step in skeleton.path_to_root(joint)[:-1]:
        offset = moved.get(step, skeleton.offsets[step])
        rotation = rotations[:, skeleton.parents[step]].astype(np.float64)
        position = quaternions.rotate_vectors(rotation, position + offset)
    return position
