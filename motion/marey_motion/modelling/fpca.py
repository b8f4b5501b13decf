"""Functional principal component analysis of spline coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import FunctionalComponents
from marey_motion.modelling.splines import SplineBasis

Floats = NDArray[np.float64]
InnerProduct = Literal["coefficients", "l2"]

SMALLEST_RELATIVE_DEVIATION = 2e-7
"""Singular values below this share of the largest one are rounding: the Gram matrix holds their squares."""

SMALLEST_RELATIVE_SPREAD = 1e-11
"""Examples that differ from their mean by less than this share of their size are copies of one example."""


@dataclass(frozen=True)
class Keep:
    """How many components are kept: the fewest that hold `share` of the variance, at most `most`; or exactly `count`.

    A count beyond the rank of the examples gives as many as there are.
    """

    share: float = 0.95
    most: int | None = None
    count: int | None = None


@dataclass(frozen=True, eq=False)
class PrincipalExamples:
    """The principal components of m examples, before any is dropped.

    Parameters
    ----------
    functions : to be kept
    energy : (r,) cumulative share of the variance, of all r components that the examples have
    scores : (m, r) of the examples on all of them, centred
    directions : (r, n, D) of all of them
    """

    functions: FunctionalComponents
    energy: Floats
    scores: Floats
    directions: Floats


def find_components(
    basis: SplineBasis,
    coefficients: Floats,
    weights: Floats,
    keep: Keep = Keep(),
    inner_product: InnerProduct = "coefficients",
) -> PrincipalExamples:
    """The principal functions of m examples.

    Parameters
    ----------
    coefficients : (m, n, D) of the examples in `basis`
    weights : (D,) positive; channels are multiplied by them before the analysis, which is undone in the result
    inner_product : `coefficients` sums products of coefficients; `l2` integrates products of functions over canonical
        time, so that the result does not depend on where the knots are (Ramsay and Silverman 2005, 8.4.2)

    Notes
    -----
    Fewer examples than coefficients: the eigenvectors of the (m, m) Gram matrix are those of the covariance, at a
    fraction of the cost. The share of variance is of all components. Signs are such that the largest entry of each
    scaled direction is positive.
    """
    examples = len(coefficients)
    if coefficients.shape[1] != basis.count or weights.shape != coefficients.shape[2:]:
        raise MotionError(
            f"coefficients {coefficients.shape} do not fit {basis.count} splines, weights {weights.shape}"
        )
    mean = coefficients.mean(axis=0)
    root = root_of_products(basis, inner_product)
    scaled = (root.T @ (coefficients - mean)) * weights
    flat = scaled.reshape(examples, -1)
    size = np.linalg.norm((root.T @ coefficients) * weights)
    deviations, left = _decompose(flat, float(size))
    vectors = (left.T @ flat) / deviations[:, None]
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, None], axis=1)
    signs = np.where(largest < 0.0, -1.0, 1.0)
    vectors, left = vectors * signs, left * signs.T
    shaped = vectors.reshape(-1, *mean.shape)
    directions = np.linalg.solve(root.T, shaped) / weights
    projections = (root @ shaped) * weights
    energy = np.cumsum(deviations**2) / max(float((deviations**2).sum()), np.finfo(np.float64).tiny)
    kept = _kept_count(energy, keep)
    functions = FunctionalComponents(
        basis=basis,
        mean=mean,
        directions=directions[:kept],
        projections=projections[:kept],
        variances=deviations[:kept] ** 2 / max(examples - 1, 1),
        energy=energy[:kept],
    )
    return PrincipalExamples(functions, energy, left * deviations, directions)


def _decompose(flat: Floats, size: float) -> tuple[Floats, Floats]:
    """Singular values (r,), falling, and left singular vectors (m, r) of centred examples (m, P)."""
    squares, vectors = np.linalg.eigh(flat @ flat.T)
    squares, vectors = squares[::-1], vectors[:, ::-1]
    deviations = np.sqrt(np.maximum(squares, 0.0))
    floor = max(SMALLEST_RELATIVE_DEVIATION * float(deviations[0]), SMALLEST_RELATIVE_SPREAD * size)
    rank = min(int((deviations > floor).sum()), len(flat) - 1)
    return deviations[:rank], vectors[:, :rank]


def _kept_count(energy: Floats, keep: Keep) -> int:
    if keep.count is not None:
        return min(keep.count, len(energy))
    enough = int(np.searchsorted(energy, keep.share - 1e-12)) + 1
    return min(enough, len(energy), len(energy) if keep.most is None else keep.most)


def root_of_products(basis: SplineBasis, inner_product: InnerProduct) -> Floats:
    """(n, n) lower triangular L with L Lᵀ the inner products of the basis functions."""
    if inner_product == "coefficients":
        return np.eye(basis.count)
    return np.asarray(np.linalg.cholesky(basis.products), dtype=np.float64)
