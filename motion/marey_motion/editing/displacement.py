"""Displacement maps, which spread changes of a few frames over the surrounding frames with cubic B-splines.

A displacement (Lee and Shin 1999) consists of a shift of the root and a rotation vector d per joint, which replaces the
local rotation q with q·exp(d). There is one control point per frame. The displacement is the sum of two curves. The
first is the curve of least bending through the smoothed changes of the given frames. A curve through the changes
themselves would continue the slope of the last two frames, which is mostly noise, far into the surroundings. The second
curve passes through the differences between the changes and the smoothed changes; its high tension keeps it from
extending far beyond the given frames. Near a smooth end of a window, the control points are zero, so that value, slope
and curvature are exactly zero there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import AnyInts, Floats
from marey_motion.errors import EditError
from marey_motion.motion import Motion

# Values of a cubic B-spline at its control points' frames.
WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0
BENDING_STENCIL, TENSION_STENCIL = (1.0, -2.0, 1.0), (1.0, -1.0)
SWING_SHARE = 1.0 / 6.0
"""Number of frames to which the overshoot of the first curve is limited, as a share of the frames of the window."""
SINGLE_SWING_SHARE = 1.0 / 60.0
"""Number of frames to which the overshoot of the second curve is limited, as a share of the blended frames."""
NEIGHBOURS_SHARE = 0.2
"""Number of frames over which given changes are smoothed, as a share of the blended frames."""
# Weight of the given values relative to the bending energy. The remaining errors are fitted again, until they vanish.
FIT_WEIGHT = 1e4
MOST_REFINEMENTS = 40
MISSED_SHARE = 1e-13


class Window(NamedTuple):
    """Frames [start, stop) that may change. At a smooth end of the window, the change fades out to zero.

    A frame at an end that is not smooth, such as the end of the clip, may change as much as its neighbours.
    """

    start: int
    stop: int
    smooth_start: bool = True
    smooth_stop: bool = True


def windows_around(frames: AnyInts, blend_frames: int, frame_count: int) -> tuple[Window, ...]:
    """Make windows in which a change of given frames is blended in and out; overlapping windows are merged.

    Parameters
    ----------
    frames : (n,) int    increasing frame numbers
    blend_frames : int    number of frames on either side that may change, too; 0 changes only the given frames
    frame_count : int    frames of the motion

    Returns
    -------
    tuple of Window    windows that do not overlap
    """
    groups: list[list[int]] = []
    for frame in frames.tolist():
        if groups and frame - groups[-1][1] <= max(2 * blend_frames, 1):
            groups[-1][1] = frame
        else:
            groups.append([frame, frame])
    windows = []
    for first, last in groups:
        start, stop = max(0, first - blend_frames), min(frame_count, last + 1 + blend_frames)
        windows.append(Window(start, stop, start > 0 and blend_frames > 0, stop < frame_count and blend_frames > 0))
    return tuple(windows)


def displace(motion: Motion, frames: AnyInts, changed: Motion, windows: Sequence[Window]) -> Motion:
    """Change some frames and spread the change over windows; frames outside the windows stay bit-identical.

    Parameters
    ----------
    motion : Motion    F frames
    frames : (n,) int    increasing indices of the given frames, each inside a window
    changed : Motion    the n given frames with their change applied
    windows : sequence of Window    windows that do not overlap

    Returns
    -------
    Motion    F frames

    Raises
    ------
    EditError    if a given frame is not inside a window, or a window contains no given frame
    """
    _check_windows(frames, windows)
    rotations, roots = motion.rotations.copy(), motion.root_translations.copy()
    turned = np.flatnonzero((changed.rotations != motion.rotations[frames]).any(axis=(0, 2)))
    moved = bool((changed.root_translations != motion.root_translations[frames]).any())
    turns = _rotation_vectors(motion.rotations[frames][:, turned], changed.rotations[:, turned])
    shifts = changed.root_translations - motion.root_translations[frames]
    for window in windows:
        given = (frames >= window.start) & (frames < window.stop)
        span = slice(window.start, window.stop)
        together = np.concatenate((turns[given].reshape(int(given.sum()), -1), shifts[given]), axis=1)
        spread = spread_displacements(frames[given], _continued(together, len(turned)), window)
        exact = quaternions.from_rotation_vector(spread[:, :-3].reshape(len(spread), -1, 3))
        rotations[span, turned] = quaternions.multiply(rotations[span, turned], exact)
        if moved:
            roots[span] += spread[:, -3:]
    return motion._replace(root_translations=roots, rotations=rotations)


def _check_windows(frames: AnyInts, windows: Sequence[Window]) -> None:
    """Check that each window contains a given frame, and that each given frame is in a window.

    Frames at a smooth end of a window (`smooth_start`, `smooth_stop`) do not count as inside, because the displacement
    is zero there.
    """
    inside = np.zeros(len(frames), dtype=np.bool_)
    for window in windows:
        start, stop = window.start + window.smooth_start, window.stop - window.smooth_stop
        held = (frames >= start) & (frames < stop)
        if not held.any():
            raise EditError(
                f"the window {window.start}:{window.stop} contains no changed frame (frames where the change fades "
                "out do not count); remove this window, or choose one around a changed frame",
                where="windows",
            )
        inside |= held
    if not inside.all():
        raise EditError(
            f"no window contains the changed frame {int(frames[~inside][0])} (frames where the change fades out do not "
            "count); add or extend a window",
            where="windows",
        )


def spread_displacements(frames: AnyInts, values: Floats, window: Window) -> Floats:
    """Compute a curve of displacements over all frames of a window from given values at some of the frames.

    The curve is the sum of two curves. The first is the curve of least bending through the smoothed values. The second
    passes through the differences between the values and the smoothed values; its high tension keeps it from extending
    far beyond the given frames. In this way, noise in the values is not continued into the rest of the window.

    Parameters
    ----------
    frames : (n,) int    frames of the values
    values : (n, c) float64    displacements: metres or rotation vectors
    window : Window    frames [start, stop)

    Returns
    -------
    (stop - start, c) float64    displacements in the same unit
    """
    swing = SWING_SHARE * (window.stop - window.start)
    blend = max(int(frames[0]) - window.start, window.stop - 1 - int(frames[-1]))
    even = _evened(frames, values, NEIGHBOURS_SHARE * blend) if blend else values
    if np.abs(values - even).max(initial=0.0) <= MISSED_SHARE * np.abs(values).max(initial=0.0):
        return _curve(frames, values, window, swing)
    spread = _curve(frames, even, window, swing)
    return spread + _curve(frames, values - spread[frames - window.start], window, SINGLE_SWING_SHARE * blend)


def _evened(frames: AnyInts, values: Floats, reach: float) -> Floats:
    """Smooth values (n, c) along runs of consecutive frames (n,), over about `reach` frames.

    Constant values stay constant; at the ends of runs, slopes become smaller.
    """
    from scipy.ndimage import gaussian_filter1d

    rows = np.split(values, np.flatnonzero(np.diff(frames) > 1) + 1)
    return np.concatenate([gaussian_filter1d(row, reach, axis=0, mode="nearest") for row in rows])


def _curve(frames: AnyInts, values: Floats, window: Window, swing: float) -> Floats:
    """Compute the curve (stop - start, c) of least bending through `values` (n, c) at `frames` (n,).

    Tension limits the overshoot of the curve beyond the values to about `swing` frames.
    """
    from scipy.linalg import cho_solve_banded, cholesky_banded

    first = window.start + 1 if window.smooth_start else window.start - 1
    last = window.stop - 2 if window.smooth_stop else window.stop
    count = max(last - first + 1, 1)
    columns = np.asarray(frames)[:, None] + np.arange(-1, 2) - first
    weights = np.where((columns >= 0) & (columns < count), WEIGHTS, 0.0)
    columns = np.clip(columns, 0, count - 1)
    bands = _energy(count, window, swing)
    most_missed = MISSED_SHARE * np.abs(values).max(initial=0.0)
    for i in range(3):
        for j in range(i + 1):
            np.add.at(bands[i - j], columns[:, j], FIT_WEIGHT * weights[:, i] * weights[:, j])
    factor = cholesky_banded(bands[:count], lower=True, check_finite=False)
    points, rest = np.zeros((count, values.shape[1])), values
    for _ in range(MOST_REFINEMENTS):
        right = np.zeros_like(points)
        for i in range(3):
            np.add.at(right, columns[:, i], FIT_WEIGHT * weights[:, i, None] * rest)
        points += cho_solve_banded((factor, True), right, check_finite=False)
        rest = values - np.einsum("ni,nic->nc", weights, points[columns])
        if np.abs(rest).max(initial=0.0) <= most_missed:
            break
    padded = np.concatenate((np.zeros((3, values.shape[1])), points, np.zeros((3, values.shape[1]))))
    start = window.start - first + 3
    size = window.stop - window.start
    parts = (WEIGHTS[i] * padded[start + i - 1 : start + i - 1 + size] for i in range(3))
    return sum(parts, np.zeros((size, values.shape[1])))


def _energy(count: int, window: Window, swing: float) -> Floats:
    """Compute the matrix of the quadratic form that gives the bending and tension energy of a curve.

    The form applies to the `count` control points of the curve. Returns the main diagonal and the three diagonals
    below it (4, count); `swing` is as in `_curve`. Beyond a smooth end of the window, all control points are zero;
    beyond other ends, there are no control points.
    """
    bands = np.zeros((4, count))
    tension = swing**-2
    for stencil, factor in ((BENDING_STENCIL, 1.0), (TENSION_STENCIL, tension)):
        reach = len(stencil) - 1
        rows = np.arange(0 if not window.smooth_start else -reach, count - (0 if window.smooth_stop else reach))
        for i, a in enumerate(stencil):
            for j in range(i + 1):
                here = (rows + j >= 0) & (rows + i < count)
                np.add.at(bands[i - j], rows[here] + j, factor * a * stencil[j])
    return bands


def _rotation_vectors(before: Floats, after: Floats) -> Floats:
    turns = quaternions.multiply(quaternions.conjugate(before), after)
    return np.asarray(quaternions.as_rotation_vector(turns), dtype=np.float64)


def _continued(values: Floats, joints: int) -> Floats:
    """Make the rotation vectors of displacements continuous over time; their angles may then exceed half a turn.

    `values` (n, 3·joints + 3) are rotation vectors of `joints` joints, followed by displacements of the root.
    """
    vectors = values[:, : 3 * joints].reshape(len(values), joints, 3)
    if np.linalg.norm(vectors, axis=-1).max(initial=0.0) < 0.5 * np.pi:
        return values
    for n in range(1, len(values)):
        angle = np.linalg.norm(vectors[n], axis=-1, keepdims=True)
        other = vectors[n] * (1.0 - 2.0 * np.pi / np.maximum(angle, 1e-12))
        gap, other_gap = (np.linalg.norm(one - vectors[n - 1], axis=-1, keepdims=True) for one in (vectors[n], other))
        vectors[n] = np.where((other_gap < gap) & (angle > 1e-6), other, vectors[n])
    return np.concatenate((vectors.reshape(len(values), -1), values[:, 3 * joints :]), axis=1)
