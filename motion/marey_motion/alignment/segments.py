"""Labelled cuts that all examples of an action share, and alignments that keep them."""

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
    """A frame that is known in every example of an action, under the same labels."""

    labels: tuple[str, ...]
    frame: int


class Sections(NamedTuple):
    """The frames between which a motion is aligned: its first and last one, and the cuts in between.

    Parameters
    ----------
    bounds : increasing frames, the first 0 and the last one the motion's last: neighbours bound a section and belong to
        both sections beside them
    labels : the labels of each bound, none where only the motion begins or ends there
    """

    bounds: tuple[int, ...]
    labels: tuple[tuple[str, ...], ...]

    @property
    def keyframes(self) -> dict[str, int]:
        """Frame by label."""
        return {label: frame for frame, labels in zip(self.bounds, self.labels, strict=True) for label in labels}


def cuts_of(layer: Layer) -> tuple[Cut, ...]:
    """The cuts that an annotation makes: keyframes, and where segments begin or end.

    A segment begins under its own label. It ends as `end of <label>` unless another segment begins there or the clip
    ends with it. A label that stands several times is numbered: `step`, `step 2`, `step 3`.
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
        raise AnnotationError("stands twice once labels are numbered", code="label-repeats", where=repeated[0])
    return cuts


def sections_of(cuts: Sequence[Cut], frame_count: int, *, rate_ratio: float = 1.0) -> Sections:
    """The sections of a motion of so many frames, at `rate_ratio` times the rate that the cuts count in.

    Raises `AnnotationError` where that leaves a section without two frames.
    """
    last = frame_count - 1
    bounds: dict[int, tuple[str, ...]] = {0: (), last: ()}
    for cut in cuts:
        frame = min(round(cut.frame * rate_ratio), last)
        if bounds.get(frame):
            raise AnnotationError(
                f"it falls on the same frame as {', '.join(bounds[frame])}; a section needs two frames",
                code="section-too-short",
                where=", ".join(cut.labels),
            )
        bounds[frame] = cut.labels
    frames = tuple(sorted(bounds))
    return Sections(frames, tuple(bounds[frame] for frame in frames))


def common_labels(all_labels: Mapping[str, tuple[tuple[str, ...], ...]]) -> tuple[tuple[str, ...], ...]:
    """The labels of bounds that most examples have, given by uid; of several, those of the first example."""
    counts = Counter(all_labels.values())
    most = max(counts.values())
    return next(labels for labels in all_labels.values() if counts[labels] == most)


def require_labels(own: tuple[tuple[str, ...], ...], common: tuple[tuple[str, ...], ...]) -> None:
    """Raises `AnnotationError` where an example's cuts are not, in order, those of the others."""
    if own != common:
        raise AnnotationError(
            f"it has the cuts {_shown(own)}, the others have {_shown(common)}: all need the same labels in one order",
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
    """Alignments of all sections, put together.

    Parameters
    ----------
    path : (L, 2) from the first to the last frames of both motions, through each pair of bounds once
    total : sum of the costs along it
    times : (N,) source frame at each frame of the reference
    """

    path: NDArray[np.int32]
    total: float
    times: Floats

    @property
    def mean_cost(self) -> float:
        """Cost per cell of the path."""
        return self.total / len(self.path)


def align_sections(
    costs: Floats,
    reference: Sequence[int],
    source: Sequence[int],
    align: Callable[[Floats], Alignment],
) -> SectionedAlignment:
    """Align two motions section by section: each pair of bounds is matched with each other.

    Parameters
    ----------
    costs : (N, M) of reference and source frames
    reference, source : as many bounds of each, from 0 to N - 1 and to M - 1
    align : finds the way through the costs of one section

    Raises what `align` raises, and `MotionError` for sections without two frames.
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
