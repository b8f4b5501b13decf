"""Time functions (time warps) of motions, stored as logarithms of slopes, so that time increases in every sample."""

from __future__ import annotations

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.splines import SplineBasis


def fit_log_slopes(basis: SplineBasis, time_functions: Floats) -> Floats:
    """Fit splines to the logarithms of the slopes of time functions.

    The logarithms are fitted by least squares. Then each function is shifted as a whole, so that the motion keeps its
    exact duration. (Smoothing of logarithms would otherwise shorten the motion: the logarithm of a mean is above the
    mean of logarithms.)

    Parameters
    ----------
    basis : SplineBasis    splines over the N - 1 steps
    time_functions : (m, N) float64    strictly increasing frames of real time

    Returns
    -------
    (m, n, 1) float64    coefficients

    Raises
    ------
    MotionError    naming the example whose time function is not strictly increasing
    """
    slopes = np.diff(time_functions, axis=1)
    increasing = np.isfinite(slopes) & (slopes > 0.0)
    if not increasing.all():
        worst = int(np.argwhere(~increasing)[0, 0])
        raise MotionError(
            "a time function must be strictly increasing", code="time-function-invalid", where=f"example {worst}"
        )
    coefficients = basis.fit(np.log(slopes)[..., None])
    lasting = np.exp(basis.at_frames @ coefficients).sum(axis=1, keepdims=True)
    # B-splines add up to 1 everywhere: what is added to all coefficients is added to the function.
    return np.asarray(coefficients + np.log(slopes.sum(axis=1)[:, None, None] / lasting), dtype=np.float64)


def equalising_weight(spatial_variances: Floats, temporal_variances: Floats) -> float:
    """Compute the factor that gives the temporal part of latent vectors the variance of the spatial part.

    Parameters
    ----------
    spatial_variances : (k,) float64    variances of the spatial scores
    temporal_variances : (l,) float64    variances of the temporal scores

    Returns
    -------
    float    the factor; 1 if either part has no variance
    """
    spatial, temporal = float(spatial_variances.sum()), float(temporal_variances.sum())
    return float(np.sqrt(spatial / temporal)) if spatial > 0.0 and temporal > 0.0 else 1.0
