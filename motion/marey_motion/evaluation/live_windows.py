"""Windows of one second of a motion whose frames arrive one by one, at a constant cost per frame.

The windows are those of `coverage.sliding_windows`.

The root is smoothed as in `matching.simulation_root`. The filters look half a second ahead, so results are half a
second late (`LiveWindows.delay_s`). When a take ends, its last frames are smoothed like the end of a clip, so that no
window is missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import WINDOW_S, Windows
from marey_motion.matching.simulation_root import (
    DIRECTION_WINDOW_S,
    FILTER_ORDER,
    POSITION_WINDOW_S,
    SHORTEST_MEAN,
    SHORTEST_WINDOW,
    window_frames,
)
from marey_schemas.options.evaluation import LEAST_FRAME_RATE_HZ, MOST_FRAME_RATE_HZ


class LiveTake(NamedTuple):
    """State of the current take: ring buffers, in which frame f of the take is at f modulo the buffer's length.

    Parameters
    ----------
    raw : (D, 4)    ground position (x, z) in metres and unit facing (x, z) of the newest frames, not smoothed
    steps : (S, 3)    newest steps of the smoothed root from frame to frame: length, forward part and leftward part,
        metres
    headings : (S + 1,)    newest headings of the smoothed root, radians, continuous
    sums : (3,)    sums of the columns of `steps`
    root : (3,)    ground position (x, z) and heading of the smoothed root, in the newest smoothed frame
    counters : (2,) int64    number of frames received and number of frames smoothed
    """

    raw: Floats
    steps: Floats
    headings: Floats
    sums: Floats
    root: Floats
    counters: NDArray[np.int64]


class Filters(NamedTuple):
    """Smoothers of the position and of the direction, made by `smoother`."""

    positions: Floats
    directions: Floats


class LiveWindows:
    """Computation of windows of one second for a live performance, one take after another.

    Parameters
    ----------
    rate_hz : float    frames per second of the performance

    Raises
    ------
    MotionError    if the frame rate is too low or too high
    """

    def __init__(self, rate_hz: float) -> None:
        if not LEAST_FRAME_RATE_HZ <= rate_hz <= MOST_FRAME_RATE_HZ:
            raise MotionError(
                f"the frame rate must be {LEAST_FRAME_RATE_HZ:g} to {MOST_FRAME_RATE_HZ:g} Hz, not {rate_hz:g}; "
                "send every n-th frame of a faster recording",
                where="frame_rate_hz",
            )
        self.rate_hz = rate_hz
        self._span = round(WINDOW_S * rate_hz)
        self._filters = Filters(
            smoother(window_frames(POSITION_WINDOW_S, rate_hz)), smoother(window_frames(DIRECTION_WINDOW_S, rate_hz))
        )
        self._take = self._empty_take()

    @property
    def delay_s(self) -> float:
        """Seconds until a frame becomes part of a window: half the width of the filter of directions."""
        return len(self._filters.directions) // 2 / self.rate_hz

    @property
    def frame_count(self) -> int:
        """Number of frames received in the current take."""
        return int(self._take.counters[0])

    @property
    def newest_frame(self) -> Floats | None:
        """Unsmoothed position (x, z) in metres and facing (x, z) of the newest frame; None at the start of a take."""
        return self._take.raw[(self.frame_count - 1) % len(self._take.raw)].copy() if self.frame_count else None

    @property
    def newest_window(self) -> Windows | None:
        """The last window of the current take, with scalars instead of arrays; None if no window is complete."""
        from marey_motion.evaluation import live_kernels

        window = np.empty(4)
        if not live_kernels.newest_window(self._take, self._duration_s, window):
            return None
        return Windows._make(window)

    def receive(self, frames: Floats) -> Windows:
        """Add the next frames of the take.

        Parameters
        ----------
        frames : (n, 4) float64    ground position (x, z) in metres and unit facing (x, z)

        Returns
        -------
        Windows    the windows that these frames complete
        """
        from marey_motion.evaluation import live_kernels

        windows = np.empty((len(frames) + len(self._take.raw), 4))
        frames = np.array(frames, dtype=np.float64, order="C")
        count = live_kernels.receive(self._take, self._filters, frames, self._duration_s, SHORTEST_MEAN, windows)
        return Windows(*windows[:count].T)

    def end_take(self) -> Windows:
        """End the take; the next frame begins a new one.

        Returns
        -------
        Windows    the windows of the take's last frames
        """
        from marey_motion.evaluation import live_kernels

        windows = np.empty((len(self._take.raw), 4))
        filters = Filters(*(_shortened(one, self.frame_count) for one in self._filters))
        count = live_kernels.finish(self._take, filters, self._duration_s, SHORTEST_MEAN, windows)
        self._take = self._empty_take()
        return Windows(*windows[:count].T)

    def as_tree(self) -> dict[str, Any]:
        """Save the state for `from_tree`.

        Returns
        -------
        dict    plain values and arrays
        """
        return {"rate_hz": self.rate_hz, **{name: value.copy() for name, value in self._take._asdict().items()}}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> LiveWindows:
        """Restore exactly the state that `as_tree` saved, to the last bit.

        Parameters
        ----------
        tree : mapping    plain values and arrays

        Returns
        -------
        LiveWindows    windows that continue with the next frame
        """
        live = cls(tree["rate_hz"])
        for name, own in live._take._asdict().items():
            own[...] = tree[name]
        return live

    @property
    def _duration_s(self) -> float:
        return self._span / self.rate_hz

    def _empty_take(self) -> LiveTake:
        return LiveTake(
            raw=np.zeros((len(self._filters.directions), 4)),
            steps=np.zeros((self._span, 3)),
            headings=np.zeros(self._span + 1),
            sums=np.zeros(3),
            root=np.zeros(3),
            counters=np.zeros(2, dtype=np.int64),
        )


@lru_cache(maxsize=32)
def smoother(window: int) -> Floats:
    """Make the matrix of a Savitzky-Golay filter: row i estimates frame i of a window from all its frames.

    The middle row is the filter. The rows before it are for the beginning of a take, and the rows after it for the end
    of a take: there, the polynomial of the outermost window is evaluated up to the edge. If the window is too short for
    the polynomial, the result is the identity of shape (1, 1), which leaves values unchanged.

    Parameters
    ----------
    window : int    odd number of frames

    Returns
    -------
    (window, window) float64    weights
    """
    if window < SHORTEST_WINDOW:
        basis = np.ones((1, 1))
    else:
        basis, _ = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, window), FILTER_ORDER))
    matrix: Floats = np.ascontiguousarray(basis @ basis.T)
    matrix.setflags(write=False)
    return matrix


def _shortened(matrix: Floats, frame_count: int) -> Floats:
    """Return the smoother for a take of `frame_count` frames.

    If the take is shorter than the window of `matrix`, the smoother's window has the largest odd number of frames that
    fits into the take.
    """
    return matrix if frame_count >= len(matrix) else smoother(frame_count - (frame_count + 1) % 2)
