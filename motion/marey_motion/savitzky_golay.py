"""Savitzky-Golay filter: each value is replaced by that of a polynomial fitted to its neighbours.

The results are those of `scipy.signal`, bit for bit. This package is not used, because it takes nearly a second of
processor time to load: every process that builds a database of motion matching would spend it.
"""

from __future__ import annotations

import numpy as np

from marey_motion.arrays import Floats


def filter_weights(window: int, order: int) -> Floats:
    """Compute the weights of the neighbours of a value.

    Parameters
    ----------
    window : int    odd number of values
    order : int    degree of the polynomial, less than `window`

    Returns
    -------
    (window,) float64    symmetric weights that sum to 1
    """
    places = np.arange(window // 2, -(window // 2) - 1, -1, dtype=np.float64)
    powers = places ** np.arange(order + 1, dtype=np.float64)[:, None]
    wanted = np.zeros(order + 1)
    wanted[0] = 1.0
    return np.asarray(np.linalg.lstsq(powers, wanted)[0], dtype=np.float64)


def filtered(values: Floats, window: int, order: int) -> Floats:
    """Smooth values over time; one polynomial is fitted to the first, and one to the last `window` values.

    Parameters
    ----------
    values : (F,) or (F, C) float64    at least `window` frames
    window : int    odd number of frames
    order : int    degree of the polynomials, less than `window`

    Returns
    -------
    Floats    smoothed values, of the same shape
    """
    from scipy.ndimage import convolve1d  # brings much of scipy: only who needs it shall wait

    smooth = np.asarray(convolve1d(values, filter_weights(window, order), axis=0, mode="constant"), dtype=np.float64)
    half, frames, times = window // 2, len(values), np.arange(window, dtype=np.float64)
    columns = values.reshape(frames, -1)
    for first, shown in ((0, slice(half)), (frames - window, slice(window - half, window))):
        polynomials = np.polyfit(times, columns[first : first + window], order)
        ends = np.polyval(polynomials, times[shown, None])
        smooth[first : first + window][shown] = ends.reshape(-1, *values.shape[1:])
    return smooth
