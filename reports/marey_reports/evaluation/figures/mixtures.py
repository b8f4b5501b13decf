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
        """Of the mixture at each value."""
        return np.asarray(_densities(values, self).sum(axis=1), dtype=np.float64)


def fit_one(values: AnyFloats) -> Normals:
    """Mean and population standard deviation."""
    return Normals(np.ones(1), np.array([values.mean()]), np.array([max(values.std(), LEAST_DEVIATION)]))


def fit_two(values: AnyFloats, second: NDArray[np.bool_]) -> Normals:
    """Two normal distributions by expectation maximisation, begun at the two groups that `second` makes.

    A begin that is known, as from the wished speed of each tick, makes the fit repeatable. Where one group is empty the
    values are split at their mean. Values without spread give two equal components.
    """
    spread = float(values.std())
    if np.ptp(values) == 0.0:
        one = fit_one(values)
        return Normals(np.full(2, 0.5), np.repeat(one.means, 2), np.repeat(one.deviations, 2))
    if second.all() or not second.any():
        second = values > values.mean()
    shares = np.stack((~second, second), axis=1).astype(np.float64)
    before = -np.inf
    for _ in range(MOST_STEPS):
        fit = _maximised(values, shares, NARROWEST * spread)
        densities = _densities(values, fit)
        total = np.maximum(densities.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        shares = densities / total
        likelihood = float(np.log(total).mean())
        if likelihood - before < TOLERANCE:
            break
        before = likelihood
    order = np.argsort(fit.means, kind="stable")
    return Normals(fit.weights[order], fit.means[order], fit.deviations[order])


def _maximised(values: AnyFloats, shares: AnyFloats, narrowest: float) -> Normals:
    held = np.maximum(shares.sum(axis=0), np.finfo(float).tiny)
    means = shares.T @ values / held
    variances = (shares * (values[:, None] - means) ** 2).sum(axis=0) / held
    return Normals(held / len(values), means, np.maximum(np.sqrt(variances), narrowest))


def _densities(values: AnyFloats, fit: Normals) -> AnyFloats:
    scaled = (values[:, None] - fit.means) / fit.deviations
    return np.asarray(fit.weights / (fit.deviations * np.sqrt(2.0 * np.pi)) * np.exp(-0.5 * scaled**2))
