"""Fewer frames, or the same in pieces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from marey_motion.editing.take import Take
from marey_motion.errors import EditError


def trim(take: Take, *, start: int = 0, stop: int | None = None) -> Take:
    """Keep the frames [start, stop); without `stop`, up to the end. Raises `EditError` where they are not there."""
    first, last = take.frames((start, stop))
    return take.moved(take.motion.sliced(first, last))


def split(take: Take, *, at: Sequence[int]) -> tuple[Take, ...]:
    """Cut before each of the frames `at`, in increasing order, into one piece more than these.

    Raises `EditError` where a cut lies outside of the motion or would leave a piece without frames.
    """
    bounds = [0, *at, take.frame_count]
    for before, after in pairwise(bounds):
        if after <= before:
            raise EditError(
                f"cuts at {', '.join(map(str, at))} leave a piece without frames; cuts increase, from 1 to "
                f"{take.frame_count - 1}",
                code="frames-missing",
                where="at",
            )
    return tuple(
        replace(take.moved(take.motion.sliced(start, stop)), pieces=(*take.pieces, number))
        for number, (start, stop) in enumerate(pairwise(bounds), start=1)
    )
