"""One and two normal distributions fitted to errors, for figure 8 of Abichequer Sangalli et al. (2022)."""

from __future__ import annotations

import warnings
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
    """Fit a mixture of two normal distributions with scikit-learn.

    The fit starts with two groups of values: the mask `second` selects the second group, and the other values are the
    first group. Because the start is given, the fit is repeatable. If a group is empty, the values are split at their
    mean instead. If all values are equal, both components are equal.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    if np.ptp(values) == 0.0:
        one = fit_one(values)
        return Normals(np.full(2, 0.5), np.repeat(one.means, 2), np.repeat(one.deviations, 2))
    if second.all() or not second.any():
        second = values > values.mean()
    groups = (values[~second], values[second])
    narrowest = NARROWEST * float(values.std())
    mixture = GaussianMixture(
        2,
        covariance_type="spherical",
        tol=TOLERANCE,
        reg_covar=narrowest**2,
        max_iter=MOST_STEPS,
        weights_init=[len(group) / len(values) for group in groups],
        means_init=[[group.mean()] for group in groups],
        precisions_init=[1.0 / max(float(group.std()), narrowest) ** 2 for group in groups],
        init_params="random",  # replaced by the start above
        random_state=0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # after so many steps a picture shows no difference
        mixture.fit(values[:, None])
    means, deviations = mixture.means_[:, 0], np.sqrt(mixture.covariances_)
    order = np.argsort(means, kind="stable")
    return Normals(mixture.weights_[order], means[order], deviations[order])


def _densities(values: AnyFloats, fit: Normals) -> AnyFloats:
    scaled = (values[:, None] - fit.means) / fit.deviations
    return np.asarray(fit.weights / (fit.deviations * np.sqrt(2.0 * np.pi)) * np.exp(-0.5 * scaled**2))
