"""Positions of the joints that the checks of a clip use, and lengths of limbs of its skeleton."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.importing.landmarks import KEPT_SKELETONS, Landmarks, common_ancestor, find_landmarks, path_length
from marey_motion.importing.order_statistics import low_quantile
from marey_motion.kinematics import forward_kinematics
from marey_motion.skeleton import Skeleton

_FRAMES_PER_BLOCK = 4096


@dataclass(frozen=True)
class BodyPoints:
    """Points of a skeleton that the checks use, and lengths of its limbs.

    `points` lists the points: joints by their index, then end sites, which are numbered from J on. The place of a point
    in this list is its column; `column` maps points to columns. `soles` has, for each foot, the columns of its joints
    and end sites from the ankle down. `all_soles` has the columns of both feet.
    `limbs` are the joint indices of each arm and leg, `span_m` is the length of both arms together, and `leg_m` the
    length of the left leg. If there are no hands or no feet, `limbs` is empty and both lengths are zero.
    """

    landmarks: Landmarks
    points: NDArray[np.intp]
    column: Mapping[int, int]
    soles: tuple[NDArray[np.intp], ...]
    all_soles: NDArray[np.intp]
    span_m: float
    leg_m: float
    limbs: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Tracks:
    """Positions (F, k, 3) in metres of the points of a body over the frames of a clip."""

    body: BodyPoints
    positions: NDArray[np.float32]

    def of(self, *joints: int) -> NDArray[np.float32]:
        """Select the positions of joints.

        Parameters
        ----------
        joints : int    indices of joints that are points of the body (keys of `body.column`)

        Returns
        -------
        (F, n, 3) float32    metres
        """
        return self.positions[:, [self.body.column[joint] for joint in joints]]

    @cached_property
    def soles(self) -> NDArray[np.float32]:
        """Positions (F, n, 3) of the points of both feet."""
        return self.positions[:, self.body.all_soles]

    @cached_property
    def lowest(self) -> NDArray[np.float32]:
        """Height (F,) of the lowest point of the two feet in each frame, in metres."""
        lowest: NDArray[np.float32] = self.soles[..., 1].min(axis=1)
        return lowest

    @cached_property
    def floor_height(self) -> float:
        """Height of the floor in metres: in 5 % of the frames, the lowest point of both feet is lower."""
        return float(low_quantile(self.lowest))


def track(clip: Clip, landmarks: Landmarks | None = None) -> Tracks:
    """Compute the positions that the checks of a clip use.

    Parameters
    ----------
    clip : Clip    F frames
    landmarks : Landmarks, optional    landmarks of its skeleton, if already known

    Returns
    -------
    Tracks    positions over F frames
    """
    skeleton = clip.skeleton
    body = _body_points(skeleton, landmarks or find_landmarks(skeleton))
    positions = np.empty((clip.frame_count, len(body.points), 3), np.float32)
    # In blocks, so that a clip of an hour needs no more memory than its own.
    for start in range(0, clip.frame_count, _FRAMES_PER_BLOCK):
        block = slice(start, start + _FRAMES_PER_BLOCK)
        everything = forward_kinematics(
            skeleton,
            clip.poses[block],
            translations=None if clip.translations is None else clip.translations[block],
            translated_joints=clip.translated_joints,
            end_sites=True,
        )
        positions[block] = everything[:, body.points]
    return Tracks(body, positions)


@lru_cache(maxsize=KEPT_SKELETONS)
def _body_points(skeleton: Skeleton, landmarks: Landmarks) -> BodyPoints:
    """Select the points and measure the lengths; the result is cached for all clips of a skeleton."""
    soles = tuple(sole_points(skeleton, foot) for foot in landmarks.feet or ())
    ends = [joint for pair in (landmarks.hands, landmarks.feet) if pair for joint in pair]
    points = sorted({0, landmarks.hips or 0, *ends, *(point for sole in soles for point in sole)})
    column = {point: index for index, point in enumerate(points)}
    columns = tuple(np.array([column[point] for point in sole]) for sole in soles)
    span = leg = 0.0
    limbs: tuple[tuple[int, ...], ...] = ()
    if landmarks.hands and landmarks.feet:
        chest, hips = common_ancestor(skeleton.parents, landmarks.hands), landmarks.hips or 0
        span = sum(path_length(skeleton, chest, hand) for hand in landmarks.hands)
        leg = path_length(skeleton, hips, landmarks.feet[0])
        tops = [(chest, hand) for hand in landmarks.hands] + [(hips, foot) for foot in landmarks.feet]
        paths = [(skeleton.path_to_root(end), top) for top, end in tops]
        limbs = tuple(path[: path.index(top)] for path, top in paths)
    all_soles = np.concatenate(columns) if columns else np.empty(0, np.intp)
    return BodyPoints(landmarks, np.array(points), column, columns, all_soles, span, leg, limbs)


def sole_points(skeleton: Skeleton, foot: int) -> list[int]:
    """List the points of a foot that may touch the ground.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    foot : int    index of the ankle

    Returns
    -------
    list of int    indices of the joints from the ankle down, and of their end sites, which are numbered from J on
    """
    below = {foot}
    for joint in range(foot + 1, skeleton.joint_count):
        if int(skeleton.parents[joint]) in below:
            below.add(joint)
    tips = [skeleton.joint_count + index for index, site in enumerate(skeleton.end_sites) if site.joint in below]
    return [*sorted(below), *tips]
