"""Order and two groups of motions, from a table of their differences (Pražák et al., figures 3 and 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError

RESTARTS = 50


@dataclass(frozen=True, eq=False)
class MotionOrder:
    """Motions in the order of the first principal component, and in two groups.

    Parameters
    ----------
    order : (n,) int64    motions by increasing projection
    projections : (n,) float64    projection of each motion on the first principal component
    groups : (n,) int64    group of each motion, 0 or 1; group 0 has the smaller mean projection
    membership : (n,) float64    degree of membership in group 1, from 0 to 1: the distance from the centre of group 0,
        divided by the sum of the distances from both centres
    """

    order: Ints
    projections: Floats
    groups: Ints
    membership: Floats


def order_motions(differences: Floats, seed: int = 0) -> MotionOrder:
    """Order motions and divide them into two groups by k-means.

    Each motion is a point whose coordinates are its row of the table. The sign of the first principal component is
    chosen so that its entry of largest magnitude is positive.

    Parameters
    ----------
    differences : (n, n) float64    symmetric table; a missing difference (NaN) of two motions is replaced by the mean
        of both motions' mean differences
    seed : int    seed of the starts of k-means

    Returns
    -------
    MotionOrder    order, groups and membership

    Raises
    ------
    MotionError    for fewer than three motions, or a motion without any difference to another
    """
    from sklearn.cluster import KMeans

    rows = _filled(differences)
    projections = _project(rows)
    means = KMeans(2, n_init=RESTARTS, random_state=seed).fit(rows)
    groups, centres = means.labels_.astype(np.int64), means.cluster_centers_
    if projections[groups == 0].mean() > projections[groups == 1].mean():
        groups, centres = 1 - groups, centres[::-1]
    from_0, from_1 = (np.linalg.norm(rows - centre, axis=1) for centre in centres)
    return MotionOrder(np.argsort(projections, kind="stable"), projections, groups, from_0 / (from_0 + from_1))


def order_along_first_component(differences: Floats) -> Ints:
    """Order motions by their projections on the first principal component.

    Each motion is a point whose coordinates are its row of the table. The sign of the component is chosen so that its
    entry of largest magnitude is positive.

    Parameters
    ----------
    differences : (n, n) float64    symmetric table; a missing difference (NaN) of two motions is replaced by the mean
        of both motions' mean differences

    Returns
    -------
    (n,) int64    motions by increasing projection on the first principal component

    Raises
    ------
    MotionError    for fewer than three motions, or a motion without any difference to another
    """
    return np.argsort(_project(_filled(differences)), kind="stable")


def _project(rows: Floats) -> Floats:
    """Return the projections (n,) of points (n, n) on their first principal component."""
    centred = rows - rows.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
    return np.asarray(centred @ direction)


def _filled(differences: Floats) -> Floats:
    n = len(differences)
    if n < 3 or differences.shape != (n, n):
        raise MotionError(f"an order needs a square table of at least 3 motions, not {differences.shape}")
    known = np.where(np.eye(n, dtype=bool), np.nan, differences)
    if (alone := ~np.isfinite(known).any(axis=1)).any():
        raise MotionError(
            "the motion has no known difference from any other motion, but an order needs at least one",
            where=f"motion {int(np.argmax(alone))}",
        )
    means = np.nanmean(known, axis=1)
    return np.where(np.isfinite(differences), differences, 0.5 * (means[:, None] + means))
