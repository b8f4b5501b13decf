"""Axis of canonical time, the common time to which examples are aligned, in figures of alignments and models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from marey_reports.drawing.paper import QUIET, shortened, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CANONICAL_TIME = "canonical time (%)"
LONGEST_LABEL = 24


def percents(frame_count: int) -> NDArray[np.float64]:
    """Return the canonical time (N,), in percent, of each of `frame_count` (N) canonical frames."""
    return np.linspace(0.0, 100.0, frame_count)


def mark_keyframes(panel: Axes, keyframes: Mapping[str, int], frame_count: int, *, named: bool = True) -> None:
    """Draw a vertical line at each keyframe except the first and last frame, and write its labels along the line."""
    labels: dict[int, list[str]] = {}
    for label, frame in keyframes.items():
        if 0 < frame < frame_count - 1:
            labels.setdefault(frame, []).append(label)
    for frame, names in sorted(labels.items()):
        place = 100.0 * frame / max(frame_count - 1, 1)
        panel.axvline(place, color=QUIET, lw=0.8, ls=(0, (1.5, 2.0)))
        if named:
            text = shortened(", ".join(names), LONGEST_LABEL)
            look = {"transform": panel.get_xaxis_transform(), "rotation": 90, "ha": "right", "va": "top"}
            write(panel, (place - 0.4, 0.985), text, color=QUIET, **look)
