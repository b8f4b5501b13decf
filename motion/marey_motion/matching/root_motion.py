"""How the simulation root moves from each row of a matching database to the one that follows it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class RootMotion(NamedTuple):
    """The step that follows each row: a tuple of arrays, so that compiled code takes it as it is.

    Parameters
    ----------
    successors : (N,) int64    the row that follows; -1 after the last row of a clip that does not wrap
    steps : (N, 3) float64    metres to the left and forward, in the frame of the row's root, and radians to the left.
        A clip's end repeats the step that led there: it is what the root's velocity was.
    """

    successors: NDArray[np.int64]
    steps: NDArray[np.float64]


def root_motion(
    positions: NDArray[np.float64], headings: NDArray[np.float64], starts: NDArray[np.int64], wraps: NDArray[np.bool_]
) -> RootMotion:
    """Steps of a root at `positions` (N, 2) with `headings` (N,), for clips that begin at `starts` (C + 1,).

    The step that closes a clip marked in `wraps` (C,) is the mean of its neighbours: the last step and the first.
    """
    count = len(headings)
    successors = np.arange(1, count + 1, dtype=np.int64)
    steps = np.zeros((count, 3))
    sine, cosine = np.sin(headings[:-1]), np.cos(headings[:-1])
    x, z = np.diff(positions, axis=0).T
    steps[:-1, 0] = x * cosine - z * sine
    steps[:-1, 1] = x * sine + z * cosine
    steps[:-1, 2] = np.diff(headings)
    first, last = starts[:-1], starts[1:] - 1
    single = first == last
    steps[last] = np.where(single[:, None], 0.0, steps[last - 1])
    steps[last[wraps]] = 0.5 * (steps[last[wraps]] + steps[first[wraps]])
    successors[last] = np.where(wraps, first, -1)
    return RootMotion(successors, steps)
