"""Bodies drawn as lines: the choice of bones, the camera, and the drawing order by depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import AnyFloats, Indices
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.rigs import JointMapping, map_joints
from marey_motion.rigs.standard import SIDES
from marey_motion.skeleton import Skeleton

LEFT, CENTRE, RIGHT = -1, 0, 1
TIP_SHARE = 0.25  # of the body's size: longer ends are markers of something else
HEADING_PAIRS = ("hip", "shoulder")


@dataclass(frozen=True)
class Camera:
    """Camera with parallel projection.

    `direction_rad` is the direction of the camera about +Y (0: it looks from +Z). `tilt_rad` is its angle above the
    horizontal.
    """

    direction_rad: float
    tilt_rad: float

    def seen(self, points: AnyFloats) -> AnyFloats:
        """Convert points (..., 3) to the camera's axes (right, up, towards the viewer), in metres; shape (..., 3)."""
        turn, tilt = self.direction_rad, self.tilt_rad
        right = points[..., 0] * np.cos(turn) - points[..., 2] * np.sin(turn)
        near = points[..., 0] * np.sin(turn) + points[..., 2] * np.cos(turn)
        up = points[..., 1] * np.cos(tilt) - near * np.sin(tilt)
        return np.stack((right, up, near * np.cos(tilt) + points[..., 1] * np.sin(tilt)), axis=-1)


@dataclass(frozen=True)
class StickFigure:
    """Lines and points that represent a skeleton.

    Parameters
    ----------
    bones : (n, 2) indices of the points at the outer and the inner end of each bone; the points are all joints, then
        all end sites
    sides : (n,) LEFT, CENTRE or RIGHT for each bone
    pelvis : index of the joint that is at the centre of a drawn figure
    head : index of the bone of the head, and the position of the centre of the head along this bone, from 0 (inner end)
        to 1 (outer end); None if no head is known
    facing : indices of joints on the left side, and of the matching joints on the right side; the facing direction is
        computed from them
    """

    bones: Indices
    sides: Indices
    pelvis: int
    head: tuple[int, float] | None
    facing: tuple[tuple[int, ...], tuple[int, ...]]


@dataclass(frozen=True)
class Stances:
    """Points of a body in K frames of a clip.

    Parameters
    ----------
    points : (K, P, 3) positions in metres; x and z are relative to the pelvis, y to the floor
    facing : (K, 2) unit (x, z) directions in which the body faces, None if its joints do not determine them
    """

    points: AnyFloats
    facing: AnyFloats | None


def body_of(skeleton: Skeleton) -> StickFigure:
    """Choose the bones of a body, without floor roots, props and helper joints; all bones if no pelvis is known."""
    mapping = map_joints(skeleton)
    standard = {skeleton.index_of(name): key for key, name in mapping.joints.items() if key != "root"}
    pelvis = next((joint for joint, key in standard.items() if key == "pelvis"), None)
    if pelvis is None:
        bones = [(joint, int(parent)) for joint, parent in enumerate(skeleton.parents) if parent >= 0]
        return StickFigure(_pairs(bones), np.zeros(len(bones), dtype=np.intp), 0, None, ((), ()))
    sides: dict[int, int] = {}
    for joint, key in standard.items():
        path = skeleton.path_to_root(joint)
        for step in path[: path.index(pelvis)] if pelvis in path else ():
            side = _side(standard.get(step, key))
            # A joint without a standard name that leads to both sides is in the centre.
            sides[step] = side if sides.get(step, side) == side else CENTRE
    bones = [(joint, int(skeleton.parents[joint])) for joint in sides]
    tips = _tips(skeleton, pelvis, sides)
    ends = [skeleton.end_sites[number - skeleton.joint_count].joint for number, _ in tips]
    heads = [(len(bones) + place, 0.5) for place, joint in enumerate(ends) if standard.get(joint) == "head"]
    heads += [(place, 1.0) for place, (joint, _) in enumerate(bones) if standard.get(joint) == "head"]
    return StickFigure(
        _pairs(bones + tips),
        np.array([*sides.values(), *(sides[joint] for joint in ends)], dtype=np.intp),
        pelvis,
        next(iter(heads), None),
        _facing_joints(skeleton, mapping),
    )


def runs_of(bones: Indices) -> list[Indices]:
    """Join bones (n, 2) to as few polylines as possible: sequences of indices of points, from an outer end inwards."""
    inner = {int(outer): int(inner) for outer, inner in bones}
    ends = sorted(set(inner) - set(inner.values()))
    runs, drawn = [], set()
    for point in ends:
        run = [point]
        while run[-1] in inner and run[-1] not in drawn:
            drawn.add(run[-1])
            run.append(inner[run[-1]])
        runs.append(np.array(run, dtype=np.intp))
    return runs


def stances_at(clip: Clip, body: StickFigure, frames: Indices) -> Stances:
    """Compute the positions and facing directions of the body in the frames `frames` (K,) of a clip."""
    points = kinematics.forward_kinematics(
        clip.skeleton,
        clip.poses[frames].astype(np.float64),
        translations=None if clip.translations is None else clip.translations[frames].astype(np.float64),
        translated_joints=clip.translated_joints,
        end_sites=True,
    )
    facing: AnyFloats | None = None
    if body.facing[0]:
        try:
            facing = kinematics.forward_directions(points, *body.facing)
        except MotionError:
            facing = None  # lies on its side throughout
    return Stances(points - points[:, [body.pelvis]] * (1.0, 0.0, 1.0), facing)


def _tips(skeleton: Skeleton, pelvis: int, sides: dict[int, int]) -> list[tuple[int, int]]:
    """List the last bone of each drawn chain of joints, as its outer point, an end site, and its inner joint.

    The index of an end site is counted after all joints, as in `StickFigure.bones`.
    """
    size = float(np.ptp(skeleton.rest_global_positions[[pelvis, *sides]], axis=0).max())
    inner = {int(skeleton.parents[joint]) for joint in sides}
    return [
        (skeleton.joint_count + number, site.joint)
        for number, site in enumerate(skeleton.end_sites)
        if site.joint in sides and site.joint not in inner and np.linalg.norm(site.offset) < TIP_SHARE * size
    ]


def _facing_joints(skeleton: Skeleton, mapping: JointMapping) -> tuple[tuple[int, ...], tuple[int, ...]]:
    known = [pair for pair in HEADING_PAIRS if all(f"{side}_{pair}" in mapping.joints for side in SIDES)]
    left, right = (mapping.indices(skeleton, [f"{side}_{pair}" for pair in known]) for side in SIDES)
    return left, right


def _side(standard: str) -> int:
    if standard.startswith("left_"):
        return LEFT
    return RIGHT if standard.startswith("right_") else CENTRE


def _pairs(bones: list[tuple[int, int]]) -> Indices:
    return np.array(bones, dtype=np.intp).reshape(-1, 2)
