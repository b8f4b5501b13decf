"""Results of an alignment: motions that start at the same place and share one canonical time, with the data to undo the
alignment.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton


@dataclass(frozen=True)
class Placement:
    """Original position and heading of a clip's first frame, before the clip was moved to canonical coordinates.

    A point p in canonical coordinates was at R(heading) p + (x, y, z) in the source; R rotates about the vertical axis.

    Parameters
    ----------
    heading_rad : float    heading in the first frame, 0 along +z, positive to the left
    x, z : float    ground position of `joint` in the first frame, metres
    y : float    metres subtracted from all heights; 0 by default, which leaves the heights unchanged
    joint : int    index of the joint that carries the body (`MatchingBody.carrier`): the root or, if the root is a
        static reference on the floor, usually the hips
    """

    heading_rad: float
    x: float
    z: float
    y: float = 0.0
    joint: int = 0


class Recording(NamedTuple):
    """Take and performer of an example.

    Examples of the same take or performer are not independent, so cross-validation of models keeps them together.

    Parameters
    ----------
    take : str    stable name of the take; empty if the example is a take of its own
    subject : str    performer; empty if unknown
    """

    take: str = ""
    subject: str = ""


UNKNOWN_RECORDING = Recording()


@dataclass(frozen=True, eq=False)
class AlignedClip:
    """One aligned example of N canonical frames.

    Parameters
    ----------
    uid : str    unique among the clips
    name : str    name shown to people; clips are ordered by name, then uid
    motion : Motion    N frames in canonical coordinates: the body begins at x = z = 0 and faces +z. If the root is
        static, the joints between the root and `placement.joint` are not translated.
    time_function : (N,) float64    time warp: for each canonical frame, the fractional frame of the source, which is
        sampled at the set's rate; strictly increasing from 0 to the last frame of the source
    placement : Placement    position and heading of the source's first frame
    cost : float    mean cost per cell of the alignment path that gave `time_function`: square metres, or without unit
        if the poses were compared by a perceptual metric
    source_frames : int    number of frames of the source at the set's rate
    recording : Recording    take and performer
    """

    uid: str
    name: str
    motion: Motion
    time_function: Floats
    placement: Placement
    cost: float
    source_frames: int
    recording: Recording = UNKNOWN_RECORDING


@dataclass(frozen=True, eq=False)
class AlignedSet:
    """Examples of one action, aligned with each other.

    Parameters
    ----------
    skeleton : Skeleton    skeleton of all clips
    frame_rate_hz : float    canonical frames per second
    clips : tuple of AlignedClip    ordered by name, then uid
    reference : str    uid of the clip whose time is the canonical time
    keyframes : mapping of str to int    canonical frame by label
    """

    skeleton: Skeleton
    frame_rate_hz: float
    clips: tuple[AlignedClip, ...]
    reference: str
    keyframes: Mapping[str, int]

    @property
    def frame_count(self) -> int:
        """Number of canonical frames N, the same in all clips."""
        return self.clips[0].motion.frame_count

    @property
    def poses(self) -> Floats:
        """Root translations (metres) and rotations (quaternions) of all clips, (clips, N, 3 + 4·J) float64."""
        return np.stack([clip.motion.poses for clip in self.clips])

    @property
    def time_functions(self) -> Floats:
        """Fractional source frame of each clip for each canonical frame, (clips, N) float64."""
        return np.stack([clip.time_function for clip in self.clips])
