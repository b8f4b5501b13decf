"""Preparation of source clips: the frames that a database uses, resampled to the database's rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.importing.checks import CheckWarning, check_clip
from marey_motion.importing.landmarks import Landmarks
from marey_motion.looping import LoopSeam, loop_seam
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.database import DatabaseNote, SourceClip
from marey_motion.matching.simulation_root import bone_root, raw_root
from marey_motion.mirroring import mirror_motion
from marey_motion.motion import Motion
from marey_motion.resampling import resample_motion
from marey_motion.skeleton import SAME_OFFSET_M, Skeleton, same_hierarchy
from marey_schemas.options.matching import DatabaseOptions
from marey_schemas.wording import counted

# If the seam of a loop is shorter than this share of a step between frames, the last frame repeats the first.
REPEATED_STEPS = 0.2
OPEN_STEPS = 3.0
STILL_RAD = 1e-4

_Warn = Callable[[str, str], None]


@dataclass(frozen=True, eq=False)
class PreparedClip:
    """A source clip's motion at the database's rate.

    Parameters
    ----------
    seam : transition from the end of a loop to its start, across which rows look ahead; None if the clip does not wrap
    notes : remarks on data that were left out or look doubtful
    mirrored : whether left and right are exchanged
    first_s : time of the first frame in the recording, seconds
    """

    source: SourceClip
    motion: Motion
    seam: LoopSeam | None
    in_place: bool
    notes: tuple[DatabaseNote, ...]
    mirrored: bool = False
    first_s: float = 0.0

    @property
    def uid(self) -> str:
        """Permanent identifier of the clip in the database."""
        return f"{self.source.uid}~mirrored" if self.mirrored else self.source.uid


def prepare_clip(
    source: SourceClip, body: MatchingBody, options: DatabaseOptions, landmarks: Landmarks
) -> PreparedClip:
    """Select the frames of a source clip that a database uses, and resample them to the database's rate.

    Parameters
    ----------
    source : SourceClip    the clip
    body : MatchingBody    the joints to match
    options : DatabaseOptions    rate, end policy, root mode and whether rest poses are kept
    landmarks : Landmarks    joints of the body, by which rest poses and walks in place are detected

    Returns
    -------
    PreparedClip    the resampled frames, with remarks on data that were left out or look doubtful

    Raises
    ------
    MotionError    if the clip has another skeleton or does not contain the range of frames, or if a loop has no facing
        direction
    """
    notes: list[DatabaseNote] = []

    def warn(code: str, message: str) -> None:
        notes.append(DatabaseNote(code, f"{source.name}: {message}", source.uid))

    clip, first, in_place = _wanted_frames(source, body, options, landmarks, warn)
    motion, seam = Motion.of(clip), None
    if source.loop and options.end_policy == "loop":
        motion = _closed(motion, warn)
        bone = options.root_mode == "bone"
        seam = loop_seam(*(bone_root(motion, body) if bone else raw_root(motion.positions(body.skeleton), body)))
    motion = resample_motion(motion, clip.frame_rate_hz, options.rate_hz, seam=seam)
    return PreparedClip(source, motion, seam, in_place, tuple(notes), first_s=first / clip.frame_rate_hz)


def mirror_prepared(clip: PreparedClip, body: MatchingBody, *, keep_notes: bool) -> PreparedClip:
    """Make the mirrored copy of a prepared clip.

    Parameters
    ----------
    clip : PreparedClip    the clip
    body : MatchingBody    pairs of joints
    keep_notes : bool    whether the copy has the remarks of the clip, too

    Returns
    -------
    PreparedClip    left and right exchanged
    """
    seam = clip.seam
    if seam is not None:
        seam = LoopSeam(-seam.turn_rad, seam.shift_m * (-1.0, 1.0))
    motion = mirror_motion(body.skeleton, body.partners, clip.motion)
    return replace(clip, motion=motion, seam=seam, mirrored=True, notes=clip.notes if keep_notes else ())


def _wanted_frames(
    source: SourceClip, body: MatchingBody, options: DatabaseOptions, landmarks: Landmarks, warn: _Warn
) -> tuple[Clip, int, bool]:
    """Cut a clip to the requested range, and drop rest poses at both ends unless the options keep them.

    Returns the cut clip, the index of its first frame in the source, and whether the body walks in place.
    """
    clip, first = source.clip, 0
    if not _fits_skeleton(clip, body.skeleton):
        raise MotionError(
            "the clip has a different skeleton from the database; retarget the clip first", code="skeleton-mismatch"
        )
    if source.frames is not None:
        clip, first = clip.sliced(*source.frames), source.frames[0]
    warnings = check_clip(clip, landmarks)
    if not options.keep_rest_poses:
        start, stop = _without_rest_poses(clip, warnings, warn)
        clip, first = clip.sliced(start, stop), first + start
    in_place = [warning for warning in warnings if warning.code == "in-place-gait"]
    for warning in in_place:
        warn(warning.code, warning.message)
    return clip, first, bool(in_place)


def _fits_skeleton(clip: Clip, skeleton: Skeleton) -> bool:
    """Return whether the poses of a clip are also poses of `skeleton`.

    The skeletons must be equal, except in end sites and in the offsets of the root and of joints whose translations
    the clip contains.
    """
    own = clip.skeleton
    if own is skeleton:
        return True
    if own.joint_count != skeleton.joint_count:
        return False
    offsets, replaced = own.offsets.copy(), [0, *clip.translated_joints]
    offsets[replaced] = skeleton.offsets[replaced]
    alike = replace(own, offsets=offsets, end_sites=skeleton.end_sites)
    return same_hierarchy(alike, skeleton, tolerance_m=SAME_OFFSET_M)


def _without_rest_poses(clip: Clip, warnings: tuple[CheckWarning, ...], warn: _Warn) -> tuple[int, int]:
    """Find the range [start, stop) of frames between the rest poses that `warnings` report at the ends of a clip."""
    start, stop = 0, clip.frame_count
    for warning in warnings:
        if warning.code == "rest-pose-frame" and warning.frames is not None:
            if warning.frames == (0, clip.frame_count):
                warn("only-a-rest-pose", "the whole clip is a rest pose, so no frame was left out")
                return 0, clip.frame_count
            if warning.frames[0] == 0:
                start = warning.frames[1]
            else:
                stop = warning.frames[0]
    if stop - start < clip.frame_count:
        ending = clip.frame_count - stop
        left_out = f"{counted(start, 'frame')} at the start and {ending} at the end of the clip"
        warn("rest-pose-dropped", f"a rest pose was left out: {left_out}")
    return start, stop


def _closed(motion: Motion, warn: _Warn) -> Motion:
    """Drop the last frame of a loop if it repeats the first frame; warn of this, and of a loop that does not close."""
    if motion.frame_count < 3 or motion.rotations.shape[1] < 2:
        return motion
    inner = motion.rotations[:, 1:]
    steps = quaternions.angle_between(inner[1:], inner[:-1]).max(axis=1)
    gap = float(quaternions.angle_between(inner[-1], inner[0]).max())
    if gap < REPEATED_STEPS * float(np.median(steps)):
        warn("loop-end-repeated", "the last frame of the loop repeats the first one and was left out")
        return motion.at_frames(np.arange(motion.frame_count - 1))
    if gap > OPEN_STEPS * max(float(steps.max()), STILL_RAD):
        warn(
            "loop-does-not-close",
            f"the clip is marked as a loop, but a joint turns {np.degrees(gap):.0f}° from the last frame to the first",
        )
    return motion
