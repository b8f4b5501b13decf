"""A set of clips as motion matching searches it: features, root motion and poses, row by row."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.normaliser import Normaliser
from marey_motion.matching.options import DatabaseOptions
from marey_motion.matching.root_motion import RootMotion, root_motion


@dataclass(frozen=True, eq=False)
class SourceClip:
    """A clip that goes into a database.

    Parameters
    ----------
    uid : what names the clip for good, for example "clip_01J…@3"; ties between equal costs go to the lower uid
    name : what people call it
    content : digest of its motion document, or "" when unknown
    loop : the last frame leads into the first one
    frames : the half-open range of frames to use, all when None
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
    """A clip in a database. Its rows are [start, stop); a mirrored one has the uid of its source plus "~mirrored"."""

    uid: str
    name: str
    content: str
    start: int
    stop: int
    loop: bool = False
    mirrored_from: str | None = None
    tags: tuple[str, ...] = ()

    @property
    def frame_count(self) -> int:
        """Rows at the database's rate."""
        return self.stop - self.start


@dataclass(frozen=True, eq=False)
class MatchingDatabase:
    """N rows, D feature dimensions, P pose joints, C clips in ascending order of uid: the lowest row wins a tie.

    Parameters
    ----------
    features : (N, D) float64    before normalisation, in metres and metres per second, in the frame of the row's root
    normaliser : see `Normaliser`; `normaliser.apply(features)` is what costs are made of
    selectable : (N,) bool    rows a search may choose
    root_positions : (N, 2) float64    the simulation root on the ground, metres, in the clip's own world
    root_headings : (N,) float64    radians, continuous within a clip
    pose_points : (N, P, 3) float32    positions of the body's pose joints in the frame of the row's root, metres
    poses : (N, 3 + 4·J) float32    hips relative to the simulation root (position and rotation), then local rotations
    contacts : (N, 2) bool    whether the left and the right foot stand
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

    @property
    def row_count(self) -> int:
        """N."""
        return len(self.features)

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """(C + 1,) first row of each clip, and N."""
        return np.array([clip.start for clip in self.clips] + [self.row_count], dtype=np.int64)

    @cached_property
    def root_motion(self) -> RootMotion:
        """What follows each row, and how the root moves there."""
        wraps = np.array([clip.loop and self.options.end_policy == "loop" for clip in self.clips], dtype=np.bool_)
        return root_motion(self.root_positions, self.root_headings, self.starts, wraps)
