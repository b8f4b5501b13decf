"""Features of motion matching: feet and hips in the frame of the root, and the root's trajectory of the next second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.looping import loop_seam, moves_of_rounds, rotated
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.simulation_root import SimulationRoot
from marey_schemas.options.matching import DatabaseOptions


class FeatureGroup(NamedTuple):
    """Feature dimensions [start, stop) that share a scale; `joint` is the joint described, None for the trajectory."""

    name: str
    start: int
    stop: int
    weight: float
    joint: int | None


@dataclass(frozen=True)
class FeatureLayout:
    """The D dimensions of a feature vector: first the pose, then the trajectory.

    Positions and velocities have the components left, up and forward in the frame of the root: x, y and z of a body
    that heads along +z. Points and directions of the trajectory have the components left and forward (x, z).
    """

    groups: tuple[FeatureGroup, ...]
    names: tuple[str, ...]
    horizons_s: tuple[float, ...]

    @property
    def dimension_count(self) -> int:
        """Number of dimensions D."""
        return len(self.names)

    @property
    def pose_dimensions(self) -> int:
        """Number of dimensions of the pose.

        The dimensions of the trajectory follow: positions (x, z) at each horizon, then directions (x, z).
        """
        return self.dimension_count - 4 * len(self.horizons_s)

    @property
    def matched_joints(self) -> tuple[int, ...]:
        """Indices of the matched joints, in order of their groups."""
        return tuple(dict.fromkeys(group.joint for group in self.groups if group.joint is not None))


def feature_layout(options: DatabaseOptions, body: MatchingBody) -> FeatureLayout:
    """List the dimensions selected by options; 27 unless joints or horizons are added.

    Parameters
    ----------
    options : DatabaseOptions    joints, horizons and weights
    body : MatchingBody    the joints

    Returns
    -------
    FeatureLayout    D dimensions

    Raises
    ------
    MotionError    if the body lacks a joint
    """
    _require_joints(options, body)
    weights = options.weights
    left, right = body.feet
    blocks: list[tuple[str, Sequence[str], float, int | None]] = [
        ("left_foot_position", "xyz", weights.left_foot_position, left),
        ("right_foot_position", "xyz", weights.right_foot_position, right),
        ("left_foot_velocity", "xyz", weights.left_foot_velocity, left),
        ("right_foot_velocity", "xyz", weights.right_foot_velocity, right),
        ("hip_velocity", "xyz", weights.hip_velocity, body.hips),
    ]
    for name in options.extra_joints:
        extra = body.standard_joints[name]
        blocks += [(f"{name}_{part}", "xyz", weights.extra_joints, extra) for part in ("position", "velocity")]
    points = [f"{horizon_s:.3f}s.{axis}" for horizon_s in options.horizons_s for axis in "xz"]
    blocks.append(("trajectory_positions", points, weights.trajectory_positions, None))
    blocks.append(("trajectory_directions", points, weights.trajectory_directions, None))
    groups: list[FeatureGroup] = []
    names: list[str] = []
    for name, parts, weight, joint in blocks:
        groups.append(FeatureGroup(name, len(names), len(names) + len(parts), float(weight), joint))
        names += [f"{name}.{part}" for part in parts]
    return FeatureLayout(tuple(groups), tuple(names), tuple(options.horizons_s))


def _require_joints(options: DatabaseOptions, body: MatchingBody) -> None:
    missing = [name for name in options.extra_joints if name not in body.standard_joints]
    if missing:
        raise MotionError(
            f"the joint mapping of the skeleton has no {', '.join(missing)}; "
            f"it has {', '.join(sorted(body.standard_joints))}",
            code="unknown-joint",
            where="extra_joints",
        )


def in_root_frame(points: Floats, root: SimulationRoot) -> Floats:
    """Convert positions from the world to coordinates relative to the root, in each frame of a clip.

    Parameters
    ----------
    points : (F, K, 3) float64    positions in the world, metres
    root : SimulationRoot    F frames

    Returns
    -------
    (F, K, 3) float64    left, up, forward in metres
    """
    seen = points.copy()
    seen[..., (0, 2)] -= root.positions[:, None]
    return turned_to_root(seen, root)


def turned_to_root(vectors: Floats, root: SimulationRoot) -> Floats:
    """Convert vectors from the axes of the world to the axes of the root, in each frame of a clip.

    Parameters
    ----------
    vectors : (F, K, 3) float64    vectors in the world
    root : SimulationRoot    F frames

    Returns
    -------
    (F, K, 3) float64    left, up, forward in the same unit
    """
    turned = vectors.copy()
    turned[..., (0, 2)] = rotated(vectors[..., (0, 2)], -root.headings[:, None])
    return turned


def look_ahead(root: SimulationRoot, ticks: NDArray[np.int64], *, wraps: bool) -> SimulationRoot:
    """Look up position and heading of the root some frames after each frame.

    After the last frame, the root stays in place; the root of a loop that wraps continues with the next rounds.

    Parameters
    ----------
    root : SimulationRoot    F frames
    ticks : (H,) int64    numbers of frames to look ahead
    wraps : bool    whether the root belongs to a loop that wraps

    Returns
    -------
    SimulationRoot    positions (F, H, 2) in metres and headings (F, H) in radians
    """
    count = len(root.headings)
    ahead = np.arange(count)[:, None] + ticks
    if not wraps:
        rows = np.minimum(ahead, count - 1)
        return SimulationRoot(root.positions[rows], root.headings[rows])
    rounds, rows = np.divmod(ahead, count)
    turns, shifts = moves_of_rounds(loop_seam(*root), rounds.reshape(-1))
    turns, shifts = turns.reshape(rounds.shape), shifts.reshape(*rounds.shape, 2)
    return SimulationRoot(rotated(root.positions[rows], turns) + shifts, root.headings[rows] + turns)


def extract_features(
    layout: FeatureLayout, positions: Floats, velocities: Floats, root: SimulationRoot, future: SimulationRoot
) -> Floats:
    """Compute the features of each frame from the motion of joints and root.

    Parameters
    ----------
    layout : FeatureLayout    D dimensions with H horizons
    positions, velocities : (F, J, 3) float64    in the world, metres and metres per second
    root : SimulationRoot    root of the frames
    future : SimulationRoot    the root at each horizon: positions (F, H, 2) and headings (F, H)

    Returns
    -------
    (F, D) float64    metres and metres per second, relative to the root in the same frame of the motion
    """
    features = np.empty((len(positions), layout.dimension_count))
    for group in layout.groups:
        if group.joint is not None:
            columns = slice(group.start, group.stop)
            if group.name.endswith("_velocity"):
                features[:, columns] = turned_to_root(velocities[:, [group.joint]], root)[:, 0]
            else:
                features[:, columns] = in_root_frame(positions[:, [group.joint]], root)[:, 0]
    trajectory = np.empty((len(features), 2, len(layout.horizons_s), 2))
    trajectory[:, 0] = rotated(future.positions - root.positions[:, None], -root.headings[:, None])
    turns = future.headings - root.headings[:, None]
    trajectory[:, 1] = np.stack((np.sin(turns), np.cos(turns)), axis=-1)
    features[:, layout.pose_dimensions :] = trajectory.reshape(len(features), -1)
    return features
