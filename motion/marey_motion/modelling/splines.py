"""Cubic B-splines over canonical time: the functional form of motions and of time functions.

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
    """Coefficients of a motion of so many canonical frames: a fifth of them, at least 7, never more than the frames."""
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
            raise MotionError("knots must not decrease, and must span a range")
        object.__setattr__(self, "knots", knots)

    @classmethod
    def clamped(cls, frames: int, coefficients: int, degree: int = DEGREE) -> SplineBasis:
        """Evenly spaced knots over `frames` canonical frames, clamped at both ends."""
        if coefficients <= degree:
            raise MotionError(f"a spline of degree {degree} needs more than {degree} coefficients, not {coefficients}")
        if frames < 2:
            raise MotionError(f"a spline needs at least 2 canonical frames, not {frames}")
        inner = np.linspace(0.0, frames - 1.0, coefficients - degree + 1)
        return cls(np.concatenate((np.zeros(degree), inner, np.full(degree, frames - 1.0))), degree)

    @property
    def count(self) -> int:
        """n, the number of coefficients."""
        return len(self.knots) - self.degree - 1

    @property
    def span(self) -> tuple[float, float]:
        """The canonical time that the splines cover."""
        return float(self.knots[self.degree]), float(self.knots[-self.degree - 1])

    def matrix(self, times: ArrayLike, *, derivative: int = 0) -> Floats:
        """Values (m, n) of the basis functions, or of their derivatives, at canonical times (m,) within the span."""
        from scipy.interpolate import BSpline

        start, stop = self.span
        places = np.asarray(times, dtype=np.float64)
        if places.size and not (start <= places.min() and places.max() <= stop):
            raise MotionError(f"canonical times lie between {start:g} and {stop:g}", where="times")
        if derivative == 0:
            return np.asarray(BSpline.design_matrix(places, self.knots, self.degree).toarray(), dtype=np.float64)
        splines = BSpline(self.knots, np.eye(self.count), self.degree)
        return np.asarray(splines(places, nu=derivative), dtype=np.float64)

    def fit(self, values: Floats) -> Floats:
        """Least-squares coefficients (..., n, D) of samples (..., N, D) at N canonical frames 0 to N - 1."""
        frames = values.shape[-2]
        if frames != self.frame_count:
            raise MotionError(f"{frames} samples where the knots span {self.frame_count} canonical frames")
        return np.asarray(self._fitting @ values, dtype=np.float64)

    @property
    def frame_count(self) -> int:
        """N, the whole canonical frames that the knots span."""
        start, stop = self.span
        return round(stop - start) + 1

    @cached_property
    def at_frames(self) -> Floats:
        """Values (N, n) of the basis functions at every canonical frame."""
        return self.matrix(np.arange(self.frame_count, dtype=np.float64))

    @cached_property
    def products(self) -> Floats:
        """(n, n) integrals over canonical time of the products of basis functions, by Gauss's rule, which is exact."""
        nodes, shares = np.polynomial.legendre.leggauss(self.degree + 1)
        breaks = np.unique(self.knots)
        half = 0.5 * np.diff(breaks)[:, None]
        start, stop = self.span
        places = np.clip((breaks[:-1, None] + half) + half * nodes, start, stop).ravel()
        values = self.matrix(places)
        return np.asarray(values.T @ (values * (half * shares).reshape(-1, 1)), dtype=np.float64)

    @cached_property
    def _fitting(self) -> Floats:
        """(n, N) from samples to coefficients."""
        return np.asarray(np.linalg.pinv(self.at_frames), dtype=np.float64)
