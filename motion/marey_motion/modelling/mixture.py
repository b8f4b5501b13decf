"""A mixture of normal distributions over the latent vectors of a model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError


@dataclass(frozen=True, eq=False)
class LatentMixture:
    """K normal distributions with full covariances in L dimensions; L is 0 if nothing varies.

    Parameters
    ----------
    weights : (K,) float64    positive, of sum 1
    means : (K, L) float64    means
    covariances : (K, L, L) float64    symmetric, positive definite
    """

    weights: Floats
    means: Floats
    covariances: Floats

    def __post_init__(self) -> None:
        count, dimensions = self.means.shape
        if not count or self.weights.shape != (count,) or self.covariances.shape != (count, dimensions, dimensions):
            shapes = f"{self.weights.shape}, {self.means.shape}, {self.covariances.shape}"
            raise MotionError(f"the shapes of the weights, means and covariances, {shapes}, do not match")
        if not ((self.weights > 0).all() and abs(self.weights.sum() - 1.0) < 1e-6):
            raise MotionError("the weights of a mixture must be positive and add up to 1")

    @property
    def dimensions(self) -> int:
        """Number of dimensions L."""
        return int(self.means.shape[1])

    @cached_property
    def cholesky(self) -> Floats:
        """Lower triangular factors of the covariances, (K, L, L).

        Raises `MotionError` if a covariance is not positive definite.
        """
        try:
            return np.asarray(np.linalg.cholesky(self.covariances), dtype=np.float64)
        except np.linalg.LinAlgError:
            raise MotionError("a covariance of the mixture is not positive definite") from None

    @cached_property
    def whitening(self) -> Floats:
        """Inverses (K, L, L) of the Cholesky factors: `whitening[k] @ (s - means[k])` has unit covariance."""
        return np.asarray(np.linalg.inv(self.cholesky), dtype=np.float64)

    @cached_property
    def log_peaks(self) -> Floats:
        """Natural logarithm of weight times density at the mean of each component, (K,)."""
        log_roots = np.log(np.diagonal(self.cholesky, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(np.log(self.weights) - log_roots - 0.5 * self.dimensions * np.log(2.0 * np.pi))

    def widened(self, factor: float) -> LatentMixture:
        """Make a mixture with the same means and larger covariances.

        Parameters
        ----------
        factor : float    factor of all covariances, positive

        Returns
        -------
        LatentMixture    the widened mixture
        """
        return LatentMixture(self.weights, self.means, self.covariances * factor)

    def component_log_densities(self, latents: Floats) -> Floats:
        """Compute each component's weighted log density ln(pi_k N_k(s)) of latent vectors.

        Parameters
        ----------
        latents : (n, L) float64    latent vectors

        Returns
        -------
        (n, K) float64    natural logarithms
        """
        away = np.einsum("kij,nkj->nki", self.whitening, latents[:, None, :] - self.means)
        return np.asarray(self.log_peaks - 0.5 * np.einsum("nki,nki->nk", away, away))

    def log_density(self, latents: Floats) -> Floats:
        """Compute the log density ln p(s) of latent vectors.

        Parameters
        ----------
        latents : (n, L) float64    latent vectors

        Returns
        -------
        (n,) float64    natural logarithms
        """
        each = self.component_log_densities(latents)
        highest = each.max(axis=1)
        return np.asarray(highest + np.log(np.exp(each - highest[:, None]).sum(axis=1)))

    def sample(self, count: int, seed: int, attempt: int = 0) -> Floats:
        """Draw latent vectors.

        With the same seed and attempt, a smaller count gives the first vectors of a larger count.

        Parameters
        ----------
        count : int    number of vectors
        seed : int    the same seed gives the same vectors
        attempt : int    number of the draw with this seed, from 0 on; each attempt gives different vectors

        Returns
        -------
        (count, L) float64    latent vectors
        """
        generator = np.random.Generator(np.random.Philox(seed).jumped(attempt))
        # One stream of rows: what a row holds must not depend on how many follow.
        draws = generator.standard_normal((count, self.dimensions + 1))
        chosen = np.searchsorted(np.cumsum(self.weights)[:-1], _as_share(draws[:, 0]), side="right")
        turned = np.einsum("nij,nj->ni", self.cholesky[chosen], draws[:, 1:])
        return np.asarray(self.means[chosen] + turned, dtype=np.float64)


def _as_share(normal: Floats) -> Floats:
    """Map standard normal numbers to numbers uniformly distributed over 0 to 1."""
    from scipy.special import ndtr

    return np.asarray(ndtr(normal), dtype=np.float64)
