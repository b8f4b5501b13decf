"""Fit of a mixture with a given number of normal distributions and a given kind of covariance."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import ModelError
from marey_motion.modelling.mixture import LatentMixture
from marey_schemas.options.modelling import CovarianceKind

SEEDS = 2**32
MOST_ITERATIONS = 500
"""Maximum number of iterations from each start of expectation maximisation."""
TOLERANCE = 1e-3
"""Change of the mean log-likelihood between iterations below which the fit has converged; without unit."""
SMALLEST_DEVIATION = 1e-9
_NAMES: Mapping[CovarianceKind, Literal["full", "tied", "diag"]] = {"full": "full", "tied": "tied", "diagonal": "diag"}


def fit_components(
    latents: Floats, count: int, covariance: CovarianceKind, *, regularisation: float, starts: int, seed: int
) -> tuple[LatentMixture, bool]:
    """Fit a mixture by expectation maximisation, then shrink covariances that are not diagonal.

    Parameters
    ----------
    latents : (n, d) float64    latent vectors of unit mean variance
    count : int    number of normal distributions
    covariance : str    "full": one covariance for each distribution; "tied": one covariance that all distributions
        share; "diagonal": one variance for each distribution and dimension
    regularisation : float    variance that is added in every dimension
    starts : int    starts of expectation maximisation
    seed : int    the same seed gives the same mixture

    Returns
    -------
    mixture : LatentMixture    heaviest distribution first
    converged : bool    whether expectation maximisation converged

    Raises
    ------
    ModelError    if there are fewer examples than distributions

    Notes
    -----
    In many dimensions, the covariance of few examples differs much from the covariance of their distribution. It is
    therefore shrunk, by the share of Ledoit and Wolf (2004), towards the diagonal matrix of the variances.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    if count > len(latents):
        raise ModelError(
            f"a mixture of {count} components needs at least {count} examples; there are {len(latents)}",
            code="too-many-components",
        )
    if count == 1:
        mean, members = latents.mean(axis=0)[None], [latents]
        return _assembled(np.ones(1), mean, members, latents, covariance, regularisation), True
    model = GaussianMixture(
        count,
        covariance_type=_NAMES[covariance],
        reg_covar=regularisation,
        n_init=starts,
        max_iter=MOST_ITERATIONS,
        tol=TOLERANCE,
        random_state=seed % SEEDS,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # told by the second result
        model.fit(latents)
    if covariance == "diagonal":
        spread = np.stack([np.diag(variances) for variances in model.covariances_])
        return _ordered(model.weights_, model.means_, spread), bool(model.converged_)
    nearest = model.predict(latents)
    members = [latents[nearest == number] for number in range(count)]
    found = _assembled(model.weights_, model.means_, members, latents, covariance, regularisation)
    return found, bool(model.converged_)


def parameter_count(count: int, dimensions: int, covariance: CovarianceKind) -> int:
    """Count the numbers of a mixture that are fitted.

    Parameters
    ----------
    count : int    number of normal distributions
    dimensions : int    number of dimensions d
    covariance : str    kind of covariance: "full", "tied" or "diagonal"

    Returns
    -------
    int    weights, means and covariances
    """
    whole = dimensions * (dimensions + 1) // 2
    spreads = {"full": count * whole, "tied": whole, "diagonal": count * dimensions}
    return count - 1 + count * dimensions + spreads[covariance]


def _assembled(
    weights: Floats,
    means: Floats,
    members: list[Floats],
    latents: Floats,
    covariance: CovarianceKind,
    regularisation: float,
) -> LatentMixture:
    """Make a mixture of weights (K,), means (K, d) and the shrunk covariances of the members of each distribution."""
    added = regularisation * np.eye(latents.shape[1])
    away = [some - mean for some, mean in zip(members, means, strict=True)]
    common = _shrunk(np.concatenate(away))
    if covariance == "diagonal":
        spreads = [np.diag(np.diag(np.cov(latents.T, bias=True).reshape(added.shape)))]
    elif covariance == "tied":
        spreads = [common] * len(members)
    else:
        spreads = [_shrunk(some) if len(some) > 1 else common for some in away]
    return _ordered(weights, means, np.stack(spreads) + added)


def _shrunk(away: Floats) -> Floats:
    """Compute the covariance (d, d) of deviations from a mean (n, d), shrunk towards its diagonal."""
    from sklearn.covariance import ledoit_wolf

    deviations = np.maximum(np.sqrt((away**2).mean(axis=0)), SMALLEST_DEVIATION)
    shrunk, _ = ledoit_wolf(away / deviations, assume_centered=True)
    return np.asarray(shrunk * np.outer(deviations, deviations), dtype=np.float64)


def _ordered(weights: Floats, means: Floats, covariances: Floats) -> LatentMixture:
    """Sort components, the heaviest first; components of equal weight are sorted by their means."""
    order = np.lexsort((*means.T[::-1], -weights))
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    return LatentMixture(weights[order] / weights.sum(), means[order], symmetric[order])
