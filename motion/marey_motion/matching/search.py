"""Exact nearest neighbours among the rows of a matching database.

Consecutive rows of a clip are near each other, so sixteen of them fit into a small box; sixteen boxes of a clip make a
group with a box of its own. A search skips every group and box that is farther away than the best row so far.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError

Method = Literal["auto", "boxes", "scan"]

LARGEST = 1e18
"""Largest magnitude allowed in rows and queries; squares of larger values would overflow float32."""

_SIXTEEN = 16
_PROBES = 32
# If searches visit more than this share of the blocks, a scan of all blocks in order is faster. In measurements on
# captured motion with increasing noise, both took the same time at a share between 0.25 and 0.45.
_SCAN_ABOVE = 0.35


class SearchIndex(NamedTuple):
    """A database prepared for search, as a tuple of arrays that can be passed to compiled code.

    There are B blocks of up to 16 selectable rows of one clip, and G groups of up to 16 blocks of one clip. D' is D
    rounded up to an even number. A block or group of fewer than 16 elements is padded with copies of its last element.

    Parameters
    ----------
    rows : (N, D) float64    normalised features
    selectable : (N,) bool    True for rows that a search may choose
    blocks : (B, D', 16) float32    the features of the rows of each block, one dimension after the other
    block_rows : (B, 16) int32    numbers of the rows of each block
    block_of_row : (N,) int32    index of each row's block; a row that is not selectable has the block of the last
        selectable row before it, or of the first selectable row
    boxes : (G, D', 2, 16) float32    low and high sides of the boxes about a group's blocks
    group_blocks : (G + 1,) int32    first block of each group, and B
    group_boxes : (⌈G / 16⌉, D', 2, 16) float32    sides of the boxes about groups
    radius : the largest norm of a row
    boxed : True if a search uses the boxes, False if it compares the rows of all blocks; both give the same result
    """

    rows: NDArray[np.float64]
    selectable: NDArray[np.bool_]
    blocks: NDArray[np.float32]
    block_rows: NDArray[np.int32]
    block_of_row: NDArray[np.int32]
    boxes: NDArray[np.float32]
    group_blocks: NDArray[np.int32]
    group_boxes: NDArray[np.float32]
    radius: float
    boxed: bool


def build_index(
    normalised: NDArray[np.float64],
    starts: NDArray[np.int64],
    selectable: NDArray[np.bool_],
    *,
    method: Method = "auto",
) -> SearchIndex:
    """Index normalised features for search.

    Parameters
    ----------
    normalised : (N, D) float64    normalised features, from `Normaliser.apply`
    starts : (C + 1,) int64    first row of each clip, and N
    selectable : (N,) bool    True for rows that a search may choose
    method : str    "boxes", "scan" or "auto". "auto" makes a few searches, with mixtures of rows as queries, and
        chooses by the share of the database that they visit. The choice depends only on the data, and affects only the
        time of a search, not its result

    Returns
    -------
    SearchIndex    input of searches

    Raises
    ------
    MotionError    if no row is selectable, if a value is not finite or exceeds `LARGEST`, or if the shapes of the
        arrays do not match
    """
    rows = np.ascontiguousarray(normalised, dtype=np.float64)
    mask = np.ascontiguousarray(selectable, dtype=np.bool_)
    clip_starts = np.asarray(starts, dtype=np.int64)
    _check(rows, clip_starts, mask)

    block_rows, block_of_row, group_blocks = _arranged(clip_starts, mask)
    padded = np.zeros((len(rows), rows.shape[1] + rows.shape[1] % 2), np.float32)
    padded[:, : rows.shape[1]] = rows
    blocks = padded[block_rows]
    low, high = blocks.min(axis=1), blocks.max(axis=1)
    group_low, group_high = (
        edge.reduceat(sides, group_blocks[:-1], axis=0) for edge, sides in ((np.minimum, low), (np.maximum, high))
    )
    index = SearchIndex(
        rows=rows,
        selectable=mask,
        blocks=np.ascontiguousarray(blocks.transpose(0, 2, 1)),
        block_rows=block_rows,
        block_of_row=block_of_row,
        boxes=_boxes(low, high, group_blocks),
        group_blocks=group_blocks,
        group_boxes=_boxes(group_low, group_high, _by_sixteen(len(group_low))),
        radius=float(np.sqrt(np.einsum("nd,nd->n", rows, rows).max())),
        boxed=True,
    )
    boxed = _boxes_save_work(index) if method == "auto" else method == "boxes"
    return index._replace(boxed=boxed)


def _check(rows: NDArray[np.float64], starts: NDArray[np.int64], selectable: NDArray[np.bool_]) -> None:
    if rows.ndim != 2 or rows.shape[1] == 0 or selectable.shape != rows.shape[:1]:
        raise MotionError(
            "the features must have the shape (rows, dimensions), and `selectable` one value per row; their "
            f"shapes are {rows.shape} and {selectable.shape}"
        )
    if len(starts) < 2 or starts[0] != 0 or starts[-1] != len(rows) or (np.diff(starts) < 0).any():
        raise MotionError(f"the first rows of the clips must ascend from 0 to the number of rows, {len(rows)}")
    if not selectable.any():
        raise MotionError(
            "no row of the database can be selected: a clip that is shorter than the look-ahead has no selectable "
            "rows; add longer clips",
            code="nothing-selectable",
        )
    if not (rows.max() <= LARGEST and rows.min() >= -LARGEST):
        row, dimension = np.argwhere(~(np.abs(rows) <= LARGEST))[0]
        raise MotionError(
            f"the value is {rows[row, dimension]}; the magnitude of a normalised feature must be finite and at most "
            f"{LARGEST:g}",
            where=f"row {row}, dimension {dimension}",
        )


def _arranged(
    starts: NDArray[np.int64], selectable: NDArray[np.bool_]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """List the rows of each block (B, 16), the block of each row (N,), and the first block of each group (G + 1,)."""
    chosen = np.flatnonzero(selectable)
    bounds = np.searchsorted(chosen, starts)
    blocks_per_clip = -(-np.diff(bounds) // _SIXTEEN)
    first_blocks = np.concatenate([[0], np.cumsum(blocks_per_clip)])
    clips = np.searchsorted(bounds, np.arange(len(chosen)), side="right") - 1
    ranks = np.arange(len(chosen)) - bounds[clips]
    block_of_chosen = first_blocks[clips] + ranks // _SIXTEEN

    last_of_block = np.append(np.flatnonzero(np.diff(block_of_chosen)), len(chosen) - 1)
    block_rows = np.repeat(chosen[last_of_block, None], _SIXTEEN, axis=1)
    block_rows[block_of_chosen, ranks % _SIXTEEN] = chosen
    before = np.maximum(np.cumsum(selectable) - 1, 0)

    groups_per_clip = -(-blocks_per_clip // _SIXTEEN)
    first_groups = np.concatenate([[0], np.cumsum(groups_per_clip)])
    clip_of_group = np.repeat(np.arange(len(groups_per_clip)), groups_per_clip)
    within = np.arange(first_groups[-1]) - first_groups[clip_of_group]
    group_blocks = np.append(first_blocks[clip_of_group] + _SIXTEEN * within, first_blocks[-1])
    return block_rows.astype(np.int32), block_of_chosen[before].astype(np.int32), group_blocks.astype(np.int32)


def _by_sixteen(count: int) -> NDArray[np.int32]:
    return np.append(np.arange(0, count, _SIXTEEN), count).astype(np.int32)


def _boxes(low: NDArray[np.float32], high: NDArray[np.float32], starts: NDArray[np.int32]) -> NDArray[np.float32]:
    """Arrange the lower and upper bounds of K boxes, (K, D') each, in M groups of up to sixteen boxes.

    Group m begins at box `starts[m]`. The result has the shape (M, D', 2, 16); its axis of length 2 has the lower and
    the upper bound.
    """
    lanes = np.minimum(starts[:-1, None] + np.arange(_SIXTEEN), starts[1:, None] - 1)
    return np.ascontiguousarray(np.stack([low[lanes], high[lanes]], axis=2).transpose(0, 3, 2, 1))


def _boxes_save_work(index: SearchIndex) -> bool:
    """Return whether searches that use boxes save enough comparisons.

    This is measured by searches for queries whose first and second halves come from two random rows.
    """
    from marey_motion.matching import search_kernels as kernels

    draws = np.random.default_rng(0).choice(np.flatnonzero(index.selectable), size=(2, _PROBES))
    queries = index.rows[draws[0]]
    half = queries.shape[1] // 2
    queries[:, half:] = index.rows[draws[1], half:]
    _, costs = find_nearest(index, queries)
    visited = sum(kernels.boxes_within(index, query, cost) for query, cost in zip(queries, costs, strict=True))
    return bool(visited <= _SCAN_ABOVE * _PROBES * len(index.blocks))


def find_nearest(
    index: SearchIndex,
    queries: NDArray[np.float64],
    *,
    weights: NDArray[np.float64] | None = None,
    warm_rows: NDArray[np.int64] | None = None,
    skips: NDArray[np.int64] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the nearest selectable row of each query, and its squared distance.

    Of several rows that are equally near, the one with the lowest number is returned.

    Parameters
    ----------
    index : SearchIndex    N rows of D dimensions
    queries : (Q, D) float64    normalised like the rows
    weights : (D,) float64, optional    factors by which the squared differences are multiplied, one per dimension and
        not negative; 1 if None
    warm_rows : (Q,) int64, optional    a row likely to be near each query, or -1; it only makes the search quicker
    skips : (Q, 2) int64, optional    rows [start, stop) that each query may not choose

    Returns
    -------
    rows : (Q,) int64    numbers of the rows; -1 where all selectable rows are skipped
    costs : (Q,) float64    squared distances; infinite where all selectable rows are skipped

    Raises
    ------
    MotionError    if the queries or weights have invalid values or another number of dimensions than the index
    """
    from marey_motion.matching import search_kernels as kernels

    queries = _as_queries(index, queries)
    count = len(queries)
    warm = np.full(count, -1, np.int64) if warm_rows is None else np.ascontiguousarray(warm_rows, np.int64)
    skipped = np.zeros((count, 2), np.int64) if skips is None else np.ascontiguousarray(skips, np.int64)
    rows, costs = np.empty(count, np.int64), np.empty(count)
    kernels.nearest_of_each(index, queries, _as_weights(index, weights), warm, skipped, rows, costs)
    return rows, costs


def find_best(
    index: SearchIndex,
    query: NDArray[np.float64],
    count: int,
    *,
    weights: NDArray[np.float64] | None = None,
    skip: tuple[int, int] = (0, 0),
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the selectable rows nearest to a query, the nearest first; equally near rows are sorted by their numbers.

    Parameters
    ----------
    index : SearchIndex    N rows of D dimensions
    query : (D,) float64    normalised like the rows
    count : int    number of rows to find; fewer are returned if fewer are selectable and not skipped
    weights : (D,) float64, optional    factors by which the squared differences are multiplied, one per dimension and
        not negative; 1 if None
    skip : (int, int)    rows [start, stop) that may not be chosen

    Returns
    -------
    rows : (count,) int64    numbers of the rows
    costs : (count,) float64    squared distances, equal to those of `find_nearest` to the last bit

    Raises
    ------
    MotionError    if the query or the weights have invalid values or another number of dimensions than the index
    """
    from marey_motion.matching import search_kernels as kernels

    costs = np.empty(len(index.rows))
    kernels.all_costs(index, _as_queries(index, query[None])[0], _as_weights(index, weights), costs)
    allowed = index.selectable.copy()
    allowed[max(skip[0], 0) : max(skip[1], 0)] = False
    rows = np.flatnonzero(allowed)
    if count < len(rows):
        rows = rows[costs[rows] <= np.partition(costs[rows], count - 1)[count - 1]] if count > 0 else rows[:0]
    best = rows[np.argsort(costs[rows], kind="stable")][:count]
    return best, costs[best]


def _as_queries(index: SearchIndex, queries: NDArray[np.float64]) -> NDArray[np.float64]:
    queries = np.ascontiguousarray(queries, dtype=np.float64)
    if queries.ndim != 2 or queries.shape[1] != index.rows.shape[1]:
        raise MotionError(
            f"each query must have {index.rows.shape[1]} dimensions, but the queries have the shape {queries.shape}"
        )
    if not (np.abs(queries) <= LARGEST).all():
        raise MotionError(f"the numbers of a query must be finite, with a magnitude of at most {LARGEST:g}")
    return queries


def _as_weights(index: SearchIndex, weights: NDArray[np.float64] | None) -> NDArray[np.float64]:
    if weights is None:
        return np.ones(index.rows.shape[1])
    weights = np.ascontiguousarray(weights, dtype=np.float64)
    if weights.shape != index.rows.shape[1:] or not ((weights >= 0) & (weights <= LARGEST)).all():
        raise MotionError(f"weights must be {index.rows.shape[1]} numbers from 0 to {LARGEST:g}")
    return weights
