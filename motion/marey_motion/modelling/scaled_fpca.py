"""Channel weights that minimise the errors of joint positions for few components (Du et al. 2016, scaled FPCA)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.modelling.fpca import Keep, dual_coefficients, find_components
from marey_motion.modelling.reconstruction import comparison_frames
from marey_motion.modelling.splines import SplineBasis
from marey_motion.skeleton import Skeleton
from marey_schemas.options.modelling import DEFAULT_INNER_PRODUCT, InnerProduct

SMALLEST_WEIGHT = 1e-2
LARGEST_WEIGHT = 1e3
MOST_ITERATIONS = 60
TOLERANCE = 1e-5
"""Change of the error, as a share of the first error, below which the optimisation stops."""

MOST_POSES = 6000
"""Maximum number of poses in which joints are compared; if there are many examples, fewer frames of each are used."""


def optimised_weights(
    skeleton: Skeleton,
    basis: SplineBasis,
    coefficients: Floats,
    starts: Sequence[Floats],
    keep: Keep,
    inner_product: InnerProduct = DEFAULT_INNER_PRODUCT,
) -> tuple[Floats, Keep]:
    """Optimise weights of channels, one weight for each root axis and each joint.

    The weights minimise the squared distances of joints between the examples and their reconstructions from a few
    components. The number of components is determined by `keep` with the first starting weights, and is then fixed.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    basis : SplineBasis    splines with n coefficients
    coefficients : (m, n, D) float64    coefficients of m examples in D = 3 + 4·J channels; the quaternions of the
        examples have consistent signs
    starts : sequence of (D,) float64    candidates for the starting weights; the best candidate is improved
    keep : Keep    number of components
    inner_product : str    "coefficients" or "l2"

    Returns
    -------
    weights : (D,) float64    positive
    keep : Keep    the number of components used

    Notes
    -----
    When examples are reconstructed from leading components, the matrix of their coefficients is projected, from the
    left, on the leading eigenvectors of the Gram matrix K = Σ wᵍ² Kᵍ over the channels g. So the weights matter only
    through K, which has the shape (m, m), and the derivative of its eigenprojector gives the gradient. Value and
    gradient together cost one pass of forward kinematics.
    """
    from scipy.optimize import minimize

    count = find_components(basis, coefficients, starts[0], keep, inner_product).functions.count
    problem = _Problem(skeleton, basis, coefficients, count, inner_product)
    start = min(map(_logarithms, starts), key=lambda logarithms: problem.value_and_gradient(logarithms)[0])
    if not 0 < count < len(coefficients) - 1:
        return _expanded(np.exp(start)), Keep(count=count)
    first = problem.value_and_gradient(start)[0]

    def relative(logarithms: Floats) -> tuple[float, Floats]:
        # The tolerance of SLSQP is an absolute one.
        value, gradient = problem.value_and_gradient(logarithms)
        return value / first, gradient / first

    found = minimize(
        relative,
        start,
        jac=True,
        method="SLSQP",
        bounds=[(np.log(SMALLEST_WEIGHT), np.log(LARGEST_WEIGHT))] * len(start),
        options={"maxiter": MOST_ITERATIONS, "ftol": TOLERANCE},
    )
    return _expanded(np.exp(found.x if found.fun < 1.0 else start)), Keep(count=count)


def _logarithms(weights: Floats) -> Floats:
    """Compute logarithms (3 + J,) of weights (3 + 4·J,) that are equal in the channels of a joint."""
    return np.log(np.clip(np.concatenate((weights[:3], weights[3::4])), SMALLEST_WEIGHT, LARGEST_WEIGHT))


def _expanded(groups: Floats) -> Floats:
    return np.concatenate((groups[:3], np.repeat(groups[3:], 4)))


@dataclass(frozen=True, eq=False)
class _Problem:
    """The mean squared distance of joints after reconstruction, as a function of the logarithms of weights."""

    skeleton: Skeleton
    basis: SplineBasis
    coefficients: Floats
    count: int
    inner_product: InnerProduct

    @cached_property
    def deviations(self) -> Floats:
        """Deviations (m, n, D) of the examples from their mean."""
        return np.asarray(self.coefficients - self.coefficients.mean(axis=0))

    @cached_property
    def grams(self) -> Floats:
        """Inner products (3 + J, m, m) of the examples' deviations, by group of channels: root axes, then joints."""
        duals = dual_coefficients(self.basis, self.deviations, self.inner_product)
        each = self.deviations.transpose(2, 0, 1) @ duals.transpose(2, 1, 0)
        joints = each[3:].reshape(-1, 4, *each.shape[1:]).sum(axis=1)
        return np.concatenate((each[:3], joints))

    @cached_property
    def values(self) -> Floats:
        """Values (T, n) of the basis functions at the frames where joints are compared."""
        frames = comparison_frames(self.basis)
        allowed = max(4, MOST_POSES // len(self.coefficients))
        chosen = frames[np.unique(np.linspace(0, len(frames) - 1, min(allowed, len(frames))).round().astype(np.int64))]
        return self.basis.matrix(chosen.astype(np.float64))

    @cached_property
    def deviating_poses(self) -> Floats:
        """Deviations (m, T·D) of the examples from the mean pose, at the T frames where joints are compared."""
        return np.asarray((self.values @ self.deviations).reshape(len(self.coefficients), -1))

    @cached_property
    def mean_poses(self) -> Floats:
        """Mean poses (T·D,) at the frames where joints are compared."""
        return np.asarray((self.values @ self.coefficients.mean(axis=0)).ravel())

    @cached_property
    def targets(self) -> Floats:
        """Positions (m·T, J, 3) of the joints of the examples."""
        poses = (self.mean_poses + self.deviating_poses).reshape(-1, self.coefficients.shape[2])
        rotations = poses[:, 3:].reshape(len(poses), -1, 4)
        rotations /= np.sqrt(np.einsum("fjc,fjc->fj", rotations, rotations))[..., None]
        return np.asarray(kinematics.forward_kinematics(self.skeleton, poses), dtype=np.float64)

    def value_and_gradient(self, logarithms: Floats) -> tuple[float, Floats]:
        """Compute the mean squared distance in m², and its gradient (3 + J,) in the logarithms of the weights."""
        from marey_motion.modelling import reconstruction_kernels

        squares = np.exp(2.0 * logarithms)
        eigenvalues, vectors = np.linalg.eigh(np.tensordot(squares, self.grams, axes=1))
        kept, dropped = vectors[:, ::-1][:, : self.count], vectors[:, ::-1][:, self.count :]
        made = self.mean_poses + kept @ (kept.T @ self.deviating_poses)
        poses = made.reshape(-1, self.coefficients.shape[2])
        gradient = np.empty_like(poses)
        total = reconstruction_kernels.squared_error_gradient(
            poses, self.skeleton.parents, self.skeleton.offsets, self.targets, gradient
        )
        by_projector = gradient.reshape(made.shape) @ self.deviating_poses.T
        # The projector on the kept eigenvectors changes by how the matrix couples kept and dropped ones.
        gaps = eigenvalues[::-1][: self.count, None] - eigenvalues[::-1][None, self.count :]
        gaps = np.maximum(gaps, 1e-12 * max(float(eigenvalues[-1]), np.finfo(np.float64).tiny))
        coupling = kept.T @ (by_projector + by_projector.T) @ dropped / gaps
        by_squares = np.einsum("gab,ab->g", self.grams, kept @ coupling @ dropped.T, optimize=True)
        share = 1.0 / (self.targets.shape[0] * self.targets.shape[1])
        return total * share, 2.0 * squares * by_squares * share
