"""Commands that cut, resample or retime a take."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from marey_motion.editing.take import Take
from marey_motion.errors import EditError
from marey_motion.resampling import count_samples, resample_motion
from marey_schemas.editing.commands import Resample, Retime, Split, Trim


def trim(take: Take, command: Trim) -> Take:
    """Keep a range of frames of a take, and remove all other frames.

    Parameters
    ----------
    take : Take    F frames
    command : Trim    the range

    Returns
    -------
    Take    the frames [start, stop)

    Raises
    ------
    EditError    if the take lacks one of the frames
    """
    first, last = take.frames((command.start, command.stop))
    return take.with_motion(take.motion.sliced(first, last))


def split(take: Take, command: Split) -> tuple[Take, ...]:
    """Cut a take into pieces, each of which becomes a take.

    Parameters
    ----------
    take : Take    F frames
    command : Split    frames at which the take is cut: the first frame of each piece but the first

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
        replace(take.with_motion(take.motion.sliced(start, stop)), pieces=(*take.pieces, number))
        for number, (start, stop) in enumerate(pairwise(bounds), start=1)
    )


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
    return take.with_motion(resample_motion(take.motion, take.frame_rate_hz, slowed_hz))
