"""Errors of joint positions in motions that are reconstructed from a few components: training and left-out examples."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import CM_PER_M, Floats
from marey_motion.modelling.fpca import PrincipalExamples
from marey_motion.modelling.splines import SplineBasis
from marey_motion.skeleton import Skeleton

Progress = Callable[[int, int, str], None]

MOST_DIMENSIONS = 200
"""Maximum number of components used when examples are left out; if there are more, the smallest are dropped."""


@dataclass(frozen=True, eq=False)
class ReconstructionErrors:
    """Mean distance of reconstructed joints from the joints of the aligned examples, in centimetres.

    Parameters
    ----------
    components : (c,) numbers of components: 0, 1, 2, ...
    training_cm : (c,) mean error of the examples from which the components were computed
    left_out_cm : (c,) mean error of examples that are reconstructed from the components and the mean of all other
        examples
    left_out_each_cm : (m, c) the error of each of these examples
    """

    components: NDArray[np.int64]
    training_cm: Floats
    left_out_cm: Floats
    left_out_each_cm: Floats


def reconstruction_errors(
    skeleton: Skeleton,
    principal: PrincipalExamples,
    poses: Floats,
    most_components: int,
    *,
    threads: int = 1,
    progress: Progress | None = None,
) -> ReconstructionErrors:
    """Compute the errors of m aligned examples by number of components.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    principal : PrincipalExamples    components of the examples
    poses : (m, N, D) float64    poses with consistent signs
    most_components : int    largest number of components
    threads : int    threads to use
    progress : callable, optional    called as progress(done, total, name of the step)

    Returns
    -------
    ReconstructionErrors    centimetres

    Notes
    -----
    Leaving example i out of a principal component analysis subtracts c sᵢsᵢᵀ from the diagonal covariance of the scores
    s, with c = m / (m - 1), and moves the mean to -sᵢ / (m - 1). Each left-out example therefore needs only an
    eigendecomposition of the size of the score space; the coefficients are not analysed again.
    """
    basis = principal.functions.basis
    frames = comparison_frames(basis)
    values = basis.matrix(frames.astype(np.float64))
    mean = values @ principal.functions.mean
    used = min(principal.directions.shape[0], MOST_DIMENSIONS)
    directions = values @ principal.directions[:used]
    scores = principal.scores[:, :used]
    compare = _Comparison(skeleton, mean, directions)
    count = min(most_components, used) + 1

    def errors_of(example: int) -> tuple[Floats, Floats]:
        chosen = np.ascontiguousarray(poses[example, frames])
        own = np.tril(np.ones((count, used)), -1) * scores[example]
        return compare.distances(own, chosen), compare.distances(_left_out(scores, example, count), chosen)

    found = []
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for done, errors in enumerate(pool.map(errors_of, range(len(poses)))):
            found.append(errors)
            if progress is not None:
                progress(done + 1, len(poses), "leaving examples out")
    training, left_out = (np.array(one) * CM_PER_M for one in zip(*found, strict=True))
    return ReconstructionErrors(np.arange(count), training.mean(axis=0), left_out.mean(axis=0), left_out)


def comparison_frames(basis: SplineBasis) -> NDArray[np.int64]:
    """Choose the canonical frames at which motions are compared: two for each coefficient of the splines.

    Parameters
    ----------
    basis : SplineBasis    splines with n coefficients

    Returns
    -------
    (k,) int64    canonical frames, at most 2·n
    """
    count = min(basis.frame_count, 2 * basis.count)
    return np.unique(np.linspace(0, basis.frame_count - 1, count).round().astype(np.int64))


def _left_out(scores: Floats, example: int, count: int) -> Floats:
    """Compute the scores (count, r) of reconstructions of an example by 0, 1, ... components of the other examples."""
    examples = len(scores)
    own = scores[example]
    if examples < 2:
        return np.zeros((count, scores.shape[1]))
    share = examples / (examples - 1)
    _, vectors = np.linalg.eigh(np.diag(np.einsum("mr,mr->r", scores, scores)) - share * np.outer(own, own))
    leading = vectors[:, ::-1][:, : count - 1]
    along = leading * (leading.T @ own * share)
    return np.asarray(np.concatenate((np.zeros((1, len(own))), np.cumsum(along.T, axis=0))) - own / (examples - 1))


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Poses at T frames as a linear function of r scores: mean (T, D), directions (r, T, D)."""

    skeleton: Skeleton
    mean: Floats
    directions: Floats

    def distances(self, scores: Floats, poses: Floats) -> Floats:
        """Compute the mean distance of joints, in metres, between each of c motions and one given motion; (c,).

        The c motions are given by their `scores` (c, r), and the one motion by its `poses` (T, D).
        """
        from marey_motion import kinematics
        from marey_motion.modelling import reconstruction_kernels

        made = self.mean + np.tensordot(scores, self.directions, axes=1)
        targets = kinematics.forward_kinematics(self.skeleton, poses)
        out = np.empty(len(made))
        reconstruction_kernels.mean_distances(
            made, self.skeleton.parents, self.skeleton.offsets, np.asarray(targets, dtype=np.float64), out
        )
        return out
