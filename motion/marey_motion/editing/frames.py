"""Commands that cut, join, resample or retime a take."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from marey_motion.editing.borders import blended, smooth_step
from marey_motion.editing.offsets import VELOCITY_S, add_offset, dying_away, seam_offset
from marey_motion.editing.placement import body_track, moved_over
from marey_motion.editing.take import Take, motion_of
from marey_motion.editing.translations import with_equal_joints
from marey_motion.errors import EditError
from marey_motion.looping import LoopSeam, loop_seam, rotated
from marey_motion.motion import Motion
from marey_motion.resampling import count_samples, resample_motion
from marey_motion.root_carrier import body_first, root_first, root_stands
from marey_motion.skeleton import SAME_SKELETON_M, same_hierarchy
from marey_schemas.editing.commands import Concatenate, Resample, Retime, Split, Trim


def trim(take: Take, command: Trim) -> Take:
    """Keep a range of frames.

    Parameters
    ----------
    take : Take    F frames
    command : Trim    the range

    Returns
    -------
    Take    the frames [start, stop)

    Raises
    ------
    EditError    if the frames do not exist
    """
    first, last = take.frames((command.start, command.stop))
    return take.moved(take.motion.sliced(first, last))


def split(take: Take, command: Split) -> tuple[Take, ...]:
    """Cut a take into pieces.

    Parameters
    ----------
    take : Take    F frames
    command : Split    the cuts

    Returns
    -------
    tuple of Take    the pieces, one more than there are cuts

    Raises
    ------
    EditError    if a cut lies outside the motion or would leave a piece without frames
    """
    bounds = [0, *command.at, take.frame_count]
    for before, after in pairwise(bounds):
        if after <= before:
            raise EditError(
                f"cuts at {', '.join(map(str, command.at))} would leave a piece without frames; cuts must be "
                f"in increasing order, from 1 to {take.frame_count - 1}",
                code="frames-missing",
                where="at",
            )
    return tuple(
        replace(take.moved(take.motion.sliced(start, stop)), pieces=(*take.pieces, number))
        for number, (start, stop) in enumerate(pairwise(bounds), start=1)
    )


def concatenate(take: Take, command: Concatenate) -> Take:
    """Append another clip of the same skeleton, resampled to the frame rate of the take.

    If the root is a static reference and the hips below it are translated, the travel of the hips is merged into the
    travel of the root.

    Parameters
    ----------
    take : Take    F frames
    command : Concatenate    name of the clip to append, its placement, and the blend

    Returns
    -------
    Take    frames of both clips

    Raises
    ------
    EditError    if the source is unknown or has another skeleton, or if the result is too long
    MotionError    if the body has no facing direction at the seam
    """
    added = _same_rate(take, command.source)
    first, second = with_equal_joints(take.motion, added.motion, take.skeleton)
    before, after = take.moved(first), added.moved(second)
    count = take.count_frames(command.blend_s)
    overlap = min(count, before.frame_count, after.frame_count) if command.blend == "slerp" else 0
    if command.place == "keep" and count == 0:
        return take.moved(_in_a_row(first, second))
    seam = _seam(before, after, overlap) if command.place == "seam" else LoopSeam(0.0, np.zeros(2))
    body, carrier = take.skeleton, take.body.carrier
    stays = all(root_stands(motion, body, carrier) for motion in (first, second))
    first, second = (body_first(motion, body, carrier, root_stays=stays) for motion in (first, second))
    joined = _joined(first, moved_over(second, seam), overlap, count, take.frame_rate_hz)
    return take.moved(root_first(joined, body, carrier, root_stays=stays))


def _same_rate(take: Take, source: str) -> Take:
    """Resample a source clip to the rate of the take.

    Raises `EditError` if the source is unknown or has another skeleton, or if the result is too long.
    """
    clip = take.source(source)
    if not same_hierarchy(clip.skeleton, take.skeleton, tolerance_m=SAME_SKELETON_M):
        raise EditError(
            f"the source clip {source} has a different skeleton from the edited clip; retarget it first",
            code="other-skeleton",
            where="source",
        )
    count = count_samples(clip.frame_count, clip.frame_rate_hz, take.frame_rate_hz)
    take.require_room(take.frame_count + count)
    return take.moved(resample_motion(motion_of(clip), clip.frame_rate_hz, take.frame_rate_hz))


def _seam(before: Take, after: Take, overlap: int) -> LoopSeam:
    """Compute the rotation about the vertical and the shift on the ground that attach `after` to the end of `before`.

    `overlap` is the number of frames at the end of `before` that are blended with the first frames of `after`. If it
    is not 0, position and heading of the two bodies agree in the middle of the overlap.
    """
    if overlap:
        there, here = before.frame_count - overlap + overlap // 2, overlap // 2
        (target,), (wanted,) = body_track(before, there, there + 1)
        (start,), (heading,) = body_track(after, here, here + 1)
        turn = float(wanted - heading)
        return LoopSeam(turn, target[[0, 2]] - rotated(start[[0, 2]], turn))
    ends, end_headings = body_track(before, max(0, before.frame_count - 2), before.frame_count)
    starts, start_headings = body_track(after, 0, min(2, after.frame_count))
    # One frame alone stands still: it is its own neighbour.
    rows = np.stack((starts[0], starts[-1], ends[0], ends[-1]))[:, [0, 2]]
    return loop_seam(rows, np.array([start_headings[0], start_headings[-1], end_headings[0], end_headings[-1]]))


def _joined(first: Motion, second: Motion, overlap: int, count: int, frame_rate_hz: float) -> Motion:
    """Join two motions.

    If `overlap` is not 0, this many frames of both are blended into each other. Otherwise, the difference in pose and
    velocity decays over the first `count` frames of the second motion; if `count` is 0, the result is a hard cut.
    """
    if overlap:
        return _faded_over(first, second, overlap)
    return _in_a_row(first, _inertialised(first, second, count, frame_rate_hz) if count else second)


def _inertialised(first: Motion, second: Motion, count: int, frame_rate_hz: float) -> Motion:
    """Make the second motion start with the pose and velocity that the first motion has at its end.

    The change decays over the first `count` frames.
    """
    difference, velocity = seam_offset(first, second)
    ages = np.arange(min(count, second.frame_count), dtype=np.float64)
    velocity_life = min(float(count), max(1.0, VELOCITY_S * frame_rate_hz))
    left = dying_away(difference, velocity, ages, float(count), velocity_life)
    return add_offset(second, np.arange(len(ages)), left)


def _in_a_row(first: Motion, second: Motion) -> Motion:
    return first._replace(
        root_translations=np.concatenate((first.root_translations, second.root_translations)),
        rotations=np.concatenate((first.rotations, second.rotations)),
        translations=np.concatenate((first.translations, second.translations)),
    )


def _faded_over(first: Motion, second: Motion, overlap: int) -> Motion:
    """Join two motions; the last `overlap` frames of the first fade into the first frames of the second."""
    share = smooth_step(np.arange(1, overlap + 1) / (overlap + 1))
    end, start = slice(first.frame_count - overlap, None), slice(None, overlap)
    middle = first._replace(
        root_translations=first.root_translations[end]
        + share[:, None] * (second.root_translations[start] - first.root_translations[end]),
        rotations=blended(first.rotations[end], second.rotations[start], share),
        translations=first.translations[end]
        + share[:, None, None] * (second.translations[start] - first.translations[end]),
    )
    kept = first.sliced(0, first.frame_count - overlap)
    return _in_a_row(_in_a_row(kept, middle), second.sliced(overlap, second.frame_count))


def resample(take: Take, command: Resample) -> Take:
    """Sample the motion at another frame rate; the first frame stays the same.

    Parameters
    ----------
    take : Take    F frames
    command : Resample    the frame rate

    Returns
    -------
    Take    the same motion at the new rate

    Raises
    ------
    EditError    if the result is too long
    """
    rate_hz = command.frame_rate_hz
    take.require_room(count_samples(take.frame_count, take.frame_rate_hz, rate_hz))
    motion = resample_motion(take.motion, take.frame_rate_hz, rate_hz)
    return replace(take, motion=motion, frame_rate_hz=rate_hz)


def retime(take: Take, command: Retime) -> Take:
    """Play the motion faster or slower, at the same frame rate.

    Parameters
    ----------
    take : Take    F frames
    command : Retime    the factor by which the motion becomes faster

    Returns
    -------
    Take    about F / speed frames

    Raises
    ------
    EditError    if the result is too long
    """
    slowed_hz = take.frame_rate_hz / command.speed
    take.require_room(count_samples(take.frame_count, take.frame_rate_hz, slowed_hz))
    return take.moved(resample_motion(take.motion, take.frame_rate_hz, slowed_hz))
