"""Cost of each pair of frames of two motions: the difference of their poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_schemas.options.alignment import CostOptions


class CostPoints(NamedTuple):
    """The points of one motion of n frames, prepared for comparison with other motions.

    Costs are averaged over a window of W frames (`CostOptions.window`). The motion is extended to F = n + W - 1 frames
    by copies of its first and last frames, so that each of its n frames is the middle of a window.

    For the cost `turned`, horizontal positions are relative to a centre. If W is 1, it is the weighted centre of the
    points of each frame; otherwise, it is the mean of these centres over all frames. For the cost `plain`, positions
    are not centred, and `energies` and `centres` are not used.

    Parameters
    ----------
    rows : (F, P, 3) float64    positions, multiplied by the square root of each point's share of the total weight
    columns : (P, 3, F) float64    the same, transposed
    energies : (n,) float64    for each window, the weighted sum of the squared horizontal distances of its points from
        their weighted centre
    centres : (n, 2) float64    for each window, the horizontal weighted centre of its points; zero if W is 1, or if the
        cost is `plain`
    """

    rows: Floats
    columns: Floats
    energies: Floats
    centres: Floats


def frame_costs(a: Floats, b: Floats, options: CostOptions | None = None, weights: ArrayLike | None = None) -> Floats:
    """Compute the cost of each pair of frames of two motions.

    The cost is the weighted mean of the squared distances between corresponding points. If the option `cost` is
    `turned`, the distances are those after the best rotation about the vertical and the best shift on the ground. If
    the option `window` is above 1, the cost is the mean over a window of frames.

    Parameters
    ----------
    a : (n, P, 3) float64    points in metres, Y up
    b : (m, P, 3) float64    the same points of the other motion
    options : CostOptions, optional    kind of cost, and window
    weights : (P,), optional    non-negative weights of the points, with any sum; all equal if None

    Returns
    -------
    (n, m) float64    square metres

    Raises
    ------
    MotionError    if the shapes of the points do not match, a position is not finite or the weights are invalid

    Notes
    -----
    The cost `turned` is equation 1 of Kovar and Gleicher (2002), divided by the sum of weights. Let the complex numbers
    z be the horizontal positions relative to their weighted centre. The minimum over all rotations and shifts is then
    Σ w|z_a|² + Σ w|z_b|² - 2 |Σ w z_a z̄_b|, plus the weighted sum of the squared differences of height.

    All frames of a window are rotated and shifted together. A window that extends beyond the motion is filled with
    copies of the first or the last frame.
    """
    options = options or CostOptions()
    require_same_points(a, b)
    return costs_between(cost_points(a, options, weights), cost_points(b, options, weights), options)


def cost_points(points: Floats, options: CostOptions, weights: ArrayLike | None = None) -> CostPoints:
    """Prepare the points of a motion for comparison.

    Parameters
    ----------
    points : (n, P, 3) float64    metres, Y up
    options : CostOptions    kind of cost, and window
    weights : (P,), optional    as in `frame_costs`

    Returns
    -------
    CostPoints    input of `costs_between`

    Raises
    ------
    MotionError    for positions that are not finite, and for invalid weights
    """
    columns = np.array(points.transpose(1, 2, 0), dtype=np.float64, order="C")
    if not np.isfinite(columns).all():
        raise MotionError(
            "a position is infinite or not a number", where=f"frame {int(np.argwhere(~np.isfinite(points))[0, 0])}"
        )
    shares = _shares(weights, points.shape[1])
    window = options.window
    if window > 1:
        columns = np.pad(columns, ((0, 0), (0, 0), (window // 2, window // 2)), mode="edge")
    ground, centres = columns[:, ::2], np.zeros((2, len(points)))
    if options.cost == "turned":
        middle = np.einsum("p,pcf->cf", shares, ground)
        ground -= middle if window == 1 else middle.mean(axis=1, keepdims=True)
        if window > 1:
            centres = _boxed(middle - middle.mean(axis=1, keepdims=True), window) / window
    columns *= np.sqrt(shares)[:, None, None]
    squares = np.einsum("pcf,pcf->f", ground, ground)
    energies = _boxed(squares, window) - window * np.einsum("cn,cn->n", centres, centres)
    return CostPoints(np.ascontiguousarray(columns.transpose(2, 0, 1)), columns, energies, centres.T.copy())


def costs_between(a: CostPoints, b: CostPoints, options: CostOptions) -> Floats:
    """Compute the cost of each pair of frames, as `frame_costs` does, for points that are already prepared.

    Parameters
    ----------
    a, b : CostPoints    n and m frames, prepared with the same options
    options : CostOptions    the options with which the points were prepared

    Returns
    -------
    (n, m) float64    square metres
    """
    from marey_motion.alignment import cost_kernels as kernels

    costs = np.empty((len(a.energies), len(b.energies)))
    if options.cost == "turned":
        if options.window == 1:
            kernels.turned(a.rows, b.columns, a.energies, b.energies, costs)
        else:
            kernels.turned_windows(a, b, options.window, costs)
    elif options.window == 1:
        kernels.plain(a.rows, b.columns, costs)
    else:
        kernels.plain_windows(a.rows, b.columns, options.window, costs)
    return costs


def require_same_points(a: NDArray[np.floating], b: NDArray[np.floating]) -> None:
    """Check that two motions consist of positions of the same number of points.

    Parameters
    ----------
    a : (n, P, 3)    points of one motion
    b : (m, P, 3)    points of the other motion

    Raises
    ------
    MotionError    if the shapes differ in more than the number of frames, or an array is empty
    """
    if a.ndim != 3 or a.shape[1:] != b.shape[1:] or a.shape[2] != 3 or not a.size or not b.size:
        raise MotionError(
            "both motions must have the shape (frames, points, 3) with the same number of points; their "
            f"shapes are {a.shape} and {b.shape}"
        )


def _shares(weights: ArrayLike | None, count: int) -> Floats:
    given = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if given.shape != (count,):
        raise MotionError(
            f"the weights have the shape {given.shape}, but one weight for each of {count} points is needed",
            where="weights",
        )
    if not (np.isfinite(given).all() and (given >= 0).all() and given.sum() > 0):
        raise MotionError("weights must be finite and at least 0, and at least one must be above 0", where="weights")
    return np.asarray(given / given.sum())


def _boxed(values: Floats, window: int) -> Floats:
    """Compute the moving sums of `window` consecutive values along the last axis."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(values, window, axis=-1).sum(axis=-1))
