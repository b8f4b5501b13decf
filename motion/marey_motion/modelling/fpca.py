"""Functional principal component analysis of spline coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import FunctionalComponents
from marey_motion.modelling.splines import SplineBasis
from marey_schemas.options.modelling import DEFAULT_INNER_PRODUCT, InnerProduct

SMALLEST_RELATIVE_DEVIATION = 2e-7
"""A singular value whose ratio to the largest one is below this number is treated as a rounding error.

The number is much larger than the precision of float64, because singular values are computed as square roots of the
eigenvalues of the Gram matrix.
"""

SMALLEST_RELATIVE_SPREAD = 1e-11
"""A singular value whose ratio to the norm of all examples is below this number is treated as a rounding error.

Examples that vary so little are copies of one example.
"""


@dataclass(frozen=True)
class Keep:
    """Number of components to keep: `count` if given, else the least number that explains `share` of the variance.

    The number is at most `most`, unless `count` is given.

    If `count` exceeds the rank of the examples, all components are kept.
    """

    share: float = 0.95
    most: int | None = None
    count: int | None = None


@dataclass(frozen=True, eq=False)
class PrincipalExamples:
    """All principal components of m examples, from which a model keeps the first ones.

    Parameters
    ----------
    functions : FunctionalComponents    the components to keep
    energy : (r,) float64    cumulative share of the variance in the first 1, 2, ... r components; r is the number of
        all components
    scores : (m, r) float64    scores of the examples on all components, centred
    deviations : (m, n, D) float64    deviations of the examples' coefficients from their mean
    """

    functions: FunctionalComponents
    energy: Floats
    scores: Floats
    deviations: Floats

    @cached_property
    def directions(self) -> Floats:
        """Change of the coefficients per unit of each score, for all components; (r, n, D) float64."""
        directions: Floats = np.tensordot((self.scores / (self.scores**2).sum(axis=0)).T, self.deviations, axes=1)
        return directions


def find_components(
    basis: SplineBasis,
    coefficients: Floats,
    weights: Floats,
    keep: Keep = Keep(),
    inner_product: InnerProduct = DEFAULT_INNER_PRODUCT,
) -> PrincipalExamples:
    """Compute the principal functions of m examples.

    Parameters
    ----------
    basis : SplineBasis    splines with n coefficients
    coefficients : (m, n, D) float64    coefficients of the examples in `basis`
    weights : (D,) float64    positive factors of the channels in the analysis; the resulting functions are scaled back
    keep : Keep    number of components to keep
    inner_product : str    "coefficients" sums products of coefficients; "l2" integrates products of functions over
        canonical time, so that the result does not depend on the position of the knots (Ramsay and Silverman 2005,
        section 8.4.2)

    Returns
    -------
    PrincipalExamples    components and scores

    Raises
    ------
    MotionError    if the shapes do not match

    Notes
    -----
    There are fewer examples than coefficients. Therefore, the eigenvectors u of the (m, m) matrix of the examples'
    inner products are computed instead of those of the covariance, at a fraction of the cost. For either kind of inner
    product, a direction is the sum of the examples' deviations from the mean, weighted by the entries of u. The same
    inner product projects the deviations onto the directions to compute the scores. Each share of the variance is
    relative to the variance before components are left out. The largest entry of each direction is positive.
    """
    examples = len(coefficients)
    if coefficients.shape[1] != basis.count or weights.shape != coefficients.shape[2:]:
        raise MotionError(
            f"the shapes do not match: coefficients {coefficients.shape}, {basis.count} splines, weights "
            f"{weights.shape}"
        )
    mean = coefficients.mean(axis=0)
    deviations = coefficients - mean
    lengths, left = _decompose(*_inner_products(basis, deviations, mean, weights, inner_product))
    energy = np.cumsum(lengths**2) / max(float((lengths**2).sum()), np.finfo(np.float64).tiny)
    kept = _kept_count(energy, keep)
    shares = (left[:, :kept] / lengths[:kept]).T
    directions = np.tensordot(shares, deviations, axes=1)
    flat = directions.reshape(kept, mean.size)
    signs = np.where(flat[np.arange(kept), np.abs(flat).argmax(axis=1)] < 0.0, -1.0, 1.0)
    directions *= signs[:, None, None]
    functions = FunctionalComponents(
        basis=basis,
        mean=mean,
        directions=directions,
        projections=dual_coefficients(basis, directions, inner_product) * weights**2,
        variances=lengths[:kept] ** 2 / max(examples - 1, 1),
        energy=energy[:kept],
    )
    scores = left * lengths
    scores[:, :kept] *= signs
    return PrincipalExamples(functions, energy, scores, deviations)


def dual_coefficients(basis: SplineBasis, coefficients: Floats, inner_product: InnerProduct) -> Floats:
    """Compute dual coefficients, whose dot products with a function's coefficients are inner products of functions.

    Parameters
    ----------
    basis : SplineBasis    splines with n coefficients
    coefficients : (..., n, D) float64    coefficients of functions
    inner_product : str    "coefficients" or "l2"

    Returns
    -------
    (..., n, D) float64    dual coefficients
    """
    return coefficients if inner_product == "coefficients" else np.asarray(basis.products @ coefficients)


def _inner_products(
    basis: SplineBasis, deviations: Floats, mean: Floats, weights: Floats, inner_product: InnerProduct
) -> tuple[Floats, float]:
    """Compute inner products of m examples whose channels are multiplied by `weights`.

    Returns the inner products (m, m) of the examples' deviations from their mean, and the norm of the vector that
    consists of all examples.
    """
    weighted, weighted_mean = deviations * weights, mean * weights
    if inner_product == "l2":
        root = np.linalg.cholesky(basis.products).T
        weighted, weighted_mean = root @ weighted, root @ weighted_mean
    flat = weighted.reshape(len(weighted), -1)
    products = flat @ flat.T
    return products, float(np.sqrt(np.trace(products) + len(flat) * (weighted_mean**2).sum()))


def _decompose(products: Floats, size: float) -> tuple[Floats, Floats]:
    """Compute singular values (r,), descending, and left singular vectors (m, r) from inner products (m, m).

    Values that are small compared with the largest one, or with the norm `size` of all examples, are left out.
    """
    squares, vectors = np.linalg.eigh(products)
    lengths = np.sqrt(np.maximum(squares[::-1], 0.0))
    floor = max(SMALLEST_RELATIVE_DEVIATION * float(lengths[0]), SMALLEST_RELATIVE_SPREAD * size)
    rank = min(int((lengths > floor).sum()), len(products) - 1)
    return lengths[:rank], vectors[:, ::-1][:, :rank]


def _kept_count(energy: Floats, keep: Keep) -> int:
    if keep.count is not None:
        return min(keep.count, len(energy))
    enough = int(np.searchsorted(energy, keep.share - 1e-12)) + 1
    return min(enough, len(energy), len(energy) if keep.most is None else keep.most)
