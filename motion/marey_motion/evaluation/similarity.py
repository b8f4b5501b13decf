"""Similarity of the poses in each cell of the coverage map, across clips.

A cell may have enough data, and yet be useless for motion matching because the poses of different clips are never close
enough to blend. A frame belongs to the cell of the one-second window that begins with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.selection import clips_by_source
from marey_motion.evaluation.perceived import PerceivedRows
from marey_motion.evaluation.result import Coverage
from marey_motion.evaluation.running import CancelCallback, EvaluationCancelled
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.documents.metrics import MetricIdentity

ProgressCallback = Callable[[int, int, str], None]

MOST_FRAMES = 2_000
"""Maximum number of frames of a cell that are measured; if the cell has more frames, every k-th frame is measured. The
nearest frame is searched for among all frames of the cell.
"""


@dataclass(frozen=True, eq=False)
class PoseSimilarity:
    """Distances from frames to the nearest frame of another source clip in the same cell of the coverage map.

    The map has V speeds and O turn rates.

    Parameters
    ----------
    threshold : largest distance of two frames that can be blended
    frames, sources : (V, O) int64    numbers of frames and of sources in the cell; a clip and its mirrored copy are one
        source
    measured : (V, O) int64    number of frames compared; if a cell has more than `MOST_FRAMES`, evenly spaced frames
        are chosen
    distance : (V, O) median distance; NaN with fewer than two sources
    blendable_share : (V, O) share of the measured frames within the threshold; 0 if the cell has one source, NaN if it
        has no frames
    share : mean of `blendable_share`, weighted by the frames of each cell; None if there are no frames
    metric : the perceptual metric of the distances; if None, a distance is the sum of the distances between pose joints
        in metres
    """

    threshold: float
    frames: NDArray[np.int64]
    sources: NDArray[np.int64]
    measured: NDArray[np.int64]
    distance: Floats
    blendable_share: Floats
    share: float | None
    metric: MetricIdentity | None = None


def accepted_distance(records: Sequence[TrialRecord]) -> float | None:
    """Compute the median pose cost of the transitions that motion matching made.

    Parameters
    ----------
    records : sequence of TrialRecord    simulated ticks of each trial

    Returns
    -------
    float or None    metres; None if there are no transitions
    """
    costs = [record.pose_cost[:-1][record.status[1:] == Status.REPLACING] for record in records]
    joined = np.concatenate([np.empty(0), *costs])
    return float(np.median(joined)) if len(joined) else None


def measure_similarity(
    database: MatchingDatabase,
    coverage: Coverage,
    threshold: float,
    *,
    perceived_rows: PerceivedRows | None = None,
    most_frames: int = MOST_FRAMES,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> PoseSimilarity:
    """Compare the frames in each cell of the coverage map with the frames of other source clips in the same cell.

    Distances are exact. Progress counts cells with frames.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    coverage : Coverage    coverage of the clips
    threshold : float    distance up to which a frame can be blended, usually `accepted_distance`; in metres or, with
        `perceived_rows`, in the distance of the metric
    perceived_rows : PerceivedRows, optional    rows of `database`, prepared for a perceptual metric; if None, distances
        are in metres
    most_frames : int    greatest number of frames compared per cell
    progress : callable, optional    called as progress(done, total, name)
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    PoseSimilarity    distances and shares per cell

    Raises
    ------
    MotionError    if the threshold is not above 0
    EvaluationCancelled    if cancelled
    """
    if not (np.isfinite(threshold) and threshold > 0.0):
        raise MotionError("the threshold must be a distance above 0", where="threshold")
    shape = coverage.seconds.shape
    rows, cells = window_rows(database, coverage), window_cells(coverage)
    groups = source_of_rows(database)
    frames, sources, measured = (np.zeros(shape, dtype=np.int64) for _ in range(3))
    distance, share = np.full(shape, np.nan), np.full(shape, np.nan)
    filled = np.unique(cells[cells >= 0])
    for done, cell in enumerate(filled.tolist()):
        if cancelled is not None and cancelled():
            raise EvaluationCancelled(f"the comparison of grid cells was stopped after {done} of {len(filled)} cells")
        own, place = rows[cells == cell], divmod(cell, shape[1])
        chosen = every_kth(own, most_frames)
        found = _nearest_rows(database, perceived_rows, chosen, own, groups)
        frames[place], sources[place], measured[place] = len(own), len(np.unique(groups[own])), len(chosen)
        share[place] = np.mean(found <= threshold)
        if sources[place] > 1:
            distance[place] = np.median(found)
        if progress is not None:
            progress(done + 1, len(filled), "")
    total = int(frames.sum())
    overall = float(np.nansum(share * frames) / total) if total else None
    metric = None if perceived_rows is None else MetricIdentity.of(perceived_rows.document)
    return PoseSimilarity(threshold, frames, sources, measured, distance, share, overall, metric)


def _nearest_rows(
    database: MatchingDatabase,
    perceived_rows: PerceivedRows | None,
    chosen: NDArray[np.int64],
    own: NDArray[np.int64],
    groups: NDArray[np.int64],
) -> Floats:
    """Compute the distance of each row of `chosen` from the nearest row of `own` that is in another group."""
    if perceived_rows is not None:
        return perceived_rows.nearest(chosen, groups[chosen], perceived_rows, own, groups[own])
    return nearest_poses(database.pose_points[chosen], groups[chosen], database.pose_points[own], groups[own])


def every_kth(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Select evenly spaced entries of a list of rows.

    Parameters
    ----------
    rows : (n,) int64    the rows
    most : int    largest number of rows to keep

    Returns
    -------
    (m,) int64    every k-th row, with the smallest k that keeps at most `most` rows
    """
    return rows[:: max(1, -(-len(rows) // most))]


def window_rows(database: MatchingDatabase, coverage: Coverage) -> NDArray[np.int64]:
    """Find the first row of each window of the coverage.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    coverage : Coverage    W windows

    Returns
    -------
    (W,) int64    database rows
    """
    clips = coverage.clip.astype(np.int64)
    firsts = np.concatenate(([True], np.diff(clips) != 0))[: len(clips)]
    numbers = np.arange(len(clips))
    within = numbers - np.maximum.accumulate(np.where(firsts, numbers, 0))
    rows: NDArray[np.int64] = database.starts[clips] + within
    return rows


def window_cells(coverage: Coverage) -> NDArray[np.int64]:
    """Find the cell of the coverage map in which each window lies.

    Parameters
    ----------
    coverage : Coverage    W windows

    Returns
    -------
    (W,) int64    flat index of the cell, -1 outside the map
    """
    shape = coverage.seconds.shape
    speeds = np.searchsorted(coverage.speed_edges_m_s, coverage.speed_m_s, side="right") - 1
    turns = np.searchsorted(coverage.turn_rate_edges_deg_s, np.degrees(coverage.turn_rate_rad_s), side="right") - 1
    inside = (speeds >= 0) & (speeds < shape[0]) & (turns >= 0) & (turns < shape[1])
    return np.where(inside, speeds * shape[1] + turns, -1)


def source_of_rows(database: MatchingDatabase) -> NDArray[np.int64]:
    """Number the source clips, and find the number of each row's source clip.

    Parameters
    ----------
    database : MatchingDatabase    N rows

    Returns
    -------
    (N,) int64    number of the source; a clip and its mirrored copy have the same source
    """
    of_clip = np.empty(len(database.clips), dtype=np.int64)
    for number, own in enumerate(clips_by_source(database.clips).values()):
        of_clip[list(own)] = number
    return of_clip[database.clip_of_row]


def nearest_poses(
    queries: NDArray[np.float32],
    query_groups: NDArray[np.int64],
    points: NDArray[np.float32],
    groups: NDArray[np.int64],
) -> Floats:
    """Compute the distance of each query from the nearest pose of another group.

    Parameters
    ----------
    queries : (Q, P, 3) float32    points in metres
    query_groups : (Q,) int64    group of each query
    points : (N, P, 3) float32    points in metres
    groups : (N,) int64    group of each pose

    Returns
    -------
    (Q,) float64    metres, summed over the points like the pose cost of a transition; infinite if there is no other
        group
    """
    from marey_motion.evaluation import similarity_kernels as kernels

    found = np.full(len(queries), np.inf)
    if len(points):
        kernels.nearest_of_others(queries, query_groups, points, groups, found)
    return found
