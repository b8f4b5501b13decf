"""Exact nearest neighbours among the rows of a matching database."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError

Method = Literal["auto", "boxes", "scan"]


class SearchIndex(NamedTuple):
    """A database made ready for search: a tuple of arrays, so that compiled code takes it as it is.

    Parameters
    ----------
    rows : (N, D) float64    normalised features
    selectable : (N,) bool    rows a search may choose
    """

    rows: NDArray[np.float64]
    selectable: NDArray[np.bool_]


def build_index(
    normalised: NDArray[np.float64],
    starts: NDArray[np.int64],
    selectable: NDArray[np.bool_],
    *,
    method: Method = "auto",
) -> SearchIndex:
    """Make normalised features searchable.

    Parameters
    ----------
    normalised : (N, D) float64    features divided by their scales
    starts : (C + 1,) int64    first row of each clip, and N
    selectable : (N,) bool    rows a search may choose

    Raises `MotionError` when no row is selectable or a value is not finite.
    """
    rows = np.ascontiguousarray(normalised, dtype=np.float64)
    if not selectable.any():
        raise MotionError("no row can be chosen: every clip is shorter than the time it must look ahead")
    return SearchIndex(rows, np.ascontiguousarray(selectable, dtype=np.bool_))


def find_nearest(index: SearchIndex, queries: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The nearest selectable row of each query (Q, D), lowest row first among equals, and its squared distance."""
    from marey_motion.matching import search_kernels as kernels

    queries = np.ascontiguousarray(queries, dtype=np.float64)
    rows = np.empty(len(queries), np.int64)
    costs = np.empty(len(queries))
    kernels.nearest_of_each(index, queries, rows, costs)
    return rows, costs


def find_best(
    index: SearchIndex, query: NDArray[np.float64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The `count` selectable rows nearest to a query (D,), nearest first, lowest row first among equals."""
    costs = np.zeros(len(index.rows))
    for d in range(index.rows.shape[1]):
        costs += (index.rows[:, d] - query[d]) ** 2
    costs[~index.selectable] = np.inf
    order = np.argsort(costs, kind="stable")[:count]
    order = order[np.isfinite(costs[order])]
    return order, costs[order]
