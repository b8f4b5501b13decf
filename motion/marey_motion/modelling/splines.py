"""Cubic B-splines over canonical time, by which motions and time functions (time warps) are represented.

Canonical time of N frames runs from 0 to N - 1. Knots are clamped, so that a spline begins and ends at its first and
last coefficient.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError

DEGREE = 3
LEAST_COEFFICIENTS = 7
SHARE_OF_FRAMES = 0.2


def coefficient_count(frames: int) -> int:
    """Choose the number of coefficients for a motion: a fifth of the frames, at least 7, never more than the frames.

    Parameters
    ----------
    frames : int    canonical frames

    Returns
    -------
    int    coefficients
    """
    return min(frames, max(LEAST_COEFFICIENTS, round(SHARE_OF_FRAMES * frames)))


@dataclass(frozen=True, eq=False)
class SplineBasis:
    """The B-splines over a knot vector.

    Parameters
    ----------
    knots : (n + degree + 1,) not decreasing, in canonical frames
    degree : 3 for a cubic
    """

    knots: Floats
    degree: int = DEGREE

    def __post_init__(self) -> None:
        knots = np.asarray(self.knots, dtype=np.float64)
        if knots.ndim != 1 or len(knots) < 2 * (self.degree + 1) or not np.isfinite(knots).all():
            raise MotionError(f"a spline of degree {self.degree} needs at least {2 * (self.degree + 1)} finite knots")
        if (np.diff(knots) < 0).any() or knots[self.degree] >= knots[-self.degree - 1]:
            raise MotionError("knots must not decrease, and must span a range of more than 0 frames")
        object.__setattr__(self, "knots", knots)

    @classmethod
    def clamped(cls, frames: int, coefficients: int, degree: int = DEGREE) -> SplineBasis:
        """Make a basis with evenly spaced knots, clamped at both ends.

        Parameters
        ----------
        frames : int    canonical frames
        coefficients : int    number of coefficients n
        degree : int    3 for a cubic

        Returns
        -------
        SplineBasis    over canonical time 0 to frames - 1

        Raises
        ------
        MotionError    if there are at most `degree` coefficients, or fewer than 2 frames
        """
        if coefficients <= degree:
            raise MotionError(f"a spline of degree {degree} needs more than {degree} coefficients, not {coefficients}")
        if frames < 2:
            raise MotionError(f"a spline needs at least 2 canonical frames, not {frames}")
        inner = np.linspace(0.0, frames - 1.0, coefficients - degree + 1)
        return cls(np.concatenate((np.zeros(degree), inner, np.full(degree, frames - 1.0))), degree)

    @property
    def count(self) -> int:
        """Number of coefficients n."""
        return len(self.knots) - self.degree - 1

    @property
    def span(self) -> tuple[float, float]:
        """First and last canonical frame that the splines cover."""
        return float(self.knots[self.degree]), float(self.knots[-self.degree - 1])

    def matrix(self, times: ArrayLike) -> Floats:
        """Evaluate the basis functions.

        Parameters
        ----------
        times : (m,) float    canonical frames within the span

        Returns
        -------
        (m, n) float64    values of the basis functions

        Raises
        ------
        MotionError    if a time is outside the span
        """
        from scipy.interpolate import BSpline

        start, stop = self.span
        places = np.asarray(times, dtype=np.float64)
        if places.size and not (start <= places.min() and places.max() <= stop):
            raise MotionError(f"canonical times must be from {start:g} to {stop:g}", where="times")
        return np.asarray(BSpline.design_matrix(places, self.knots, self.degree).toarray(), dtype=np.float64)

    def fit(self, values: Floats) -> Floats:
        """Fit coefficients to samples by least squares.

        Parameters
        ----------
        values : (..., N, D) float64    samples at canonical frames 0 to N - 1

        Returns
        -------
        (..., n, D) float64    coefficients

        Raises
        ------
        MotionError    if there is not one sample for each canonical frame that the knots span
        """
        frames = values.shape[-2]
        if frames != self.frame_count:
            raise MotionError(
                f"there are {frames} samples, but the knots of the spline span {self.frame_count} "
                "canonical frames; one sample per frame is needed"
            )
        return np.asarray(self._fitting @ values, dtype=np.float64)

    @property
    def frame_count(self) -> int:
        """Number of whole canonical frames N that the knots span."""
        start, stop = self.span
        return round(stop - start) + 1

    @cached_property
    def at_frames(self) -> Floats:
        """Values (N, n) of the basis functions at every canonical frame."""
        return self.matrix(np.arange(self.frame_count, dtype=np.float64))

    @cached_property
    def products(self) -> Floats:
        """Integrals (n, n) over canonical time of the products of basis functions, by Gauss's rule, which is exact."""
        nodes, shares = np.polynomial.legendre.leggauss(self.degree + 1)
        breaks = np.unique(self.knots)
        half = 0.5 * np.diff(breaks)[:, None]
        start, stop = self.span
        places = np.clip((breaks[:-1, None] + half) + half * nodes, start, stop).ravel()
        values = self.matrix(places)
        return np.asarray(values.T @ (values * (half * shares).reshape(-1, 1)), dtype=np.float64)

    @cached_property
    def _fitting(self) -> Floats:
        """Compute the matrix (n, N) that fits coefficients to samples."""
        return np.asarray(np.linalg.pinv(self.at_frames), dtype=np.float64)
