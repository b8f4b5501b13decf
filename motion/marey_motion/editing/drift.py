"""Where the body ends up, corrected little by little."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from marey_motion.editing.borders import smooth_step
from marey_motion.editing.placement import carried, pelvis_track
from marey_motion.editing.take import Take
from marey_motion.errors import EditError
from marey_motion.looping import about_vertical


def fix_drift(
    take: Take,
    *,
    shift_m: Sequence[float] = (0.0, 0.0, 0.0),
    turn_rad: float = 0.0,
    frames: tuple[int, int | None] | None = None,
    profile: Literal["linear", "smooth"] = "linear",
) -> Take:
    """Spread a shift and a turn about the vertical over a range: none of it in its first frame, all in its last.

    Within the range each frame turns about its own pelvis; the frames after it follow the last one rigidly. Raises
    `EditError` where the frames are not there or there is but one.
    """
    start, stop = take.frames(frames)
    if stop - start < 2:
        raise EditError(
            f"drift needs a range of at least 2 frames to spread over; {start}:{stop} is one",
            code="frames-missing",
            where="frames",
        )
    places = np.clip((np.arange(take.frame_count) - start) / (stop - 1 - start), 0.0, 1.0)
    shares = places if profile == "linear" else smooth_step(places)
    pivots = pelvis_track(take, 0, take.frame_count)
    pivots[stop:] = pivots[stop - 1]
    turns = about_vertical(shares * turn_rad)
    return take.moved(carried(take.motion, turns, pivots, shares[:, None] * np.asarray(shift_m)))
