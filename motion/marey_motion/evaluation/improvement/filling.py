"""Clips of other collections that would fill the holes in the coverage of a set of clips."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.evaluation.coverage import measure_coverage
from marey_motion.evaluation.improvement.effects import Effect
from marey_motion.evaluation.improvement.selection import clips_by_source, same_skeleton
from marey_motion.evaluation.perceived import PerceivedRows
from marey_motion.evaluation.result import Coverage
from marey_motion.evaluation.running import CancelCallback, EvaluationCancelled
from marey_motion.evaluation.similarity import every_kth, nearest_poses, window_cells, window_rows
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.options.evaluation import EvaluationOptions

ProgressCallback = Callable[[int, int, str], None]

MOST_FRAMES = 200
"""Maximum number of frames of a candidate clip that are compared with the set.

If more frames of the candidate lie in cells that lack data, every k-th of these frames is compared.
"""


@dataclass(frozen=True)
class FilledCell:
    """A cell of the grid that lacks data, and the number of missing seconds that a candidate clip provides."""

    speed_m_s: float
    turn_rate_deg_s: float
    filled_s: float
    deficit_s: float


@dataclass(frozen=True)
class Filling:
    """A source clip with data for cells that lack data, together with its mirrored copy if its collection contains one.

    Parameters
    ----------
    collection : name of the collection that contains the clip
    seconds : duration of the clip
    cells : the cells that the clip helps to fill; the cell that gains most seconds comes first
    filled_s : missing seconds that the clip provides, summed over the cells
    blendable_share : share of the clip's frames in these cells that can be blended with a frame of the set; None if the
        clip has another skeleton
    measured : number of frames compared
    needs_retarget : whether the clip has another skeleton, and must be retargeted before `blendable_share` can be
        measured
    score : `filled_s` times `blendable_share`, by which candidates are ranked; candidates without a share come after
        all others, ranked by `filled_s`
    coverage_index : coverage index of the set after this clip is added
    """

    collection: str
    source: str
    name: str
    seconds: float
    cells: tuple[FilledCell, ...]
    filled_s: float
    blendable_share: float | None
    measured: int
    needs_retarget: bool
    score: float | None
    coverage_index: float


@dataclass(frozen=True)
class Addition:
    """One step of filling: a candidate clip, and its gain after the candidates of all earlier steps were added.

    `confirmed` is the effect of the step on the trials, corrected for the number of simulated steps; None if the step
    was not simulated.
    """

    filling: Filling
    filled_s: float
    coverage_index: float
    confirmed: Effect | None = None


def rank_fillings(
    database: MatchingDatabase,
    coverage: Coverage,
    collections: Mapping[str, MatchingDatabase],
    options: EvaluationOptions,
    threshold: float,
    *,
    perceived_rows: PerceivedRows | None = None,
    most_frames: int = MOST_FRAMES,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> tuple[Filling, ...]:
    """Rank the source clips of other collections that contain data missing from the set, the best first.

    Parameters
    ----------
    database : MatchingDatabase    the set
    coverage : Coverage    coverage of the set
    collections : mapping of str to MatchingDatabase    databases by name, of any skeleton, at the set's frame rate
    options : EvaluationOptions    grid and minimum seconds per cell
    threshold : float    distance up to which a frame can be blended, in metres or, with `perceived_rows`, in the
        distance of the metric
    perceived_rows : PerceivedRows, optional    rows of the set, prepared for a perceptual metric; None for distances in
        metres
    most_frames : int    greatest number of frames compared per source
    progress : callable, optional    called as progress(sources done, total, name)
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    tuple of Filling    the best first

    Raises
    ------
    EvaluationCancelled    if cancelled
    """
    seconds = {name: source_seconds(other, options) for name, other in collections.items()}
    total, done = sum(map(len, seconds.values())), 0
    found: list[Filling] = []
    for name, other in collections.items():
        comparable = same_skeleton(database, other)
        present = set(clips_by_source(database.clips)) if comparable else set()
        nearest = _nearest_of_set(database, other, perceived_rows)
        for source, (own, rows, cells) in seconds[name].items():
            if cancelled is not None and cancelled():
                raise EvaluationCancelled(f"the comparison was stopped after {done} of {total} candidates")
            filled = np.minimum(own, coverage.deficit_s)
            if source not in present and filled.any():
                useful = rows[np.isin(cells, np.flatnonzero(filled))]
                chosen = every_kth(useful, most_frames) if comparable else useful[:0]
                share = float(np.mean(nearest(chosen) <= threshold)) if comparable else None
                found.append(_filling(name, other, source, own, coverage, options, share, len(chosen)))
            done += 1
            if progress is not None:
                progress(done, total, source)
    return tuple(sorted(found, key=_rank))


def plan_fillings(
    fillings: Sequence[Filling],
    coverage: Coverage,
    collections: Mapping[str, MatchingDatabase],
    options: EvaluationOptions,
) -> tuple[Addition, ...]:
    """Order candidate clips: each step adds the clip that supplies the most seconds of data that are still missing.

    The seconds that a candidate supplies are multiplied by its `blendable_share`; a candidate with a share of 0 is left
    out. Candidates of another skeleton come after all others. The list ends when no candidate supplies missing data any
    more.

    Parameters
    ----------
    fillings : sequence of Filling    result of `rank_fillings`
    coverage : Coverage    coverage of the set
    collections : mapping of str to MatchingDatabase    databases by name, as for `rank_fillings`
    options : EvaluationOptions    grid and minimum seconds per cell

    Returns
    -------
    tuple of Addition    in order
    """
    seconds = {name: source_seconds(other, options) for name, other in collections.items()}
    missing = coverage.deficit_s.copy()
    left = list(fillings)
    steps: list[Addition] = []
    while left:
        gains = [float(np.minimum(seconds[one.collection][one.source][0], missing).sum()) for one in left]
        ranked = sorted(
            (one.needs_retarget, -gain * (1.0 if one.blendable_share is None else one.blendable_share), number)
            for number, (one, gain) in enumerate(zip(left, gains, strict=True))
            if gain > 0.0 and one.blendable_share != 0.0
        )
        if not ranked:
            break
        number = ranked[0][2]
        chosen = left.pop(number)
        missing = _less(missing, seconds[chosen.collection][chosen.source][0], options)
        steps.append(Addition(chosen, gains[number], float(np.mean(missing == 0.0))))
    return tuple(steps)


def source_seconds(
    database: MatchingDatabase, options: EvaluationOptions
) -> dict[str, tuple[Floats, NDArray[np.int64], NDArray[np.int64]]]:
    """Compute the seconds of data that each source clip has in each cell of the trial grid.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    the grid

    Returns
    -------
    dict of str to (seconds, rows, cells)    for each source: the seconds (V, O) in each cell; the first row of each
        window; and the flat index of each window's cell, -1 outside the map
    """
    coverage = measure_coverage(database, options)
    rows, cells = window_rows(database, coverage), window_cells(coverage)
    found = {}
    for source, own in clips_by_source(database.clips).items():
        members = np.isin(coverage.clip, own)
        counts = np.bincount(cells[members & (cells >= 0)], minlength=coverage.seconds.size)
        seconds = counts.reshape(coverage.seconds.shape) / database.options.rate_hz
        found[source] = (seconds, rows[members], cells[members])
    return found


def _less(missing: Floats, seconds: Floats, options: EvaluationOptions) -> Floats:
    """Compute the seconds that each cell still lacks: `missing` (V, O) minus the `seconds` (V, O) of added data.

    A value below half a frame is set to 0.
    """
    left = np.maximum(missing - seconds, 0.0)
    left[left < 0.5 / options.database.rate_hz] = 0.0
    return left


def _nearest_of_set(
    database: MatchingDatabase, other: MatchingDatabase, perceived_rows: PerceivedRows | None
) -> Callable[[NDArray[np.int64]], Floats]:
    """Return a function that computes the distances of rows of another database from the nearest row of the set."""
    everything, ones = np.arange(database.row_count), np.ones(database.row_count, dtype=np.int64)
    if perceived_rows is None:
        points = other.pose_points
        return lambda rows: nearest_poses(points[rows], np.zeros_like(rows), database.pose_points, ones)
    theirs = PerceivedRows(other, perceived_rows.document)
    return lambda rows: theirs.nearest(rows, np.zeros_like(rows), perceived_rows, everything, ones)


def _filling(
    collection: str,
    other: MatchingDatabase,
    source: str,
    own: Floats,
    coverage: Coverage,
    options: EvaluationOptions,
    share: float | None,
    measured: int,
) -> Filling:
    filled = np.minimum(own, coverage.deficit_s)
    speeds, turn_rates = np.unique(options.speeds_m_s), np.unique(options.turn_rates_deg_s)
    cells = [
        FilledCell(float(speeds[v]), float(turn_rates[w]), float(filled[v, w]), float(coverage.deficit_s[v, w]))
        for v, w in np.argwhere(filled > 0.0).tolist()
    ]
    clips = [other.clips[index] for index in clips_by_source(other.clips)[source]]
    total = float(filled.sum())
    return Filling(
        collection=collection,
        source=source,
        name=min(clips, key=lambda clip: clip.mirrored_from is not None).name,
        seconds=clips[0].frame_count / other.options.rate_hz,
        cells=tuple(sorted(cells, key=lambda cell: (-cell.filled_s, cell.speed_m_s, cell.turn_rate_deg_s))),
        filled_s=total,
        blendable_share=share,
        measured=measured,
        needs_retarget=share is None,
        score=None if share is None else total * share,
        coverage_index=float(np.mean(_less(coverage.deficit_s, own, options) == 0.0)),
    )


def _rank(filling: Filling) -> tuple[bool, float, float, str, str]:
    return (
        filling.score is None,
        -(filling.filled_s if filling.score is None else filling.score),
        -filling.filled_s,
        filling.collection,
        filling.source,
    )
