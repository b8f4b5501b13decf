"""A set of clips for motion matching: features, root motion and poses, row by row."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.features import FeatureLayout, feature_layout
from marey_motion.matching.normaliser import Normaliser
from marey_schemas.options.matching import DatabaseOptions


class RootMotion(NamedTuple):
    """Steps of the root from each row of a database to the next row, as arrays that compiled code can take.

    Parameters
    ----------
    successors : (N,) int64    the row that follows; -1 for the last row of a clip that does not wrap (continue at its
        start)
    steps : (N, 3) float64    metres to the left and forward, in the frame of the row's root, and radians to the left.
        The last row of a clip that does not wrap repeats the step before, so that every row has a velocity.
    """

    successors: NDArray[np.int64]
    steps: NDArray[np.float64]


def root_motion(
    positions: NDArray[np.float64], headings: NDArray[np.float64], starts: NDArray[np.int64], wraps: NDArray[np.bool_]
) -> RootMotion:
    """Compute the steps of a root from row to row.

    For a clip marked in `wraps`, the step from the last row to the first is the mean of the steps before and after it.

    Parameters
    ----------
    positions : (N, 2) float64    (x, z) in metres
    headings : (N,) float64    radians
    starts : (C + 1,) int64    first row of each clip, and N
    wraps : (C,) bool    True for clips whose last row is followed by their first row

    Returns
    -------
    RootMotion    successors and steps of N rows
    """
    count = len(headings)
    successors = np.arange(1, count + 1, dtype=np.int64)
    steps = np.zeros((count, 3))
    sine, cosine = np.sin(headings[:-1]), np.cos(headings[:-1])
    x, z = np.diff(positions, axis=0).T
    steps[:-1, 0] = x * cosine - z * sine
    steps[:-1, 1] = x * sine + z * cosine
    steps[:-1, 2] = np.diff(headings)
    first, last = starts[:-1], starts[1:] - 1
    single = first == last
    steps[last] = np.where(single[:, None], 0.0, steps[last - 1])
    steps[last[wraps]] = 0.5 * (steps[last[wraps]] + steps[first[wraps]])
    successors[last] = np.where(wraps, first, -1)
    return RootMotion(successors, steps)


@dataclass(frozen=True, eq=False)
class SourceClip:
    """A clip from which rows of a database are computed.

    Parameters
    ----------
    uid : permanent identifier of the clip, for example "clip_01J…@3"; if rows of several clips have equal costs, the
        row of the clip with the lowest uid is chosen
    name : name to show to users
    content : digest of its motion document, or "" when unknown
    loop : whether the last frame leads into the first frame
    frames : the half-open range of frames to use; all frames if None
    """

    uid: str
    name: str
    clip: Clip
    content: str = ""
    loop: bool = False
    frames: tuple[int, int] | None = None
    tags: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatabaseClip:
    """A clip in a database. Its rows are [start, stop); a mirrored copy has the uid of its source plus "~mirrored".

    `in_place` clips walk without travelling, as on a treadmill: their speeds are meaningless. `first_s` is the time of
    the first row in the recording, in seconds; it is above 0 if a range of frames was chosen or a rest pose was left
    out.
    """

    uid: str
    name: str
    content: str
    start: int
    stop: int
    loop: bool = False
    mirrored_from: str | None = None
    tags: tuple[str, ...] = ()
    in_place: bool = False
    first_s: float = 0.0

    @property
    def frame_count(self) -> int:
        """Number of rows at the database's rate."""
        return self.stop - self.start


@dataclass(frozen=True)
class DatabaseNote:
    """Remark about a database: its code, its text, and the uid of the clip concerned, if it concerns one."""

    code: str
    message: str
    clip: str | None = None

    def __str__(self) -> str:
        return self.message


@dataclass(frozen=True, eq=False)
class MatchingDatabase:
    """A database of N rows, D feature dimensions, P pose joints and C clips; the clips are in ascending order of uid.

    The pose of a row is relative to the row's simulation root: the position and heading of the body on the ground. If
    the root is placed at position p with heading theta, and R(theta) is the rotation about +Y, joint 0 is at
    R(theta)·poses[:3] + (p.x, 0, p.z) with the rotation R(theta)·poses[3:7]. All other joints follow by their local
    rotations, offsets and translations. If p and theta are the position and heading of the root in the clip, the joint
    `MatchingBody.carrier` and all joints below it have the same pose as in the clip. Joints above the carrier have
    their rest pose relative to the root instead, because in some clips they stay in one place while the body moves
    away.

    Parameters
    ----------
    features : (N, D) float64    before normalisation, in metres and metres per second, in the frame of the row's root
    normaliser : see `Normaliser`; costs are computed from `normaliser.apply(features)`
    selectable : (N,) bool    True for rows that a search may choose
    root_positions : (N, 2) float64    the simulation root on the ground, metres, in the clip's own world
    root_headings : (N,) float64    radians, continuous within a clip
    pose_points : (N, P, 3) float32    positions of the body's pose joints in the frame of the row's root, metres
    poses : (N, 3 + 4·J) float32    joint 0 relative to the root (position in metres and rotation), then local rotations
    contacts : (N, 2) bool    whether the left and the right foot touch the ground
    translations : (N, k, 3) float32    local translations in metres that replace the offsets of the k
        `translated_joints`, as in a clip; None if no clip has any
    notes : remarks on data that were left out or look doubtful
    """

    body: MatchingBody
    clips: tuple[DatabaseClip, ...]
    options: DatabaseOptions
    features: NDArray[np.float64]
    normaliser: Normaliser
    selectable: NDArray[np.bool_]
    root_positions: NDArray[np.float64]
    root_headings: NDArray[np.float64]
    pose_points: NDArray[np.float32]
    poses: NDArray[np.float32]
    contacts: NDArray[np.bool_]
    translations: NDArray[np.float32] | None = None
    translated_joints: tuple[int, ...] = ()
    notes: tuple[DatabaseNote, ...] = ()

    @property
    def row_count(self) -> int:
        """Number of rows N."""
        return len(self.features)

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """First row of each clip, followed by N; (C + 1,) int64."""
        return np.array([clip.start for clip in self.clips] + [self.row_count], dtype=np.int64)

    @cached_property
    def layout(self) -> FeatureLayout:
        """Names, groups and weights of the D dimensions of the features."""
        return feature_layout(self.options, self.body)

    @cached_property
    def clip_of_row(self) -> NDArray[np.int32]:
        """Index of each row's clip, (N,) int32."""
        return np.repeat(np.arange(len(self.clips), dtype=np.int32), np.diff(self.starts))

    @cached_property
    def root_motion(self) -> RootMotion:
        """Successor of each row, and the step of the root from the row to its successor."""
        wraps = np.array([clip.loop and self.options.end_policy == "loop" for clip in self.clips], dtype=np.bool_)
        return root_motion(self.root_positions, self.root_headings, self.starts, wraps)
