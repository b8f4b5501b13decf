"""Fitting of mixtures of normal distributions to latent vectors, and choice of the number of components."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import ModelError
from marey_motion.modelling.mixture import LatentMixture
from marey_schemas.options.modelling import MixtureOptions

Refusal = Literal["", "small-component", "held-out"]

LEAST_EXAMPLES_PER_COMPONENT = 5
LEAST_FOLDS = 2
SEEDS = 2**32
MOST_ITERATIONS = 500
"""Maximum number of iterations from each start of expectation maximisation."""
TOLERANCE = 1e-3
"""Change of the mean log-likelihood between iterations below which the fit has converged; without unit."""


@dataclass(frozen=True)
class MixtureCandidate:
    """A mixture of a given number of components, with its criteria.

    Parameters
    ----------
    components : int    number of components
    bic, aic : float    Bayesian and Akaike information criterion
    log_likelihood : float    natural logarithm of the likelihood of all examples
    smallest_weight : float    the least weight of a component
    converged : bool    whether the fit converged
    refusal : str    reason why the mixture is excluded, regardless of its criteria; empty if it is not excluded.
        "small-component": a component has too few examples; "held-out": held-out examples are not more likely than
        with one component
    """

    components: int
    bic: float
    aic: float
    log_likelihood: float
    smallest_weight: float
    converged: bool
    refusal: Refusal = ""


@dataclass(frozen=True, eq=False)
class FittedMixture:
    """A mixture, the method by which it was fitted, and the candidates compared.

    Parameters
    ----------
    mixture : LatentMixture    the mixture
    method : str    "em": expectation maximisation; "shrunk": one component of shrunk covariance, for few examples;
        "point": a single point, for examples that do not vary
    candidates : tuple of MixtureCandidate    by number of components; empty unless the method is "em"
    held_out : (n,) float64, optional    ln p of each example under a mixture that has the same number of components,
        but was fitted without the fold (part of the data) that contains the example
    """

    mixture: LatentMixture
    method: Literal["em", "shrunk", "point"]
    candidates: tuple[MixtureCandidate, ...]
    held_out: Floats | None


@contextmanager
def one_thread() -> Iterator[None]:
    """Run linear algebra and clustering on one thread, because the rounding of sums depends on the number of threads.

    Yields
    ------
    None    once, within the context
    """
    from threadpoolctl import threadpool_limits

    for module in ("scipy.linalg", "sklearn.mixture"):
        import_module(module)  # libraries that are loaded later would not be held to it
    with threadpool_limits(1):
        yield


def fit_mixture(latents: Floats, options: MixtureOptions | None = None, *, seed: int = 0) -> FittedMixture:
    """Fit a mixture to latent vectors.

    With no more than d + 1 examples, a full covariance would be singular. The mixture then has one component only, and
    its covariance is shrunk towards a sphere (Ledoit and Wolf 2004). Otherwise, mixtures with different numbers of
    components are compared by `options.criterion`. A mixture is excluded if one of its components has fewer than d + 1
    examples, or fewer than 5, or if held-out examples are not more likely than under a single component.

    Parameters
    ----------
    latents : (n, d) float64    latent vectors
    options : MixtureOptions, optional    options
    seed : int    the same seed gives the same mixture

    Returns
    -------
    FittedMixture    mixture and candidates
    """
    examples, dimensions = latents.shape
    wanted = options or MixtureOptions()
    if not np.isfinite(latents).all():
        raise ModelError("latent vectors must be finite numbers", where="latents")
    if dimensions == 0:
        return FittedMixture(_single(latents.mean(axis=0), np.zeros((0, 0))), "point", (), None)
    # In units of the mean deviation, everything below is independent of the scale of the data.
    unit = float(np.sqrt(latents.var(axis=0).mean()))
    if not unit > 0.0:
        raise ModelError("all latent vectors are equal, so no mixture can be fitted to them", where="latents")
    with one_thread():
        mixture, candidates, held_out = _Fitting(latents / unit, wanted, seed).choose()
    shift = dimensions * float(np.log(unit))
    return FittedMixture(
        mixture=LatentMixture(mixture.weights, mixture.means * unit, mixture.covariances * unit**2),
        method="em" if candidates else "shrunk",
        candidates=tuple(_rescaled(candidate, shift * examples) for candidate in candidates),
        held_out=None if held_out is None else held_out - shift,
    )


@dataclass(frozen=True, eq=False)
class _Fitting:
    """Fit of a mixture to latent vectors of unit mean variance."""

    latents: Floats
    options: MixtureOptions
    seed: int

    def choose(self) -> tuple[LatentMixture, list[MixtureCandidate], Floats | None]:
        """Choose the mixture; return it, all candidates, and the examples' held-out log-likelihoods (n,) or None."""
        examples, dimensions = self.latents.shape
        if examples <= dimensions + 1:
            return _fitted(self.latents, 1, self.options, self.seed)[0], [], self._held_out(1)
        counts = range(1, max(1, min(self.options.most_mixture_components, examples // (2 * dimensions))) + 1)
        if self.options.mixture_components is not None:
            counts = range(self.options.mixture_components, self.options.mixture_components + 1)
        fits = {count: _fitted(self.latents, count, self.options, self.seed) for count in counts}
        candidates = {count: self._judged(count, *fit) for count, fit in fits.items()}
        chosen, held_out = self._best(candidates)
        return fits[chosen][0], list(candidates.values()), held_out

    def _judged(self, count: int, mixture: LatentMixture, converged: bool) -> MixtureCandidate:
        examples, dimensions = self.latents.shape
        likelihood = float(mixture.log_density(self.latents).sum())
        numbers = count * (1 + dimensions + dimensions * (dimensions + 1) // 2) - 1
        smallest = float(mixture.weights.min())
        least = max(dimensions + 1, LEAST_EXAMPLES_PER_COMPONENT) / examples
        return MixtureCandidate(
            components=count,
            bic=numbers * float(np.log(examples)) - 2.0 * likelihood,
            aic=2.0 * numbers - 2.0 * likelihood,
            log_likelihood=likelihood,
            smallest_weight=smallest,
            converged=converged,
            refusal="small-component" if count > 1 and smallest < least else "",
        )

    def _best(self, candidates: dict[int, MixtureCandidate]) -> tuple[int, Floats | None]:
        """Choose the number of components with the best criterion among the candidates that are not refused.

        `candidates` maps a number of components to its candidate. A candidate that is refused here is replaced by a
        copy that contains the reason. Returns the chosen number, and the held-out log-likelihoods (n,) of the examples
        for this number, or None.
        """
        single = self._held_out(1)
        falling = sorted(candidates.values(), key=lambda one: getattr(one, self.options.criterion))
        for candidate in falling:
            count = candidate.components
            if count == 1 or self.options.mixture_components is not None:
                return count, single if count == 1 else self._held_out(count)
            if candidate.refusal:
                continue
            held_out = self._held_out(count)
            if single is None or held_out is None or held_out.mean() > single.mean():
                return count, held_out
            candidates[count] = replace(candidate, refusal="held-out")
        raise ModelError("no mixture can be chosen, because a mixture with 1 component was not tried")

    def _held_out(self, count: int) -> Floats | None:
        """Compute ln p (n,) of each example under a mixture of `count` components fitted without the example's fold.

        Returns None if the examples cannot be divided into folds.
        """
        examples = len(self.latents)
        if self.options.folds < LEAST_FOLDS or examples <= self.options.folds:
            return None
        folds = np.random.Generator(np.random.Philox(self.seed)).permutation(examples) % self.options.folds
        densities = np.empty(examples)
        for fold in range(self.options.folds):
            held = folds == fold
            mixture, _ = _fitted(self.latents[~held], count, self.options, self.seed)
            densities[held] = mixture.log_density(self.latents[held])
        return densities


def _fitted(latents: Floats, count: int, options: MixtureOptions, seed: int) -> tuple[LatentMixture, bool]:
    """Fit a mixture with `count` components to latent vectors (n, d); return it, and whether the fit converged."""
    examples, dimensions = latents.shape
    if count == 1:
        return _normal(latents, options.regularisation, shrink=examples <= dimensions + 1), True
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    model = GaussianMixture(
        count,
        covariance_type="full",
        reg_covar=options.regularisation,
        n_init=options.starts,
        max_iter=MOST_ITERATIONS,
        tol=TOLERANCE,
        random_state=seed % SEEDS,
    )
    if count > examples:
        raise ModelError(
            f"a mixture of {count} components needs at least {count} examples; there are {examples}",
            code="too-many-components",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # told by the second result
        model.fit(latents)
    return _ordered(model.weights_, model.means_, model.covariances_), bool(model.converged_)


def _normal(latents: Floats, regularisation: float, *, shrink: bool) -> LatentMixture:
    """Fit one component to latent vectors (n, d) by maximum likelihood.

    With `shrink`, the covariance is shrunk towards a sphere. `regularisation` is added to the diagonal.
    """
    if shrink:
        from sklearn.covariance import ledoit_wolf

        covariance, _ = ledoit_wolf(latents)
    else:
        away = latents - latents.mean(axis=0)
        covariance = away.T @ away / len(latents)
    return _single(latents.mean(axis=0), covariance + regularisation * np.eye(latents.shape[1]))


def _single(mean: Floats, covariance: Floats) -> LatentMixture:
    return LatentMixture(np.ones(1), mean[None], covariance[None])


def _ordered(weights: Floats, means: Floats, covariances: Floats) -> LatentMixture:
    """Sort components, the heaviest first; components of equal weight are sorted by their means."""
    order = np.lexsort((*means.T[::-1], -weights))
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    return LatentMixture(weights[order] / weights.sum(), means[order], symmetric[order])


def _rescaled(candidate: MixtureCandidate, shift: float) -> MixtureCandidate:
    """Convert a mixture to the units of the data; `shift` is the change of all log-likelihoods by the scaling."""
    return replace(
        candidate,
        bic=candidate.bic + 2.0 * shift,
        aic=candidate.aic + 2.0 * shift,
        log_likelihood=candidate.log_likelihood - shift,
    )
