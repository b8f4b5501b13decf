"""Conversion of time functions (time warps) between models of Marey's predecessor and models of Marey.

A time function t(x) maps each canonical frame x, from 0 to N - 1, to a frame of an example. It is determined by a
vector g of scores. Marey's model contains ln(t(x + 1) - t(x)), which is linear in g. The predecessor has two forms:

* `coefficients` (layouts 1 and 3, and layout 2 by its later training program): t(x) is a spline whose coefficients are
  cumsum(exp(mean + g · eigen)) - 1. The logarithm of the slope of t is not linear in g. `as_log_slopes` approximates it
  by the linear function that fits best for scores drawn from the model, and also returns the largest error.
* `increments` (layout 2 by its first training program): t(x + 1) - t(x) = exp(spline(x + 1)), where the spline is
  linear in g. This is also the form of Marey's model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import FormatError
from marey_motion.modelling.primitive import MOST_LOG_SLOPE, FunctionalComponents, MotionPrimitive
from marey_motion.modelling.splines import DEGREE, SplineBasis

TimeForm = Literal["coefficients", "increments"]

DRAWN, SEED = 512, 0
"""Number of score vectors to which a linear function is fitted, and the seed with which they are drawn."""
ODD_LOG_SLOPE = 20.0
KNOTS_AT_MOST = 500
"""Maximum number of knots of a converted time function; no published model has as many canonical frames."""


@dataclass(frozen=True, eq=False)
class PredecessorTime:
    """Time function (warp from canonical time to the frames of an example) in a form of the predecessor's models.

    Parameters
    ----------
    form : "coefficients" or "increments"
    basis : basis of the spline over canonical time 0 to N - 1
    mean : (n,) mean coefficients
    directions : (k, n) change of the coefficients per unit of each score
    """

    form: TimeForm
    basis: SplineBasis
    mean: Floats
    directions: Floats

    def time_functions(self, scores: Floats) -> Floats:
        """Compute the frame of the example at each canonical frame.

        Parameters
        ----------
        scores : (m, k) float64    scores

        Returns
        -------
        (m, N) float64    frames, from 0
        """
        logarithms = self.mean + scores @ self.directions
        if self.form == "coefficients":
            values = np.cumsum(np.exp(logarithms), axis=1) @ self.basis.at_frames.T
            return np.asarray(values - values[:, :1])
        steps = np.exp(logarithms @ self.basis.at_frames[1:].T)
        return np.asarray(np.concatenate((np.zeros((len(scores), 1)), np.cumsum(steps, axis=1)), axis=1))


def as_log_slopes(
    time: PredecessorTime, scores: Floats, variances: Floats, file: str
) -> tuple[FunctionalComponents, float]:
    """Convert a time function of the predecessor to Marey's form, the logarithms of its slopes.

    Parameters
    ----------
    time : PredecessorTime    the time function
    scores : (m, k) float64    scores drawn from the model, at which the conversion is fitted
    variances : (k,) float64    variances of the scores
    file : str    name of the file, for messages

    Returns
    -------
    components : FunctionalComponents    Marey's form
    error_frames : float    largest difference between the two forms at these scores, in frames

    Raises
    ------
    FormatError    if the time function decreases, or if its slope is too steep or too flat
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused
        wanted = time.time_functions(scores)
        steps = np.diff(wanted, axis=1)
    if not (np.isfinite(steps).all() and (steps > 0).all() and (np.abs(np.log(steps)) < ODD_LOG_SLOPE).all()):
        raise FormatError(
            "the time function decreases, or its slope is too steep or too flat", code="bad-time", file=file
        )
    basis = _basis_over(steps.shape[1])
    # The fit over scores comes before the one over time, which is linear as well: a few functions are left by then.
    at_mean, by_score = _linear_fit(scores, np.log(steps))
    coefficients = _spline_fit(basis, np.concatenate((at_mean[None], by_score)))
    mean, directions = coefficients[0], coefficients[1:]
    components = components_of(basis, mean[:, None], directions[..., None], variances)
    made = np.exp(np.clip((mean + scores @ directions) @ basis.at_frames.T, -MOST_LOG_SLOPE, MOST_LOG_SLOPE))
    error = np.abs(np.cumsum(made, axis=1) - wanted[:, 1:]).max()
    return components, float(error)


def components_of(basis: SplineBasis, mean: Floats, directions: Floats, variances: Floats) -> FunctionalComponents:
    """Make functional components from their directions: the change of the spline coefficients per unit of each score.

    The projections, which compute scores from coefficients, are the pseudo-inverse of the directions. The variance
    that the components do not explain is unknown. Therefore, `energy` contains cumulative shares of the variance that
    all components explain together, not of the total variance.

    Parameters
    ----------
    basis : SplineBasis    splines with n coefficients
    mean : (n, D) float64    mean function
    directions : (k, n, D) float64    change per unit of each score
    variances : (k,) float64    variances of the scores

    Returns
    -------
    FunctionalComponents    the components
    """
    flat = directions.reshape(len(directions), mean.size)
    inverse = np.linalg.pinv(flat).T.reshape(directions.shape) if len(flat) else directions
    projections = np.asarray(inverse, dtype=np.float64)
    total = float(variances.sum())
    energy = np.asarray(np.cumsum(variances) / total if total > 0 else np.ones(len(variances)))
    return FunctionalComponents(basis, mean, directions, projections, variances, energy)


def as_coefficients(primitive: MotionPrimitive) -> PredecessorTime:
    """Convert the time function of a primitive to the predecessor's form `coefficients`.

    Parameters
    ----------
    primitive : MotionPrimitive    the model

    Returns
    -------
    PredecessorTime    the time function, which depends on the temporal scores in latent vectors of the primitive
    """
    scores, times = _drawn(primitive)
    count = _written_count(primitive)
    basis = SplineBasis.clamped(primitive.frame_count, count)
    coefficients = np.asarray(basis.fit(times[..., None]))[..., 0]
    coefficients[:, 0], coefficients[:, -1] = 0.0, times[:, -1]
    # A spline runs forward if its coefficients do.
    least = 1e-3 * times[:, -1:] / count
    rising = least * np.arange(coefficients.shape[1])
    coefficients = np.maximum.accumulate(coefficients - rising, axis=1) + rising
    steps = np.diff(coefficients + 1.0, axis=1, prepend=0.0)
    mean, directions = _linear_fit(scores, np.log(np.maximum(steps, least)))
    return PredecessorTime("coefficients", basis, mean, directions)


def as_increments(primitive: MotionPrimitive) -> PredecessorTime:
    """Convert the time function of a primitive to the predecessor's form `increments`.

    Parameters
    ----------
    primitive : MotionPrimitive    the model

    Returns
    -------
    PredecessorTime    the time function, which depends on the temporal scores in latent vectors of the primitive
    """
    count = _written_count(primitive)
    # With as many components as coefficients, a reader could not tell whether the components are rows or columns.
    basis = SplineBasis.clamped(primitive.frame_count, count + (count == primitive.temporal.count))
    fitting = np.linalg.pinv(basis.at_frames[1:])
    slopes = primitive.temporal.basis.at_frames
    mean = fitting @ (slopes @ primitive.temporal.mean[:, 0])
    directions = primitive.temporal.directions[..., 0] @ slopes.T @ fitting.T / primitive.temporal_weight
    return PredecessorTime("increments", basis, np.asarray(mean), np.asarray(directions))


def _written_count(primitive: MotionPrimitive) -> int:
    """Return the number of spline coefficients of a written time function: one for each canonical frame, if possible.

    The predecessor's training uses eight coefficients. With so few coefficients, the two forms of the predecessor and
    the form of Marey represent different functions: a time function would differ by up to a tenth of a frame.
    """
    return max(DEGREE + 1, min(KNOTS_AT_MOST, primitive.frame_count))


def _drawn(primitive: MotionPrimitive) -> tuple[Floats, Floats]:
    """Draw the temporal scores (m, k) of m latent vectors from the model, and compute their time functions (m, N).

    The limits that keep a model's motions within its examples' range are not applied, because they would make the time
    functions less linear in the scores.
    """
    free = replace(primitive, duration_range_s=None, log_slope_range=None)
    latents = free.sample(DRAWN, SEED)
    return latents[:, free.spatial.count :], free.time_functions(latents)


def _linear_fit(scores: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Fit a linear function of scores (m, k) to values (m, n); return its mean (n,) and its slopes (k, n)."""
    columns = np.concatenate((np.ones((len(scores), 1)), scores), axis=1)
    solution = np.linalg.lstsq(columns, values, rcond=None)[0]
    return np.asarray(solution[0], dtype=np.float64), np.asarray(solution[1:], dtype=np.float64)


def _basis_over(steps: int) -> SplineBasis:
    """Make a spline basis for functions of canonical time that have `steps` values.

    If `steps` is at most `KNOTS_AT_MOST`, there are at least as many coefficients as steps, so that any function is
    represented exactly. The knots are then at all steps except the second and the last but one. Evenly spaced knots
    would not coincide with the steps, and interpolation would amplify rounding errors. A basis for longer functions has
    fewer knots, and only approximates them.
    """
    if steps <= DEGREE:
        return SplineBasis.clamped(steps, DEGREE + 1)
    inner = np.arange(2, steps - 2, -(-steps // KNOTS_AT_MOST), dtype=np.float64)
    return SplineBasis(np.concatenate((np.zeros(DEGREE + 1), inner, np.full(DEGREE + 1, steps - 1.0))))


def _spline_fit(basis: SplineBasis, values: Floats) -> Floats:
    """Fit the coefficients (m, n) of splines to values (m, N) at N frames, by solving banded linear systems."""
    from scipy.interpolate import make_interp_spline, make_lsq_spline

    frames = np.arange(values.shape[1], dtype=np.float64)
    if basis.count > len(frames):
        return np.asarray(basis.fit(values[..., None]))[..., 0]
    if basis.count == len(frames):
        return np.asarray(make_interp_spline(frames, values.T, basis.degree, basis.knots).c.T)
    return np.asarray(make_lsq_spline(frames, values.T, basis.knots, basis.degree).c.T)
