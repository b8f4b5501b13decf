"""Sixteen pairs of real rigs between which motions are retargeted, and the measures that judge the results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import AnyFloats, Flags, Floats
from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import contact_labels
from marey_motion.editing.ground import LOWEST_SHARE, sole_heights
from marey_motion.formats import read_motion
from marey_motion.retargeting import RetargetPlan, plan_retarget
from marey_motion.rigs import guess_axes, map_joints

SIDES = ("left", "right")
RIGS = {
    "cmu-16": "cmu-amc/16/16_15.amc",
    "cmu-127": "cmu-amc/127/127_01.amc",
    "cmu-12": "cmu-bvh/cmu_12_01_walk.bvh",
    "cmu-10": "cmu-bvh/10_01.bvh",
    "reallusion-2": "cmu-iclone-bvh/002_01.bvh",
    "reallusion-7": "cmu-iclone-bvh/007_02.bvh",
    "bandai-1": "bandai-namco-1/dataset-1_walk_normal_001.bvh",
    "bandai-2": "bandai-namco-2/dataset-2_walk-turn-left_normal_003.bvh",
    "snu-walk": "rigs/snu-mss/walk_fullbody.bvh",
    "snu-run": "rigs/snu-mss/run_simple.bvh",
    "game": "rigs/game-engine/custom_skeleton_walk_example.bvh",
    "folded": "rigs/game-engine/vis_example.bvh",
    "makehuman": "rigs/makehuman/zombieWalk1.bvh",
    "freebvh": "rigs/misc/test_freebvh.bvh",
    "mocapbank": "rigs/misc/test_mocapbank.bvh",
    "walk01": "rigs/misc/walk01.bvh",
    "geno": "rigs/geno/Geno_stance.bvh",
    "boxing": "torture/Boxing_Toes.bvh",
}
PAIRS = (
    ("cmu-12", "reallusion-7"),
    ("freebvh", "cmu-10"),
    ("cmu-16", "reallusion-2"),
    ("reallusion-2", "cmu-127"),
    ("reallusion-7", "freebvh"),
    ("bandai-1", "reallusion-2"),
    ("bandai-2", "geno"),
    ("snu-walk", "makehuman"),
    ("snu-run", "bandai-1"),
    ("game", "reallusion-2"),
    ("folded", "snu-walk"),
    ("cmu-10", "freebvh"),
    ("mocapbank", "game"),
    ("walk01", "cmu-12"),
    ("boxing", "geno"),
    ("makehuman", "bandai-2"),
)


class Actor:
    """Skeleton with the mapping and axes that retargeting needs, and a motion."""

    def __init__(self, clip: Clip) -> None:
        self.clip, self.skeleton = clip, clip.skeleton
        self.mapping = map_joints(self.skeleton)
        self.axes = guess_axes(self.skeleton, self.mapping, clip)

    @classmethod
    def of(cls, mocap: Path, path: str) -> Actor:
        """Read a file of the collection, and the skeleton file in the same folder if there is one."""
        file = mocap / path
        companion = next(file.parent.glob("*.asf")).read_bytes() if file.suffix == ".amc" else None
        read = read_motion(file.read_bytes(), file.name, companion=companion).clip
        assert read is not None
        return cls(read)

    def joint(self, standard: str) -> int:
        """Find the index of a standard joint."""
        return self.skeleton.index_of(self.mapping.joints[standard])


def plan_between(source: Actor | SimpleNamespace, target: Actor | SimpleNamespace, **options: Any) -> RetargetPlan:
    """Plan retargeting from one actor to another."""
    return plan_retarget(
        source.skeleton, source.mapping, source.axes, target.skeleton, target.mapping, target.axes, **options
    )


@dataclass(frozen=True, eq=False)
class JudgedRetargeting:
    """A clip and its retargeted copy, with positions of joints in world coordinates."""

    source: Actor
    target: Actor
    result: Clip
    scale: float

    def way(self, start: str, end: str) -> tuple[Floats, Floats]:
        """Compute the vectors (F, 3) from one standard joint to another in source and result."""
        (a, b), (c, d) = (self.places(joint) for joint in (start, end))
        return c - a, d - b

    def places(self, standard: str) -> tuple[Floats, Floats]:
        """Compute the positions (F, 3) of a standard joint in source and result."""
        source, target = (
            kinematics.global_positions(clip)[:, actor.joint(standard)].astype(np.float64) for actor, clip in self._both
        )
        return source, target

    def off_deg(self, start: str, end: str) -> float:
        """Compute the greatest angle between the directions of a bone in source and result."""
        return float(degrees_between(*self.way(start, end)).max())

    @property
    def soles_off_m(self) -> float:
        """Median height of the soles of the result above the floor, while the lower foot of the source touches it."""
        before, after = (
            sole_heights(kinematics.global_positions(clip, end_sites=True), actor.skeleton, self._feet(actor, "ankle"))
            for actor, clip in self._both
        )
        touching = self._touching.reshape(len(before), 2, 2).any(axis=1)
        touching &= before <= before.min(axis=1, keepdims=True)
        if not touching.any():
            touching = before <= np.quantile(before.min(axis=1), LOWEST_SHARE)
        return float(np.median(after[touching]) - self.scale * np.median(before[touching]))

    @property
    def contact_speeds_m_s(self) -> tuple[float, float]:
        """Mean horizontal speeds of ankles and toes in source and result, while they touch the floor in the source."""
        still = self._touching[1:] & self._touching[:-1]
        rate = self.source.clip.frame_rate_hz
        source, target = (
            float((np.linalg.norm(np.diff(points[..., ::2], axis=0), axis=-1) * rate)[still].mean())
            for points in (self._foot_points(*one) for one in self._both)
        )
        return source, target

    @property
    def knee_speeds_deg_s(self) -> tuple[float, float]:
        """Greatest speeds at which knees bend and stretch, in source and result."""
        fastest = np.zeros(2)
        for side in SIDES:
            thighs, shanks = self.way(f"{side}_hip", f"{side}_knee"), self.way(f"{side}_knee", f"{side}_ankle")
            bends = (degrees_between(*bones) for bones in zip(thighs, shanks, strict=True))
            speeds = [np.abs(np.diff(bend)).max() * self.source.clip.frame_rate_hz for bend in bends]
            fastest = np.maximum(fastest, speeds)
        return float(fastest[0]), float(fastest[1])

    @property
    def upper_arm_speeds_deg_s(self) -> tuple[float, float]:
        """Greatest speeds at which upper arms turn, in source and result."""
        fastest = np.zeros(2)
        for side in SIDES:
            arms = self.way(f"{side}_shoulder", f"{side}_elbow")
            speeds = [degrees_between(arm[1:], arm[:-1]).max() * self.source.clip.frame_rate_hz for arm in arms]
            fastest = np.maximum(fastest, speeds)
        return float(fastest[0]), float(fastest[1])

    def hands_off_m(self, scale: float) -> float:
        """Compute the greatest distance of hands from those of the source, scaled about the middle of the shoulders."""
        (left, left_after), (right, right_after) = (self.places(f"{side}_shoulder") for side in SIDES)
        off = []
        for side in SIDES:
            hand, after = self.places(f"{side}_wrist")
            target = 0.5 * (left_after + right_after) + scale * (hand - 0.5 * (left + right))
            off.append(np.linalg.norm(after - target, axis=1).max())
        return float(max(off))

    @property
    def _both(self) -> tuple[tuple[Actor, Clip], tuple[Actor, Clip]]:
        return (self.source, self.source.clip), (self.target, self.result)

    @property
    def _touching(self) -> Flags:
        """Whether each ankle and toe of the source touches the floor, by frame (F, 4): ankles, then toes."""
        return contact_labels(self._foot_points(self.source, self.source.clip), self.source.clip.frame_rate_hz)

    def _foot_points(self, actor: Actor, clip: Clip) -> Floats:
        feet = [*self._feet(actor, "ankle"), *self._feet(actor, "toe")]
        return kinematics.global_positions(clip)[:, feet].astype(np.float64)

    @staticmethod
    def _feet(actor: Actor, joint: str) -> list[int]:
        names = [f"{side}_{joint if f'{side}_{joint}' in actor.mapping.joints else 'ankle'}" for side in SIDES]
        return [actor.joint(name) for name in names]


def degrees_between(a: AnyFloats, b: AnyFloats) -> AnyFloats:
    """Return the angles between directions in degrees, exact for small angles."""
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a.astype(float), b.astype(float)))
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))
