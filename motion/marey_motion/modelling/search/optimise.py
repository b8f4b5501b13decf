"""Refinement of latent vectors by the Levenberg-Marquardt method (Herrmann et al. 2019, Equation 2, as a posterior).

The cost is ½ Σ w (e / σ)² - λ Σ ln p(s), with errors e, their tolerances σ and weights w, and the likelihood p of each
latent vector s. To compute a step, the mixture is replaced by its component that is most likely at the current vector
(max-mixture, Olson and Agarwal 2013). The whitened distance from this component's mean is then a residual like any
other. The constant term of the component's log-likelihood does not change the step and is left out. A step is accepted
if it decreases the cost under the whole mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.mixture import LatentMixture
from marey_schemas.options.searching import LIKELIHOOD_WEIGHT, RefineOptions

FIRST_DAMPING = 1e-3
SMALLEST_DAMPING, MOST_DAMPING = 1e-12, 1e12
EASING, TIGHTENING = 10.0, 4.0
LEAST_GAIN = 1e-12


DEFAULT_REFINING = RefineOptions()


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of a refinement.

    Parameters
    ----------
    latents : (W,) refined latent vectors, one after the other
    cost : the minimised cost at `latents`
    start_cost : the cost at the start
    iterations : number of steps that were tried
    evaluations : number of times that residuals and derivatives were computed. `iterations` and `evaluations` include a
        first minimisation whose result was discarded, if there was one
    """

    latents: Floats
    cost: float
    start_cost: float
    iterations: int
    evaluations: int


class LeastSquares(Protocol):
    """A least-squares problem with a prior."""

    @property
    def priors(self) -> Sequence[LatentMixture]:
        """Distribution of each latent vector, in the order in which the vectors are stacked."""

    def linearise(self, stacked: Floats) -> tuple[Floats, Floats]:
        """Compute residuals and their derivatives.

        Parameters
        ----------
        stacked : (W,) float64    latent vectors one after the other

        Returns
        -------
        residuals : (r,) float64    errors in multiples of their tolerances
        derivatives : (r, W) float64    of the residuals with respect to the latent vectors
        """


def refine(problem: LeastSquares, start: Floats, options: RefineOptions = DEFAULT_REFINING) -> Refined:
    """Improve latent vectors; the cost of the result is never above the cost of the start.

    If `options.likelihood_weight` is None, the sum of the squared errors does not increase, either: `LIKELIHOOD_WEIGHT`
    is the weight of the likelihood and, if the sum increased with this weight, the likelihood is ignored instead.

    Parameters
    ----------
    problem : LeastSquares    residuals and priors
    start : (W,) float64    latent vectors one after the other
    options : RefineOptions    weight of the likelihood and number of iterations

    Returns
    -------
    Refined    latent vectors and costs

    Raises
    ------
    MotionError    if the start has no finite cost
    """
    if options.likelihood_weight is not None:
        return _minimised(problem, start, options.likelihood_weight, options.iterations)[0]
    found, error, start_error = _minimised(problem, start, LIKELIHOOD_WEIGHT, options.iterations)
    if error <= start_error:
        return found
    # Without the likelihood, the cost is the error, which no step makes larger.
    again = _minimised(problem, start, 0.0, options.iterations)[0]
    return replace(
        again,
        iterations=found.iterations + again.iterations,
        evaluations=found.evaluations + again.evaluations,
    )


def _minimised(problem: LeastSquares, start: Floats, weight: float, most: int) -> tuple[Refined, float, float]:
    """Minimise the cost with `weight` as the weight of the likelihood, in at most `most` iterations.

    Returns the result, the sum of squared residuals at the result, and the sum of squared residuals at the start.
    """
    prior = _Prior(problem.priors, weight)
    here = np.array(start, dtype=np.float64)
    residuals, slopes = problem.linearise(here)
    cost = start_cost = _cost(residuals, prior, here)
    if not np.isfinite(cost):
        raise MotionError(
            "the cost of the constraints is too large to be computed; use wider tolerances or smaller weights",
            code="refining-not-finite",
        )
    start_error = float(residuals @ residuals)
    damping, evaluations, iterations = FIRST_DAMPING, 1, 0
    while iterations < most and damping < MOST_DAMPING:
        iterations += 1
        curvature, gradient = prior.quadratic(here)
        curvature += slopes.T @ slopes
        gradient += slopes.T @ residuals
        step = _step(curvature + damping * np.diag(prior.scales), gradient)
        if step is None:
            damping *= TIGHTENING
            continue
        there = here + step
        tried = problem.linearise(there)
        evaluations += 1
        new_cost = _cost(tried[0], prior, there)
        if new_cost < cost:
            gained = cost - new_cost
            here, (residuals, slopes), cost = there, tried, new_cost
            damping = max(damping / EASING, SMALLEST_DAMPING)
            if gained <= LEAST_GAIN * max(cost, 1.0):
                break
        else:
            if _is_still(step, here):
                break
            damping *= TIGHTENING
    return Refined(here, cost, start_cost, iterations, evaluations), float(residuals @ residuals), start_error


def _step(curvature: Floats, gradient: Floats) -> Floats | None:
    """Compute the step (W,) to the minimum of a quadratic function with given curvature (W, W) and gradient (W,).

    Returns None if the curvature is numerically singular, so that more damping is needed.
    """
    try:
        step = np.asarray(np.linalg.solve(curvature, -gradient), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    return step if np.isfinite(step).all() else None


class _Quadratic(NamedTuple):
    curvature: Floats
    gradient: Floats


class _Prior:
    """Negative log-likelihood -λ ln p of stacked latent vectors."""

    def __init__(self, mixtures: Sequence[LatentMixture], weight: float) -> None:
        self._mixtures = mixtures
        self._weight = weight
        ends = np.cumsum([mixture.dimensions for mixture in mixtures])
        self._parts = [slice(end - one.dimensions, end) for end, one in zip(ends.tolist(), mixtures, strict=True)]
        self.scales = np.concatenate([_precisions(mixture) for mixture in mixtures])

    def cost(self, stacked: Floats) -> float:
        """Compute -λ Σ ln p(s), with the weight λ of the prior and the density p of each latent vector s.

        The density is that of the whole mixture; `quadratic` uses only the most likely component of each mixture.
        """
        pairs = zip(self._mixtures, self._parts, strict=True)
        return -self._weight * sum(float(mixture.log_density(stacked[None, part])[0]) for mixture, part in pairs)

    def quadratic(self, stacked: Floats) -> _Quadratic:
        """Approximate the cost near `stacked` by the most likely component of each mixture.

        Returns JᵀJ (curvature) and Jᵀr (gradient) of the residuals r with the derivatives J.
        """
        curvature, gradient = np.zeros((len(stacked), len(stacked))), np.zeros(len(stacked))
        for mixture, part in zip(self._mixtures, self._parts, strict=True):
            likeliest = int(np.argmax(mixture.component_log_densities(stacked[None, part])[0]))
            whitening = mixture.whitening[likeliest]
            precision = self._weight * whitening.T @ whitening
            curvature[part, part] = precision
            gradient[part] = precision @ (stacked[part] - mixture.means[likeliest])
        return _Quadratic(curvature, gradient)


def _precisions(mixture: LatentMixture) -> Floats:
    """Compute the inverse variance (L,) of each dimension of a mixture, to which the damping is proportional."""
    centre = mixture.weights @ mixture.means
    spread = np.diagonal(mixture.covariances, axis1=1, axis2=2) + (mixture.means - centre) ** 2
    return np.asarray(1.0 / (mixture.weights @ spread))


def _cost(residuals: Floats, prior: _Prior, stacked: Floats) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is no improvement
        return 0.5 * float(residuals @ residuals) + prior.cost(stacked)


def _is_still(step: Floats, here: Floats) -> bool:
    return bool(np.abs(step).max(initial=0.0) <= 1e-12 * (1.0 + np.abs(here).max(initial=0.0)))
