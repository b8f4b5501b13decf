"""Fits mixtures of normal distributions to latent vectors, and chooses how many components they have."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError
from marey_motion.modelling.mixture import LatentMixture

Floats = NDArray[np.float64]

LEAST_EXAMPLES_PER_COMPONENT = 5
SEEDS = 2**32


@dataclass(frozen=True)
class MixtureOptions:
    """How a mixture is fitted.

    Parameters
    ----------
    criterion : bic or aic: what chooses the number of components
    most_components : tried at most; n examples in d dimensions also allow no more than n / 2d
    components : exactly so many, in place of a choice
    regularisation : added to the variances, as a share of the mean variance
    starts : of expectation maximisation, the best of which counts
    iterations : at most, of each start
    """

    criterion: Literal["bic", "aic"] = "bic"
    most_components: int = 10
    components: int | None = None
    regularisation: float = 1e-4
    starts: int = 5
    iterations: int = 500


@dataclass(frozen=True)
class Candidate:
    """A mixture of so many components, as the criterion sees it.

    Parameters
    ----------
    log_likelihood : of all examples, natural logarithm
    smallest_weight : of a component
    refusal : why it was not taken whatever its criterion, or nothing
    """

    components: int
    bic: float
    aic: float
    log_likelihood: float
    smallest_weight: float
    converged: bool
    refusal: Literal["", "small-component"]


@dataclass(frozen=True, eq=False)
class FittedMixture:
    """A mixture, how it came about, and what else was tried.

    Parameters
    ----------
    method : `em`: expectation maximisation; `shrunk`: one component of shrunk covariance, for few examples; `point`:
        examples that do not vary
    candidates : by number of components; empty unless the method is `em`
    """

    mixture: LatentMixture
    method: Literal["em", "shrunk", "point"]
    candidates: tuple[Candidate, ...]


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra and clustering on one thread: how sums are rounded depends on how many threads share them."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    for module in ("scipy.linalg", "sklearn.mixture"):
        import_module(module)  # libraries that are loaded later would not be held to it
    with threadpool_limits(1):
        yield


def fit_mixture(latents: Floats, options: MixtureOptions = MixtureOptions(), *, seed: int = 0) -> FittedMixture:
    """The mixture of n latent vectors (n, d), the same for the same seed.

    With no more than d + 1 examples a full covariance is singular; one component then has a covariance shrunk towards a
    sphere (Ledoit and Wolf 2004). Otherwise numbers of components are compared by their criterion. A number is out of
    the question if a component is left with fewer examples than it has dimensions (or than 5).
    """
    examples, dimensions = latents.shape
    if not np.isfinite(latents).all():
        raise MotionError("latent vectors must be finite numbers", where="latents")
    if dimensions == 0:
        return FittedMixture(_single(latents.mean(axis=0), np.zeros((0, 0))), "point", ())
    # In units of the mean deviation, everything below is independent of the scale of the data.
    unit = float(np.sqrt(latents.var(axis=0).mean()))
    if not unit > 0.0:
        raise MotionError("latent vectors that do not vary have no dimensions", where="latents")
    if examples <= dimensions + 1:
        return FittedMixture(_shrunk(latents, unit, options.regularisation), "shrunk", ())
    counts = [options.components] if options.components else range(1, _most_components(latents.shape, options) + 1)
    fits = [_fit(latents / unit, count, options, seed) for count in counts]
    accepted = [fit for fit in fits if not fit[0].refusal] or fits[:1]
    _, chosen = min(accepted, key=lambda fit: getattr(fit[0], options.criterion))
    scaled = LatentMixture(chosen.weights, chosen.means * unit, chosen.covariances * unit**2)
    shift = examples * dimensions * float(np.log(unit))
    return FittedMixture(scaled, "em", tuple(_rescaled(candidate, shift) for candidate, _ in fits))


def _most_components(shape: tuple[int, ...], options: MixtureOptions) -> int:
    examples, dimensions = shape
    return max(1, min(options.most_components, examples // (2 * dimensions)))


def _fit(latents: Floats, components: int, options: MixtureOptions, seed: int) -> tuple[Candidate, LatentMixture]:
    """A mixture of latent vectors of unit mean variance."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    model = GaussianMixture(
        components,
        covariance_type="full",
        reg_covar=options.regularisation,
        n_init=options.starts,
        max_iter=options.iterations,
        tol=1e-5,
        random_state=seed % SEEDS,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # told by `converged`
        model.fit(latents)
    examples, dimensions = latents.shape
    least = max(dimensions + 1, LEAST_EXAMPLES_PER_COMPONENT) / examples
    smallest = float(model.weights_.min())
    candidate = Candidate(
        components=components,
        bic=float(model.bic(latents)),
        aic=float(model.aic(latents)),
        log_likelihood=float(model.score(latents)) * examples,
        smallest_weight=smallest,
        converged=bool(model.converged_),
        refusal="small-component" if components > 1 and smallest < least else "",
    )
    return candidate, _ordered(model.weights_, model.means_, model.covariances_)


def _ordered(weights: Floats, means: Floats, covariances: Floats) -> LatentMixture:
    """Heaviest component first; among equals, by their means."""
    order = np.lexsort((*means.T[::-1], -weights))
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    return LatentMixture(weights[order] / weights.sum(), means[order], symmetric[order])


def _rescaled(candidate: Candidate, shift: float) -> Candidate:
    """In the units of the data; `shift` is the logarithm of the volume that all examples gain."""
    return Candidate(
        components=candidate.components,
        bic=candidate.bic + 2.0 * shift,
        aic=candidate.aic + 2.0 * shift,
        log_likelihood=candidate.log_likelihood - shift,
        smallest_weight=candidate.smallest_weight,
        converged=candidate.converged,
        refusal=candidate.refusal,
    )


def _shrunk(latents: Floats, unit: float, regularisation: float) -> LatentMixture:
    from sklearn.covariance import ledoit_wolf

    covariance, _ = ledoit_wolf(latents / unit)
    covariance = covariance + regularisation * np.eye(len(covariance))
    return _single(latents.mean(axis=0), covariance * unit**2)


def _single(mean: Floats, covariance: Floats) -> LatentMixture:
    return LatentMixture(np.ones(1), mean[None], covariance[None])
