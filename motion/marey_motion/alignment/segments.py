"""Labelled cuts that all examples of an action share, and alignments that match these cuts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.alignment.dtw import Alignment
from marey_motion.alignment.warp import time_function
from marey_motion.arrays import Floats
from marey_motion.editing.annotations.layers import Layer
from marey_motion.errors import AnnotationError


class Cut(NamedTuple):
    """Labelled frame that every example of an action must have, such as a keyframe or the border of a segment.

    Parameters
    ----------
    labels : tuple of str    labels of the frame
    frame : int    frame of the clip
    """

    labels: tuple[str, ...]
    frame: int


class Sections(NamedTuple):
    """The frames that divide a motion into sections: its first and last frame, and the cuts in between.

    Parameters
    ----------
    bounds : tuple of int    increasing frames from 0 to the last frame of the motion. Each section lasts from one bound
        to the next, including both bounds.
    labels : tuple of tuples of str    the labels of each bound; empty for a first or last frame without a cut
    """

    bounds: tuple[int, ...]
    labels: tuple[tuple[str, ...], ...]

    @property
    def keyframes(self) -> dict[str, int]:
        """Frame of the motion by label, for all labels of the bounds."""
        return {label: frame for frame, labels in zip(self.bounds, self.labels, strict=True) for label in labels}


def cuts_of(layer: Layer) -> tuple[Cut, ...]:
    """List the cuts that an annotation makes: keyframes, and starts and ends of segments.

    The cut at the start of a segment has the segment's label. The cut at its end has the label `end of <label>`; there
    is no such cut if another segment begins at this frame, or if the clip ends there. A repeated label is numbered:
    `step`, `step 2`, `step 3`.

    Parameters
    ----------
    layer : Layer    segments and keyframes

    Returns
    -------
    tuple of Cut    in the order of time

    Raises
    ------
    AnnotationError    if a label equals the numbered name of a repeated label
    """
    begins = [(segment.start, segment.label) for segment in layer.segments]
    starts = {start for start, _ in begins} | {layer.frame_count}
    ends = [(one.end, f"end of {one.label}") for one in layer.segments if one.end not in starts]
    seen: Counter[str] = Counter()
    frames: dict[int, list[str]] = {}
    for frame, label in sorted([*begins, *ends, *((one.frame, one.label) for one in layer.keyframes)]):
        seen[label] += 1
        frames.setdefault(frame, []).append(label if seen[label] == 1 else f"{label} {seen[label]}")
    cuts = tuple(Cut(tuple(sorted(labels)), frame) for frame, labels in sorted(frames.items()))
    repeated = [label for label, count in Counter(label for cut in cuts for label in cut.labels).items() if count > 1]
    if repeated:
        raise AnnotationError(
            "one cut has this label, and another label that repeats gets the same name when it is numbered; rename one "
            "of the two labels",
            code="label-repeats",
            where=repeated[0],
        )
    return cuts


def sections_of(cuts: Sequence[Cut], frame_count: int, *, rate_ratio: float = 1.0) -> Sections:
    """Compute the sections of a motion.

    Parameters
    ----------
    cuts : sequence of Cut    cuts of the clip
    frame_count : int    frames of the motion
    rate_ratio : float    frame rate of the motion, divided by that of the clip

    Returns
    -------
    Sections    bounds and labels

    Raises
    ------
    AnnotationError    if a section would have fewer than two frames
    """
    last = frame_count - 1
    bounds: dict[int, tuple[str, ...]] = {0: (), last: ()}
    for cut in cuts:
        frame = min(round(cut.frame * rate_ratio), last)
        if bounds.get(frame):
            raise AnnotationError(
                f"the cut is on the same frame as {', '.join(bounds[frame])}, but the section between two "
                "cuts needs at least two frames; move one cut",
                code="section-too-short",
                where=", ".join(cut.labels),
            )
        bounds[frame] = cut.labels
    frames = tuple(sorted(bounds))
    return Sections(frames, tuple(bounds[frame] for frame in frames))


def common_labels(all_labels: Mapping[str, tuple[tuple[str, ...], ...]]) -> tuple[tuple[str, ...], ...]:
    """Find the most frequent list of labels among the examples.

    Parameters
    ----------
    all_labels : mapping of str to tuple    labels of each example's bounds, by uid

    Returns
    -------
    tuple of tuples of str    labels of each bound; among equally frequent lists, the first in `all_labels`
    """
    counts = Counter(all_labels.values())
    most = max(counts.values())
    return next(labels for labels in all_labels.values() if counts[labels] == most)


def require_labels(own: tuple[tuple[str, ...], ...], common: tuple[tuple[str, ...], ...]) -> None:
    """Check that an example has the same cuts in the same order as the other examples.

    Parameters
    ----------
    own, common : tuple of tuples of str    labels of the bounds, in this example and in the other examples

    Raises
    ------
    AnnotationError    if they differ
    """
    if own != common:
        raise AnnotationError(
            f"the annotation cuts the clip at {_shown(own)}, but the other clips at {_shown(common)}; all "
            "annotations need the same labels in the same order",
            code="labels-differ",
        )


def _shown(labels: tuple[tuple[str, ...], ...]) -> str:
    def spelled(group: tuple[str, ...]) -> str:
        return " = ".join(group)

    inner = [spelled(group) for group in labels if group]
    if labels[0]:
        inner[0] += " (first frame)"
    if labels[-1]:
        inner[-1] += " (last frame)"
    return ", ".join(inner) or "none"


class SectionedAlignment(NamedTuple):
    """Alignment of two whole motions, joined from the alignments of their sections.

    Parameters
    ----------
    path : (L, 2) int32    matched frames of reference and source, from the first to the last frame of both; a pair of
        bounds at which two sections meet is contained once
    total : float    sum of the costs along the path, in the unit of the costs
    times : (N,) float64    source frame at each frame of the reference
    """

    path: NDArray[np.int32]
    total: float
    times: Floats

    @property
    def mean_cost(self) -> float:
        """Mean cost per cell of the path, in the unit of the costs."""
        return self.total / len(self.path)


def align_sections(
    costs: Floats,
    reference: Sequence[int],
    source: Sequence[int],
    align: Callable[[Floats], Alignment],
) -> SectionedAlignment:
    """Align two motions section by section, matching each pair of bounds.

    Parameters
    ----------
    costs : (N, M) float64    cost of each pair of a reference frame and a source frame
    reference, source : sequence of int    bounds of the sections in each motion, from 0 to N - 1 and from 0 to M - 1;
        the same number in both
    align : callable    called as align(costs of one section); returns the path through these costs

    Returns
    -------
    SectionedAlignment    the whole path

    Raises
    ------
    MotionError    if a section has fewer than two frames
    """
    paths: list[NDArray[np.int32]] = []
    times: list[Floats] = []
    total = 0.0
    for (start, stop), (own_start, own_stop) in zip(pairwise(reference), pairwise(source), strict=True):
        found = align(costs[start : stop + 1, own_start : own_stop + 1])
        path = found.path + np.array((start, own_start), dtype=np.int32)
        first = 1 if paths else 0  # the bound is the last cell of the section before
        total += found.total - (float(costs[start, own_start]) if first else 0.0)
        paths.append(path[first:])
        times.append(time_function(path)[first:])
    return SectionedAlignment(np.concatenate(paths), total, np.concatenate(times))
