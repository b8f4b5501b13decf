"""Motion maps: perceptual distances between the frames of two clips, per component and combined."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from marey_motion.arrays import Floats, Indices, Ints
from marey_motion.errors import MotionError
from marey_motion.kinematics import as_kernel_input
from marey_motion.perception.measuring import MeasuredClip, classes_measured, require_comparable
from marey_motion.perception.metric import Component, PerceptualMetric, shaped

MOST_CELLS = 50_000_000
"""Maximum number of cells of a map that `motion_map` returns; compute a larger map by `map_blocks`."""
SHAPING_NUMBERS = {"euclid": 0, "manhattan": 1, "sigmoid": 2, "power": 3}
ANGLE_NUMBERS = {"half_angle": 0, "log_norm": 0, "angle": 1, "one_minus_dot": 2}
"""Numbers that stand for shapings (`SHAPING_NUMBERS`) and for measures of angles (`ANGLE_NUMBERS`) in kernels."""
_BLOCK_CELLS = 4_000_000
_NO_POINTS = np.empty((1, 0, 2))


def motion_map(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> Floats:
    """Compute the distance of each frame of a clip from each frame of another.

    Parameters
    ----------
    a, b : MeasuredClip    n and m frames
    metric : PerceptualMetric    the metric

    Returns
    -------
    (n, m) float64    distances, without unit

    Raises
    ------
    MotionError    if the clips cannot be compared, or the map has more than `MOST_CELLS` cells
    """
    _require_size(a, b)
    return np.concatenate([block for _, block in map_blocks(a, b, metric)])


def component_map(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric, component: Component) -> Floats:
    """Compute a motion map for one component of a metric.

    Parameters
    ----------
    a, b : MeasuredClip    n and m frames
    metric : PerceptualMetric    conventions of the measurement
    component : Component    component, which need not be one of the metric

    Returns
    -------
    (n, m) float64    distances of the component, without unit

    Raises
    ------
    MotionError    if the clips cannot be compared, or the map has more than `MOST_CELLS` cells
    """
    return motion_map(a, b, replace(metric, components=(component,), shares=(1.0,)))


def map_blocks(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> Iterator[tuple[int, Floats]]:
    """Compute a motion map in blocks of rows, so that the memory does not grow with the length of `a`.

    Parameters
    ----------
    a, b : MeasuredClip    n and m frames
    metric : PerceptualMetric    the metric

    Yields
    ------
    start : int    first frame of `a` in the block
    block : (r, m) float64    distances of r frames of `a` from all frames of `b`

    Raises
    ------
    MotionError    if the clips cannot be compared
    """
    require_comparable(a, b)
    rows = max(1, _BLOCK_CELLS // b.frame_count)
    for start in range(0, a.frame_count, rows):
        frames = slice(start, start + rows)
        total = np.zeros((len(a.positions[frames]), b.frame_count))
        for share, component in zip(metric.shares, metric.components, strict=True):
            if share:
                total += share * _distances(_raw(a, b, metric, component, frames), component, metric)
        yield start, total


def joint_differences(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric, component: Component) -> Floats:
    """Compute the difference x of each joint class between frame i of one clip and frame i of another.

    Parameters
    ----------
    a, b : MeasuredClip    n frames each
    metric : PerceptualMetric    conventions of the measurement; the weights have no influence
    component : Component    component whose measurement is compared

    Returns
    -------
    (n, K) float64    x per frame and class of `classes_measured`: angles in the measure `metric.angle`, positions in
        the metric's units of length, velocities in units of length per `metric.velocity_interval_s`

    Raises
    ------
    MotionError    if the clips cannot be compared
    """
    require_comparable(a, b)
    starts, scales = _layout(a, metric, component)
    if component.measurement == "angles":
        one, other = a.rotations[:, _angled(a)], b.rotations[:, _angled(a)]
        chord = np.minimum(np.linalg.norm(one - other, axis=-1), np.linalg.norm(one + other, axis=-1))
        half = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
        distances = {0: half, 1: 2.0 * half, 2: 0.5 * chord**2}[ANGLE_NUMBERS[metric.angle]]
    else:
        one, other = _vectors(a, component, metric), _vectors(b, component, metric)
        if metric.root_alignment == "kovar2d":
            other = _superposed(a, b, other)
        distances = np.linalg.norm(one - other, axis=-1)
    return np.asarray(np.add.reduceat(distances, starts[:-1], axis=1) * scales)


def paired_distances(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> Floats:
    """Compute the distance of frame i of one clip from frame i of another.

    Parameters
    ----------
    a, b : MeasuredClip    n frames each
    metric : PerceptualMetric    the metric

    Returns
    -------
    (n,) float64    distances, without unit

    Raises
    ------
    MotionError    if the clips cannot be compared
    """
    total = np.zeros(a.frame_count)
    for share, component in zip(metric.shares, metric.components, strict=True):
        differences = joint_differences(a, b, metric, component)
        raw = weighted_shaped(differences, component, classes_measured(a, component.measurement))
        total += share * _distances(raw, component, metric)
    return total


def weighted_shaped(differences: Floats, component: Component, classes: tuple[str, ...]) -> Floats:
    """Compute the weighted mean Σ w F(x) of shaped differences, with weights w that are divided by their sum.

    Parameters
    ----------
    differences : (n, K) float64    x per class
    component : Component    weights w and shaping F
    classes : tuple of str    the K classes

    Returns
    -------
    (n,) float64    weighted means
    """
    return np.asarray(shaped(differences, component.shaping, component.exponent) @ component.shares_of(classes))


def _distances(raw: Floats, component: Component, metric: PerceptualMetric) -> Floats:
    """Compute distances c + N · raw; equal poses (raw = 0) have the distance 0 or c, depending on `metric.identity`."""
    found = component.norm * raw
    found += component.constant * (raw > 0.0) if metric.identity == "zero" else component.constant
    return found


def _raw(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric, component: Component, frames: slice) -> Floats:
    from marey_motion.perception import map_kernels as kernels

    starts, scales = _layout(a, metric, component)
    weights = component.shares_of(classes_measured(a, component.measurement))
    shape = (SHAPING_NUMBERS[component.shaping], component.exponent)
    if component.measurement == "angles":
        one, other = a.rotations[frames][:, _angled(a)], b.rotations[:, _angled(a)]
    else:
        one, other = _vectors(a, component, metric)[frames], _vectors(b, component, metric)
    out = np.empty((len(one), b.frame_count))
    tables = (as_kernel_input(one), as_kernel_input(other.transpose(1, 2, 0)), starts, scales, weights, shape)
    if component.measurement == "angles":
        kernels.rotations(*tables, ANGLE_NUMBERS[metric.angle], out)
        return out
    ground = (_NO_POINTS, _NO_POINTS)
    if metric.root_alignment == "kovar2d":
        ground = _centred(a)[frames], _centred(b).transpose(1, 2, 0)
    kernels.vectors(*tables, (as_kernel_input(ground[0]), as_kernel_input(ground[1])), out)
    return out


def _layout(clip: MeasuredClip, metric: PerceptualMetric, component: Component) -> tuple[Ints, Floats]:
    """Return the first point of each class and the number of points, as one array (K + 1,), and factors (K,).

    The difference of a class is its factor times the sum of the distances of its points.
    """
    kept = classes_measured(clip, component.measurement)
    counts = np.diff(clip.starts)[[name in kept for name in clip.classes]]
    starts = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
    return starts, 1.0 / counts if metric.side_reduce == "mean" else np.ones(len(counts))


def _angled(clip: MeasuredClip) -> Indices:
    """Return the indices of the points whose joint classes have angles."""
    kept = classes_measured(clip, "angles")
    return np.flatnonzero(np.repeat([name in kept for name in clip.classes], np.diff(clip.starts)))


def _vectors(clip: MeasuredClip, component: Component, metric: PerceptualMetric) -> Floats:
    """Convert the positions or velocities (F, P, 3) of a clip to the units of the metric."""
    if component.measurement == "velocities":
        return clip.velocities * (metric.velocity_interval_s / metric.length_unit_m)
    if metric.root_alignment != "kovar2d":
        return clip.positions / metric.length_unit_m
    centred = clip.positions.copy()
    centred[..., ::2] = _centred(clip)
    return centred / metric.length_unit_m


def _centred(clip: MeasuredClip) -> Floats:
    """Compute the points (F, P, 2) on the ground relative to their mean in each frame."""
    ground = clip.positions[..., ::2]
    return np.asarray(ground - ground.mean(axis=1, keepdims=True), dtype=np.float64)


def _superposed(a: MeasuredClip, b: MeasuredClip, vectors: Floats) -> Floats:
    """Rotate `vectors` (n, P, 3) about the vertical, by the rotation that superposes the points of `b` on those of `a`.

    Each frame has its own rotation.
    """
    ones, others = (_centred(clip) @ (1.0, 1.0j) for clip in (a, b))
    turn = np.sum(ones * others.conj(), axis=1, keepdims=True)
    turn = np.where(np.abs(turn) > 0.0, turn / np.maximum(np.abs(turn), np.finfo(float).tiny), 1.0)
    moved = (vectors[..., ::2] @ (1.0, 1.0j)) * turn
    return np.asarray(np.stack((moved.real, vectors[..., 1], moved.imag), axis=-1), dtype=np.float64)


def _require_size(a: MeasuredClip, b: MeasuredClip) -> None:
    if a.frame_count * b.frame_count > MOST_CELLS:
        raise MotionError(
            f"the map of {a.frame_count} x {b.frame_count} frames would have more than {MOST_CELLS:,} cells; cut or "
            "resample the clips, or compute the map in blocks",
            code="map-too-large",
        )
