"""A motion primitive: a generative model of one action, from latent vectors to motions and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.splines import SplineBasis
from marey_motion.modelling.time_model import fit_log_slopes
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

MOST_FRAMES = 100_000
"""Maximum number of frames of one motion."""

MOST_LOG_SLOPE = 12.0
"""Limit of |ln(slope)| of time functions, for a model whose examples are unknown.

Steps of e^-12 to e^12 frames are similar enough in size that their sum increases with each step, despite rounding.
"""

MOST_ATTEMPTS = 100
"""Maximum number of draws of a sample; the last one is accepted even if its duration is too short or too long."""


@dataclass(frozen=True, eq=False)
class FunctionalComponents:
    """Functions of canonical time with D channels: the sum of a mean and of k weighted principal functions.

    Each function is stored as n spline coefficients for each channel.

    Parameters
    ----------
    basis : splines of the functions
    mean : (n, D) coefficients
    directions : (k, n, D) change of the coefficients per unit of each score, after undoing the scaling of the analysis
    projections : (k, n, D) functions whose inner products with coefficients are scores; their inner products with the
        directions are the identity matrix
    variances : (k,) variances of the training examples' scores
    energy : (k,) share of the total variance in the first 1, 2, ... components together
    """

    basis: SplineBasis
    mean: Floats
    directions: Floats
    projections: Floats
    variances: Floats
    energy: Floats

    def __post_init__(self) -> None:
        shape = (self.basis.count, self.mean.shape[1] if self.mean.ndim == 2 else -1)
        if self.mean.shape != shape or self.directions.shape[1:] != shape:
            raise MotionError(
                f"the mean has the shape {self.mean.shape} and the directions have "
                f"{self.directions.shape}; the spline basis needs {shape}"
            )
        if self.projections.shape != self.directions.shape:
            raise MotionError(
                f"the shapes of the projections, {self.projections.shape}, and of the directions, "
                f"{self.directions.shape}, do not match"
            )

    @property
    def count(self) -> int:
        """Number of components k."""
        return len(self.directions)

    def coefficients(self, scores: Floats) -> Floats:
        """Compute spline coefficients from scores.

        Parameters
        ----------
        scores : (m, k) float64    scores

        Returns
        -------
        (m, n, D) float64    coefficients
        """
        return np.asarray(self.mean + np.tensordot(scores, self.directions, axes=1), dtype=np.float64)

    def scores(self, coefficients: Floats) -> Floats:
        """Compute scores from spline coefficients.

        Parameters
        ----------
        coefficients : (m, n, D) float64    coefficients

        Returns
        -------
        (m, k) float64    scores
        """
        return np.asarray(np.tensordot(coefficients - self.mean, self.projections, axes=([1, 2], [1, 2])))


@dataclass(frozen=True, eq=False)
class MotionPrimitive:
    """A model of one action (Min and Chai 2012; Herrmann et al. 2019, section 3).

    A latent vector contains the scores of the spatial components, followed by `temporal_weight` times the scores of the
    temporal components.

    Parameters
    ----------
    name : name of the action
    skeleton : skeleton of the motions, J joints
    frame_rate_hz : rate of the canonical frames
    spatial : 3 + 4·J channels over canonical frames 0 to N - 1: root translation in metres in canonical coordinates,
        then local quaternions, which are normalised when they are evaluated
    temporal : one channel over the N - 1 steps between canonical frames: the natural logarithm of the number of frames
        of real time, at `frame_rate_hz`, that pass in each step
    temporal_weight : positive factor of the temporal scores in latent vectors
    mixture : distribution of latent vectors from which samples are drawn
    keyframes : canonical frame by label
    duration_range_s : shortest and longest duration of a motion, or None for no limits; limits matter because normal
        distributions of logarithms have long tails
    log_slope_range : limits of the temporal function, or None if the examples are not known; without limits, splines
        could overshoot at their ends, so that a motion would nearly stop there
    widening : factor of the mixture's covariances for likelihoods, at least 1. Motions that were not among the examples
        vary more than the examples, so without widening, too many of them would be rated as unlikely
    """

    name: str
    skeleton: Skeleton
    frame_rate_hz: float
    spatial: FunctionalComponents
    temporal: FunctionalComponents
    temporal_weight: float
    mixture: LatentMixture
    keyframes: Mapping[str, int] = field(default_factory=dict)
    duration_range_s: tuple[float, float] | None = None
    log_slope_range: tuple[float, float] | None = None
    widening: float = 1.0

    def __post_init__(self) -> None:
        if self.spatial.mean.shape[1] != 3 + 4 * self.skeleton.joint_count:
            raise MotionError(
                f"the spatial components have {self.spatial.mean.shape[1]} channels, but a skeleton of "
                f"{self.skeleton.joint_count} joints needs {3 + 4 * self.skeleton.joint_count}: 3 for the root "
                "and 4 for each joint"
            )
        if self.temporal.basis.frame_count != self.frame_count - 1:
            raise MotionError(
                f"the time model must have {self.frame_count - 1} steps, one between every two of the "
                f"{self.frame_count} canonical frames"
            )
        if self.mixture.dimensions != self.dimensions:
            raise MotionError(
                f"the mixture has {self.mixture.dimensions} dimensions, but the model has "
                f"{self.dimensions} components; the two numbers must be equal"
            )
        if not (np.isfinite(self.temporal_weight) and self.temporal_weight > 0):
            raise MotionError("the temporal weight must be a positive number", where="temporal_weight")
        if not (np.isfinite(self.widening) and self.widening >= 1):
            raise MotionError("the widening must be at least 1", where="widening")
        least, most = self.log_slope_bounds
        if not -MOST_LOG_SLOPE <= least <= most <= MOST_LOG_SLOPE:
            message = (
                f"the limits {least:g} and {most:g} must be in ascending order, and from {-MOST_LOG_SLOPE:g} to "
                f"{MOST_LOG_SLOPE:g}"
            )
            raise MotionError(message, where="log_slope_range")

    @property
    def frame_count(self) -> int:
        """Number of canonical frames N."""
        return self.spatial.basis.frame_count

    @property
    def dimensions(self) -> int:
        """Number of dimensions L of a latent vector."""
        return self.spatial.count + self.temporal.count

    @property
    def log_slope_bounds(self) -> tuple[float, float]:
        """Limits of the temporal function: `log_slope_range` or, if it is None, ±`MOST_LOG_SLOPE`."""
        return self.log_slope_range or (-MOST_LOG_SLOPE, MOST_LOG_SLOPE)

    @cached_property
    def prior(self) -> LatentMixture:
        """The mixture with widened covariances, which gives the likelihood of a motion."""
        return self.mixture if self.widening == 1.0 else self.mixture.widened(self.widening)

    # -- from latent vectors -------------------------------------------------------------------------------------------

    def sample(self, count: int, seed: int) -> Floats:
        """Draw latent vectors from the mixture.

        Vectors whose motions would be too short or too long are drawn again, each independently of the others. So a
        smaller count gives the first vectors of a larger count. After `MOST_ATTEMPTS` draws, a vector is returned as it
        is.

        Parameters
        ----------
        count : int    number of vectors
        seed : int    the same seed gives the same vectors

        Returns
        -------
        (count, L) float64    latent vectors
        """
        latents = self.mixture.sample(count, seed)
        if self.duration_range_s is None:
            return latents
        least, most = self.duration_range_s
        for attempt in range(1, MOST_ATTEMPTS):
            durations = self._passed(latents)[:, -1] / self.frame_rate_hz
            odd = (durations < least) | (durations > most)
            if not odd.any():
                break
            latents[odd] = self.mixture.sample(count, seed, attempt)[odd]
        return latents

    def poses(self, latents: Floats, times: ArrayLike | None = None) -> Floats:
        """Compute poses with unit quaternions.

        Parameters
        ----------
        latents : (m, L) float64    latent vectors
        times : (T,) float, optional    canonical frames; all of them if None

        Returns
        -------
        (m, T, 3 + 4·J) float64    root translation in metres in canonical coordinates, then local rotations (w, x, y,
            z)
        """
        values = self.spatial.basis.at_frames if times is None else self.spatial.basis.matrix(times)
        poses = values @ self.spatial.coefficients(latents[:, : self.spatial.count])
        rotations = poses[..., 3:].reshape(*poses.shape[:-1], -1, 4)
        rotations /= np.sqrt(np.einsum("...c,...c->...", rotations, rotations))[..., None]
        return np.asarray(poses, dtype=np.float64)

    def time_functions(self, latents: Floats) -> Floats:
        """Compute how many frames of real time have passed at each canonical frame.

        A motion whose duration is outside `duration_range_s` is played faster or slower as a whole.

        Parameters
        ----------
        latents : (m, L) float64    latent vectors

        Returns
        -------
        (m, N) float64    frames at `frame_rate_hz`; the first is 0
        """
        passed = self._passed(latents)
        if self.duration_range_s is not None:
            least, most = (seconds * self.frame_rate_hz for seconds in self.duration_range_s)
            passed *= np.clip(passed[:, -1:], least, most) / passed[:, -1:]
        return passed

    def _passed(self, latents: Floats) -> Floats:
        scores = latents[:, self.spatial.count :] / self.temporal_weight
        log_slopes = (self.temporal.basis.at_frames @ self.temporal.coefficients(scores))[..., 0]
        passed = np.zeros((len(latents), self.frame_count))
        np.cumsum(np.exp(np.clip(log_slopes, *self.log_slope_bounds)), axis=1, out=passed[:, 1:])
        return passed

    def durations_s(self, latents: Floats) -> Floats:
        """Compute the durations of motions.

        Parameters
        ----------
        latents : (m, L) float64    latent vectors

        Returns
        -------
        (m,) float64    seconds
        """
        return np.asarray(self.time_functions(latents)[:, -1] / self.frame_rate_hz)

    def motions(self, latents: Floats) -> list[Motion]:
        """Compute the motions that latent vectors describe, with their durations and their changes of speed.

        The duration of each motion is rounded to a whole number of frames.

        Parameters
        ----------
        latents : (m, L) float64    latent vectors

        Returns
        -------
        list of Motion    at `frame_rate_hz`, in canonical coordinates

        Raises
        ------
        MotionError    for latent vectors so extreme that a motion would have more than `MOST_FRAMES` frames
        """
        made = []
        for latent in latents:
            passed = self.time_functions(latent[None])[0]
            if passed[-1] > MOST_FRAMES:
                raise MotionError(
                    f"the motion would last {passed[-1] / self.frame_rate_hz:.3g} s, far longer than the "
                    "motions that the model was trained on; choose less extreme latent vectors",
                    code="motion-too-long",
                )
            steps = max(1, round(float(passed[-1])))
            times = np.interp(np.linspace(0.0, passed[-1], steps + 1), passed, np.arange(self.frame_count))
            made.append(_as_motion(self.poses(latent[None], times)[0]))
        return made

    # -- to latent vectors ---------------------------------------------------------------------------------------------

    def latents_of(self, poses: Floats, time_functions: Floats) -> Floats:
        """Compute the latent vectors of aligned examples.

        Quaternions must have the same signs as in the training examples: the dot product of a quaternion with the
        corresponding quaternion of the mean motion must not be negative.

        Parameters
        ----------
        poses : (m, N, 3 + 4·J) float64    root translations in metres and local rotations
        time_functions : (m, N) float64    frames of real time at each canonical frame

        Returns
        -------
        (m, L) float64    latent vectors
        """
        scores = self.spatial.scores(self.spatial.basis.fit(poses))
        temporal = self.temporal.scores(fit_log_slopes(self.temporal.basis, time_functions))
        return np.concatenate((scores, self.temporal_weight * temporal), axis=1)

    def log_density(self, latents: Floats) -> Floats:
        """Compute ln p(s) of latent vectors under the widened mixture.

        Parameters
        ----------
        latents : (m, L) float64    latent vectors

        Returns
        -------
        (m,) float64    natural logarithms
        """
        return self.prior.log_density(latents)


def _as_motion(poses: Floats) -> Motion:
    frames = len(poses)
    return Motion(poses[:, :3].copy(), poses[:, 3:].reshape(frames, -1, 4).copy(), np.zeros((frames, 0, 3)), ())
