"""Moments of clips in texts: `walks/take-01:30-90` for frames 30 to 89, `walks/take-01:30` for a single pose."""

from __future__ import annotations

import re
from typing import NamedTuple

_MOMENT = re.compile(r"(?P<clip>.+):(?P<first>[0-9]{1,9})(?:[-:](?P<end>[0-9]{1,9}))?", re.DOTALL)


class Moment(NamedTuple):
    """Some frames of a clip: its path, the first frame, and the one after the last."""

    clip: str
    frames: tuple[int, int]


def read_moment(text: str) -> Moment:
    """Return the moment that a text names. Raises `ValueError`, which says what is wrong."""
    parsed = _MOMENT.fullmatch(text)
    if parsed is None:
        raise ValueError(f"{text!r} names no frames; add :120-180 to the clip, or :120 for a single pose")
    first = int(parsed["first"])
    end = first + 1 if parsed["end"] is None else int(parsed["end"])
    if end <= first:
        raise ValueError(f"{text!r}: the end, frame {end}, must be after the start, frame {first}")
    return Moment(parsed["clip"], (first, end))
