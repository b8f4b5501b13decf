"""Candidates for the lag between two clips: the frame number in the new clip minus that in the old clip."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import AnyInts, Complexes, Floats
from marey_motion.difference.poses import Poses

MOST_LAGS = 16
"""Maximum number of lags that `exact_lags` returns."""
WINDOWS = 12
"""Number of windows of the old clip that are searched for in the whole new clip."""
SHORTEST_WINDOW = 8
SIMILAR = 4.0
"""Greatest ratio at which the second-best place of a window is a candidate, too.

The ratio is that of the squared distances of the window at the second-best and at the best place.
"""
NEGLIGIBLE = 1e-3
"""Squared distance of the features of two frames (`_features`) that is attributed to noise."""
GREATEST_PACE = 4.0
"""Greatest number of frames of the new clip per frame of the old clip that is tried; the least is its reciprocal."""
PACES = 97
DECIMATED = 2048
"""Approximate number of frames of the longer clip that are used to estimate the resampling rate (`likely_pace`)."""
PACE_WINDOW = 96
PACE_WINDOWS = 3
CHANNELS = 8
"""Number of random projections of the rotations of a pose; windows are compared by these instead of the rotations."""


def exact_lags(before: Poses, after: Poses) -> tuple[int, ...]:
    """Find the lags at which many frames of two clips are equal, by hashing frames.

    A frame that occurs once in each clip votes for the lag between its two places. If a frame repeats, as in still
    motion, its first and its last occurrences vote. Frames are hashed twice, the second time without the root, because
    a clip may have been moved in space.

    Parameters
    ----------
    before, after : Poses    frames of the same joints

    Returns
    -------
    tuple of int    frame number in `after` minus frame number of the equal frame in `before`; at most `MOST_LAGS`, the
        most frequent lag first
    """
    votes: Counter[int] = Counter()
    for hashed in (_hashes, _body_hashes):
        _, where_before, where_after = np.intersect1d(hashed(before), hashed(after), return_indices=True)
        _, last_before, last_after = np.intersect1d(hashed(before)[::-1], hashed(after)[::-1], return_indices=True)
        first = where_after - where_before
        last = (after.frame_count - 1 - last_after) - (before.frame_count - 1 - last_before)
        for lags in (first, last):
            votes.update(dict(zip(*(part.tolist() for part in np.unique(lags, return_counts=True)), strict=True)))
    return tuple(lag for lag, _ in sorted(votes.items(), key=lambda one: (-one[1], abs(one[0]))[:2])[:MOST_LAGS])


def similar_lags(before: Poses, after: Poses, unmatched: AnyInts) -> tuple[int, ...]:
    """Find the lags at which windows of the old clip, `before`, are most similar to the new clip, `after`.

    Each window is compared with all places of the new clip at once, by correlation in the frequency domain.

    Parameters
    ----------
    before, after : Poses    frames of the same joints
    unmatched : (n,) int    frames of the old clip on which windows are centred

    Returns
    -------
    tuple of int    frame number in `after` minus frame number of the similar frame in `before`
    """
    length = min(before.frame_count, after.frame_count, max(SHORTEST_WINDOW, before.frame_count // WINDOWS))
    size = 1 << int(np.ceil(np.log2(after.frame_count + length)))
    source, target = _features(before), _features(after)
    spectrum = np.fft.rfft(target, size, axis=0)
    energy = np.concatenate(([0.0], np.cumsum(np.einsum("fc,fc->f", target, target))))
    centres = np.unique(unmatched[np.linspace(0, len(unmatched) - 1, WINDOWS).astype(np.int64)])
    found: list[int] = []
    for start in np.unique(np.clip(centres - length // 2, 0, before.frame_count - length)).tolist():
        distances = _window_distances(source[start : start + length], spectrum, energy, size)
        best = int(np.argmin(distances))
        nearby = slice(max(0, best - length // 2), best + length // 2 + 1)
        others = distances.copy()
        others[nearby] = np.inf
        second = int(np.argmin(others))
        found.append(best - start)
        if others[second] <= SIMILAR * max(distances[best], 0.0) + NEGLIGIBLE * length:
            found.append(second - start)
    return tuple(dict.fromkeys(found))[: 2 * WINDOWS]


def _window_distances(window: Floats, spectrum: Complexes, energy: Floats, size: int) -> Floats:
    """Compute the squared distance of a window (w, C) to each range of w consecutive frames of another clip.

    Parameters
    ----------
    window : (w, C) features of the window's frames
    spectrum : Fourier transform of the features of the other clip, padded with zeros to `size` frames
    energy : (F + 1,) cumulative sums of the squared features of the other clip's F frames
    size : number of frames of the Fourier transform

    Returns
    -------
    (F + 1 - w,) float64    squared distance, by first frame of the range
    """
    length = len(window)
    places = len(energy) - length
    products = np.fft.irfft(spectrum * np.conj(np.fft.rfft(window, size, axis=0)), size, axis=0)[:places]
    squares = energy[length:] - energy[:-length]
    return np.asarray(squares - 2.0 * products.sum(axis=1) + np.sum(window * window), dtype=np.float64)


def likely_pace(before: Poses, after: Poses) -> float:
    """Estimate the rate at which the new clip was resampled from the old clip, or from a part of the old clip.

    Windows of the new clip are stretched by many factors, and each is compared with every place of the old clip.

    Parameters
    ----------
    before, after : Poses    frames of the same joints

    Returns
    -------
    float    number of frames of the new clip per frame of the old clip, to within about 3 %; 1 if a clip is too short
    """
    stride = max(1, max(before.frame_count, after.frame_count) // DECIMATED)
    source, target = (
        _features(before)[::stride, :-3],
        _features(after)[::stride, :-3],
    )  # without the displacements of the root, which depend on the rate
    length = max(SHORTEST_WINDOW, min(PACE_WINDOW, len(target) // 2))
    if len(target) < length or len(source) < length:
        return 1.0
    paces = np.geomspace(1.0 / GREATEST_PACE, GREATEST_PACE, PACES)
    size = 1 << int(np.ceil(np.log2(len(source) + length * GREATEST_PACE)))
    spectrum = np.fft.rfft(source, size, axis=0)
    energy = np.concatenate(([0.0], np.cumsum(np.einsum("fc,fc->f", source, source))))
    starts = np.linspace(0, len(target) - length, PACE_WINDOWS).astype(np.int64)
    costs = np.full(len(paces), np.inf)
    for place, pace in enumerate(paces.tolist()):
        count = round(length / pace)
        if SHORTEST_WINDOW <= count <= len(source):
            windows = (_stretched(target[start : start + length], count) for start in starts)
            least = [_window_distances(window, spectrum, energy, size).min() for window in windows]
            costs[place] = float(np.sum(least)) / count
    return float(paces[np.argmin(costs)]) if np.isfinite(costs).any() else 1.0


def _stretched(window: Floats, count: int) -> Floats:
    """Resample a window to `count` frames by linear interpolation."""
    places = np.linspace(0.0, len(window) - 1.0, count)
    left = np.minimum(places.astype(np.int64), len(window) - 2)
    share = (places - left)[:, None]
    return np.asarray((1.0 - share) * window[left] + share * window[left + 1], dtype=np.float64)


def _features(poses: Poses) -> Floats:
    """Compute features (F, `CHANNELS` + 4) of F poses.

    The first `CHANNELS` features are random projections of the rotations. The other four are the height of the root,
    and the displacement (x, y, z) of the root since the previous frame.
    """
    rotations = poses.rotations * np.where(poses.rotations[..., :1] < 0.0, -1.0, 1.0)
    flat = rotations.reshape(poses.frame_count, -1).astype(np.float64)
    projection = np.random.default_rng(0).normal(size=(flat.shape[1], CHANNELS)) / np.sqrt(CHANNELS)
    steps = np.diff(poses.roots.astype(np.float64), axis=0, prepend=poses.roots[:1])
    return np.concatenate((flat @ projection, poses.roots[:, 1:2], steps), axis=1)


def _hashes(poses: Poses) -> NDArray[np.uint64]:
    return _hashed_rows(np.concatenate((poses.roots, _one_sided(poses.rotations)), axis=1))


def _body_hashes(poses: Poses) -> NDArray[np.uint64]:
    return _hashed_rows(_one_sided(poses.rotations[:, 1:]))


def _one_sided(rotations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return rotations (F, J, 4) as rows (F, 4·J); quaternions with a negative w are negated."""
    signs = np.where(rotations[..., :1] < 0.0, np.float32(-1.0), np.float32(1.0))
    return np.asarray(rotations * signs, dtype=np.float32).reshape(len(rotations), -1)


def _hashed_rows(rows: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Hash rows of numbers: a scalar product of their bits with random odd numbers, modulo 2^64."""
    bits = np.ascontiguousarray(rows + np.float32(0.0)).view(np.uint32)  # the addition makes -0 equal to 0
    factors = np.random.default_rng(1).integers(0, 2**63, bits.shape[1], dtype=np.uint64) * 2 + 1
    hashes = np.zeros(len(rows), dtype=np.uint64)
    for column, factor in zip(bits.T, factors, strict=True):
        hashes += column * factor
    return hashes
