"""Comparison of samples of a model with its examples: durations, distances, diversity and ranges of the joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import CM_PER_M, Floats, Ints
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.sample_quality import joint_positions

MOMENTS = 8
"""Number of canonical frames at which motions are compared."""
MOTIONS_COMPARED = 100


@dataclass(frozen=True)
class SampleComparison:
    """Distributions of the samples and of the examples.

    Distances of two motions are mean distances of their joints at the same canonical frames, in centimetres.

    Parameters
    ----------
    duration_gap : statistic of Kolmogorov and Smirnov for the durations, 0 to 1: the greatest difference, over all
        durations d, between the share of the samples and the share of the examples that last at most d
    nearest_cm : median distance of a sample from the nearest example
    nearest_example_cm : median distance of an example from the nearest example of another take; None if all examples
        come from one take
    diversity_cm, example_diversity_cm : mean distance of two samples, and of two examples; None if there is only one
        sample, or only one example
    beyond_range_share : share of the rotations of joints in samples that are farther from the joint's mean rotation
        than any rotation of this joint in the examples
    """

    duration_gap: float
    nearest_cm: float
    nearest_example_cm: float | None
    diversity_cm: float | None
    example_diversity_cm: float | None
    beyond_range_share: float


def compare_samples(
    primitive: MotionPrimitive, poses: Floats, durations_s: Floats, takes: Ints, sampled: Floats
) -> SampleComparison:
    """Compare samples with examples.

    The durations of all samples are compared, but only the poses of the first `MOTIONS_COMPARED` samples. The distances
    between examples are computed for at most as many examples, evenly spread over the set.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    poses : (m, N, 3 + 4·J) float64    poses of the examples; their quaternions have consistent signs
    durations_s : (m,) float64    durations of the examples
    takes : (m,) int64    number of the take of each example
    sampled : (n, L) float64    latent vectors of the samples, n at least 1

    Returns
    -------
    SampleComparison    the comparison
    """
    frames = np.unique(np.linspace(0, primitive.frame_count - 1, MOMENTS).round().astype(np.int64))
    chosen = np.unique(np.linspace(0, len(poses) - 1, MOTIONS_COMPARED).round().astype(np.int64))
    some = sampled[:MOTIONS_COMPARED]
    drawn = primitive.poses(some)[:, frames]
    joints = tuple(range(primitive.skeleton.joint_count))
    examples = joint_positions(primitive.skeleton, poses[:, frames], joints)
    samples = joint_positions(primitive.skeleton, drawn, joints)
    to_examples = _distances(samples, examples)
    among = _distances(examples[chosen], examples)
    strangers = np.where(takes[chosen][:, None] == takes[None], np.inf, among).min(axis=1)
    known = strangers[np.isfinite(strangers)]
    return SampleComparison(
        duration_gap=_greatest_gap(durations_s, primitive.durations_s(sampled)),
        nearest_cm=float(np.median(to_examples.min(axis=1))),
        nearest_example_cm=float(np.median(known)) if known.size else None,
        diversity_cm=_mean_of_pairs(_distances(samples, samples)),
        example_diversity_cm=_mean_of_pairs(among[:, chosen]),
        beyond_range_share=_beyond_range(poses[:, frames], drawn),
    )


def _distances(motions: Floats, others: Floats) -> Floats:
    """Compute the distances (n, m) between `motions` (n, T, J, 3) and `others` (m, T, J, 3), in centimetres."""
    return CM_PER_M * np.stack([np.linalg.norm(others - one, axis=-1).mean(axis=(1, 2)) for one in motions])


def _mean_of_pairs(distances: Floats) -> float | None:
    """Compute the mean of the distances (n, n) between different motions; None if there is only one motion."""
    count = len(distances)
    return float(distances.sum() / (count * (count - 1))) if count > 1 else None


def _greatest_gap(one: Floats, other: Floats) -> float:
    """Compute the greatest difference of the cumulative distributions of two sets of numbers."""
    at = np.concatenate((one, other))
    shares = [np.searchsorted(np.sort(numbers), at, side="right") / len(numbers) for numbers in (one, other)]
    return float(np.abs(shares[0] - shares[1]).max())


def _beyond_range(examples: Floats, samples: Floats) -> float:
    """Compute the share of joint rotations in samples that are outside the ranges of the examples.

    The samples are poses (n, T, 3 + 4·J), the examples poses (m, T, 3 + 4·J).
    """
    turned = [motions[..., 3:].reshape(*motions.shape[:2], -1, 4) for motions in (examples, samples)]
    given, drawn = (one / np.linalg.norm(one, axis=-1, keepdims=True) for one in turned)
    mean = given.mean(axis=(0, 1))
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    closeness = [np.abs(np.einsum("mfjc,jc->mfj", one, mean)) for one in (given, drawn)]
    return float((closeness[1] < closeness[0].min(axis=(0, 1)) - 1e-9).mean())
