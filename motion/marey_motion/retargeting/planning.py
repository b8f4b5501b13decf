"""Plans for retargeting: pairs of corresponding joints of two skeletons, with the constant rotations between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb, limb_ending_at
from marey_motion.errors import MappingError
from marey_motion.rigs import ESSENTIAL_JOINTS, STANDARD_JOINTS, JointAxes, JointMapping
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import SAME_SKELETON_M, Skeleton, same_hierarchy

FEWEST_ESSENTIAL = 8  # least number of essential joints: a pelvis, and more than the legs or the arms alone
SAME_RAD = 1e-6  # greatest angle between equal axes of which one was stored in a document
SAME_DIRECTION = 0.94  # cosine of about 20 degrees: bones of one rig on two people differ by less
STANDING = 0.7  # least cosine between legs and trunk in a rest pose that stands
FOOT_DROP = 0.45  # height of the ankle above the toe of a standing foot, as a share of the distance from ankle to toe


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
    anchors : tuple of JointPair    the pelvis; or both hips, if the rest poses do not show how far the hips are below
        the pelvis. The middle of these joints travels as in the source, times the scale.
    limbs : mapping of str to TwoBoneLimb    arms and legs of the target by the standard name of wrist or ankle, if all
        three joints of the limb follow the source

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
    anchors: tuple[JointPair, ...]
    limbs: Mapping[str, TwoBoneLimb]

    @cached_property
    def changes_no_pose(self) -> bool:
        """True if both skeletons are the same and no correction turns a joint."""
        turned = quaternions.angle_between(self.corrections, quaternions.identity(len(self.corrections)))
        return same_hierarchy(self.source, self.target, tolerance_m=SAME_SKELETON_M) and bool(np.all(turned < SAME_RAD))

    def both_limbs(self, end: str) -> tuple[TwoBoneLimb, ...]:
        """Find both arms or both legs of the target by their ends.

        Parameters
        ----------
        end : str    "wrist" or "ankle"

        Returns
        -------
        tuple of TwoBoneLimb    left and right

        Raises
        ------
        MappingError    if not all three joints of both limbs are mapped in both skeletons
        """
        missing = [f"{side}_{end}" for side in SIDES if f"{side}_{end}" not in self.limbs]
        if missing:
            start, middle = ("hip", "knee") if end == "ankle" else ("shoulder", "elbow")
            raise MappingError(
                f"to keep {'feet' if end == 'ankle' else 'hands'}, {start}, {middle} and {end} of both sides must be "
                f"mapped in both skeletons; no complete limb ends at {' or '.join(missing)}; map these joints, or "
                "leave the option out",
                code="limbs-not-mapped",
                where=missing[0],
            )
        return tuple(self.limbs[f"{side}_{end}"] for side in SIDES)

    @cached_property
    def source_joints(self) -> dict[str, int]:
        """Indices of the paired joints of the source, by standard name."""
        return {pair.standard: self.source.index_of(pair.source) for pair in self.pairs}

    @cached_property
    def target_joints(self) -> dict[str, int]:
        """Indices of the paired joints of the target, by standard name."""
        return {pair.standard: self.target.index_of(pair.target) for pair in self.pairs}


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
    target_axes : mapping of str to JointAxes    twist and swing axes of the target by joint name, at least of the
        mapped joints
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
    bodies = _upright(pairs, source, source_axes, target, target_axes)
    if scale is None:
        scale = _hip_height_ratio(bodies)
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
        anchors=_anchors(pairs, bodies),
        limbs=_limbs(pairs, target, target_mapping, target_axes),
    )


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
    told = "; ".join(lacks) or "the target skeleton's mapping names one joint for several standard joints"
    raise MappingError(
        f"too few joints are mapped to retarget: {told}. Correct the joint mappings; both "
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


def _hip_height_ratio(bodies: tuple[_Upright, ...]) -> float:
    """Compute the height of the target's pelvis above its toes, divided by the same height of the source.

    The heights are those of upright bodies, computed as sums of bone lengths, because the rest pose of many files is
    not upright. If a part of the height is known for only one of the skeletons, both sums omit this part.
    """
    parts = []
    for skeleton, joints, up in bodies:
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
    trunk = _trunk(skeleton, pelvis, up)
    known = _shows_drop(skeleton, joints, up, side)
    drop = float((positions[pelvis] - hip) @ trunk) if known else np.nan
    toe = joints.get(f"{side}_toe")
    foot = np.nan if toe is None else FOOT_DROP * float(np.linalg.norm(positions[toe] - ankle))
    return drop, leg, foot


class _Upright(NamedTuple):
    """A skeleton with its paired joints by standard name, and the direction of the trunk in the pelvis' frame."""

    skeleton: Skeleton
    joints: Mapping[str, int]
    up: NDArray[np.float64]


def _upright(
    pairs: tuple[JointPair, ...],
    source: Skeleton,
    source_axes: Mapping[str, JointAxes],
    target: Skeleton,
    target_axes: Mapping[str, JointAxes],
) -> tuple[_Upright, ...]:
    made = []
    for skeleton, axes, which in ((source, source_axes, "source"), (target, target_axes, "target")):
        joints = {pair.standard: skeleton.index_of(getattr(pair, which)) for pair in pairs}
        made.append(_Upright(skeleton, joints, np.array(axes[skeleton.joint_names[joints["pelvis"]]].twist)))
    return tuple(made)


def _trunk(skeleton: Skeleton, pelvis: int, up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the direction (3,) of the trunk at rest."""
    rotated = quaternions.rotate_vectors(skeleton.rest_global_rotations[pelvis], up / np.linalg.norm(up))
    return np.asarray(rotated, dtype=np.float64)


def _shows_drop(skeleton: Skeleton, joints: Mapping[str, int], up: NDArray[np.float64], side: str) -> bool:
    """Return whether the rest pose shows how far a hip is below the pelvis.

    This is so if the hip is a child of the pelvis, or if the rest pose is a standing pose. Otherwise, joints between
    pelvis and hip may be bent in any way in the rest pose.
    """
    pelvis, hip = joints["pelvis"], joints[f"{side}_hip"]
    if skeleton.parents[hip] == pelvis:
        return True
    if not {f"{side}_knee", f"{side}_ankle"} <= joints.keys():
        return False
    positions = skeleton.rest_global_positions
    knee, ankle = positions[joints[f"{side}_knee"]], positions[joints[f"{side}_ankle"]]
    leg = float(np.linalg.norm(knee - positions[hip]) + np.linalg.norm(ankle - knee))
    return float((positions[hip] - ankle) @ _trunk(skeleton, pelvis, up)) > STANDING * leg


def _anchors(pairs: tuple[JointPair, ...], bodies: tuple[_Upright, ...]) -> tuple[JointPair, ...]:
    """Choose the joints whose middle follows the scaled path of the source: the pelvis, or else both hips.

    If a rest pose does not show how far the hips are below the pelvis, the scale cannot include this distance. The hips
    would then be too high or too low if the pelvis followed the path.
    """
    paired = {pair.standard: pair for pair in pairs}
    hips = [paired[f"{side}_hip"] for side in SIDES if f"{side}_hip" in paired]
    if len(hips) < len(SIDES) or all(_shows_drop(*body, side) for body in bodies for side in SIDES):
        return (paired["pelvis"],)
    return tuple(hips)


def _limbs(
    pairs: tuple[JointPair, ...], target: Skeleton, mapping: JointMapping, axes: Mapping[str, JointAxes]
) -> dict[str, TwoBoneLimb]:
    joints = {pair.standard: target.index_of(pair.target) for pair in pairs}
    followed, limbs = set(joints.values()), {}
    for end in (f"{side}_{joint}" for side in SIDES for joint in ("ankle", "wrist") if f"{side}_{joint}" in joints):
        limb = limb_ending_at(target, mapping, joints[end], axes)
        if limb is not None and followed.issuperset(limb.joints):
            limbs[end] = limb
    return limbs


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
