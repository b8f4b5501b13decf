"""Registration curves of two clips (Kovar and Gleicher 2003), and the perceptual distance of clips along them.

The path, with its slope limit, and the strictly increasing time function are computed by `marey_motion.alignment`. This
module adds costs that are averaged over a neighbourhood, cyclic shifts, and smoothing of the time function by a spline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion.alignment.dtw import align, align_cyclic
from marey_motion.alignment.warp import LEAST_SLOPE, time_function
from marey_motion.arrays import Floats, Ints32
from marey_motion.errors import MotionError
from marey_motion.perception.maps import joint_differences, motion_map, weighted_shaped
from marey_motion.perception.measuring import MeasuredClip, classes_measured
from marey_motion.perception.metric import PerceptualMetric

NEIGHBOURHOOD_S = 1.0 / 3.0
SLOPE_LIMIT = 3
KNOT_SPACING_S = 0.1
_CUBIC = 3
_MOST_CYCLE_FRAMES = 600


@dataclass(frozen=True, eq=False)
class RegistrationCurve:
    """The correspondence of the frames of two clips.

    Parameters
    ----------
    path : (L, 2) int32    cheapest path, as pairs of frames; frames of the second clip are counted from `shift`
    shift : int    frame of the second clip that corresponds to frame 0 of the first; 0 unless both clips are cyclic
    times : (n,) float64    for each of n frames of the first clip, the corresponding frame of the second clip; strictly
        increasing. If both clips are loops, and the second one has m frames, m + k stands for frame k of its next round
    mean_cost : float    mean cost along the path
    """

    path: Ints32
    shift: int
    times: Floats
    mean_cost: float


@dataclass(frozen=True, eq=False)
class ClipDistance:
    """The perceptual distance of two clips.

    Parameters
    ----------
    total : float    mean frame distance along the registration curve, averaged over both directions
    by_component : tuple of float    distance by each component of the metric alone, before the multiplication by the
        component's share in the total
    """

    total: float
    by_component: tuple[float, ...]


def registration_curve(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> RegistrationCurve:
    """Find the correspondence of the frames of two clips.

    The cost of two frames is the mean distance over a neighbourhood of `NEIGHBOURHOOD_S`. The path takes at most
    `SLOPE_LIMIT` consecutive steps in one clip alone. If both clips are cyclic, every frame of the second clip is tried
    as the start of its cycle, and the path with the least mean cost is kept.

    Parameters
    ----------
    a, b : MeasuredClip    n and m frames
    metric : PerceptualMetric    the metric

    Returns
    -------
    RegistrationCurve    the correspondence

    Raises
    ------
    MotionError    if the clips cannot be compared, their lengths differ too much for the slope limit, or a cycle has
        too many frames for trying all shifts
    """
    cyclic = a.cyclic and b.cyclic
    if cyclic and max(a.frame_count, b.frame_count) > _MOST_CYCLE_FRAMES:
        raise MotionError(
            f"a cycle has more than {_MOST_CYCLE_FRAMES} frames; cut a single cycle, or resample the clips",
            code="too-many-frames",
        )
    costs = neighbourhood_costs(motion_map(a, b, metric), round(0.5 * NEIGHBOURHOOD_S * a.rate_hz), cyclic=cyclic)
    found, shift = align_cyclic(costs, max_run=SLOPE_LIMIT) if cyclic else (align(costs, max_run=SLOPE_LIMIT), 0)
    times = shift + increasing_spline(time_function(found.path), a.rate_hz)
    return RegistrationCurve(found.path, shift, times, found.total / len(found.path))


def neighbourhood_costs(costs: Floats, reach: int, *, cyclic: bool = False) -> Floats:
    """Average costs along diagonals, over `reach` frames before and after each pair of frames.

    Parameters
    ----------
    costs : (n, m) float64    costs of pairs of frames
    reach : int    number of frames before and after
    cyclic : bool    whether both clips continue with their first frame after the last; otherwise, averages near the
        ends are over fewer frames

    Returns
    -------
    (n, m) float64    mean costs
    """
    n, m = costs.shape
    total, counts = np.zeros((n, m)), np.zeros((n, m))
    for step in range(-reach, reach + 1):
        if cyclic:
            total += np.roll(costs, (-step, -step), axis=(0, 1))
            counts += 1.0
            continue
        rows, columns = (slice(max(0, -step), size - max(0, step)) for size in (n, m))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            continue
        from_rows, from_columns = (slice(each.start + step, each.stop + step) for each in (rows, columns))
        total[rows, columns] += costs[from_rows, from_columns]
        counts[rows, columns] += 1.0
    return total / counts


def increasing_spline(times: Floats, rate_hz: float) -> Floats:
    """Smooth a time function by a strictly increasing cubic spline with a knot every `KNOT_SPACING_S`.

    The spline increases if its coefficients increase. Therefore, the differences between successive coefficients are
    fitted by least squares, with a positive lower bound. The first and the last value do not change.

    Parameters
    ----------
    times : (n,) float64    increasing times at frames 0 to n - 1
    rate_hz : float    frames per second

    Returns
    -------
    (n,) float64    strictly increasing times
    """
    from scipy.interpolate import BSpline
    from scipy.optimize import lsq_linear  # pyrefly: ignore[implicit-reexport]  # scipy collects its names when it runs

    last = len(times) - 1
    spans = max(1, round(last / (KNOT_SPACING_S * rate_hz)))
    knots = np.concatenate((np.zeros(_CUBIC), np.linspace(0.0, last, spans + 1), np.full(_CUBIC, float(last))))
    frames = np.arange(len(times), dtype=np.float64)
    design = BSpline.design_matrix(frames, knots, _CUBIC).toarray()
    # The value is the first coefficient plus the steps; the last step follows from the fixed end.
    steps = np.cumsum(design[:, ::-1], axis=1)[:, ::-1][:, 1:]
    widths = np.diff(np.convolve(knots[1:-1], np.full(_CUBIC, 1.0 / _CUBIC), mode="valid"))
    least = LEAST_SLOPE * widths
    rise = times[-1] - times[0]
    free, end = steps[:, :-1] - steps[:, -1:], steps[:, -1]
    found = lsq_linear(free, times - times[0] - rise * end, bounds=(least[:-1], np.inf), tol=1e-14).x
    found = np.append(found, rise - found.sum())
    if found[-1] < least[-1]:  # the end would fall back; the steps above the least ones give way in proportion
        spare = np.maximum(found - least, 0.0)
        spare[-1] = 0.0
        found = least + spare * (rise - least.sum()) / spare.sum()
    return np.asarray(times[0] + steps @ found)


def clip_distance(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> ClipDistance:
    """Compute the perceptual distance of two clips: the mean frame distance along the registration curve.

    The constant c of each component is added once. The result is the mean of the distances from `a` to `b` and from
    `b` to `a`, so it is symmetric. It need not satisfy the triangle inequality.

    Parameters
    ----------
    a, b : MeasuredClip    clips of one skeleton
    metric : PerceptualMetric    the metric

    Returns
    -------
    ClipDistance    total distance, and the distance by each component

    Raises
    ------
    MotionError    if the clips cannot be compared, if their lengths differ too much for the slope limit of the curve,
        or if a cycle has too many frames for trying all shifts
    """
    directions = np.array([_directed(*pair, metric) for pair in ((a, b), (b, a))])
    raw = directions.mean(axis=0)
    parts = [
        component.norm * mean + component.constant * (mean > 0.0 or metric.identity == "constant")
        for component, mean in zip(metric.components, raw, strict=True)
    ]
    return ClipDistance(float(np.dot(metric.shares, parts)), tuple(map(float, parts)))


def differences_along_curve(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> tuple[Floats, ...]:
    """Compute the differences of all joint classes along the registration curves of both directions.

    Parameters
    ----------
    a, b : MeasuredClip    n and m frames
    metric : PerceptualMetric    metric of the registration; its weights have no other influence

    Returns
    -------
    tuple of (n + m, K) float64    difference x per frame and class, for each component of the metric: n frames of `a`
        with their corresponding frames of `b`, then m frames of `b` with those of `a`

    Raises
    ------
    MotionError    if the clips cannot be compared, if their lengths differ too much for the slope limit of the curve,
        or if a cycle has too many frames for trying all shifts
    """
    pairs = [(one, other.at(registration_curve(one, other, metric).times)) for one, other in ((a, b), (b, a))]
    return tuple(
        np.concatenate([joint_differences(one, other, metric, component) for one, other in pairs])
        for component in metric.components
    )


def _directed(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> list[float]:
    """Compute, for each component of the metric, the mean of Σ w F(x) along the registration curve from `a` to `b`."""
    there = b.at(registration_curve(a, b, metric).times)
    return [
        float(
            weighted_shaped(
                joint_differences(a, there, metric, component), component, classes_measured(a, component.measurement)
            ).mean()
        )
        for component in metric.components
    ]
