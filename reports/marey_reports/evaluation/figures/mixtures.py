"""One and two normal distributions fitted to errors, for figure 8."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import AnyFloats

MOST_STEPS = 500
TOLERANCE = 1e-9
LEAST_DEVIATION = 1e-9
NARROWEST = 1e-3  # of the spread of all values: a component may not collapse onto a single value


class Normals(NamedTuple):
    """A mixture of normal distributions: weight, mean and standard deviation of each, by ascending mean."""

    weights: AnyFloats
    means: AnyFloats
    deviations: AnyFloats

    def density(self, values: AnyFloats) -> AnyFloats:
        """Compute the density of the mixture at each value."""
        return np.asarray(_densities(values, self).sum(axis=1), dtype=np.float64)


def fit_one(values: AnyFloats) -> Normals:
    """Return the normal distribution with the mean and the population standard deviation of the values."""
    return Normals(np.ones(1), np.array([values.mean()]), np.array([max(values.std(), LEAST_DEVIATION)]))


def fit_two(values: AnyFloats, second: NDArray[np.bool_]) -> Normals:
    """Fit a mixture of two normal distributions by expectation maximisation.

    The mask `second` selects the values from which the second distribution starts; the first one starts from the other
    values. Because the start is given, the fit is repeatable. If one of these groups is empty, the values are split at
    their mean. Values that are all equal give two equal components.

    scikit-learn gives the same fit, but to load it takes longer than to draw all figures of a report.
    """
    if np.ptp(values) == 0.0:
        one = fit_one(values)
        return Normals(np.full(2, 0.5), np.repeat(one.means, 2), np.repeat(one.deviations, 2))
    if second.all() or not second.any():
        second = values > values.mean()
    narrowest = NARROWEST * float(values.std())
    groups = (values[~second], values[second])
    fit = Normals(
        np.array([len(group) / len(values) for group in groups]),
        np.array([group.mean() for group in groups]),
        np.array([max(float(group.std()), narrowest) for group in groups]),
    )
    before = -np.inf
    for _ in range(MOST_STEPS):
        logarithms = _log_densities(values, fit)
        total = np.logaddexp(logarithms[:, 0], logarithms[:, 1])
        fit = _maximised(values, np.exp(logarithms - total[:, None]), narrowest)
        likelihood = float(total.mean())
        if abs(likelihood - before) < TOLERANCE:
            break
        before = likelihood
    order = np.argsort(fit.means, kind="stable")
    return Normals(fit.weights[order], fit.means[order], fit.deviations[order])


def _maximised(values: AnyFloats, shares: AnyFloats, narrowest: float) -> Normals:
    """Fit each component to the values (n,) with its shares (n, 2) in them; `narrowest` widens each component."""
    held = np.maximum(shares.sum(axis=0), np.finfo(np.float64).tiny)
    means = shares.T @ values / held
    variances = (shares * (values[:, None] - means) ** 2).sum(axis=0) / held
    return Normals(held / held.sum(), means, np.sqrt(variances + narrowest**2))


def _log_densities(values: AnyFloats, fit: Normals) -> AnyFloats:
    scaled = (values[:, None] - fit.means) / fit.deviations
    heights = np.log(np.maximum(fit.weights, np.finfo(np.float64).tiny)) - np.log(fit.deviations * np.sqrt(2.0 * np.pi))
    return np.asarray(heights - 0.5 * scaled**2, dtype=np.float64)


def _densities(values: AnyFloats, fit: Normals) -> AnyFloats:
    scaled = (values[:, None] - fit.means) / fit.deviations
    return np.asarray(fit.weights / (fit.deviations * np.sqrt(2.0 * np.pi)) * np.exp(-0.5 * scaled**2))
