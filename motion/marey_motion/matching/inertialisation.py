"""Inertialisation: blending that adds the decaying difference between the old and the new motion to the new motion.

The difference x decays like a critically damped spring with half-life h. It is computed in closed form, so that the
result does not depend on the length of the ticks: x(t) = e^(-y·t)·(x0 + (v0 + y·x0)·t) with y = 2·ln 2 / h, where x0
and v0 are the difference and its change per second at the start.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def decay_matrix(half_life_s: float, elapsed_s: float) -> NDArray[np.float64]:
    """Compute the matrix that advances a decaying offset and its velocity in time.

    Parameters
    ----------
    half_life_s : float    seconds
    elapsed_s : float    seconds to advance

    Returns
    -------
    (2, 2) float64    acts on (offset, velocity per second)
    """
    rate = 2.0 * np.log(2.0) / half_life_s
    decay = np.exp(-rate * elapsed_s)
    grown = rate * elapsed_s
    matrix: NDArray[np.float64] = decay * np.array([[1.0 + grown, elapsed_s], [-rate * grown, 1.0 - grown]])
    return matrix
