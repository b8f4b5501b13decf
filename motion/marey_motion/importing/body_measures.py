"""Measures of the body in a file: positions of its joints in some frames, lengths of its legs, heights of its hips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.importing.anatomy import Anatomy
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.landmarks import Landmarks
from marey_motion.importing.order_statistics import low_quantile, median
from marey_motion.importing.source import SourceMotion
from marey_motion.kinematics import forward_kinematics
from marey_schemas.options.imports import UpAxis

_SAMPLED_FRAMES = 64


@dataclass
class BodyMeasures:
    """Measures of the body in a file, in the unit and axes of the file.

    `positions` (J, F, 3) are joint positions in sampled frames (in the rest pose, with F = 1, if the file has no
    motion), `rest` (J, 3) joint positions in the rest pose. `leg` is the length of a leg, None if there are not two
    feet. Functions that infer the unit or the upward axis append to `evidence` and `warnings`, and set `axis_is_clear`
    if the body stands along the inferred axis.
    """

    file: str
    landmarks: Landmarks
    positions: NDArray[np.float64]
    rest: NDArray[np.float64]
    leg: float | None
    evidence: list[str] = field(default_factory=list)
    warnings: list[CheckWarning] = field(default_factory=list)
    axis_is_clear: bool = False


def measure_body(source: SourceMotion, anatomy: Anatomy, file: str) -> BodyMeasures:
    """Measure the body of a file.

    Parameters
    ----------
    source : SourceMotion    the file in its own unit and axes
    anatomy : Anatomy    anatomy of the source's skeleton
    file : str    name of the file, for messages

    Returns
    -------
    BodyMeasures    the measures; `evidence` and `warnings` are still empty
    """
    skeleton, landmarks = anatomy.skeleton, anatomy.landmarks
    rest = skeleton.rest_global_positions
    positions: NDArray[np.floating[Any]] = rest[None]
    if source.rotations is not None and source.root_positions is not None:
        frames = _sampled_frames(len(source.rotations))
        poses = np.empty((len(frames), 3 + 4 * skeleton.joint_count))
        poses[:, :3] = source.root_positions[frames]
        poses[:, 3:] = source.rotations[frames].reshape(len(frames), -1)
        translations = None if source.translations is None else source.translations[frames]
        positions = forward_kinematics(
            skeleton,
            poses,
            translations=translations,
            translated_joints=source.translated_joints,
        )
    of_joints = np.ascontiguousarray(positions.transpose(1, 0, 2), np.float64)
    return BodyMeasures(file, landmarks, of_joints, rest, anatomy.leg)


@lru_cache(maxsize=256)
def _sampled_frames(count: int) -> NDArray[np.int64]:
    """Choose at most 64 different frames of a motion of `count` frames, evenly spaced."""
    spaced = np.linspace(0, count - 1, _SAMPLED_FRAMES).astype(np.int64)
    frames: NDArray[np.int64] = spaced[np.concatenate(([True], spaced[1:] > spaced[:-1]))]
    frames.setflags(write=False)
    return frames


def heights_along(positions: NDArray[np.float64], up_axis: UpAxis) -> NDArray[np.float64]:
    """Select the coordinate along an axis.

    Parameters
    ----------
    positions : (..., 3) float64    in any unit
    up_axis : str    the axis that points up

    Returns
    -------
    (...) float64    heights in the same unit
    """
    heights: NDArray[np.float64] = positions[..., "xyz".index(up_axis[-1])]
    return -heights if up_axis[0] == "-" else heights


def hip_height_of(body: BodyMeasures, up_axis: UpAxis) -> float:
    """Compute the median height of the hips above the ground.

    Parameters
    ----------
    body : BodyMeasures    measures of a file
    up_axis : str    the axis that points up

    Returns
    -------
    float    in the file's unit; 0 if the body has no feet
    """
    if body.leg is None:
        return 0.0
    return float(median(hip_heights(body.positions.transpose(1, 0, 2), body.landmarks, up_axis)))


def hip_heights(positions: NDArray[np.float64], landmarks: Landmarks, up_axis: UpAxis = "y") -> NDArray[np.float64]:
    """Measure the heights of the hips above the ground, the 5 % quantile of the lowest toes or feet in all frames.

    Parameters
    ----------
    positions : (F, J, 3) float64    in any unit
    landmarks : Landmarks    joints of the body
    up_axis : str    the axis that points up

    Returns
    -------
    (F,) float64    in the unit of `positions`
    """
    above = heights_along(positions, up_axis)
    ground = low_quantile(np.minimum.reduce(above.take(landmarks.ground_joints, axis=1), axis=1))
    heights: NDArray[np.float64] = above[:, landmarks.hips] - ground
    return heights


def walks_on_hands(body: BodyMeasures, up_axis: UpAxis) -> bool:
    """Test whether, in most frames, the lower hand is less than a quarter of a leg above the lower foot.

    Parameters
    ----------
    body : BodyMeasures    measures of a file
    up_axis : str    the axis that points up

    Returns
    -------
    bool    false if the file has no hands or no legs
    """
    if body.landmarks.hands is None or body.leg is None:
        return False
    heights = heights_along(body.positions, up_axis)
    hands = np.minimum.reduce(heights.take(body.landmarks.hands, axis=0), axis=0)
    feet = np.minimum.reduce(heights.take(body.landmarks.ground_joints, axis=0), axis=0)
    return bool(median(hands - feet) < 0.25 * body.leg)


# Below, numpy's ufuncs give the same bits as its `mean` and `norm`, which take longer than 64 poses do.


def mean_point(positions: NDArray[np.float64], joints: Sequence[int]) -> NDArray[np.float64]:
    """Compute the mean positions of some joints.

    Parameters
    ----------
    positions : (J, F, 3) float64    positions of all joints
    joints : sequence of int    indices of joints

    Returns
    -------
    (F, 3) float64    mean positions
    """
    mean: NDArray[np.float64] = np.add.reduce(positions.take(joints, axis=0), axis=0) / len(joints)
    return mean


def lengths_of(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the lengths of vectors.

    Parameters
    ----------
    vectors : (..., 3) float64    vectors

    Returns
    -------
    (...) float64    lengths
    """
    lengths: NDArray[np.float64] = np.sqrt(np.add.reduce(vectors * vectors, axis=-1))
    return lengths
