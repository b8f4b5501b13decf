"""What alignment makes of clips: motions in one canonical frame and one canonical time, and the way back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton


@dataclass(frozen=True)
class Placement:
    """Where on the ground a clip began: what bringing it to the canonical frame took away.

    A point p of the canonical frame stood at R(heading) p + (x, y, z), R turning about the vertical.

    Parameters
    ----------
    heading_rad : where the body faced in the first frame, 0 along +z, positive to the left
    x, z : where the joint that carries the body stood in the first frame, metres
    y : what was taken off all heights, metres: nothing where they are kept, as they are by default
    joint : the joint that carries the body (`MatchingBody.carrier`): the root, or, below a root that is a static
        reference on the floor, mostly the hips
    """

    heading_rad: float
    x: float
    z: float
    y: float = 0.0
    joint: int = 0


@dataclass(frozen=True, eq=False)
class AlignedClip:
    """One example.

    Parameters
    ----------
    uid : unique among the clips
    name : for people; ties are broken by it, then by the uid, which is another one wherever the clips are stored anew
    motion : N canonical frames, in the canonical frame: the body begins at x = z = 0 and faces +z. Joints between a
        static root and the one that carries the body are not translated.
    time_function : (N,) fractional frame of the source (at the set's rate) at each canonical frame; strictly
        increasing from 0 to the last frame of the source
    placement : what was taken away
    cost : mean cost per frame of the way that the time function follows, metres squared
    source_frames : frames of the source at the set's rate
    """

    uid: str
    name: str
    motion: Motion
    time_function: Floats
    placement: Placement
    cost: float
    source_frames: int


@dataclass(frozen=True, eq=False)
class AlignedSet:
    """Examples of one action, aligned with each other.

    Parameters
    ----------
    skeleton : of all of them
    frame_rate_hz : of canonical frames, that of the reference
    clips : ordered by name, then uid
    reference : uid of the clip whose time is the canonical time
    keyframes : canonical frame by label
    """

    skeleton: Skeleton
    frame_rate_hz: float
    clips: tuple[AlignedClip, ...]
    reference: str
    keyframes: Mapping[str, int]

    @property
    def frame_count(self) -> int:
        """N, canonical frames."""
        return self.clips[0].motion.frame_count

    @property
    def poses(self) -> Floats:
        """(clips, N, 3 + 4·J) root translations and rotations."""
        return np.stack([clip.motion.poses for clip in self.clips])

    @property
    def time_functions(self) -> Floats:
        """(clips, N) source frames."""
        return np.stack([clip.time_function for clip in self.clips])
