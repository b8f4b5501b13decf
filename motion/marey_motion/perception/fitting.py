"""Weights of a component, fitted to a table of perceived differences by non-negative least squares."""

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
    measurement : str    what x is
    classes : tuple of str    the K classes
    pairs : (R, 2) int64    the motions of each pair
    frames : tuple of (L, K) float64    x of each pair
    """

    measurement: Measurement
    classes: tuple[str, ...]
    pairs: Ints
    frames: tuple[Floats, ...]

    def means(self, shaping: Shaping, exponent: float = 1.0) -> Floats:
        """Average F(x) over the frames of each pair.

        Parameters
        ----------
        shaping : str    F
        exponent : float    exponent of `power`

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

    The paper prints a column "difference" without saying what it is; rss, rmse_percent and l2 are candidates.

    Parameters
    ----------
    rss, rmse, rmse_percent, l2 : float    sum of squares, root mean square (also in percent), and the norm of the
        difference of the whole symmetric tables
    r2 : float    share of the variance that the fit explains; NaN if there is none
    spearman : float    rank correlation; NaN if a side is constant
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
    weights: Floats | None = None,
) -> Component:
    """Fit constant, N and weights to perceived differences.

    The problem is convex, so the result is the global optimum.

    Parameters
    ----------
    differences : PairDifferences    R pairs
    perceived : (R,) float64    perceived difference of each pair; pairs with NaN are left out
    shaping : str    F
    exponent : float    exponent of `power`
    weights : (R,) float64, optional    weights of the pairs in the sum of squares, such as shown / (p (1 - p))

    Returns
    -------
    Component    fitted component

    Raises
    ------
    MotionError    if too few pairs are known, or every weight of a class is 0: then only the constant explains anything
    """
    means = differences.means(shaping, exponent)
    raw = _solve(means, perceived, weights)
    total = float(raw[1:].sum())
    if means.mean(axis=0) @ raw[1:] <= _NOTHING:
        raise MotionError(
            f"no {differences.measurement} explain the differences: every weight is 0", code="fit-without-weights"
        )
    given = dict(zip(differences.classes, (raw[1:] / total).tolist(), strict=True))
    return Component(differences.measurement, shaping, float(raw[0]), total, given, exponent)


def fit_power(differences: PairDifferences, perceived: Floats) -> Component:
    """Fit the shaping `power`: its exponent by a search from 0.1 to 3, and the weights within each step.

    Parameters
    ----------
    differences : PairDifferences    R pairs
    perceived : (R,) float64    perceived differences; pairs with NaN are left out

    Returns
    -------
    Component    component with the best exponent

    Raises
    ------
    MotionError    as `fit_component`
    """
    known = np.isfinite(perceived)

    def loss(exponent: float) -> float:
        means = differences.means("power", exponent)
        fitted = _predicted(means, _solve(means, perceived, None))
        return float(np.sum((fitted - perceived)[known] ** 2))

    grid = np.geomspace(*EXPONENTS, _GRID)
    best = int(np.argmin([loss(float(each)) for each in grid]))
    bounds = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, _GRID - 1)])
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x
    exponent = min((float(found), float(grid[best])), key=loss)
    return fit_component(differences, perceived, "power", exponent)


def predict(component: Component, differences: PairDifferences) -> Floats:
    """Compute the differences that a component gives pairs of motions.

    Parameters
    ----------
    component : Component    component of the same measurement
    differences : PairDifferences    R pairs

    Returns
    -------
    (R,) float64    c + N · Σ w mean F(x)
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
    Every subset of components is solved with the sum 1 alone; the best solution without negative shares is the optimum.
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
    from scipy.stats import spearmanr  # takes a second to load, which no other job of a worker shall wait for

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
    """Draw participants with replacement, and fit again: how much the weights depend on who took part.

    Parameters
    ----------
    differences : PairDifferences    R pairs i < j, in the order of `numpy.triu_indices`
    shown, chosen : (N, R) int64    counts of N participants, from `judging.pair_counts_by_participant`
    shaping : str    F
    draws : int    number of draws B
    seed : int    seed of the draws

    Returns
    -------
    (B, 1 + K) float64    constant, then the weight of each class multiplied by N
    """
    people = len(shown)
    means = differences.means(shaping)
    times = np.random.default_rng(seed).multinomial(people, np.full(people, 1.0 / people), draws)
    seen, picked = times @ shown, times @ chosen
    perceived = np.where(seen > 0, 1.0 - picked / np.maximum(seen, 1), np.nan)
    return np.stack([_solve(means, each, None) for each in perceived])


def leave_one_motion_out(parts: Sequence[PairDifferences], perceived: Floats, shaping: Shaping) -> Floats:
    """Predict the pairs of each motion by a fit to the pairs without it: of components, and then of their shares.

    To leave out single pairs would not do: the other pairs of both motions would give them away.

    Parameters
    ----------
    parts : sequence of PairDifferences    the same R pairs by the measurement of each component
    perceived : (R,) float64    perceived differences
    shaping : str    F

    Returns
    -------
    (R,) float64    mean of the two predictions of each pair

    Raises
    ------
    MotionError    if too few pairs are known without some motion
    """
    means = [part.means(shaping) for part in parts]
    pairs = parts[0].pairs
    total = np.zeros(len(pairs))
    for motion in np.unique(pairs):
        of_motion = (pairs == motion).any(axis=1)
        others = np.where(of_motion, np.nan, perceived)
        predicted = [_predicted(each, _solve(each, others, None)) for each in means]
        shares = fit_shares(predicted, others)
        total[of_motion] += 0.5 * (np.column_stack(predicted) @ shares)[of_motion]
    return total


def _predicted(means: Floats, raw: Floats) -> Floats:
    return np.asarray(raw[0] + means @ raw[1:])


def _solve(means: Floats, perceived: Floats, weights: Floats | None) -> Floats:
    """Find the non-negative (1 + K,) constant and weights with the least sum of squares over the known pairs."""
    known = np.isfinite(perceived)
    if np.count_nonzero(known) < means.shape[1] + 1:
        raise MotionError(
            f"{np.count_nonzero(known)} pairs of motions are known, but {means.shape[1] + 1} numbers are to be fitted; "
            "show more motions",
            code="too-few-pairs",
        )
    table, target = np.column_stack((np.ones(len(means)), means))[known], perceived[known]
    if weights is not None:
        root = np.sqrt(weights[known])
        table, target = table * root[:, None], target * root
    scale = np.linalg.norm(table, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return np.asarray(nnls(table / scale, target)[0] / scale)
