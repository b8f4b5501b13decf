"""Totals of measures over clips, with confidence intervals over takes, and their differences from a reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_schemas.documents.evaluations import CONFIDENCE
from marey_schemas.documents.quality import LEAST_TAKES

DRAWN_AT_ONCE = 4_000_000
"""Maximum number of cells in memory at a time, of the table with a row for each draw and a column for each take."""


class MeanOverClips(NamedTuple):
    """Mean of a measure over clips, weighted by duration, with its confidence interval from `low` to `high`.

    Without an interval, because there are fewer than `LEAST_TAKES` takes, `low` and `high` are None.
    """

    value: float | None
    low: float | None
    high: float | None
    clips: int
    takes: int
    seconds: float


@dataclass(frozen=True, eq=False)
class DrawnTotals:
    """Totals of M measures over clips, and the same totals for B bootstrap draws of takes.

    Parameters
    ----------
    totals : total of each measure, by the name of the measure
    draws : (B, M) float64    totals of the draws, NaN where no drawn clip has a value; B may be 0
    """

    totals: Mapping[str, MeanOverClips]
    draws: Floats


def total_over_clips(
    values: Mapping[str, Sequence[float | None]],
    seconds: Sequence[float],
    takes: Sequence[str],
    *,
    draws: int,
    seed: int,
) -> DrawnTotals:
    """Compute the mean of each measure over clips, weighted by duration, with an interval over takes.

    Parameters
    ----------
    values : mapping of str to sequence    N values of each of M measures; None where a measure is undefined for a clip
    seconds : sequence of float    durations of the N clips
    takes : sequence of str    take of each clip
    draws : int    number of bootstrap draws; takes are drawn with replacement, with all their clips
    seed : int    seed of the draws

    Returns
    -------
    DrawnTotals    M totals; the total of a measure leaves out clips for which the measure is undefined
    """
    table = np.array([[np.nan if one is None else one for one in column] for column in values.values()]).T
    known = np.isfinite(table)
    weights = np.asarray(seconds)[:, None] * known
    _, owners = np.unique(np.asarray(takes), return_inverse=True)
    take_count = int(owners.max()) + 1
    sums, masses = np.zeros((take_count, table.shape[1])), np.zeros((take_count, table.shape[1]))
    np.add.at(sums, owners, weights * np.where(known, table, 0.0))
    np.add.at(masses, owners, weights)
    drawn = _drawn(sums, masses, draws, seed)
    totals = {}
    for column, name in enumerate(values):
        mass = float(masses[:, column].sum())
        held = int((masses[:, column] > 0.0).sum())
        low, high = interval(drawn[:, column]) if held >= LEAST_TAKES else (None, None)
        value = float(sums[:, column].sum()) / mass if mass > 0.0 else None
        totals[name] = MeanOverClips(value, low, high, int(known[:, column].sum()), held, mass)
    return DrawnTotals(totals, drawn)


def changes_from(one: DrawnTotals, reference: DrawnTotals) -> dict[str, tuple[float, float | None, float | None]]:
    """Compute the differences of totals from those of a reference, whose takes are drawn independently.

    Parameters
    ----------
    one, reference : DrawnTotals    totals of the same measures, with equally many draws and different seeds

    Returns
    -------
    dict of str to (float, float or None, float or None)    difference and ends of its interval, by measure; measures
        that are undefined in `one` or in `reference` are left out. The ends are None if a total has no interval.
    """
    found: dict[str, tuple[float, float | None, float | None]] = {}
    for column, (name, total) in enumerate(one.totals.items()):
        other = reference.totals[name]
        if total.value is None or other.value is None:
            continue
        low, high = None, None
        if total.low is not None and other.low is not None:
            low, high = interval(one.draws[:, column] - reference.draws[:, column])
        found[name] = (total.value - other.value, low, high)
    return found


def interval(drawn: Floats) -> tuple[float | None, float | None]:
    """Compute the ends of the percentile interval at `CONFIDENCE`.

    Parameters
    ----------
    drawn : (B,) float64    values of the draws; NaN is left out

    Returns
    -------
    (float or None, float or None)    lower and upper end; None if there are no values
    """
    held = drawn[np.isfinite(drawn)]
    if not len(held):
        return None, None
    low, high = np.quantile(held, (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE))
    return float(low), float(high)


def _drawn(sums: Floats, masses: Floats, draws: int, seed: int) -> Floats:
    parts = [np.empty((0, sums.shape[1]))]
    for counts in _counts(len(sums), draws, seed):
        mass = counts @ masses
        parts.append(np.where(mass > 0.0, counts @ sums, np.nan) / np.where(mass > 0.0, mass, 1.0))
    return np.concatenate(parts)


def _counts(takes: int, draws: int, seed: int) -> Iterator[NDArray[np.float64]]:
    """Yield the number of times that each take is drawn, as tables (b, takes) for b draws at a time."""
    rng = np.random.default_rng(seed)
    at_once = max(1, DRAWN_AT_ONCE // takes)
    for start in range(0, draws, at_once):
        picks = rng.multinomial(takes, np.full(takes, 1.0 / takes), size=min(at_once, draws - start))
        yield picks.astype(np.float64)
