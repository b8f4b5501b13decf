"""Clips that a suite of trials never needs, and ranges of the other clips that it never needs.

Removing these clips and ranges from the database leaves every trial bit-identical, as long as the normaliser stays the
same; `resimulation` explains why for whole clips. The needed frames are those that a trial displayed or chose. A frame
of a used clip is unneeded if it is far from every needed frame, in two respects:

* It is more than `MARGIN_BEFORE_S` before the needed frame, or more than the look-ahead plus `MARGIN_AFTER_S` after it.
* It is outside the `reselect_window_s` around the needed frame. Within this window, a search may not choose rows of the
  displayed clip; a cut there would turn these rows into rows of another clip, which may be chosen.

Removing the rows of unneeded frames changes neither the needed rows, nor the rows that follow them, nor their features.
The margins also contain all frames from which filters and differences computed the features of needed frames. If the
recording itself is cut instead, it is sampled and filtered again, which rounds differently, and frames near the cut
have no frames to look ahead to. The trials then stay nearly, but not exactly, the same, so a cut of the recording is
not reported as safe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.improvement.resimulation import needed_rows
from marey_motion.evaluation.improvement.selection import clips_by_source
from marey_motion.evaluation.scenario import Trial
from marey_motion.matching.copies import index_of
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import SearchIndex
from marey_motion.matching.simulation_root import DIRECTION_WINDOW_S
from marey_schemas.options.evaluation import EvaluationOptions

LEAST_RANGE_S = 0.5
"""Duration below which an unused range is not reported, because a cut would save too little."""
DIFFERENCES_S = 0.05
MARGIN_BEFORE_S = 0.5 * DIRECTION_WINDOW_S + DIFFERENCES_S
MARGIN_AFTER_S = MARGIN_BEFORE_S


@dataclass(frozen=True)
class UnusedClip:
    """A source clip that no trial needs: neither the clip itself nor its mirrored copy is needed."""

    source: str
    name: str
    seconds: float


@dataclass(frozen=True)
class UnusedRange:
    """Frames [start, stop) of a source clip that no trial needs, neither from the clip nor from its mirrored copy.

    Frames are counted at the database's rate from the clip's first row. Times are counted from the start of the
    recording, which can be before the first row.
    """

    source: str
    name: str
    start: int
    stop: int
    start_s: float
    stop_s: float

    @property
    def seconds(self) -> float:
        """Seconds of data saved."""
        return self.stop_s - self.start_s


@dataclass(frozen=True, eq=False)
class Unused:
    """Data whose removal changes no trial: whole source clips, ranges of other clips, and a mask (N,) of these rows."""

    clips: tuple[UnusedClip, ...]
    ranges: tuple[UnusedRange, ...]
    rows: NDArray[np.bool_]

    @property
    def seconds(self) -> float:
        """Seconds saved by removing all of this data, without mirrored copies."""
        return sum(clip.seconds for clip in self.clips) + sum(part.seconds for part in self.ranges)


def find_unused(
    database: MatchingDatabase,
    trials: Sequence[Trial],
    records: Sequence[TrialRecord],
    options: EvaluationOptions,
    *,
    index: SearchIndex | None = None,
    shown: NDArray[np.bool_] | None = None,
) -> Unused:
    """Find the source clips, and ranges of frames of other clips, that no trial needs, the longest first.

    A loop whose playback wraps from its end to its start is removed either as a whole or not at all.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    trials : sequence of Trial    the trials
    records : sequence of TrialRecord    simulated ticks of each trial
    options : EvaluationOptions    options of the evaluation
    index : SearchIndex, optional    the index that the trials were run with, built if None
    shown : (N,) bool, optional    rows that were displayed in replicates without a record, and are needed, too

    Returns
    -------
    Unused    sources, ranges and rows
    """
    needed = _needed(database, trials, records, options, index)
    if shown is not None:
        needed |= shown
    rate = database.options.rate_hz
    # Searches may not choose rows of the displayed clip near the displayed row, so these rows must stay in one clip.
    barred = int(np.ceil(options.controller.reselect_window_s * rate)) + 1
    before = max(barred, int(np.ceil(MARGIN_BEFORE_S * rate)))
    after = max(barred, int(np.ceil((max(database.options.horizons_s) + MARGIN_AFTER_S) * rate)))
    clips: list[UnusedClip] = []
    ranges: list[UnusedRange] = []
    rows = np.zeros(database.row_count, dtype=np.bool_)
    for source, members in clips_by_source(database.clips).items():
        own = [database.clips[index] for index in members]
        wanted = np.any([needed[clip.start : clip.stop] for clip in own], axis=0)
        name = min(own, key=lambda clip: clip.mirrored_from is not None).name
        if not wanted.any():
            clips.append(UnusedClip(source, name, len(wanted) / rate))
            spans = [(0, len(wanted))]
        elif any(clip.loop for clip in own) and database.options.end_policy == "loop":
            continue
        else:
            spans = _gaps(wanted, before, after, int(np.ceil(LEAST_RANGE_S * rate)))
            first_s = own[0].first_s
            ranges += [
                UnusedRange(source, name, *span, first_s + span[0] / rate, first_s + span[1] / rate) for span in spans
            ]
        for clip in own:
            for start, stop in spans:
                rows[clip.start + start : clip.start + stop] = True
    clips.sort(key=lambda clip: (-clip.seconds, clip.source))
    ranges.sort(key=lambda part: (part.start - part.stop, part.source, part.start))
    return Unused(tuple(clips), tuple(ranges), rows)


def _needed(
    database: MatchingDatabase,
    trials: Sequence[Trial],
    records: Sequence[TrialRecord],
    options: EvaluationOptions,
    index: SearchIndex | None,
) -> NDArray[np.bool_]:
    if index is None:
        index = index_of(database)
    needed = np.zeros(database.row_count, dtype=np.bool_)
    for trial, record in zip(trials, records, strict=True):
        needed[needed_rows(database, index, trial, record, options)] = True
    return needed


def _gaps(needed: NDArray[np.bool_], before: int, after: int, least: int) -> list[tuple[int, int]]:
    """Find the ranges [start, stop) of at least `least` frames that are far from every needed frame.

    A frame is far if it is more than `before` frames before the needed frame, or more than `after` frames after it.
    """
    count = len(needed)
    edges = np.zeros(count + 1, dtype=np.int64)
    frames = np.flatnonzero(needed)
    np.add.at(edges, np.maximum(frames - before, 0), 1)
    np.add.at(edges, np.minimum(frames + after + 1, count), -1)
    free = np.concatenate(([False], np.cumsum(edges[:-1]) == 0, [False]))
    bounds = np.flatnonzero(np.diff(free.astype(np.int8))).reshape(-1, 2)
    return [(int(start), int(stop)) for start, stop in bounds if stop - start >= least]
