"""Pelvis, spine and neck of a retargeted clip: corrections by joint positions where the rotations are not sufficient.

The rotation of the source's pelvis may disagree with the line between the hips, for example because joints between
pelvis and hips turn. The legs of the target would then cross, so the pelvis of the target follows the line. Also, one
of the skeletons may have joints in the spine or neck that the other skeleton lacks. The rotations of these joints would
be lost. So the part of the target's spine or neck with the additional or missing joints is turned as a whole: the line
from its first to its last joint gets the direction that it has in the source.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.importing.checks import CheckWarning
from marey_motion.moved_bones import turns_between
from marey_motion.retargeting.planning import RetargetPlan
from marey_motion.rigs.axes import bone_end

HIP_LINE_DEG = 10.0
"""Largest angle between the source's pelvis and hip line, in degrees, that is not corrected."""
DROPPED_DEG = 1.0
"""Largest angle, in degrees, between a bone with dropped joints and its source direction that is not corrected."""
_PELVIS = "pelvis"
_SPINE = ("spine", "spine_1", "spine_2", "neck")


@dataclass(frozen=True, eq=False)
class TrunkTurns:
    """Rotations of a source, corrected so that the trunk of the target follows the source's joint positions.

    Parameters
    ----------
    rotations : (F, 4·J) float32    local rotations; the input rotations if nothing has to be corrected
    checks : tuple of CheckWarning    the corrections, with their sizes
    """

    rotations: NDArray[np.float32]
    checks: tuple[CheckWarning, ...]


@dataclass(frozen=True, eq=False)
class _TrunkLine:
    """A line from the standard joint `start` to `end`, whose direction depends on the rotation of the joint `turned`.

    `direction` (3,) is the line's direction in the target, in the frame of the source's joint `turned`.
    """

    turned: str
    start: str
    end: str
    direction: Floats

    @property
    def least_deg(self) -> float:
        return HIP_LINE_DEG if self.turned == _PELVIS else DROPPED_DEG


def follow_trunk(clip: Clip, plan: RetargetPlan, rotations: NDArray[np.float32]) -> TrunkTurns:
    """Turn pelvis, spine and neck so that the target's hip line and spine have the directions of the source.

    Each joint is turned by the shortest rotation in each frame; the other joints keep their orientations in the world.

    Parameters
    ----------
    clip : Clip    F frames of the plan's source skeleton
    plan : RetargetPlan    joints and corrections
    rotations : (F, 4·J) float32    local rotations of the source's J joints that are used instead of the clip's

    Returns
    -------
    TrunkTurns    corrected rotations, and checks
    """
    from marey_motion import moved_bones_kernels as kernels

    lines = _lines(plan)
    if not lines:
        return TrunkTurns(rotations, ())
    joints = plan.source_joints
    world = kinematics.as_global_rotations(plan.source, rotations.reshape(clip.frame_count, -1, 4))
    points = kinematics.global_positions(clip)
    turned, starts, ends = (
        [joints[name] for name in names]
        for names in zip(*((line.turned, line.start, line.end) for line in lines), strict=True)
    )
    expected, found = np.zeros((2, clip.frame_count, len(lines) + 1, 3))
    expected[:, 1:] = quaternions.rotate_vectors(world[:, turned], np.stack([line.direction for line in lines]))
    found[:, 1:] = points[:, ends].astype(np.float64) - points[:, starts]
    bones = np.stack((np.zeros(len(lines), np.int64), np.arange(1, len(lines) + 1)), axis=1)
    turns, angles = turns_between(expected, found, bones)
    largest = np.degrees(angles.max(axis=1)).tolist()
    chosen = [number for number, line in enumerate(lines) if largest[number] > line.least_deg]
    if not chosen:
        return TrunkTurns(rotations, ())
    local = np.empty(rotations.shape, np.float32)
    kernels.turn_joints(world, plan.source.parents, np.array(turned, np.int64)[chosen], turns[chosen], local)
    return TrunkTurns(local, _checks([(lines[number], largest[number]) for number in chosen], plan))


def _lines(plan: RetargetPlan) -> list[_TrunkLine]:
    """List the hip line, and the bones of spine and neck that have joints between their ends in one of the skeletons.

    The corrections assume that joints between the ends of a line keep their rest rotations in the target. If the plan
    has joints that copy rotations (`carried`), the list is empty.
    """
    if plan.carried:
        return []
    names = [(_PELVIS, "right_hip", "left_hip")]
    names += [(name, name, end) for name in _SPINE if (end := bone_end(name, plan.target_joints)) is not None]
    lines = []
    for turned, start, end in names:
        if not {turned, start, end} <= plan.target_joints.keys() or not (turned == _PELVIS or _drops(plan, start, end)):
            continue
        joint = plan.target_joints[turned]
        places = plan.target.rest_global_positions
        way = places[plan.target_joints[end]] - places[plan.target_joints[start]]
        own = quaternions.rotate_vectors(quaternions.conjugate(plan.target.rest_global_rotations[joint]), way)
        lines.append(
            _TrunkLine(
                turned,
                start,
                end,
                np.asarray(quaternions.rotate_vectors(plan.corrections[joint], own), dtype=np.float64),
            )
        )
    return lines


def _drops(plan: RetargetPlan, start: str, end: str) -> bool:
    """Return whether one of the skeletons has joints between two standard joints."""
    both = ((plan.source, plan.source_joints), (plan.target, plan.target_joints))
    return any(skeleton.parents[joints[end]] != joints[start] for skeleton, joints in both)


def _checks(turned: list[tuple[_TrunkLine, float]], plan: RetargetPlan) -> tuple[CheckWarning, ...]:
    """Make findings about the corrected lines, with the largest angle of each line in degrees."""
    pelvis = {_source_name(plan, line): most for line, most in turned if line.turned == _PELVIS}
    spine = {_source_name(plan, line): most for line, most in turned if line.turned != _PELVIS}
    found = (
        (
            "pelvis-from-hip-line",
            pelvis,
            "the pelvis of the source and the line between its hips differ by up to {:.1f} degrees; the pelvis of the "
            "result follows the line, so that the legs do not cross",
        ),
        (
            "dropped-joints-followed",
            spine,
            "joints of spine or neck exist in only one of the skeletons; the bones in their place were turned by up to "
            "{:.1f} degrees, so that they point where the source's joints are",
        ),
    )
    return tuple(
        CheckWarning(code, text.format(most), joints=tuple(joints), values={"largest_turn_deg": most})
        for code, joints, text in found
        if joints and (most := max(joints.values()))
    )


def _source_name(plan: RetargetPlan, line: _TrunkLine) -> str:
    return plan.source.joint_names[plan.source_joints[line.turned]]
