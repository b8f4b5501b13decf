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
LETTER_IN = 0.058
"""Mean width of a letter in the name of a keyframe, in inches."""
LEAST_BELOW_NAMES = 0.5
"""Least share of the height of a panel that curves can have below the names of keyframes."""


def percents(frame_count: int) -> NDArray[np.float64]:
    """Return the canonical time (N,), in percent, of each of `frame_count` (N) canonical frames."""
    return np.linspace(0.0, 100.0, frame_count)


def mark_keyframes(panel: Axes, keyframes: Mapping[str, int], frame_count: int, *, named: bool = True) -> None:
    """Draw a vertical line at each keyframe except the first and last frame, and write its labels along the line."""
    for frame, text in _names(keyframes, frame_count).items():
        place = 100.0 * frame / max(frame_count - 1, 1)
        panel.axvline(place, color=QUIET, lw=0.8, ls=(0, (1.5, 2.0)))
        if named:
            look = {"transform": panel.get_xaxis_transform(), "rotation": 90, "ha": "right", "va": "top"}
            write(panel, (place - 0.4, 0.985), text, color=QUIET, **look)


def limit_above(highest: NDArray[np.float64], keyframes: Mapping[str, int], height_in: float) -> float:
    """Return the upper limit of a panel `height_in` inches high whose named keyframes do not lie over its curves.

    `highest` (N,) is the highest value at each canonical frame; the lower limit is 0.
    """
    limit = 1.04 * float(highest.max())
    for frame, text in _names(keyframes, len(highest)).items():
        below_text = max(0.985 - LETTER_IN * len(text) / height_in, LEAST_BELOW_NAMES)
        limit = max(limit, float(highest[frame]) / below_text)
    return limit


def _names(keyframes: Mapping[str, int], frame_count: int) -> dict[int, str]:
    """Return the text for each keyframe, by frame in ascending order: its labels, joined and shortened.

    Keyframes in the first and in the last frame of the clip are left out.
    """
    labels: dict[int, list[str]] = {}
    for label, frame in keyframes.items():
        if 0 < frame < frame_count - 1:
            labels.setdefault(frame, []).append(label)
    return {frame: shortened(", ".join(names), LONGEST_LABEL) for frame, names in sorted(labels.items())}
