"""Dynamic time warping: the cheapest path through a matrix of costs from its first cell to its last.

A path has steps of one frame in both motions (1-1), in the first alone (1-0) or in the second alone (0-1). Its cost is
the sum of the costs of all its cells (Sakoe and Chiba 1978, without weights). All results are exact: the path is not
limited to a band around the diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marey_motion.alignment.cost import require_same_points
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError

FRAMES_PER_BOX = 16
# Lower bounds are sums of many terms; they are lowered by more than their rounding errors, so that they remain bounds.
_ROUNDING_SLACK = 1.0 - 1e-9


@dataclass(frozen=True, eq=False)
class Alignment:
    """An alignment path through a matrix of n × m costs.

    Parameters
    ----------
    path : (L, 2) int32    pairs of a frame of the first motion and a frame of the second, from (0, 0) to (n - 1, m - 1)
    total : float    sum of the costs along the path
    """

    path: NDArray[np.int32]
    total: float


def align(costs: ArrayLike, *, max_run: int | None = None) -> Alignment:
    """Find the cheapest path through a matrix of costs.

    A step 1-0, for example, advances by one frame in the first motion and by none in the second. Among equally cheap
    paths, a step 1-1 is preferred to 1-0, and 1-0 to 0-1.

    Parameters
    ----------
    costs : (n, m) float    finite costs of each pair of frames
    max_run : int, optional    maximum number of consecutive steps 1-0, and of consecutive steps 0-1 (the slope limit of
        Kovar and Gleicher 2003); unlimited if None

    Returns
    -------
    Alignment    path and total

    Raises
    ------
    MotionError    if a cost is not finite, if `max_run` is not 0 to 60, or if no path satisfies `max_run`
    """
    from marey_motion.alignment import dtw_kernels as kernels

    matrix = _checked(costs, max_run)
    longest = np.empty((sum(matrix.shape) - 1, 2), dtype=np.int32)
    if max_run is None:
        total, length = kernels.align(matrix, longest)
    else:
        total, length = kernels.align_limited(matrix, max_run, longest)
    return _found(matrix, max_run, longest[:length], total)


def align_cyclic(costs: ArrayLike, *, max_run: int) -> tuple[Alignment, int]:
    """Find the path with the least mean cost if the second motion is cyclic.

    A cyclic motion continues with its first frame after its last one, so the path may start at any of its frames.

    Parameters
    ----------
    costs : (n, m) float    finite costs of each pair of frames
    max_run : int    maximum number of consecutive steps that advance only one motion, as for `align`

    Returns
    -------
    alignment : Alignment    path, which counts frames of the second motion from `shift`, and total
    shift : int    frame of the second motion that corresponds to frame 0 of the first

    Raises
    ------
    MotionError    for the same reasons as in `align`
    """
    from marey_motion.alignment import dtw_kernels as kernels

    matrix = _checked(costs, max_run)
    longest = np.empty((sum(matrix.shape) - 1, 2), dtype=np.int32)
    total, length, shift = kernels.align_limited_cyclic(matrix, max_run, longest)
    return _found(matrix, max_run, longest[:length], total), int(shift)


def least_total(costs: Floats, *, max_run: int | None = None) -> float:
    """Compute the total cost of the cheapest path through a matrix of costs, without the path (see `align`).

    Parameters
    ----------
    costs : (n, m) float64    result of `frame_costs`
    max_run : int, optional    as for `align`

    Returns
    -------
    float    in the unit of the costs; infinite if no path satisfies `max_run`
    """
    from marey_motion.alignment import dtw_kernels as kernels

    costs = np.ascontiguousarray(costs)
    return float(kernels.total(costs) if max_run is None else kernels.total_limited(costs, max_run))


def _found(matrix: Floats, max_run: int | None, backwards: NDArray[np.int32], total: float) -> Alignment:
    """Reverse a path that runs from the last cell to the first; raise `MotionError` if `total` is infinite."""
    if not np.isfinite(total):
        raise MotionError(
            f"{len(matrix)} frames cannot be aligned with {matrix.shape[1]} frames if one motion may pause for "
            f"at most {max_run} frames of the other; raise the slope limit",
            code="alignment-impossible",
            where="max_run",
        )
    return Alignment(backwards[::-1].copy(), float(total))


def _checked(costs: ArrayLike, max_run: int | None) -> Floats:
    matrix = np.ascontiguousarray(costs, dtype=np.float64)
    if matrix.ndim != 2 or not matrix.size:
        raise MotionError(
            f"the costs must be a matrix with at least one row and one column, but have the shape {matrix.shape}"
        )
    # The least and the greatest cost suffice; a matrix of flags would take longer than the alignment.
    if not (np.isfinite(matrix.min()) and np.isfinite(matrix.max())):
        raise MotionError(
            "a cost is infinite or not a number", where=f"cell {np.argwhere(~np.isfinite(matrix))[0].tolist()}"
        )
    if max_run is not None and not 0 <= max_run <= 60:
        raise MotionError(
            f"the number of consecutive steps that advance only one motion must be 0 to 60, not {max_run}",
            where="max_run",
        )
    return matrix


def distances(a: NDArray[np.floating], b: NDArray[np.floating]) -> Floats:
    """Compute the mean distance between corresponding points, for each pair of frames of two motions.

    Parameters
    ----------
    a : (n, P, 3)    points of one motion, metres
    b : (m, P, 3)    the same points of the other motion, metres

    Returns
    -------
    (n, m) float64    metres
    """
    from marey_motion.alignment import dtw_kernels as kernels

    found = np.empty((len(a), len(b)))
    kernels.distances(*_points(a, b), found)
    return found


def warped_distance(a: NDArray[np.floating], b: NDArray[np.floating], *, limit: float = np.inf) -> float:
    """Compute the distance of two motions after dynamic time warping.

    The distance of two frames is the mean distance of their points. These distances are summed along the cheapest path
    and divided by the number of frames of the longer motion. The memory is O(n + m), not O(n·m).

    Parameters
    ----------
    a : (n, P, 3)    points of one motion, metres
    b : (m, P, 3)    the same points of the other motion, metres
    limit : float    metres; the computation stops as soon as the result is certain to exceed this limit

    Returns
    -------
    float    metres; infinite if the result exceeds `limit`
    """
    from marey_motion.alignment import dtw_kernels as kernels

    longer = max(len(a), len(b))
    one, other = _points(a, b)
    costs = _box_costs(one, b, FRAMES_PER_BOX) * _ROUNDING_SLACK
    rest = np.concatenate((np.cumsum(costs[:0:-1])[::-1], [0.0]))
    if costs[0] + rest[0] > limit * longer:
        return np.inf
    return float(kernels.total_within(one, other, rest, limit * longer) / longer)


def distance_bound(a: NDArray[np.floating], b: NDArray[np.floating], *, frames_per_box: int = FRAMES_PER_BOX) -> float:
    """Compute a lower bound of `warped_distance(a, b)` in much less time.

    One motion is divided into runs of `frames_per_box` frames, and each run is enclosed in a bounding box per point.
    Every frame of the other motion is on the warping path at least once and costs at least its distance from the
    nearest box. The bound is the largest of four numbers, divided by the number of frames of the longer motion: the sum
    of these distances, the same sum with the motions exchanged, and the costs of the first and the last cell, which are
    on every path.

    Parameters
    ----------
    a : (n, P, 3)    points of one motion, metres
    b : (m, P, 3)    the same points of the other motion, metres
    frames_per_box : int    frames in each box

    Returns
    -------
    float    metres
    """
    one, other = _points(a, b)[0], _points(b, a)[0]
    boxes = _box_costs(one, other, frames_per_box).sum(), _box_costs(other, one, frames_per_box).sum()
    ends = [np.linalg.norm(one[frame] - other[frame], axis=-1).mean() for frame in (0, -1)]
    return float(max(*boxes, *ends) * _ROUNDING_SLACK / max(len(a), len(b)))


class RangeBounds:
    """Lower bounds of `warped_distance` between motions, computed from one bounding box per motion and point.

    Parameters
    ----------
    points : (N, P, 3)    points of all motions, metres
    starts, stops : (R,) int    frames [start, stop) of each motion, not empty
    """

    def __init__(self, points: NDArray[np.floating], starts: NDArray[np.int64], stops: NDArray[np.int64]) -> None:
        self._points = np.ascontiguousarray(points, dtype=np.float64)
        self._starts, self._stops = starts, stops
        ranges = [self._points[start:stop] for start, stop in zip(starts, stops, strict=True)]
        self._low, self._high = (np.stack([edge(part, axis=0) for part in ranges]) for edge in (np.min, np.max))

    def between(self, one: int, others: NDArray[np.int64], *, limit: float = np.inf) -> Floats:
        """Compute lower bounds of `warped_distance` from one motion to others.

        Parameters
        ----------
        one : int    index of the motion
        others : (K,) int64    indices of the other motions
        limit : float    metres; a bound that exceeds this limit is not improved further

        Returns
        -------
        (K,) float64    metres
        """
        from marey_motion.alignment import dtw_kernels as kernels

        bounds = np.empty(len(others))
        kernels.range_bounds(
            self._points, self._starts, self._stops, self._low, self._high, one, others, limit / _ROUNDING_SLACK, bounds
        )
        return bounds * _ROUNDING_SLACK


def _box_costs(a: Floats, b: NDArray[np.floating], frames_per_box: int) -> Floats:
    """Compute the distance (n,) of each frame of `a` from the nearest bounding box of `frames_per_box` frames of `b`.

    `a` (n, P, 3) and `b` (m, P, 3) are points; the distance is the mean over the points.
    """
    from marey_motion.alignment import dtw_kernels as kernels

    starts = np.arange(0, len(b), frames_per_box)
    low, high = (
        np.ascontiguousarray(edge.reduceat(b, starts, axis=0).transpose(1, 2, 0), dtype=np.float64)
        for edge in (np.minimum, np.maximum)
    )
    costs = np.empty(len(a))
    kernels.box_costs(a, low, high, costs)
    return costs


def _points(a: NDArray[np.floating], b: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Arrange the points of two motions (n, P, 3) and (m, P, 3) for kernels, as (n, P, 3) and (P, 3, m)."""
    require_same_points(a, b)
    return np.ascontiguousarray(a, dtype=np.float64), np.ascontiguousarray(b.transpose(1, 2, 0), dtype=np.float64)
