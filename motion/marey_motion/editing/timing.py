"""How many frames a second has, and how fast the motion is."""

from __future__ import annotations

from dataclasses import replace

from marey_motion.editing.take import Take
from marey_motion.resampling import count_samples, resample_motion


def resample(take: Take, *, frame_rate_hz: float) -> Take:
    """The same motion at another rate, first frames coinciding. Raises `EditError` where it gets too long."""
    take.require_room(count_samples(take.frame_count, take.frame_rate_hz, frame_rate_hz))
    motion = resample_motion(take.motion, take.frame_rate_hz, frame_rate_hz)
    return replace(take, motion=motion, frame_rate_hz=frame_rate_hz)


def retime(take: Take, *, speed: float) -> Take:
    """The motion so many times as fast, at the same frame rate. Raises `EditError` where it gets too long."""
    slowed_hz = take.frame_rate_hz / speed
    take.require_room(count_samples(take.frame_count, take.frame_rate_hz, slowed_hz))
    return take.moved(resample_motion(take.motion, take.frame_rate_hz, slowed_hz))
