"""Errors of joint positions in motions that are reconstructed from a few components: training and left-out examples."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import CM_PER_M, Floats, Ints
from marey_motion.modelling.example_groups import ExampleGroups
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
    left_out_cm : (c,) mean error of examples that are reconstructed from the components and the mean of the examples of
        all other takes; None if all examples come from one take
    left_out_each_cm : (m, c) the error of each of these examples; None if all examples come from one take
    left_out_subject_cm : (c,) mean error of examples that are reconstructed from the examples of all other performers;
        None if fewer than three performers are known
    """

    components: NDArray[np.int64]
    training_cm: Floats
    left_out_cm: Floats | None
    left_out_each_cm: Floats | None
    left_out_subject_cm: Floats | None = None


def reconstruction_errors(
    skeleton: Skeleton,
    principal: PrincipalExamples,
    poses: Floats,
    most_components: int,
    *,
    groups: ExampleGroups | None = None,
    threads: int = 1,
    progress: Progress | None = None,
) -> ReconstructionErrors:
    """Compute the errors of m aligned examples by number of components.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    principal : PrincipalExamples    components of the examples
    poses : (m, N, 3 + 4·J) float64    poses of the examples; their quaternions have consistent signs
    most_components : int    largest number of components
    groups : ExampleGroups, optional    takes and performers; by default, each example is a take of its own
    threads : int    threads to use
    progress : callable, optional    called as progress(done, total, name of the step)

    Returns
    -------
    ReconstructionErrors    centimetres

    Notes
    -----
    Leaving g of m examples out of a principal component analysis, with the sum t of their scores s, subtracts Σ ssᵀ and
    ttᵀ / (m - g) from the diagonal matrix of the sums of squared scores, and moves the mean to -t / (m - g). Each
    left-out take therefore needs only an eigendecomposition of the size of the score space; the coefficients are not
    analysed again.
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

    groups = groups or ExampleGroups.alone(len(poses))
    parts = [groups.takes] if groups.subjects is None else [groups.takes, groups.subjects]
    todo = [(part, number) for part in parts for number in range(int(part.max()) + 1)]
    known = groups.take_count > 1
    training, left_out, of_others = (np.empty((len(poses), count)) for _ in range(3))

    def measure(part: Ints, number: int) -> None:
        members = np.flatnonzero(part == number)
        by_take = part is groups.takes
        without = _left_out(scores, members, count) if known or not by_take else None
        for place, example in enumerate(members.tolist()):
            chosen = np.ascontiguousarray(poses[example, frames])
            if by_take:
                own = np.tril(np.ones((count, used)), -1) * scores[example]
                training[example] = compare.distances(own, chosen)
            if without is not None:
                (left_out if by_take else of_others)[example] = compare.distances(without[place], chosen)

    with ThreadPoolExecutor(max(1, threads)) as pool:
        for done, _ in enumerate(pool.map(lambda one: measure(*one), todo)):
            if progress is not None:
                progress(done + 1, len(todo), "leaving examples out")
    return ReconstructionErrors(
        components=np.arange(count),
        training_cm=CM_PER_M * training.mean(axis=0),
        left_out_cm=CM_PER_M * left_out.mean(axis=0) if known else None,
        left_out_each_cm=CM_PER_M * left_out if known else None,
        left_out_subject_cm=None if groups.subjects is None else CM_PER_M * of_others.mean(axis=0),
    )


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


def _left_out(scores: Floats, members: Ints, count: int) -> Floats:
    """Compute the scores (g, count, r) of g left-out examples that are rebuilt from components of the other examples.

    The examples are rebuilt from 0, 1, ... and count - 1 components. `members` are the indices of the left-out ones.
    """
    own = scores[members]
    others = len(scores) - len(members)
    moved = own.sum(axis=0) / others
    spread = np.diag(np.einsum("mr,mr->r", scores, scores)) - own.T @ own - others * np.outer(moved, moved)
    _, vectors = np.linalg.eigh(spread)
    leading = vectors[:, ::-1][:, : count - 1]
    along = ((own + moved) @ leading)[:, :, None] * leading.T
    start = np.zeros((len(members), 1, scores.shape[1]))
    return np.asarray(np.concatenate((start, np.cumsum(along, axis=1)), axis=1) - moved)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Poses at T frames as a linear function of r scores: mean (T, 3 + 4·J), directions (r, T, 3 + 4·J)."""

    skeleton: Skeleton
    mean: Floats
    directions: Floats

    def distances(self, scores: Floats, poses: Floats) -> Floats:
        """Compute the mean distance of joints, in metres, between each of c motions and one given motion; (c,).

        The c motions are given by their `scores` (c, r), and the one motion by its `poses` (T, 3 + 4·J).
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
