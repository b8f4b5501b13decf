"""Fit of a component of a perceptual metric to a table of perceived differences, by non-negative least squares.

As in `perception.metric`, a component predicts the difference c + N · Σ w F(x): c is the constant, N the norm, w the
weights of the joint classes, F the shaping, and x the measured differences of the joint classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import minimize_scalar, nnls  # pyrefly: ignore[implicit-reexport]  # scipy collects its names when it runs

from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.perception.metric import Component, shaped
from marey_schemas.documents.metrics import Measurement, Shaping

EXPONENTS = (0.1, 3.0)
_GRID = 30
_NOTHING = 1e-12


@dataclass(frozen=True, eq=False)
class PairDifferences:
    """Differences of the joint classes along the registration curves of R pairs of motions.

    Parameters
    ----------
    measurement : str    measurement whose differences are given: angles, positions or velocities
    classes : tuple of str    the K joint classes
    pairs : (R, 2) int64    the motions of each pair
    frames : tuple of (L, K) float64    for each pair, the difference x of each class in L pairs of frames
    """

    measurement: Measurement
    classes: tuple[str, ...]
    pairs: Ints
    frames: tuple[Floats, ...]

    def means(self, shaping: Shaping, exponent: float = 1.0) -> Floats:
        """Average the shaped differences F(x) over the frames of each pair.

        Parameters
        ----------
        shaping : str    the shaping F
        exponent : float    exponent of the shaping `power`

        Returns
        -------
        (R, K) float64    means
        """
        starts = np.concatenate(([0], np.cumsum([len(each) for each in self.frames])))
        sums = np.add.reduceat(shaped(np.concatenate(self.frames), shaping, exponent), starts[:-1], axis=0)
        return np.asarray(sums / np.diff(starts)[:, None])


@dataclass(frozen=True)
class FitQuality:
    """The agreement of fitted with perceived differences, over pairs of motions.

    Pražák et al. print a column "difference" without a definition; it may be rss, rmse_percent or l2.

    Parameters
    ----------
    rss, rmse, rmse_percent, l2 : float    sum of squares, root mean square (also in percent), and the norm of the
        difference of the whole symmetric tables
    r2 : float    share of the variance that the fit explains; NaN if the perceived differences do not vary
    spearman : float    rank correlation; NaN if the fitted or the perceived differences do not vary
    """

    rss: float
    rmse: float
    rmse_percent: float
    r2: float
    spearman: float
    l2: float


def fit_component(
    differences: PairDifferences,
    perceived: Floats,
    shaping: Shaping,
    exponent: float = 1.0,
) -> Component:
    """Fit the constant, the norm and the weights of a component to perceived differences.

    The problem is convex, so the result is the global optimum.

    Parameters
    ----------
    differences : PairDifferences    R pairs
    perceived : (R,) float64    perceived difference of each pair; pairs with NaN are left out
    shaping : str    the shaping F
    exponent : float    exponent of the shaping `power`

    Returns
    -------
    Component    fitted component

    Raises
    ------
    MotionError    if too few pairs have a perceived difference, or if the best fit gives every class the weight 0
    """
    means = differences.means(shaping, exponent)
    raw = _solve(means, perceived)
    total = float(raw[1:].sum())
    if means.mean(axis=0) @ raw[1:] <= _NOTHING:
        raise MotionError(
            f"{differences.measurement} do not explain the perceived differences: the best fit gives every joint class "
            "the weight 0, so no component can be fitted",
            code="fit-without-weights",
        )
    given = dict(zip(differences.classes, (raw[1:] / total).tolist(), strict=True))
    return Component(differences.measurement, shaping, float(raw[0]), total, given, exponent)


def fit_power(differences: PairDifferences, perceived: Floats) -> Component:
    """Fit a component with the shaping `power`.

    The exponent is found by a search from 0.1 to 3; for each exponent, constant and weights are fitted.

    Parameters
    ----------
    differences : PairDifferences    R pairs
    perceived : (R,) float64    perceived differences; pairs with NaN are left out

    Returns
    -------
    Component    component with the best exponent

    Raises
    ------
    MotionError    if too few pairs have a perceived difference, or if the best fit gives every class the weight 0
    """
    known = np.isfinite(perceived)

    def loss(exponent: float) -> float:
        means = differences.means("power", exponent)
        fitted = _predicted(means, _solve(means, perceived))
        return float(np.sum((fitted - perceived)[known] ** 2))

    grid = np.geomspace(*EXPONENTS, _GRID)
    best = int(np.argmin([loss(float(each)) for each in grid]))
    bounds = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, _GRID - 1)])
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x
    exponent = min((float(found), float(grid[best])), key=loss)
    return fit_component(differences, perceived, "power", exponent)


def predict(component: Component, differences: PairDifferences) -> Floats:
    """Compute the differences of pairs of motions that a component predicts.

    Parameters
    ----------
    component : Component    component with the measurement of `differences`
    differences : PairDifferences    R pairs

    Returns
    -------
    (R,) float64    c + N · Σ w · mean of F(x)
    """
    means = differences.means(component.shaping, component.exponent)
    return component.constant + component.norm * means @ component.shares_of(differences.classes)


def fit_shares(predicted: Sequence[Floats], perceived: Floats) -> tuple[float, ...]:
    """Fit the shares of components, which are at least 0 and have the sum 1.

    Parameters
    ----------
    predicted : sequence of (R,) float64    predictions of each component
    perceived : (R,) float64    perceived differences; pairs with NaN are left out

    Returns
    -------
    tuple of float    shares of the global optimum

    Notes
    -----
    For every subset of the components, the shares with the sum 1 are fitted without bounds. The best of the solutions
    that have no negative share is the optimum.
    """
    known = np.isfinite(perceived)
    table, target = np.column_stack(predicted)[known], perceived[known]
    count = table.shape[1]
    best = (np.inf, np.zeros(count))
    for size in range(1, count + 1):
        for kept in combinations(range(count), size):
            last = table[:, kept[-1]]
            free = np.linalg.lstsq(table[:, kept[:-1]] - last[:, None], target - last, rcond=None)[0]
            shares = np.zeros(count)
            shares[list(kept)] = (*free, 1.0 - free.sum())
            loss = float(np.sum((table @ shares - target) ** 2))
            if shares.min() >= 0 and loss < best[0]:
                best = loss, shares
    return tuple(float(each) for each in best[1])


def fit_quality(fitted: Floats, perceived: Floats) -> FitQuality:
    """Measure how well fitted differences agree with perceived ones.

    Parameters
    ----------
    fitted, perceived : (R,) float64    differences of pairs i < j; pairs with NaN are left out

    Returns
    -------
    FitQuality    measures
    """
    from scipy.stats import spearmanr  # imported here, because this import takes a second

    known = np.isfinite(perceived) & np.isfinite(fitted)
    one, other = fitted[known], perceived[known]
    rss = float(np.sum((one - other) ** 2))
    spread = float(np.sum((other - other.mean()) ** 2))
    constant = np.ptp(one) == 0.0 or np.ptp(other) == 0.0
    rmse = float(np.sqrt(rss / len(one)))
    return FitQuality(
        rss,
        rmse,
        100.0 * rmse,
        1.0 - rss / spread if spread > 0 else float("nan"),
        float("nan") if constant else float(spearmanr(one, other).statistic),
        float(np.sqrt(2.0 * rss)),
    )


def bootstrap_weights(
    differences: PairDifferences, shown: Ints, chosen: Ints, shaping: Shaping, *, draws: int = 1000, seed: int = 0
) -> Floats:
    """Fit the weights to random draws of participants, to estimate how much the weights depend on the participants.

    Each draw contains as many participants as the study, drawn with replacement.

    Parameters
    ----------
    differences : PairDifferences    R pairs i < j, in the order of `numpy.triu_indices`
    shown, chosen : (N, R) int64    counts of N participants, from `judging.pair_counts_by_participant`
    shaping : str    the shaping F
    draws : int    number of draws B
    seed : int    seed of the draws

    Returns
    -------
    (B, 1 + K) float64    constant, then the weight of each class multiplied by the norm

    Raises
    ------
    MotionError    if, in some draw, too few pairs have a perceived difference
    """
    people = len(shown)
    means = differences.means(shaping)
    times = np.random.default_rng(seed).multinomial(people, np.full(people, 1.0 / people), draws)
    seen, picked = times @ shown, times @ chosen
    perceived = np.where(seen > 0, 1.0 - picked / np.maximum(seen, 1), np.nan)
    return np.stack([_solve(means, each) for each in perceived])


def leave_one_motion_out(parts: Sequence[PairDifferences], perceived: Floats, shaping: Shaping) -> Floats:
    """Predict the differences of each motion from all other motions, by a fit to the pairs without this motion.

    For each left-out motion, all components and their shares are fitted. All pairs of the motion are left out, because
    a fit to some of them would already contain information about the remaining pairs.

    Parameters
    ----------
    parts : sequence of PairDifferences    the same R pairs by the measurement of each component
    perceived : (R,) float64    perceived differences
    shaping : str    the shaping F

    Returns
    -------
    (R,) float64    for each pair, the mean of two predictions, each from a fit without one motion of the pair

    Raises
    ------
    MotionError    if, without some motion, too few pairs have a perceived difference
    """
    means = [part.means(shaping) for part in parts]
    pairs = parts[0].pairs
    total = np.zeros(len(pairs))
    for motion in np.unique(pairs):
        of_motion = (pairs == motion).any(axis=1)
        others = np.where(of_motion, np.nan, perceived)
        predicted = [_predicted(each, _solve(each, others)) for each in means]
        shares = fit_shares(predicted, others)
        total[of_motion] += 0.5 * (np.column_stack(predicted) @ shares)[of_motion]
    return total


def _predicted(means: Floats, raw: Floats) -> Floats:
    return np.asarray(raw[0] + means @ raw[1:])


def _solve(means: Floats, perceived: Floats) -> Floats:
    """Fit the constant and the weights (1 + K,), all at least 0, by least squares over pairs with known differences."""
    known = np.isfinite(perceived)
    if np.count_nonzero(known) < means.shape[1] + 1:
        raise MotionError(
            f"only {np.count_nonzero(known)} pairs of motions have a perceived difference, but the fit has "
            f"{means.shape[1] + 1} unknowns; show more motions",
            code="too-few-pairs",
        )
    table, target = np.column_stack((np.ones(len(means)), means))[known], perceived[known]
    scale = np.linalg.norm(table, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return np.asarray(nnls(table / scale, target)[0] / scale)
