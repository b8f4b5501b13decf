"""Differences between annotations: segments and keyframes added, removed, moved and relabelled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.editing.annotations.layers import Segment
from marey_motion.errors import AnnotationError
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.differences import AnnotationDifference, KeyframeChange, SegmentChange

ALONE = 0.6
"""Cost of a segment without a match, which counts as added or removed."""
OTHER_LABEL = 0.7
"""Cost of a pair of segments with different labels; the cost of the two ranges (0 to 1) is added to this cost."""
SHIFTED = 0.05
"""Cost added to a pair of segments if the ranges are compared after the shift that most segments have in common."""
MOST_PAIRS = 16_000_000
"""Greatest number of pairs of segments whose costs are computed.

Each differing segment of the old annotation is paired with each differing segment of the new annotation.
"""


def compare_annotations(before: Annotation, after: Annotation) -> AnnotationDifference:
    """Describe the differences between two annotations.

    Segments are matched in order, at the least total cost. A pair with the same label costs little if its ranges
    overlap, or if they overlap after the shift that most segments have in common. A pair with different labels is
    matched only if its ranges overlap by more than a half.

    Parameters
    ----------
    before, after : Annotation    the two documents

    Returns
    -------
    AnnotationDifference    changes in the order of their frames

    Raises
    ------
    AnnotationError    if the annotations have too many differing segments or keyframes
    """
    segments = (
        SegmentChange(
            before=None if old is None else before.segments[old], after=None if new is None else after.segments[new]
        )
        for old, new in _match(_of_segments(before), _of_segments(after))
    )
    keyframes = (
        KeyframeChange(
            before=None if old is None else before.keyframes[old], after=None if new is None else after.keyframes[new]
        )
        for old, new in _match(_of_keyframes(before), _of_keyframes(after))
    )
    return AnnotationDifference(
        segment_count=(len(before.segments), len(after.segments)),
        segments=tuple(one for one in segments if one.before != one.after),
        keyframe_count=(len(before.keyframes), len(after.keyframes)),
        keyframes=tuple(one for one in keyframes if one.before != one.after),
    )


def _of_segments(annotation: Annotation) -> list[Segment]:
    return [Segment(one.label, one.start, one.end) for one in annotation.segments]


def _of_keyframes(annotation: Annotation) -> list[Segment]:
    """Return keyframes as segments of one frame."""
    return [Segment(one.label, one.frame, one.frame + 1) for one in annotation.keyframes]


def _match(before: Sequence[Segment], after: Sequence[Segment]) -> list[tuple[int | None, int | None]]:
    """Match the entries of two ordered lists; return the indices of each pair.

    An entry without a match is paired with None. Equal entries at the beginning of both lists, or at the end of both
    lists, are left out.
    """
    shortest = min(len(before), len(after))
    head = next((place for place in range(shortest) if before[place] != after[place]), shortest)
    tail = next((n for n in range(shortest - head) if before[-1 - n] != after[-1 - n]), shortest - head)
    old, new = before[head : len(before) - tail], after[head : len(after) - tail]
    if len(old) * len(new) > MOST_PAIRS:
        raise AnnotationError(
            f"too many segments or keyframes differ to be compared: {len(old):,} of the old and {len(new):,} of the "
            "new annotation; compare annotations with fewer changes",
            code="too-many-entries",
        )
    labels = {one.label: number for number, one in enumerate((*old, *new))}
    columns = [
        np.array([(labels[one.label], one.start, one.end) for one in entries], dtype=np.int64).reshape(-1, 3)
        for entries in (old, new)
    ]
    return [
        (None if row is None else head + row, None if column is None else head + column)
        for row, column in _cheapest_pairs(_pair_costs(columns[0], columns[1]))
    ]


def _pair_costs(before: Ints, after: Ints) -> Floats:
    """Compute the costs (n, m) of pairing n entries with m entries, given as rows (label number, start, end)."""
    same = before[:, None, 0] == after[None, :, 0]
    costs = np.minimum(
        _range_costs(before, after), SHIFTED + _range_costs(before + _common_shift(before, after), after)
    )
    return np.asarray(np.where(same, costs, OTHER_LABEL + costs), dtype=np.float64)


def _range_costs(before: Ints, after: Ints) -> Floats:
    """Compute the costs (n, m) of pairing ranges: 0 for equal ranges, 1 for ranges that do not overlap.

    The cost is 1 minus a ratio: the number of common frames, divided by the number of frames from the first start to
    the last end.
    """
    common = np.minimum(before[:, None, 2], after[None, :, 2]) - np.maximum(before[:, None, 1], after[None, :, 1])
    whole = np.maximum(before[:, None, 2], after[None, :, 2]) - np.minimum(before[:, None, 1], after[None, :, 1])
    return np.asarray(1.0 - np.maximum(common, 0) / whole, dtype=np.float64)


def _common_shift(before: Ints, after: Ints) -> Ints:
    """Find the most frequent shift d between entries of the same label and length; 0 if there are no such entries.

    Returns (0, d, d), which is added to a row (label number, start, end) in order to shift it.
    """
    alike = (before[:, None, 0] == after[None, :, 0]) & (
        before[:, None, 2] - before[:, None, 1] == after[None, :, 2] - after[None, :, 1]
    )
    shifts = (after[None, :, 1] - before[:, None, 1])[alike]
    if not len(shifts):
        return np.zeros(3, dtype=np.int64)
    found, counts = np.unique(shifts, return_counts=True)
    shift = found[np.lexsort((np.abs(found), -counts))[0]]
    return np.array([0, shift, shift])


def _cheapest_pairs(costs: Floats) -> list[tuple[int | None, int | None]]:
    """Match rows and columns in order at the least cost; each row or column without a match costs `ALONE`."""
    rows, columns = costs.shape
    steps = ALONE * np.arange(columns + 1)
    totals = np.empty((rows + 1, columns + 1))
    totals[0] = steps
    for row in range(rows):
        entered = totals[row] + ALONE
        entered[1:] = np.minimum(entered[1:], totals[row, :-1] + costs[row])
        totals[row + 1] = np.minimum.accumulate(entered - steps) + steps
    pairs: list[tuple[int | None, int | None]] = []
    row, column = rows, columns
    while row or column:
        total = totals[row, column] - 1e-9
        if row and column and totals[row - 1, column - 1] + costs[row - 1, column - 1] - 2e-9 <= total:
            row, column = row - 1, column - 1
            pairs.append((row, column))
        elif row and totals[row - 1, column] + ALONE - 2e-9 <= total:
            row -= 1
            pairs.append((row, None))
        else:
            column -= 1
            pairs.append((None, column))
    return pairs[::-1]
